"""Refine a face's pose and shape from one image, by its landmarks and its colours."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from scan2albedo.core import BudgetLike, Meter, OnProgress, Plan, PlanStep, Trace
from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, checked_array, finite_rows, norms, rms
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import edges_with_faces, vertex_normals
from scan2albedo.geometry.pinhole import (
    camera_centers,
    focal_px,
    normalized_cameras,
    pixel_directions,
    project,
)
from scan2albedo.geometry.rigid import compose, is_rigid, procrustes, rotation_from_vector, transform_points
from scan2albedo.optimization.least_squares import Damping, Descent, minimize
from scan2albedo.reflectance import geometry_terms as terms
from scan2albedo.reflectance.environment_shading import HARMONICS
from scan2albedo.reflectance.geometry_terms import GeometryPoint, PhotometricTerm
from scan2albedo.reflectance.image_fit import MOST_UNEXPLAINED
from scan2albedo.reflectance.shape_model import LANDMARKS, MorphableShapeModel
from scan2albedo.reflectance.vertex_reflectance import (
    VertexReflectance,
    checked_coefficients,
    require_one_topology,
)

BLUR_EDGES = 0.3
"""Standard deviation of the image's smoothing, in mean edges of the mesh: vertices hold nothing finer."""


@dataclass(frozen=True)
class GeometryFit:
    """A face's pose and shape that explain an image."""

    scene_from_model: FloatArray
    """(4, 4), rigid, from the shape model's frame to the one of the camera matrix; mm."""
    identity: FloatArray
    """(N_S,)."""
    expression: FloatArray
    """(N_E,)."""
    vertices: FloatArray
    """(V, 3) in the scene, mm."""
    normals: FloatArray
    """(V, 3) unit, in the scene."""
    landmark_error_px: FloatArray
    """(68,) distances in the image; NaN where a landmark was not seen or left out."""
    photometric_rmse_before: float | None
    photometric_rmse_after: float | None
    """`photometric_rmse_before`, `photometric_rmse_after`: of the colours over that of the image, at vertices
    that both shapes show: from landmarks alone (or the start), and with photometry; None without it."""
    plan: Plan
    """Whether landmarks and photometry were used, and why."""
    converged: bool
    iterations: int
    trace: Trace
    """Of the objective, in rows of "reflectance.geometry.landmarks" and ".photometry". `converged` is False
    when the budget or the steps (`iterations`) ended first."""

    @property
    def landmark_rmse_px(self) -> float | None:
        """Root mean square over the landmarks used; None without any."""
        seen = np.isfinite(self.landmark_error_px)
        return rms(self.landmark_error_px[seen]) if seen.any() else None


def refine_geometry(
    image_linear: ArrayLike,
    camera: ArrayLike,
    landmarks_px: ArrayLike,
    shape_model: MorphableShapeModel,
    *,
    reflectance: VertexReflectance | None = None,
    light: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    initial_scene_from_model: ArrayLike | None = None,
    initial_identity: ArrayLike | None = None,
    initial_expression: ArrayLike | None = None,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> GeometryFit:
    """Return pose and shape fitted to landmarks, then to landmarks and the colours of the image together.

    Minimises over pose (6 numbers), identity a and expression b

        E = 0.2 / n sum |p(x_k) - q_k|^2 + 2 / 3U sum (sqrt(r^2 + eps^2) - eps) + 1e-3 (|a|^2 + |b|^2),
        r = (I(p(x_v)) - c_v D(n_v) L - sum_s w_vs S_s(n_v, v_v) L) / unit,

    q in mm at the face's depth, by Levenberg-Marquardt with analytic derivatives on re-weighted squares. In r
    both the image, smoothed by 0.3 edges of the mesh, moves under a vertex and the shading turns with its
    normal. Rays find which vertices U are seen, anew every five steps. The result with photometry is accepted
    only when the objective over the vertices seen in both shapes falls and the colours are explained;
    otherwise the result of the landmarks alone is returned. Raises `ReflectanceError` where nothing says what
    pose or shape are, for another topology and numbers that are not finite; `ValueError` for other shapes, or
    one of `reflectance` and `light` alone. Warns by `RuntimeWarning` when it stops without having converged.

    Parameters
    ----------
    image_linear : (H, W, 3) array_like of float
        Linear colours; NaN pixels are gaps.
    camera : (3, 4) array_like of float
        Pixels from mm in the scene, any scale, see `geometry.pinhole`.
    landmarks_px : (68, 2) array_like of float
        Column and row, iBUG-68 order; NaN rows are not seen.
    shape_model : MorphableShapeModel
    reflectance, light : VertexReflectance, (81, 3) array_like of float, optional
        Of the model's V vertices, and harmonics of the light in the scene's frame; without them landmarks
        alone are used.
    mask : (H, W) array_like of bool, optional
        Where the image shows skin.
    initial_scene_from_model, initial_identity, initial_expression : array_like of float, optional
        (4, 4), rigid, found from the landmarks when omitted; (N_S,), (N_E,), zeros when omitted.
    budget, on_progress : optional
        When it ends the best so far is returned with `converged=False`; called with every `TraceRow`.

    Notes
    -----
    Cast shadows are not modelled. Only the prior separates how far away a face is from how large it is.
    `python tools/bench face_geometry` compares weights of landmarks.
    """
    matrix = normalized_cameras(np.asarray(camera, float)[None])[0]
    landmarks = checked_array(landmarks_px, (LANDMARKS, 2), "landmarks_px").copy()
    landmarks[~finite_rows(landmarks)] = np.nan
    sizes = (shape_model.identity_components,), (shape_model.expression_components,)
    identity = checked_coefficients(initial_identity, sizes[0], "initial_identity")
    expression = checked_coefficients(initial_expression, sizes[1], "initial_expression")
    coefficients = np.concatenate([identity, expression])
    seen = np.flatnonzero(finite_rows(landmarks))
    pose = _initial_pose(initial_scene_from_model, matrix, landmarks[seen], seen, shape_model, coefficients)
    meter = Meter("reflectance.geometry", "objective", budget, on_progress)
    state = GeometryPoint(shape_model, pose, coefficients, meter)
    if (reflectance is None) != (light is None):
        raise ValueError("reflectance and light go together; give both or none")
    term_over = None
    if reflectance is not None and light is not None:
        image = _blurred(image_linear, mask, matrix, state)
        count = len(shape_model.mean)
        require_one_topology("the reflectance", len(reflectance.known), "the shape model", count)
        sent = checked_coefficients(light, (HARMONICS, 3), "light")
        term_over = partial(terms.photometric_term, image, matrix, shape_model.faces, reflectance, sent)
    elif not len(seen):
        raise ReflectanceError("no landmark is seen, no reflectance given: undetermined; give one of both")
    converged = True
    iterations = 0
    name = "reflectance.geometry.landmarks"
    plan = [PlanStep(name, False, "no landmark is seen")]
    if len(seen):
        vertex = shape_model.landmark_vertices[seen]
        _, depth = project(matrix, state.vertices[vertex])
        if not (depth > 0).all():
            raise ReflectanceError("landmarks lie behind the camera at first; check pose and camera")
        anchor = terms.LandmarkTerm(matrix, vertex, landmarks[seen], _pixel_mm(matrix, depth))
        plan = [PlanStep(name, True, "landmarks are seen", f"{len(seen)} landmarks")]
        stage = meter.sub_meter(name, "objective")
        state = replace(state, terms=[anchor], meter=stage)
        for rigid, most in ((True, 20), (False, 100)):
            found = _descent(replace(state, rigid=rigid), most)
            state, converged = found.best, found.converged
            iterations += found.steps
        meter.merge(stage)
    name, gain = "reflectance.geometry.photometry", ColourGain()
    if term_over is None:
        plan.append(PlanStep(name, False, "no reflectance and light are given"))
    elif meter.exhausted:
        converged = False
        plan.append(PlanStep(name, False, "the budget had ended"))
    else:
        stage = meter.sub_meter(name, "objective")
        moved = photometric_descent(term_over, replace(state, meter=stage))
        meter.merge(stage)
        iterations += moved.steps
        gain = ColourGain.between(state, moved, term_over)
        accepted = not gain.objection
        reason = gain.objection or "the colours are explained better"
        plan.append(PlanStep(name, accepted, reason, gain.evidence))
        if accepted:
            state, converged = moved.best, moved.converged
        elif meter.exhausted:
            converged = False
    if not converged:
        text = f"the geometry fit stopped after {iterations} steps without having converged"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
    identity, expression = np.split(state.coefficients, [shape_model.identity_components])
    pixels, _ = project(matrix, state.vertices[shape_model.landmark_vertices])
    return GeometryFit(
        scene_from_model=state.scene_from_model,
        identity=identity,
        expression=expression,
        vertices=state.vertices,
        normals=vertex_normals(state.vertices, shape_model.faces),
        landmark_error_px=norms(pixels - landmarks),
        photometric_rmse_before=gain.before,
        photometric_rmse_after=gain.after,
        plan=Plan(tuple(plan)),
        converged=converged,
        iterations=iterations,
        trace=meter.trace,
    )


def _initial_pose(
    initial: ArrayLike | None,
    camera: FloatArray,
    pixels: FloatArray,
    seen: IntArray,
    model: MorphableShapeModel,
    coefficients: FloatArray,
) -> FloatArray:
    """Return the pose (4, 4) to start from: the one given, or that of the landmarks `seen` at `pixels`."""
    if initial is not None:
        pose = checked_array(initial, (4, 4), "initial_scene_from_model")
        if not is_rigid(pose):
            raise ReflectanceError("initial_scene_from_model is not rigid; give rotation and translation")
        return pose
    if len(seen) < 6:
        raise ReflectanceError(f"{len(seen)} landmarks seen, a pose takes 6; give initial_scene_from_model")
    return pose_from_landmarks(camera, model.at(coefficients)[model.landmark_vertices[seen]], pixels)


def _blurred(
    image_linear: ArrayLike, mask: ArrayLike | None, camera: FloatArray, start: GeometryPoint
) -> terms.SmoothImage:
    """Return the image smoothed by `BLUR_EDGES` of the mesh at `start`; as it is where that is behind."""
    edges, _ = edges_with_faces(start.model.faces)
    length = norms(start.vertices[edges[:, 0]] - start.vertices[edges[:, 1]]).mean()
    _, depth = project(camera, start.vertices)
    edge_px = float(length / _pixel_mm(camera, depth)) if np.median(depth) > 0 else 0.0
    return terms.SmoothImage(image_linear, mask, BLUR_EDGES * edge_px)


@dataclass(frozen=True)
class ColourGain:
    """What photometry changed, over the vertices that the shapes before and after it show."""

    before: float | None = None
    after: float | None = None
    """`before`, `after`: relative RMSE of the colours; None where they were not compared."""
    objection: str = ""
    """Why the shape after it is not taken."""
    evidence: str = ""

    @classmethod
    def between(
        cls,
        start: GeometryPoint,
        moved: Descent[GeometryPoint],
        term_over: Callable[..., PhotometricTerm | None],
    ) -> Self:
        """Compare objectives and colours at the start and at the end of a descent."""
        if not moved.steps:
            return cls(objection="the image shows nothing of the face, or no step helps")
        term = term_over(start.vertices, moved.best.vertices)
        if term is None:
            return cls(objection="shapes before and after show nothing in common")
        before, after = (term.relative_rmse(one.vertices) for one in (start, moved.best))
        both = [*start.terms, term]
        first, last = (
            replace(one, terms=both, meter=one.meter.untraced()).cost for one in (start, moved.best)
        )
        objection = ""
        if not last < first:
            objection = "the objective did not fall over what both shapes show"
        elif not after <= MOST_UNEXPLAINED:
            objection = "the colours are not explained; light or reflectance are others"
        evidence = f"relative rmse {before:.4f} -> {after:.4f}, {len(term.used)} vertices"
        return cls(before, after, objection, evidence)


def photometric_descent(
    term_over: Callable[..., PhotometricTerm | None], start: GeometryPoint
) -> Descent[GeometryPoint]:
    """Return where colours and the start's terms lead; what is seen is found anew every five steps."""
    found = Descent(start, False, 0, Damping().first)
    for _ in range(10):
        term = term_over(found.best.vertices)
        if term is None or start.meter.exhausted:
            break
        point = replace(found.best, terms=[*start.terms, term])
        part = _descent(point, 5, found.damping)
        settled = part.converged and not start.meter.exhausted
        found = replace(part, converged=settled, steps=found.steps + part.steps)
        if part.converged:
            break
    return found


def _descent(start: GeometryPoint, steps: int, damping: float = Damping().first) -> Descent[GeometryPoint]:
    """Return where up to `steps` steps lead, nowhere when the budget has ended."""
    if (meter := start.meter).exhausted:
        return Descent(start, False, 0, damping)
    first, record = Damping(first=damping), lambda point: meter.record(point.cost)
    return minimize(
        start, steps=steps, tolerance=1e-4, flat_steps=3, damping=first, meter=meter, on_better=record
    )


def _pixel_mm(camera: FloatArray, depth: FloatArray) -> float:
    """Return the size of a pixel at the median depth."""
    return float(np.median(depth) / focal_px(camera))


def pose_from_landmarks(camera: FloatArray, points_mm: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return the rigid transform (4, 4), scene from model, that puts points on their lines of sight.

    Minimises the sum of squared distances to the lines of sight by orthogonal iteration (Lu, Hager,
    Mjolsness, IEEE PAMI 22(6), 2000): with the projections V_i = d_i d_i^T onto these lines, the best
    translation is linear in the rotation, and the rotation is the Procrustes one from points to their
    projections. Takes a normalised camera (3, 4), four or more points (N, 3) in mm that are not on a line,
    and their pixels (N, 2). Raises `ReflectanceError` when pixels coincide, or no pose has the points in
    front of the camera.
    """
    if not np.ptp(pixels, axis=0).max() > 0:
        raise ReflectanceError("all landmarks lie in one point of the image; check them")
    center = points_mm.mean(0)
    local = points_mm - center
    directions = pixel_directions(camera, pixels)
    # Where lines of sight cross a plane in front of the camera: a weak-perspective picture.
    axis = directions.mean(0) / np.linalg.norm(directions.mean(0))
    first = procrustes(local, directions / (directions @ axis)[:, None], scale=True)
    upright = first[:3, :3] / np.cbrt(np.linalg.det(first[:3, :3]))
    onto = directions[:, :, None] * directions[:, None, :]
    off = onto - np.eye(3)
    to_translation = -np.linalg.inv(off.sum(0))
    best, least = np.eye(4), np.inf
    # Flat sets of points have two minima, hence several starts: pitch and yaw in degrees.
    for pitch, yaw in np.radians([(0, 0), (0, 45), (0, -45), (35, 0), (-35, 0)]):
        rotation = upright @ rotation_from_vector([0, yaw, 0]) @ rotation_from_vector([pitch, 0, 0])
        before = np.inf
        for _ in range(200):
            shift = to_translation @ np.einsum("nij,nj->i", off, local @ rotation.T)
            pose = compose(rotation, shift)
            target = np.einsum("nij,nj->ni", onto, transform_points(pose, local))
            error = np.sum((transform_points(pose, local) - target) ** 2)
            if not error < before * (1 - 1e-6):
                break
            before = error
            rotation = procrustes(local, target)[:3, :3]
        ahead = (transform_points(pose, local) * directions).sum(1) > 0
        if ahead.all() and error < least:
            best, least = pose, error
    if not np.isfinite(least):
        raise ReflectanceError("no pose puts the landmarks before the camera; check landmarks and camera")
    to_scene = compose(np.eye(3), camera_centers(camera))
    return to_scene @ best @ compose(np.eye(3), -center)
