"""Pose, shape and expression coefficients of a linear (morphable) model: robust maximum a posteriori."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from scan2albedo.core import Budget, Meter, PlanStep, ProgressCallback, RawScan, Trace
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import FitError
from scan2albedo.fitting.alignment import SIZE_SD
from scan2albedo.fitting.options import GATE_MM, FitOptions
from scan2albedo.fitting.result import RESIDUAL_GATE_MM, FittedFace, residuals_mm
from scan2albedo.fitting.scan_surface import ScanSurface, scan_near_model
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.mesh import normalized, vertex_areas, vertex_normals
from scan2albedo.geometry.rigid import Similarity, procrustes, rotation_from_vector
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.result_records import LinearModelRecord
from scan2albedo.optimization.least_squares import NormalEquations, minimize

FREEDOM = 4.0
"""Degrees of freedom of Student's t (Lange, Little, Taylor, "Robust statistical modeling using the t
distribution", 1989): hair, a lid that is shut and a beard are rare and far."""
JOINT_SD_RAD = 0.2
"""Standard deviation of a joint's rotation about each axis: a jaw opens by some 20 degrees at most."""
FREE_JOINTS = ("neck", "jaw")
MOST_VERTICES, MOST_ROUNDS, TRUSTING_ROUNDS, MOST_PAIRED = 6000, 60, 5, 1500
"""Vertices that are fitted, evenly spread over their numbers: more say the same. Rounds of closest points.
Vertices whose pairs say how errors are correlated."""


@dataclass(frozen=True)
class ModelPlaces:
    """Where a linear model's mean lies on an annotated face model that was fitted to it.

    `points` of the N `vertices` (N,) of its main surface on the fitted surface's faces, trusted where `known`
    (N,); millimetres per unit of the model; whether its faces are wound inward.
    """

    vertices: IntArray
    points: SurfacePoints
    known: BoolArray
    mm_per_unit: float
    inward: bool


@dataclass(frozen=True)
class LinearModelFit:
    """A linear model fitted to a scan, in the frame of the annotated face model, mm.

    `pose` takes the `model`'s own frame and unit there; `coefficients` (K,), `rotations` (J, 3) of the joints
    in radians. `deviation` are standard deviations of the posterior of a turn about each axis [rad], a
    shift [mm], log scale, the free joints' rotations and the coefficients, in this order. `vertices` (V, 3),
    `faces` (F, 3), `uv` (F, 3, 2) or None, outward; `residual_mm` (V,) from the scan, NaN where it has none,
    `displacement_mm` (V,) along the normals, what is left. `noise_mm` is the scale of the residuals, which
    count as `observations` independent ones.
    """

    model: LinearFaceModel
    pose: Similarity
    coefficients: FloatArray
    rotations: FloatArray
    deviation: FloatArray
    mm_per_unit: float
    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None
    residual_mm: FloatArray
    displacement_mm: FloatArray
    noise_mm: float
    observations: float
    converged: bool
    trace: Trace
    plan: tuple[PlanStep, ...]

    def as_template(self, fitted: FittedFace) -> FittedFace:
        """Return a fitted face whose template is this mesh, so that textures are painted on it."""
        model = replace(
            fitted.model,
            template_points=None,
            template_offset=None,
            template_faces=self.faces,
            template_uv=self.uv,
            template_from_model=self.pose.inverse(),
        )
        return replace(fitted, template_vertices=self.vertices, model=model)

    def record(self, scan_from_here: FloatArray) -> LinearModelRecord:
        """Return what `coefficients.json` holds; `scan_from_here` (4, 4): to the scan's frame and unit."""
        model, free = self.model, [name for name in FREE_JOINTS if name in self.model.joints]
        coefficients, deviation = self.coefficients, self.deviation[7 + 3 * len(free) :]
        places = model.joint_mean + model.joint_basis @ coefficients
        turns: Any = self.deviation[7 : 7 + 3 * len(free)].reshape(-1, 3).tolist()
        return LinearModelRecord(
            model=model.name,
            model_sha256=model.sha256,
            shape=coefficients[: model.shapes].tolist(),
            shape_deviation=deviation[: model.shapes].tolist(),
            expression=coefficients[model.shapes :].tolist(),
            expression_deviation=deviation[model.shapes :].tolist(),
            joint_rotations_rad=dict(zip(model.joints, self.rotations.tolist(), strict=True)),
            joint_deviations_rad=dict(zip(free, turns, strict=True)),
            joint_positions=dict(zip(model.joints, places.tolist(), strict=True)),
            scan_from_model=(scan_from_here @ self.pose.matrix()).tolist(),
            mm_per_unit=self.mm_per_unit,
            scale=self.pose.scale / self.mm_per_unit,
            scale_deviation=float(self.deviation[6]),
            rotation_deviation_rad=self.deviation[:3].tolist(),
            translation_deviation_mm=self.deviation[3:6].tolist(),
            noise_mm=self.noise_mm,
            observations=self.observations,
            residual_mean_mm=float(np.nanmean(self.residual_mm)),
            converged=self.converged,
        )


@dataclass(frozen=True)
class _Term:
    """Residuals of some vertices, d along `axes` (N, d, 3), of Student's t with a `scale`."""

    index: IntArray
    target: FloatArray
    axes: FloatArray
    weight: FloatArray
    known: FloatArray
    scale: float = 1.0
    share: float = 1.0
    """Independent observations a vertex: neighbours err together."""

    def residuals(self, points: FloatArray) -> FloatArray:
        return np.einsum("ndj,nj->nd", self.axes, points[self.index] - self.target)

    def trust(self, square: FloatArray) -> FloatArray:
        return (FREEDOM + self.axes.shape[1]) / (FREEDOM + square / self.scale**2)

    def settled(self, points: FloatArray) -> _Term:
        """Return the term with the likeliest scale, and the share that correlations of residuals leave."""
        residual, counts = self.residuals(points), self.weight * self.known
        square, term = np.sum(residual**2, axis=1), self
        level = max(float(np.sqrt(counts @ square / counts.sum())), np.finfo(float).eps)
        term = replace(self, scale=level)
        for _ in range(30):  # expectation maximisation
            total = counts @ (term.trust(square) * square) / (counts.sum() * residual.shape[1])
            term = replace(term, scale=max(float(np.sqrt(total)), 1e-6 * level))
        # Correlation of the influences over distance, summed to where it first vanishes.
        there = np.flatnonzero(counts > 0)
        near = there[np.unique(np.linspace(0, len(there) - 1, MOST_PAIRED).astype(int))]
        where, pull = points[self.index[near]], (term.trust(square)[:, None] * residual)[near]
        first, second = np.triu_indices(len(near), 1)
        spacing = np.median(cKDTree(where).query(where, k=2)[0][:, 1])
        bins = (pdist(where) / spacing).astype(int)
        product = np.bincount(bins, np.einsum("nd,nd->n", pull[first], pull[second]))
        pairs = np.bincount(bins)
        ends = np.flatnonzero((product <= 0) & (pairs > 0))
        within = product[: ends[0] if len(ends) else None].sum()
        crowd = 1 + 2 * within / np.sum(pull**2) * len(there) / len(near)
        return replace(term, share=1 / max(float(crowd), 1.0))


@dataclass(frozen=True)
class _State:
    """A state of the fit, which `minimize` walks over: see `LeastSquaresPoint`."""

    model: LinearFaceModel
    """Of the fitted vertices alone."""
    free: IntArray
    """Numbers of the joints that turn."""
    meter: Meter
    mm_per_unit: float
    pose: Similarity
    coefficients: FloatArray
    rotations: FloatArray
    terms: tuple[_Term, ...] = ()

    @cached_property
    def _posed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        shaped = self.model.mean + self.model.basis @ self.coefficients
        return self.model.posed(shaped, self.coefficients, self.rotations)

    @cached_property
    def points(self) -> FloatArray:
        return self.pose.apply(self._posed[0])

    @cached_property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Precision and value of each parameter but the motion."""
        size, turns = np.log(self.pose.scale / self.mm_per_unit), self.rotations[self.free].ravel()
        tight = [SIZE_SD**-2], np.full(len(turns), JOINT_SD_RAD**-2), np.ones(len(self.coefficients))
        return np.concatenate(tight), np.concatenate([[size], turns, self.coefficients])

    @cached_property
    def cost(self) -> float:
        """Minus the logarithm of the posterior."""
        precision, value = self._prior
        total = float(precision @ value**2) / 2
        for term in self.terms:
            square = np.sum(term.residuals(self.points) ** 2, axis=1) / term.scale**2
            freedom = (FREEDOM + term.axes.shape[1]) / 2
            total += term.share * freedom * float(term.weight @ np.log1p(square / FREEDOM))
        self.meter.count()
        return total

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model, the prior in it."""
        precision, value = self._prior
        count = 6 + len(value)
        matrix, gradient = np.zeros((count, count)), np.zeros(count)
        matrix[range(6, count), range(6, count)] += precision
        gradient[6:] += precision * value
        _, blend, slopes = self._posed
        turns = list[FloatArray]()
        for joint in self.free:
            for axis in range(3):
                moved = self.rotations.copy()
                moved[joint, axis] += 1e-5
                turns.append((replace(self, rotations=moved).points - self.points) / 1e-5)
        for term in self.terms:
            residual = term.residuals(self.points)
            each = term.axes.shape[1]
            index = np.repeat(term.index, each)
            axes, weight = term.axes.reshape(-1, 3), term.weight * term.trust(np.sum(residual**2, axis=1))
            away = self.points[index] - self.pose.translation
            own = self.pose.scale * axes @ self.pose.rotation
            shape = (np.einsum("nij,ni->nj", blend[index], own)[:, None] @ self.model.basis[index])[:, 0]
            for skin, slope in zip(self.model.weights[index].T, slopes, strict=True):
                shape += skin[:, None] * (own @ slope)
            joints = [np.einsum("nj,nj->n", turn[index], axes)[:, None] for turn in turns]
            size = np.einsum("ij,ij->i", away, axes)[:, None]
            rows = np.hstack([np.cross(away, axes), axes, size, *joints, shape])
            weighted = np.repeat(term.share * weight / term.scale**2, each)[:, None] * rows
            matrix += weighted.T @ rows
            gradient += weighted.T @ residual.ravel()
        return NormalEquations(matrix, gradient)

    def moved(self, step: FloatArray) -> _State:
        """Return the state after a step: turn, shift, log scale, joints, coefficients."""
        rotation = rotation_from_vector(step[:3]) @ self.pose.rotation
        scale = self.pose.scale * float(np.exp(step[6]))
        rotations, end = self.rotations.copy(), 7 + 3 * len(self.free)
        rotations[self.free] += step[7:end].reshape(-1, 3)
        pose = Similarity(rotation, self.pose.translation + step[3:6], scale)
        return replace(self, pose=pose, rotations=rotations, coefficients=self.coefficients + step[end:])

    def of_whole(self, model: LinearFaceModel) -> FloatArray:
        """Return all vertices (V, 3) of the model."""
        return self.pose.apply(model.at(self.coefficients, self.rotations))

    def posterior_step(self, other: _State) -> float:
        """Return how far another state is, in standard deviations of the posterior, RMS over coefficients."""
        change = other.coefficients - self.coefficients
        matrix = self.normal_equations().matrix[-len(change) :, -len(change) :]
        return float(np.sqrt(change @ matrix @ change / max(len(change), 1)))


def fit_linear_model(
    scan: RawScan,
    fitted: FittedFace,
    model: LinearFaceModel,
    places: ModelPlaces,
    weight: FloatArray,
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> LinearModelFit:
    """Return the most probable pose, shape, expression and joints' rotations of a linear model on a scan.

    With x_i the model's vertices and coefficients c of unit variance, the logarithm of the posterior is

        -|c|^2 / 2 - (log s / sd)^2 / 2 - |joints / sd|^2 / 2
        + u sum a_i log t(n_i . (x_i - y_i) / sigma) + v sum a_i log t(|x_i - z_i| / tau),

    with y_i the scan's closest point and n_i its normal, found anew each round, z_i the point of the `fitted`
    face where the vertex lies by its place on the mean, Student's t, and the areas a_i. The scales sigma and
    tau are the likeliest of the residuals; u and v, independent observations a vertex, follow from how these
    are correlated over the surface, so that a misfit of the model does not count as thousands of
    measurements. Raises `FitError` when no vertex has a place on the fitted face.

    Parameters
    ----------
    scan, fitted : RawScan, FittedFace
        The face fitted to the scan.
    model, places : LinearFaceModel, ModelPlaces
    weight : (V,) array
        Of each vertex of the `fitted` face, 0 to 1: hair and cloth count nothing.
    budget, on_progress
        See `fit`; the best answer so far is returned with ``converged=False``.
    """
    meter = Meter("linear_model", "mm", Budget.of(budget), on_progress)
    kept = np.unique(np.linspace(0, len(places.vertices) - 1, MOST_VERTICES).astype(int))
    index, known = places.vertices[kept], places.known[kept]
    corners = fitted.faces[places.points.face[kept]]
    shares = places.points.barycentric[kept]
    target = np.einsum("nk,nkj->nj", shares, fitted.vertices[corners])
    skin = np.where(known, np.einsum("nk,nk->n", shares, weight[corners]), 1.0)
    unit, faces = places.mm_per_unit, model.faces[:, ::-1] if places.inward else model.faces
    area = vertex_areas(unit * model.mean, faces)[index]
    counts = skin * area / max(float(area.mean()), np.finfo(float).tiny)
    if not (placed := np.flatnonzero(known & (counts > 0))).size:
        raise FitError(
            f"{scan.name}: no vertex of {model.name} has a place on the part of the face that is skin"
        )
    start = procrustes(unit * model.mean[index][placed], target[placed], weights=counts[placed])
    free = np.array([model.joints.index(name) for name in FREE_JOINTS if name in model.joints], np.int64)
    pose = Similarity(start[:3, :3], start[:3, 3], unit)
    coefficients, rotations = np.zeros(model.basis.shape[2]), np.zeros((len(model.joints), 3))
    state = _State(model.of_vertices(index), free, meter, unit, pose, coefficients, rotations)
    # Every fourth place: they err together over centimetres.
    some = placed[::4]
    axes = np.broadcast_to(np.eye(3), (len(some), 3, 3))
    along = _Term(some, target[some], axes, counts[some], np.ones(len(some)))
    for _ in range(8):
        state = replace(state, terms=(along.settled(state.points),))
        state = minimize(state, steps=2, trials=6, meter=meter).best
    # Settled for good: a face that slides along the scan would excuse itself.
    along = along.settled(state.points)
    whole = state.of_whole(model)
    surface = _surface(scan, fitted, whole[places.vertices])
    normals = vertex_normals(whole, faces)
    surface = surface.turned_outward(whole[places.vertices], normals[places.vertices], GATE_MM[0])
    converged, across = False, along
    for step in range(MOST_ROUNDS):
        whole = state.of_whole(model)
        outward = vertex_normals(whole, faces)[index]
        hits = surface.nearest.query(state.points)
        normal = normalized(surface.normals_at(hits))
        there = ~surface.on_boundary(hits) & (np.einsum("ij,ij->i", normal, outward) > 0) & (counts > 0)
        if not (there & known).any():
            break
        seen = np.flatnonzero(there)
        across = _Term(seen, hits.points[seen], normal[seen, None], counts[seen], known[seen].astype(float))
        across = across.settled(state.points)
        # What a poor fit leaves is correlated, too, and would excuse it: independent at first.
        across = replace(across, share=across.share ** min(step / TRUSTING_ROUNDS, 1))
        before = replace(state, terms=(across, along))
        off = np.abs(across.residuals(state.points)[:, 0])
        meter.record(float(np.average(off, weights=across.weight * across.known)))
        if meter.exhausted:
            break
        state = minimize(before, steps=3, trials=6, meter=meter).best
        if converged := step >= TRUSTING_ROUNDS and before.posterior_step(state) < 1 / 20:
            break
    matrix = state.normal_equations().matrix
    deviation = np.sqrt(np.diag(np.linalg.inv(matrix)))
    vertices = state.of_whole(model)
    residual = residuals_mm(surface, vertices, faces, RESIDUAL_GATE_MM, exact=not meter.out_of_time)
    offset = surface.nearest.query(vertices).points - vertices
    left = np.where(np.isnan(residual), np.nan, np.sum(offset * vertex_normals(vertices, faces), axis=1))
    observations = across.share * float(across.weight.sum())
    evidence = f"{np.nanmean(residual):.3f} mm mean, {observations:.0f} independent observations"
    reason = f"{len(coefficients)} coefficients of {model.name} are fitted"
    steps = [PlanStep("linear_model", True, reason, evidence)]
    if not converged:
        steps.append(PlanStep.doubt("linear_model", "the linear model's fit had not converged when it ended"))
    return LinearModelFit(
        model=model,
        pose=state.pose,
        coefficients=state.coefficients,
        rotations=state.rotations,
        deviation=deviation,
        mm_per_unit=unit,
        vertices=vertices,
        faces=faces,
        uv=model.uv[:, ::-1] if model.uv is not None and places.inward else model.uv,
        residual_mm=residual,
        displacement_mm=left,
        noise_mm=across.scale,
        observations=observations,
        converged=converged,
        trace=meter.trace,
        plan=tuple(steps),
    )


def _surface(scan: RawScan, fitted: FittedFace, points: FloatArray) -> ScanSurface:
    """Return the scan around points (N, 3), without what stands before the eyes."""
    bare = scan if fitted.covered_faces is None else scan.without_faces(fitted.covered_faces)
    low, high = points.min(0) - GATE_MM[0], points.max(0) + GATE_MM[0]
    near = scan_near_model(
        bare.vertices, bare.faces, fitted.model_from_scan, low, high, FitOptions.smoothing_mm
    )
    assert near is not None  # the face was fitted to it
    return near
