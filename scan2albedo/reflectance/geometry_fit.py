"""Refine a face's pose and shape from one image, by its landmarks and its colours."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import Budget, Meter, Plan, PlanStep, ProgressCallback, Trace
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.pinhole import normalized_cameras, project
from scan2albedo.reflectance.environment_shading import checked_light
from scan2albedo.reflectance.geometry_search import GeometryObjective, GeometrySearch, GeometryState
from scan2albedo.reflectance.geometry_start import checked_landmarks, edge_px, initial_state, landmark_term
from scan2albedo.reflectance.geometry_terms import (
    GeometryFitOptions,
    GeometryTerm,
    PhotometricTerm,
    Photometry,
)
from scan2albedo.reflectance.picture_samples import SmoothImage
from scan2albedo.reflectance.shape_model import MorphableShapeModel
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

_RIGID_STEPS, _LANDMARK_STEPS = 20, 100
"""Most steps with landmarks alone: of the pose, then of pose and shape."""
_REFRESH_STEPS = 5
"""After so many steps with photometry, rays find anew which vertices are seen."""
_LANDMARK_GROWTH, _LANDMARK_SLACK_PX = 1.5, 0.5
"""Photometry is not accepted when it makes the landmarks' error larger than this times the error without, and
by more than this many pixels."""


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
    """Of the colours with the shape from landmarks alone (or the initial one), over that of the image, over
    vertices that both shapes show; None without photometry."""
    photometric_rmse_after: float | None
    """The same with photometry, accepted or not."""
    plan: Plan
    """Whether landmarks and photometry were used, and why."""
    converged: bool
    """False when the budget or the steps ended first."""
    iterations: int
    """Steps taken."""
    trace: Trace
    """Of the objective, in rows of "reflectance.geometry.landmarks" and ".photometry"."""

    @property
    def landmark_rmse_px(self) -> float | None:
        """Root mean square over the landmarks used; None without any."""
        seen = np.isfinite(self.landmark_error_px)
        return float(np.sqrt(np.mean(self.landmark_error_px[seen] ** 2))) if seen.any() else None


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
    options: GeometryFitOptions = GeometryFitOptions(),
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> GeometryFit:
    """Return pose and shape fitted to landmarks, then to landmarks and the colours of the image together.

    Minimises over pose (6 numbers), identity a and expression b

        E = W_l / n sum |p(x_k) - q_k|^2 + W_p / 3U sum (sqrt(r^2 + eps^2) - eps) + w (|a|^2 + |b|^2),
        r = (I(p(x_v)) - c_v D(n_v) L - sum_s w_vs S_s(n_v, v_v) L) / unit,

    q in mm at the face's depth, by Levenberg-Marquardt with analytic derivatives on re-weighted squares. In r
    both the image moves under a vertex and the shading turns with its normal. Rays find which vertices U are
    seen, anew every few steps. The result with photometry is accepted only when the objective over the
    vertices seen in both shapes falls, landmarks stay near, and the colours are explained; otherwise the
    result of the landmarks alone is returned.

    Parameters
    ----------
    image_linear : (H, W, 3) array_like of float
        Linear colours; NaN pixels are gaps.
    camera : (3, 4) array_like of float
        Pixels from mm in the scene, any scale, see `geometry.pinhole`.
    landmarks_px : (68, 2) array_like of float
        Column and row, iBUG-68 order; NaN rows are not seen.
    shape_model : MorphableShapeModel
    reflectance : VertexReflectance, optional
        Of the model's V vertices, in the unit that goes with `light`; without it landmarks alone are used.
    light : (81, 3) array_like of float, optional
        Harmonics of the light in the scene's frame; goes with `reflectance`.
    mask : (H, W) array_like of bool, optional
        Where the image shows skin.
    initial_scene_from_model : (4, 4) array_like of float, optional
        Rigid; found from the landmarks when omitted.
    initial_identity, initial_expression : (N_S,), (N_E,) array_like of float, optional
        Zeros when omitted.
    options : GeometryFitOptions
    budget : Budget or float, optional
        Evaluations or seconds after which the best so far is returned with `converged=False`.
    on_progress : callable, optional
        Called with every `TraceRow`.

    Raises
    ------
    ReflectanceError
        When there is neither a landmark nor photometry, no initial pose and too few landmarks to find one,
        another topology, or numbers that are not finite.
    ValueError
        When shapes disagree, or only one of `reflectance` and `light` is given.

    Warns
    -----
    RuntimeWarning
        When it stops without having converged.

    Notes
    -----
    Cast shadows are not modelled. One image cannot separate how far away a face is from how large it is, but
    for the prior. Han, Wang and Xu (supplement) weight landmarks far less, since those of networks are
    several mm off; tools/bench_reflectance_geometry.py compares weights. Cost of a step: 3 U (N_S + N_E)^2.
    """
    matrix = normalized_cameras(np.asarray(camera, np.float64)[None])[0]
    landmarks = checked_landmarks(landmarks_px, options.contour)
    start = initial_state(
        matrix, landmarks, shape_model, initial_scene_from_model, initial_identity, initial_expression
    )
    if (reflectance is None) != (light is None):
        raise ValueError("reflectance and light go together; give both or none")
    photometry = None
    if reflectance is not None and light is not None:
        blur_px = [edge_px(matrix, shape_model, start) * blur for blur in options.blur_edges]
        images = [SmoothImage(image_linear, mask, blur) for blur in blur_px]
        photometry = _photometry(images, matrix, shape_model, reflectance, light, options)
    elif not np.isfinite(landmarks).any():
        raise ReflectanceError(
            "no landmark is seen and no reflectance given, so the geometry is undetermined; give one of both"
        )
    fit = _Refinement(matrix, landmarks, shape_model, photometry, start, options)
    fit.run(Budget.of(budget), on_progress)
    if not fit.converged:
        warnings.warn(
            f"the geometry fit stopped after {fit.iterations} steps without having converged",
            RuntimeWarning,
            stacklevel=2,
        )
    return _result(fit)


def _photometry(
    images: list[SmoothImage],
    camera: FloatArray,
    shape_model: MorphableShapeModel,
    reflectance: VertexReflectance,
    light: ArrayLike,
    options: GeometryFitOptions,
) -> Photometry:
    if len(reflectance.known) != len(shape_model.mean):
        raise ReflectanceError(
            f"the reflectance has {len(reflectance.known)} vertices and the shape model "
            f"{len(shape_model.mean)}; bring both to one topology"
        )
    return Photometry(images, camera, shape_model.faces, reflectance, checked_light(light), options)


@dataclass
class _Refinement:
    """A fit in its two stages: landmarks alone, then colours with them, accepted or not."""

    camera: FloatArray
    landmarks: FloatArray
    model: MorphableShapeModel
    photometry: Photometry | None
    state: GeometryState
    options: GeometryFitOptions
    converged: bool = True
    iterations: int = 0
    rmse: tuple[float | None, float | None] = (None, None)
    steps: list[PlanStep] = field(default_factory=list)
    trace: Trace = field(default_factory=Trace)

    def __post_init__(self) -> None:
        self.anchor = landmark_term(self.camera, self.landmarks, self.model, self.state, self.options)

    def run(self, budget: Budget, on_progress: ProgressCallback | None) -> None:
        """Run both stages."""
        meter = Meter("reflectance.geometry", "objective", budget, on_progress)
        self._fit_landmarks(meter)
        self._fit_photometry(meter)
        self.trace = meter.trace

    def _fit_landmarks(self, meter: Meter) -> None:
        name = "reflectance.geometry.landmarks"
        if self.anchor is None:
            self.steps.append(PlanStep(name, False, "no landmark is seen"))
            return
        stage = meter.sub_meter(name, "objective")
        rigid = GeometrySearch(self.state, stage)
        rigid.run(self._objective([self.anchor], stage, rigid=True), _RIGID_STEPS)
        search = GeometrySearch(rigid.state, stage)
        search.run(self._objective([self.anchor], stage), _LANDMARK_STEPS)
        self.state, self.converged = search.state, search.converged
        self.iterations += rigid.iterations + search.iterations
        meter.merge(stage)
        self.steps.append(PlanStep(name, True, "landmarks are seen", f"{len(self.anchor.vertex)} landmarks"))

    def _fit_photometry(self, meter: Meter) -> None:
        name = "reflectance.geometry.photometry"
        if self.photometry is None:
            self.steps.append(PlanStep(name, False, "no reflectance and light are given"))
            return
        if meter.exhausted:
            self.converged = False
            self.steps.append(PlanStep(name, False, "the budget had ended"))
            return
        stage = meter.sub_meter(name, "objective")
        search = GeometrySearch(self.state, stage)
        converged = self._search(search, self.photometry)
        meter.merge(stage)
        self.iterations += search.iterations
        if self._accept(name, self.photometry, search):
            self.state, self.converged = search.state, converged
        elif meter.exhausted:
            self.converged = False

    def _objective(
        self, terms: list[GeometryTerm], meter: Meter, *, rigid: bool = False
    ) -> GeometryObjective:
        return GeometryObjective.of(self.model, self.options.prior_weight, terms, meter, rigid=rigid)

    def _search(self, search: GeometrySearch, photometry: Photometry) -> bool:
        """Search, updating the seen vertices every few steps; return whether it converged."""
        converged = False
        for level in range(len(photometry.images)):
            converged = False
            for _ in range(self.options.rounds):
                vertices = search.state.vertices(self.model)
                term = photometry.term(vertices, photometry.usable(vertices), level)
                if term is None or search.meter.exhausted:
                    break
                terms: list[GeometryTerm] = [term] if self.anchor is None else [self.anchor, term]
                search.run(self._objective(terms, search.meter), _REFRESH_STEPS)
                # Nothing to gain from what is seen now, and so neither from finding it anew.
                if search.converged or search.hardly_fell:
                    converged = not search.meter.exhausted
                    break
        return converged

    def _accept(self, name: str, photometry: Photometry, search: GeometrySearch) -> bool:
        """Return whether the result of photometry is accepted, and write it into the plan."""
        if search.iterations == 0:
            self.steps.append(PlanStep(name, False, "the image shows nothing of the face, or no step helps"))
            return False
        shapes = [state.vertices(self.model) for state in (self.state, search.state)]
        term = photometry.common_term(shapes)
        if term is None:
            self.steps.append(PlanStep(name, False, "shapes before and after show nothing in common"))
            return False
        objection = self._objection(term, self.state, search.state)
        evidence = f"relative rmse {self.rmse[0]:.4f} -> {self.rmse[1]:.4f}, {len(term.used)} vertices"
        reason = objection or "the colours are explained better"
        self.steps.append(PlanStep(name, not objection, reason, evidence))
        return not objection

    def _objection(self, term: PhotometricTerm, before: GeometryState, after: GeometryState) -> str:
        """Return why the result of photometry is not accepted, or an empty text."""
        values, rmse = [], []
        for state in (before, after):
            vertices = state.vertices(self.model)
            rmse.append(term.relative_rmse(vertices))
            prior = self.options.prior_weight * float(state.coefficients @ state.coefficients)
            of_landmarks = 0.0 if self.anchor is None else self.anchor.value(vertices)
            values.append(term.value(vertices) + of_landmarks + prior)
        self.rmse = rmse[0], rmse[1]
        if not values[1] < values[0]:
            return "the objective did not fall over what both shapes show"
        if not rmse[1] <= self.options.largest_rmse:
            return "the colours are not explained; light or reflectance are others"
        if self.anchor is not None:
            error = [_rms(self.landmark_errors(state)) for state in (before, after)]
            if error[1] > max(_LANDMARK_GROWTH * error[0], error[0] + _LANDMARK_SLACK_PX):
                return f"the landmarks' error grew from {error[0]:.2f} to {error[1]:.2f} px"
        return ""

    def landmark_errors(self, state: GeometryState) -> FloatArray:
        """Return (68,) distances in pixels, NaN where a landmark is not seen."""
        pixels, _ = project(self.camera, state.vertices(self.model)[self.model.landmark_vertices])
        return np.asarray(np.linalg.norm(pixels - self.landmarks, axis=1))


def _result(fit: _Refinement) -> GeometryFit:
    vertices = fit.state.vertices(fit.model)
    return GeometryFit(
        scene_from_model=fit.state.scene_from_model,
        identity=fit.state.identity,
        expression=fit.state.expression,
        vertices=vertices,
        normals=vertex_normals(vertices, fit.model.faces),
        landmark_error_px=fit.landmark_errors(fit.state),
        photometric_rmse_before=fit.rmse[0],
        photometric_rmse_after=fit.rmse[1],
        plan=Plan(tuple(fit.steps)),
        converged=fit.converged,
        iterations=fit.iterations,
        trace=fit.trace,
    )


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))
