"""Find a face's reflectance and the light of one image with morphable models of both."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scan2albedo.core import Budget, Meter, ProgressCallback, Trace
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.optimization import Descent, NormalEquations, minimize
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.image_terms import (
    ImageFitOptions,
    ImageTerms,
    PerceptualDistance,
    PerceptualTerm,
    PerceptualValue,
    Prediction,
    secant_curvature,
)
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import ModelReflectance, MorphableReflectanceModel

_STEPS = 200
"""Most steps; 10 to 20 are usual."""
_TOLERANCE, _FLAT_STEPS = 1e-5, 3
"""Converged when the objective falls by less than this part, so many steps running."""
_LARGEST_LOG_SCALE_STEP = 5.0
"""A scale that grows by e^5 in a step is a runaway, and would overflow in the exponential."""


@dataclass(frozen=True)
class ImageFit:
    """A face's reflectance and the light that together explain an image."""

    face: ModelReflectance
    """Reflectance of all vertices the model knows, and its coefficients (N,)."""
    light_coefficients: FloatArray
    """(M,) of the lighting model."""
    scale_rgb: FloatArray
    """(3,) mean radiance of the light in each channel, in units of the image."""
    light: FloatArray
    """(81, 3) coefficients of harmonics."""
    radiance_linear: FloatArray
    """(V, 3) colours with negatives of the reflectance clipped; NaN where not seen or not known."""
    relative_rmse: float
    """Root mean square of the differences over that of the image, at the vertices used."""
    objective: float
    """Value of the minimised function."""
    converged: bool
    """False when the budget or the steps ended first."""
    iterations: int
    """Steps taken."""
    trace: Trace
    """Of the objective."""


def fit_image(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    lighting: LightingModel | None = None,
    *,
    perceptual: PerceptualDistance | None = None,
    options: ImageFitOptions = ImageFitOptions(),
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> ImageFit:
    """Return the reflectance and light that fit one image best, its geometry and pose being known.

    Minimises, with r the differences over the image's median colour and n their number,

        E = W / n sum (sqrt(r^2 + eps^2) - eps) + w (|b|^2 + |g|^2) + w_p P

    over coefficients b of the reflectance, g of the light and log scale_rgb, by Levenberg-Marquardt on
    re-weighted squares. P is a function of the caller's. The penalty of Han, Wang and Xu on coloured light is
    left out: at their weight the albedo's error rose from 0.067 to 0.135, under grey light to 0.070.

    Parameters
    ----------
    observation : ImageObservation
        Colours, normals and directions to the camera of the model's V vertices. Give it the transfer of
        `light_transfer`; without it, shadows that the face casts on itself are taken for dark skin.
    model : MorphableReflectanceModel
    lighting : LightingModel, optional
        `LightingModel.default()` when omitted.
    perceptual : callable, optional
        P: from predicted and observed linear colours (V, 3), NaN at vertices that are not used, to a value
        and its gradient (V, 3) by the predicted ones; its rows for vertices not used do not count.
    options : ImageFitOptions
    budget : Budget or float, optional
        Evaluations or seconds after which the best so far is returned with `converged=False`.
    on_progress : callable, optional
        Called with every `TraceRow`.

    Raises
    ------
    ReflectanceError
        When no vertex is both seen and known, the topologies differ, or `perceptual` returns something else
        than finite numbers of the right shape.

    Warns
    -----
    RuntimeWarning
        When it stops without having converged.

    Notes
    -----
    The second derivative of P is taken as the same along every colour: that along the step before, and at
    first that of a squared distance whose least value is 0. Steps that do not lower the objective are refused
    in any case, so this decides the pace and not the end. A wrong gradient ends the search early.

    One image cannot separate bright skin from bright light, but for the models' priors. In pictures with
    ray-traced shadows the albedo of new faces is 0.067 off with a transfer and 0.078 without; the mean face
    is 0.079 and the nearest one of the model 0.052 off (tools/bench_reflectance_model.py).

    Cost of a step: 3 U (N + M)^2 for U vertices used; 3,700 vertices with 40 and 80 coefficients take about a
    second of CPU in all.
    """
    terms = _image_terms(observation, model, lighting, options)
    meter = Meter("reflectance.image", "objective", Budget.of(budget), on_progress)
    term = None
    if perceptual is not None:
        term = PerceptualTerm(perceptual, terms.used, terms.observed, len(model.known))
    found = minimize(
        _start(_Objective(terms, options, observation.transfer is not None, term, meter)),
        steps=_STEPS,
        tolerance=_TOLERANCE,
        flat_steps=_FLAT_STEPS,
        meter=meter,
        on_better=lambda point: meter.record(point.cost),
    )
    if not found.converged:
        warnings.warn(
            f"the image fit stopped after {found.steps} steps without having converged; the "
            f"objective is {found.best.cost:.4g}",
            RuntimeWarning,
            stacklevel=2,
        )
    return _result(found, terms, model, meter.trace)


def _image_terms(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    lighting: LightingModel | None,
    options: ImageFitOptions,
) -> ImageTerms:
    """Return what the colours of the vertices are made of; `ReflectanceError` where there is none to fit."""
    if len(np.asarray(observation.seen)) != len(model.known):
        raise ReflectanceError(
            f"the observation has {len(np.asarray(observation.seen))} vertices and the model "
            f"{len(model.known)}; bring both to one topology"
        )
    lighting = LightingModel.default() if lighting is None else lighting
    terms = ImageTerms.of(observation, model, lighting, options.lobe)
    if len(terms.used) == 0:
        raise ReflectanceError("no vertex is both seen and known to the model; check the mask")
    return terms


def _result(
    found: Descent[_Point], terms: ImageTerms, model: MorphableReflectanceModel, trace: Trace
) -> ImageFit:
    prediction, used = found.best.prediction, terms.used
    b, g, t = terms.split(found.best.parameters)
    face = model.reconstruct(b)
    specular = np.einsum("vk,vkj->vj", face.reflectance.weights[used], prediction.lobe_light)
    radiance = np.full(model.diffuse_mean.shape, np.nan)
    radiance[used] = face.reflectance.diffuse_linear[used] * prediction.diffuse_light + specular
    off = np.linalg.norm(radiance[used] - terms.observed) / np.linalg.norm(terms.observed)
    return ImageFit(
        face=face,
        light_coefficients=g.copy(),
        scale_rgb=np.exp(t),
        light=prediction.light,
        radiance_linear=radiance,
        relative_rmse=float(off),
        objective=found.best.cost,
        converged=found.converged,
        iterations=found.steps,
        trace=trace,
    )


@dataclass(frozen=True)
class _Objective:
    """E of `fit_image`."""

    terms: ImageTerms
    options: ImageFitOptions
    shadows_modelled: bool
    perceptual: PerceptualTerm | None
    meter: Meter

    @cached_property
    def unit(self) -> float:
        """Median over vertices of the colour, which specks do not move; the mean where that is 0."""
        grey = np.abs(self.terms.observed).mean(1)
        return float(np.median(grey)) or float(grey.mean())

    @cached_property
    def prior(self) -> FloatArray:
        """(P,) second derivatives of the prior; log scale_rgb has none."""
        components = self.terms.basis[1].shape[1] + self.terms.lighting.components
        weight = self.options.prior_weight_of(shadows_modelled=self.shadows_modelled)
        return np.concatenate([np.full(components, 2 * weight), np.zeros(3)])

    def at(self, parameters: FloatArray, before: _Point | None = None) -> _Point:
        """Evaluate the objective at parameters (P,) after a step from `before`."""
        self.meter.count()
        prediction = self.terms.predict(parameters)
        options, soft = self.options, self.options.softness
        off = (prediction.color - self.terms.observed) / self.unit
        cost = options.photometric_weight * float(np.mean(np.hypot(off, soft) - soft))
        cost += 0.5 * float(self.prior @ parameters**2)
        value, curvature = None, 0.0
        if self.perceptual is not None:
            value = self.perceptual.at(prediction.color)
            cost += options.perceptual_weight * value.value
            curvature = value.first_curvature
            if before is not None and before.perceptual is not None:
                step = prediction.color - before.prediction.color
                curvature = secant_curvature(before.perceptual, value, step)
        return _Point(self, parameters, prediction, value, curvature, cost)


@dataclass(frozen=True)
class _Point:
    """The objective at parameters p = (b, g, t)."""

    objective: _Objective
    parameters: FloatArray
    prediction: Prediction
    perceptual: PerceptualValue | None
    curvature: float
    """Second derivative of the perceptual value, taken as the same along every colour."""
    cost: float

    def moved(self, step: FloatArray) -> _Point:
        """Return the objective a step on."""
        return self.objective.at(self.parameters + step, self)

    def normal_equations(self) -> NormalEquations:
        """Return the Gauss-Newton matrix and the gradient.

        Charbonnier's penalty enters as weighted squares, the perceptual value with its own gradient and the
        same second derivative along every colour.
        """
        terms, options, unit = self.objective.terms, self.objective.options, self.objective.unit
        jacobian = terms.jacobian(self.parameters, self.prediction) / unit
        off = ((self.prediction.color - terms.observed) / unit).ravel()
        rows = jacobian.reshape(len(off), -1)
        weight = options.photometric_weight / len(off) / np.hypot(off, options.softness)
        by_color = weight * off
        if self.perceptual is not None:
            share = options.perceptual_weight * unit
            by_color += share * self.perceptual.gradient.ravel()
            weight += share * unit * self.curvature
        scaled = rows * np.sqrt(weight)[:, None]
        prior = self.objective.prior
        gradient = rows.T @ by_color + prior * self.parameters
        longest = np.full(len(gradient), np.inf)
        longest[-3:] = _LARGEST_LOG_SCALE_STEP
        return NormalEquations(scaled.T @ scaled + np.diag(prior), gradient, -longest, longest)


def _start(objective: _Objective) -> _Point:
    """Evaluate the mean face in mean light, scaled so that it is as bright as the image."""
    terms, start = objective.terms, np.zeros(len(objective.prior))
    color = np.median(terms.predict(start).color, axis=0)
    observed = np.maximum(np.median(terms.observed, axis=0), 1e-4 * objective.unit)
    start[-3:] = np.log(observed / np.maximum(color, 1e-4 * max(float(color.max()), 1e-12)))
    return objective.at(start)
