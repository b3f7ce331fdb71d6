"""Levenberg-Marquardt search for the reflectance and the light of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Meter
from scan2albedo.reflectance.image_fit_options import ImageFitOptions
from scan2albedo.reflectance.image_terms import ImageTerms, Prediction
from scan2albedo.reflectance.perceptual_term import PerceptualTerm, PerceptualValue, secant_curvature
from scan2albedo.reflectance.white_light_term import WhiteLightTerm

FloatArray = NDArray[np.float64]

_FLAT_STEPS = 3
_LARGEST_DAMPING = 1e10
_WHITE = np.sqrt(4 * np.pi)
"""First coefficient of light whose mean radiance is 1."""


@dataclass(frozen=True)
class _Point:
    """Parameters and what they lead to."""

    parameters: FloatArray
    prediction: Prediction
    perceptual: PerceptualValue | None
    value: float


class ImageSearch:
    """State of the search; `run` moves it.

    Parameters
    ----------
    terms : ImageTerms
    options : ImageFitOptions
    prior_weight : float
        Of the squared coefficients.
    meter : Meter
    perceptual : PerceptualTerm, optional
    """

    def __init__(
        self,
        terms: ImageTerms,
        options: ImageFitOptions,
        prior_weight: float,
        meter: Meter,
        perceptual: PerceptualTerm | None,
    ) -> None:
        self.terms, self.options, self.meter, self._perceptual = terms, options, meter, perceptual
        self._unit = _unit(terms.observed)
        components = terms.basis[1].shape[1] + terms.lighting.components
        self._prior = np.concatenate([np.full(components, 2 * prior_weight), np.zeros(3)])
        start = np.zeros(components + 3)
        start[-3:] = self._first_scale(start)
        brightness = float(np.exp(start[-3:]).mean()) * _WHITE
        self._white = WhiteLightTerm(options.white_light_weight, brightness, terms.lighting)
        self._at = self._point(start)
        self._curvature = self._at.perceptual.first_curvature if self._at.perceptual else 0.0
        self.iterations, self.converged, self._damping = 0, False, 1e-3
        self.meter.record(self.value)

    @property
    def parameters(self) -> FloatArray:
        """The best so far."""
        return self._at.parameters

    @property
    def prediction(self) -> Prediction:
        """Colours of the best so far."""
        return self._at.prediction

    @property
    def value(self) -> float:
        """Objective of the best so far."""
        return self._at.value

    def run(self) -> None:
        """Step until the objective hardly falls, or the budget or the steps end."""
        flat = 0
        while self.iterations < self.options.iterations and not self.meter.exhausted:
            before = self.value
            if not self._step():
                # No step along the descent direction helps any more, or the budget cut the trials short.
                self.converged = self._damping > _LARGEST_DAMPING
                return
            self.iterations += 1
            self.meter.record(self.value)
            flat = flat + 1 if before - self.value < self.options.tolerance * abs(before) else 0
            if flat == _FLAT_STEPS:
                self.converged = True
                return

    def _step(self) -> bool:
        """Go down by one damped step, damping more until the objective falls; tell whether it did."""
        hessian, gradient = self._normal_equations()
        diagonal = np.diag(hessian)
        floor = 1e-12 * max(diagonal.max(), 1e-300)
        while self._damping <= _LARGEST_DAMPING and not self.meter.exhausted:
            damped = hessian + np.diag(self._damping * diagonal + floor)
            trial = self.parameters - np.linalg.solve(damped, gradient)
            # A scale that grows by e^5 in a step is a runaway, and would overflow in the exponential.
            trial[-3:] = self.parameters[-3:] + np.clip(trial[-3:] - self.parameters[-3:], -5, 5)
            point = self._point(trial)
            if np.isfinite(point.value) and point.value < self.value:
                self._accept(point)
                return True
            self._damping *= 4
        return False

    def _accept(self, point: _Point) -> None:
        if point.perceptual and self._at.perceptual:
            step = point.prediction.color - self.prediction.color
            self._curvature = secant_curvature(self._at.perceptual, point.perceptual, step)
        self._at = point
        self._damping = max(self._damping / 5, 1e-9)

    def _normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton matrix and the gradient.

        Charbonnier's penalty enters as weighted squares, the perceptual value with its own gradient and the
        same second derivative along every colour.
        """
        at, options = self._at, self.options
        jacobian = self.terms.jacobian(at.parameters, at.prediction) / self._unit
        off = ((at.prediction.color - self.terms.observed) / self._unit).ravel()
        rows = jacobian.reshape(len(off), -1)
        weight = options.photometric_weight / len(off) / np.hypot(off, options.softness)
        by_color = weight * off
        if at.perceptual is not None:
            share = options.perceptual_weight * self._unit
            by_color += share * at.perceptual.gradient.ravel()
            weight += share * self._unit * self._curvature
        scaled = rows * np.sqrt(weight)[:, None]
        hessian = scaled.T @ scaled + np.diag(self._prior)
        gradient = rows.T @ by_color + self._prior * at.parameters
        if self._white.weight:
            light = slice(self.terms.basis[1].shape[1], None)
            matrix, slope = self._white.normal_equations(at.parameters[-3:], at.prediction.light)
            hessian[light, light] += matrix
            gradient[light] += slope
        return hessian, gradient

    def _point(self, parameters: FloatArray) -> _Point:
        prediction = self.terms.predict(parameters)
        perceptual = self._perceptual.at(prediction.color) if self._perceptual else None
        self.meter.count()
        off, soft = (prediction.color - self.terms.observed) / self._unit, self.options.softness
        value = self.options.photometric_weight * float(np.mean(np.hypot(off, soft) - soft))
        value += 0.5 * float(self._prior @ parameters**2) + self._white.value(prediction.light)
        if perceptual is not None:
            value += self.options.perceptual_weight * perceptual.value
        return _Point(parameters, prediction, perceptual, value)

    def _first_scale(self, parameters: FloatArray) -> FloatArray:
        """Return log scale_rgb with which the mean face under mean light is as bright as the image."""
        color = np.median(self.terms.predict(parameters).color, axis=0)
        observed = np.maximum(np.median(self.terms.observed, axis=0), 1e-4 * self._unit)
        return np.asarray(np.log(observed / np.maximum(color, 1e-4 * max(float(color.max()), 1e-12))))


def _unit(observed: FloatArray) -> float:
    """Return the median over vertices of the colour, which specks do not move; the mean where that is 0."""
    grey = np.abs(observed).mean(1)
    return float(np.median(grey)) or float(grey.mean())
