"""Pose, shape and expression coefficients of a linear (morphable) model: robust maximum a posteriori."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from scan2albedo.core import BudgetLike, Meter, OnProgress, PlanStep, RawScan, Trace
from scan2albedo.core.arrays import EPSILON, BoolArray, FloatArray, IntArray, attributes, dots
from scan2albedo.errors import FitError
from scan2albedo.fitting.alignment import SIZE_SD
from scan2albedo.fitting.options import GATE_MM, FitOptions
from scan2albedo.fitting.result import NEAR_MM, RESIDUAL_GATE_MM, FittedFace
from scan2albedo.fitting.scan_surface import ScanSurface, scan_near_model
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.mesh import normalized, vertex_areas, vertex_normals
from scan2albedo.geometry.operators import cross_matrices
from scan2albedo.geometry.rigid import Similarity, procrustes, rotation_from_vector
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.records import plain_json
from scan2albedo.io.result_records import LinearModelRecord
from scan2albedo.optimization.least_squares import LocalTerm, NormalEquations, map_equations, minimize
from scan2albedo.statistics.linear_model import Posterior

FREEDOM = 4.0
"""Degrees of freedom of Student's t (Lange, Little, Taylor, "Robust statistical modeling using the t
distribution", 1989): hair, a lid that is shut and a beard are rare and far."""
JOINT_SD_RAD = 0.2
"""Standard deviation of a joint's rotation about each axis: jaws open by some 20 degrees."""
FREE_JOINTS = ("neck", "jaw")
"""Joints that turn."""
SMALL = 1 / 20
"""Part of the scale of the errors, and of a coefficient's posterior deviation, that is little."""


@dataclass(frozen=True)
class LinearModelFit:
    """A linear model fitted to a scan, in the frame of the annotated face model, mm."""

    model: LinearFaceModel
    """As it was placed: with its unit, and faces wound outward."""
    pose: Similarity
    """From the linear model's own frame and unit."""
    coefficients: FloatArray
    rotations: FloatArray
    """(K,), and (J, 3) rotation vectors of the joints, radians."""
    deviation: FloatArray
    """Standard deviations of the posterior: of a turn about each axis [rad], a shift [mm], the log scale, the
    rotations of the joints that turn, and the coefficients, in this order."""
    vertices: FloatArray
    residual_mm: FloatArray
    displacement_mm: FloatArray
    """(V, 3), and (V,) distance to the scan, and its part along the normal; NaN where there is no scan."""
    noise_mm: float
    observations: float
    """Scale of the residuals, and the independent ones that they count as."""
    converged: bool
    trace: Trace
    plan: tuple[PlanStep, ...]

    def as_template(self, fitted: FittedFace) -> FittedFace:
        """Return a fitted face whose template is this mesh, so that textures are painted on it."""
        model = replace(
            fitted.model,
            template_faces=self.model.faces,
            template_uv=self.model.uv,
            template_points=None,
            template_offset=None,
            template_from_model=self.pose.inverse(),
        )
        return replace(fitted, template_vertices=self.vertices, model=model)

    def neutral_and_targets(self) -> tuple[FloatArray, dict[str, FloatArray], FloatArray]:
        """Return the face without expression (V, 3), by ARKit's names how far each blendshape moves its
        vertices (V, 3), and their weights (S,); mm."""
        shape, expression = np.split(self.coefficients, [self.model.shapes])

        def face(weights: FloatArray) -> FloatArray:
            return self.pose.apply(self.model.at(np.append(shape, weights), self.rotations))

        neutral = face(np.zeros(len(expression)))
        shares = self.model.arkit()
        targets = {name: face(share) - neutral for name, share in shares.items()}
        weights = [share @ expression / share.sum() for share in shares.values()]
        return neutral, targets, np.array(weights)

    def record(self, scan_from_here: FloatArray) -> LinearModelRecord:
        """Return what `coefficients.json` holds; `scan_from_here` (4, 4): to the scan's frame and unit."""
        model, free = self.model, [name for name in FREE_JOINTS if name in self.model.joints]
        pose, turns, deviation = np.split(self.deviation, [7, 7 + 3 * len(free)])
        shape, expression = np.split(np.stack([self.coefficients, deviation]), [model.shapes], axis=1)
        positions = model.joint_places.at(self.coefficients)
        _, targets, weights = self.neutral_and_targets()
        content = {
            "model": model.name,
            "model_sha256": model.sha256,
            "shape": shape[0],
            "expression": expression[0],
            "blendshapes": dict(zip(targets, weights, strict=True)),
            "shape_deviation": shape[1],
            "expression_deviation": expression[1],
            "pose_deviation": pose,
            "joint_rotations_rad": dict(zip(model.joints, self.rotations, strict=True)),
            "joint_deviations_rad": dict(zip(free, turns.reshape(-1, 3), strict=True)),
            "joint_positions": dict(zip(model.joints, positions, strict=True)),
            "scan_from_model": scan_from_here @ self.pose.matrix(),
            "mm_per_unit": model.mm_per_unit,
            "scale": self.pose.scale / model.mm_per_unit,
            "residual_mean_mm": np.nanmean(self.residual_mm),
            **attributes(self, "noise_mm", "observations", "converged"),
        }
        return LinearModelRecord(**plain_json(content))


@dataclass(frozen=True)
class _Term:
    """Residuals of some vertices `index` (N,), d along `axes` (N, d, 3), of Student's t with a `scale`.

    `share` of a vertex is an independent observation: neighbours err together.
    """

    index: IntArray
    target: FloatArray
    axes: FloatArray
    weight: FloatArray
    scale: float = 1.0
    share: float = 1.0

    def residuals(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (N, d) and their squares' sums (N,)."""
        residual = np.einsum("ndj,nj->nd", self.axes, points[self.index] - self.target)
        return residual, np.sum(residual**2, axis=1)

    def trust(self, square: FloatArray) -> FloatArray:
        return (FREEDOM + self.axes.shape[1]) / (FREEDOM + square / self.scale**2)

    def cost(self, points: FloatArray) -> float:
        """Return minus the logarithm of the likelihood."""
        square = self.residuals(points)[1] / self.scale**2
        freedom = (FREEDOM + self.axes.shape[1]) / 2
        return self.share * freedom * float(self.weight @ np.log1p(square / FREEDOM))

    def linearized(self, points: FloatArray, motion: FloatArray) -> LocalTerm:
        """Return the term as weighted squares by what moves the points, `motion` (V, 3, P)."""
        residual, square = self.residuals(points)
        curvature = self.share / self.scale**2 * self.weight * self.trust(square)
        curvature = np.repeat(curvature, self.axes.shape[1])
        jacobian = (self.axes @ motion[self.index]).reshape(residual.size, -1)
        return LocalTerm(jacobian, curvature * residual.ravel(), curvature)

    def with_scale_of(self, points: FloatArray, counts: FloatArray) -> _Term:
        """Return the term with the scale likeliest by `counts` (N,) and the share that correlations leave."""
        residual, square = self.residuals(points)
        level = max(float(np.sqrt(counts @ square / counts.sum())), EPSILON)
        term = replace(self, scale=level)
        for _ in range(30):  # expectation maximisation
            mean = counts @ (term.trust(square) * square) / (counts.sum() * residual.shape[1])
            term = replace(term, scale=max(float(np.sqrt(mean)), level / 1e6))
        # Correlation of the influences over distance, summed to where it first vanishes.
        there = np.flatnonzero(counts > 0)
        near = there[np.unique(np.linspace(0, len(there) - 1, 1500).astype(int))]  # 10^6 pairs
        where = points[self.index[near]]
        pull = (term.trust(square)[:, None] * residual)[near]
        first, second = np.triu_indices(len(near), 1)
        spacing = np.median(cKDTree(where).query(where, k=2)[0][:, 1])
        bins = (pdist(where) / spacing).astype(int)
        product = np.bincount(bins, dots(pull[first], pull[second]))
        ends = np.flatnonzero((product <= 0) & (np.bincount(bins) > 0))
        within = product[: ends[0] if len(ends) else None].sum()
        crowd = 1 + 2 * within / np.sum(pull**2) * len(there) / len(near)
        return replace(term, share=1 / max(float(crowd), 1.0))


@dataclass(frozen=True)
class _State:
    """A state of the fit, which `minimize` walks over: see `LeastSquaresPoint`."""

    model: LinearFaceModel
    """Of the fitted vertices alone; `free` are the numbers of the joints that turn."""
    free: IntArray
    meter: Meter
    pose: Similarity
    coefficients: FloatArray
    rotations: FloatArray
    terms: tuple[_Term, ...] = ()

    @cached_property
    def points(self) -> FloatArray:
        return self.of(self.model)

    def of(self, model: LinearFaceModel) -> FloatArray:
        """Return the vertices of the fitted model, or all (V, 3) of the whole one, in this state."""
        return self.pose.apply(model.at(self.coefficients, self.rotations))

    @cached_property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Precision and value of each parameter; the motion has no prior."""
        size = np.log(self.pose.scale / self.model.mm_per_unit)
        turns = self.rotations[self.free].ravel()
        tight = [np.zeros(6), [SIZE_SD**-2], np.full(len(turns), JOINT_SD_RAD**-2)]
        precision = np.concatenate([*tight, np.ones(len(self.coefficients))])
        return precision, np.concatenate([np.zeros(6), [size], turns, self.coefficients])

    @cached_property
    def cost(self) -> float:
        """Minus the logarithm of the posterior."""
        self.meter.count()
        precision, value = self._prior
        return sum((term.cost(self.points) for term in self.terms), start=float(precision @ value**2) / 2)

    def _motion(self) -> FloatArray:
        """Return the derivatives (V, 3, P) of the points by turn, shift, log scale, joints, coefficients."""
        away = self.points - self.pose.translation
        small = np.cbrt(EPSILON)  # rad; truncation and rounding alike
        turns = list[FloatArray]()
        for joint, axis in itertools.product(self.free, range(3)):
            moved = self.rotations.copy()
            moved[joint, axis] += small
            turns.append((replace(self, rotations=moved).points - self.points) / small)
        shape = self.model.turned(self.rotations).basis.transpose(1, 2, 0)
        shift = np.broadcast_to(np.eye(3), (len(away), 3, 3))
        single = np.stack([away, *turns], axis=2)
        by_shape = self.pose.scale * self.pose.rotation @ shape
        return np.concatenate([-cross_matrices(away), shift, single, by_shape], axis=2)

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model, the prior in it; weights of blendshapes stay between 0 and 1."""
        motion = self._motion()
        terms = (term.linearized(self.points, motion) for term in self.terms)
        equations = map_equations(terms, *self._prior)
        if not self.model.names:
            return equations
        weights = self.coefficients[self.model.shapes :]
        lower = np.full(len(equations.gradient), -np.inf)
        upper = np.full(len(equations.gradient), np.inf)
        lower[-len(weights) :] = -weights
        upper[-len(weights) :] = 1 - weights
        return replace(equations, lower=lower, upper=upper)

    @cached_property
    def deviation(self) -> FloatArray:
        equations = self.normal_equations()
        return Posterior(equations.matrix, -equations.gradient).deviation

    def moved(self, step: FloatArray) -> _State:
        """Return the state after a step: turn, shift, log scale, joints, coefficients."""
        turn, shift, size, joints, more = np.split(step, [3, 6, 7, 7 + 3 * len(self.free)])
        pose = Similarity(
            rotation_from_vector(turn) @ self.pose.rotation,
            self.pose.translation + shift,
            self.pose.scale * float(np.exp(size[0])),
        )
        rotations = self.rotations.copy()
        rotations[self.free] += joints.reshape(-1, 3)
        return replace(self, pose=pose, rotations=rotations, coefficients=self.coefficients + more)


def fit_linear_model(
    scan: RawScan,
    fitted: FittedFace,
    model: LinearFaceModel,
    places: SurfacePoints,
    weight: FloatArray,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
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
    model, places : LinearFaceModel, SurfacePoints
        From `linear_model_places`.
    weight : (V,) array
        Of each vertex of the `fitted` face, 0 to 1: hair and cloth count nothing.
    budget, on_progress
        See `fit`; the best answer so far is returned with ``converged=False``.
    """
    meter = Meter("linear_model", "mm", budget, on_progress)
    task = _Task.of(scan, fitted, model, places, weight)
    state, along = task.placed(meter)
    surface = task.scan_around(scan, fitted, state)
    state, across, converged = task.descended(surface, state, along)
    vertices = state.of(model)
    normals = vertex_normals(vertices, model.faces)
    hits = surface.nearest.query(vertices)
    shown = ~surface.on_boundary(hits) & (hits.distance < RESIDUAL_GATE_MM)
    shown &= dots(surface.normals_at(hits), normals) > 0
    residual = np.where(shown, hits.distance, np.nan)
    observations = across.share * float(across.weight.sum())
    evidence = f"{np.nanmean(residual):.3f} mm mean, {observations:.0f} independent observations"
    reason = f"{len(state.coefficients)} coefficients of {model.name} are fitted"
    steps = [PlanStep("linear_model", True, reason, evidence)]
    if not converged:
        steps.append(PlanStep.doubt("linear_model", "the linear model's fit had not converged when it ended"))
    return LinearModelFit(
        model=model,
        pose=state.pose,
        coefficients=state.coefficients,
        rotations=state.rotations,
        deviation=state.deviation,
        vertices=vertices,
        residual_mm=residual,
        displacement_mm=np.where(shown, dots(hits.points - vertices, normals), np.nan),
        noise_mm=across.scale,
        observations=observations,
        converged=converged,
        trace=meter.trace,
        plan=tuple(steps),
    )


@dataclass(frozen=True)
class _Task:
    """What is known of the N vertices of a linear model that are fitted: at most 6000, more say the same.

    `index` (N,) are their numbers, `counts` (N,) what each counts: its area, relative to the mean, times how
    surely it is skin. Those `known` (N,) have a place on the fitted face, at `target` (N, 3). `mean_mm2` is
    the mean area, `used` how many vertices lie on the face at all.
    """

    model: LinearFaceModel
    index: IntArray
    counts: FloatArray
    known: BoolArray
    target: FloatArray
    mean_mm2: float
    used: int

    @classmethod
    def of(
        cls,
        scan: RawScan,
        fitted: FittedFace,
        model: LinearFaceModel,
        places: SurfacePoints,
        weight: FloatArray,
    ) -> _Task:
        used = np.flatnonzero(places.face >= 0)
        index = used[np.unique(np.linspace(0, len(used) - 1, 6000).astype(int))]
        corners, shares = fitted.faces[places.face[index]], places.barycentric[index]
        known = shares.any(1)
        area = vertex_areas(model.mm_per_unit * model.mean, model.faces)[index]
        skin = np.where(known, dots(shares, weight[corners]), 1.0)
        counts = skin * area / area.mean()
        if not (known & (counts > 0)).any():
            raise FitError(
                f"{scan.name}: no vertex of {model.name} has a place on the skin of the fitted face"
            )
        target = np.einsum("nk,nkj->nj", shares, fitted.vertices[corners])
        return cls(model, index, counts, known, target, area.mean(), len(used))

    def placed(self, meter: Meter) -> tuple[_State, _Term]:
        """Return the state that the places on the fitted face alone give, and their term."""
        model, unit = self.model, self.model.mm_per_unit
        placed = np.flatnonzero(self.known & (self.counts > 0))
        counts = self.counts[placed]
        start = procrustes(unit * model.mean[self.index][placed], self.target[placed], weights=counts)
        free = np.array([model.joints.index(name) for name in FREE_JOINTS if name in model.joints], int)
        some = placed[::4]
        # Places err together over NEAR_MM: `common_shape` counts as many patches.
        patches = counts.sum() * self.mean_mm2 * self.used / len(self.index) / (4 * np.pi * NEAR_MM**2)
        along = _Term(
            some,
            self.target[some],
            np.broadcast_to(np.eye(3), (len(some), 3, 3)),
            self.counts[some],
            # Along each axis the fitted face misplaces vertices by 1.6 to 2.1 mm, on raw ICT scans.
            scale=2.0,
            share=float(patches / self.counts[some].sum()),
        )
        state = _State(
            model.of_vertices(self.index),
            free,
            meter,
            Similarity(start[:3, :3], start[:3, 3], unit),
            np.zeros(model.components),
            np.zeros((len(model.joints), 3)),
            (along,),
        )
        return minimize(state, steps=20, tolerance=SMALL**2, meter=meter).best, along

    def scan_around(self, scan: RawScan, fitted: FittedFace, state: _State) -> ScanSurface:
        """Return the scan within `GATE_MM` of the model, without covers, facing outward."""
        whole = state.of(self.model)
        points = whole[self.index]
        bare = scan if fitted.covered_faces is None else scan.without_faces(fitted.covered_faces)
        near = scan_near_model(
            bare.vertices,
            bare.faces,
            fitted.model_from_scan,
            points.min(0) - GATE_MM[0],
            points.max(0) + GATE_MM[0],
            FitOptions.smoothing_mm,
        )
        assert near is not None  # the face was fitted to it
        normals = vertex_normals(whole, self.model.faces)[self.index]
        return near.turned_outward(points, normals, GATE_MM[0])

    def descended(self, surface: ScanSurface, state: _State, along: _Term) -> tuple[_State, _Term, bool]:
        """Return where the scan leads, the term of its closest points, and whether that has converged."""
        across = replace(along, scale=np.inf, share=1.0)
        falls = True
        for _ in range(60):
            nearest = self.closest(surface, state)
            if nearest is None:
                break
            certain = self.counts[nearest.index] * self.known[nearest.index]
            last, across = across, nearest.with_scale_of(state.points, certain)
            # What a poor fit leaves is correlated, too, and would excuse it: independent while errors fall.
            falls = falls and across.scale < (1 - SMALL) * last.scale
            across = replace(across, share=1.0 if falls else float(np.sqrt(across.share * last.share)))
            off = np.sqrt(across.residuals(state.points)[1])
            state.meter.record(np.average(off, weights=certain))
            if state.meter.exhausted:
                break
            before = replace(state, terms=(across, along))
            state = minimize(before, steps=3, trials=6, meter=state.meter).best
            change = (state.coefficients - before.coefficients) / state.deviation[-len(state.coefficients) :]
            if not falls and np.mean(change**2) < SMALL**2:
                return state, across, True
        return state, across, False

    def closest(self, surface: ScanSurface, state: _State) -> _Term | None:
        """Return the term of the scan's closest points; None where no vertex with a place has one."""
        outward = vertex_normals(state.of(self.model), self.model.faces)[self.index]
        hits = surface.nearest.query(state.points)
        normal = normalized(surface.normals_at(hits))
        facing = dots(normal, outward) > 0
        there = ~surface.on_boundary(hits) & facing & (self.counts > 0)
        if not (there & self.known).any():
            return None
        seen = np.flatnonzero(there)
        return _Term(seen, hits.points[seen], normal[seen, None], self.counts[seen])
