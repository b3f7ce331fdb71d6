"""The two stages of `refine_geometry`: landmarks alone, then colours with them, believed or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Budget, Meter, PlanStep, ProgressCallback, Trace
from scan2albedo.geometry.pinhole import project
from scan2albedo.reflectance.geometry_input import landmark_term
from scan2albedo.reflectance.geometry_options import GeometryFitOptions
from scan2albedo.reflectance.geometry_search import GeometrySearch, GeometryState
from scan2albedo.reflectance.geometry_terms import GeometryTerm, PhotometricTerm
from scan2albedo.reflectance.photometry import Photometry
from scan2albedo.reflectance.shape_model import MorphableShapeModel

FloatArray = NDArray[np.float64]

_RIGID_STEPS = 20


class GeometryRefinement:
    """State of a fit in its two stages."""

    def __init__(
        self,
        camera: FloatArray,
        landmarks: FloatArray,
        model: MorphableShapeModel,
        photometry: Photometry | None,
        start: GeometryState,
        options: GeometryFitOptions,
    ) -> None:
        self.camera, self.landmarks, self.model = camera, landmarks, model
        self.photometry, self.state, self.options = photometry, start, options
        self.anchor = landmark_term(camera, landmarks, model, start, options)
        self.converged, self.iterations = True, 0
        self.rmse: tuple[float | None, float | None] = (None, None)
        self.steps: list[PlanStep] = []
        self.trace = Trace()

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
        stage, options = meter.child(name, "objective"), self.options
        rigid = GeometrySearch(self.model, self.state, options.prior_weight, stage, rigid=True)
        rigid.run([self.anchor], _RIGID_STEPS, options.tolerance)
        search = GeometrySearch(self.model, rigid.state, options.prior_weight, stage)
        search.run([self.anchor], options.landmark_steps, options.tolerance)
        self.state, self.converged = search.state, search.converged
        self.iterations += rigid.iterations + search.iterations
        meter.adopt(stage)
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
        stage = meter.child(name, "objective")
        search = GeometrySearch(self.model, self.state, self.options.prior_weight, stage)
        converged = self._descend(search, self.photometry)
        meter.adopt(stage)
        self.iterations += search.iterations
        if self._accept(name, self.photometry, search):
            self.state, self.converged = search.state, converged
        elif meter.exhausted:
            self.converged = False

    def _descend(self, search: GeometrySearch, photometry: Photometry) -> bool:
        """Search with what is seen settled anew every few steps; tell whether it converged."""
        options, converged = self.options, False
        for level in range(photometry.levels):
            converged = False
            for _ in range(options.rounds):
                term = photometry.term(search.vertices, photometry.usable(search.vertices), level)
                if term is None or search.meter.exhausted:
                    break
                terms: list[GeometryTerm] = [term] if self.anchor is None else [self.anchor, term]
                search.run(terms, options.refresh_steps, options.tolerance)
                # Nothing to gain from what is seen now, and so neither from settling it anew.
                if search.converged or search.first_value - search.value <= options.tolerance * search.value:
                    converged = not search.meter.exhausted
                    break
        return converged

    def _accept(self, name: str, photometry: Photometry, search: GeometrySearch) -> bool:
        """Tell whether the result of photometry is believed, and write it into the plan."""
        if search.iterations == 0:
            self.steps.append(PlanStep(name, False, "the image shows nothing of the face, or no step helps"))
            return False
        shapes = [state.vertices(self.model) for state in (self.state, search.state)]
        term = photometry.common_term(shapes)
        if term is None:
            self.steps.append(PlanStep(name, False, "shapes before and after show nothing in common"))
            return False
        refusal = self._refusal(term, self.state, search.state)
        evidence = f"relative rmse {self.rmse[0]:.4f} -> {self.rmse[1]:.4f}, {len(term.used)} vertices"
        reason = refusal or "the colours are explained better"
        self.steps.append(PlanStep(name, not refusal, reason, evidence))
        return not refusal

    def _refusal(self, term: PhotometricTerm, before: GeometryState, after: GeometryState) -> str:
        """Return why the result of photometry is not believed, or an empty text."""
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
            options = self.options
            if error[1] > max(options.landmark_growth * error[0], error[0] + options.landmark_slack_px):
                return f"the landmarks' error grew from {error[0]:.2f} to {error[1]:.2f} px"
        return ""

    def landmark_errors(self, state: GeometryState) -> FloatArray:
        """Return (68,) distances in pixels, NaN where a landmark is not seen."""
        pixels, _ = project(self.camera, state.vertices(self.model)[self.model.landmark_vertices])
        return np.asarray(np.linalg.norm(pixels - self.landmarks, axis=1))


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))
