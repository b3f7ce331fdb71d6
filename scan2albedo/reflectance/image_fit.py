"""Find a face's reflectance and the light of one image with morphable models of both."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ReflectanceError
from scan2albedo.optimization import Budget, Meter, ProgressCallback, Trace
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.image_terms import ImageTerms, Prediction
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.lobe_coefficients import Lobe
from scan2albedo.reflectance.morphable_model import ModelReflectance, MorphableReflectanceModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ImageFitOptions:
    """Settings of `fit_image`."""

    photometric_weight: float = 2.0
    """Of the mean absolute difference, in units of the image's median colour."""
    prior_weight: float = 1e-3
    """Of the squared coefficients of reflectance and light. Less is as good or better where light casts no
    shadow, and worse where it does."""
    softness: float = 0.01
    """Differences below this share of the median colour count by their squares (Charbonnier's epsilon)."""
    lobe: Lobe = "tilted"
    """Lobe of the highlights; see `shade_environment`."""
    iterations: int = 200
    """After this many steps it stops without having converged."""
    tolerance: float = 1e-5
    """Relative fall of the objective, three steps running, that counts as convergence."""

    def __post_init__(self) -> None:
        for name in ("photometric_weight", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")
        if not self.prior_weight >= 0:
            raise ValueError(f"prior_weight must be 0 or more, got {self.prior_weight}")


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
    """Root mean square of the differences over that of the image, over what was used."""
    objective: float
    """What was minimised."""
    converged: bool
    iterations: int
    trace: Trace


def fit_image(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    lighting: LightingModel | None = None,
    *,
    options: ImageFitOptions = ImageFitOptions(),
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> ImageFit:
    """Fit coefficients of reflectance and light to one image, its geometry and pose being known.

    Minimises, with r the differences over the image's median colour and n their number,

        E = W / n sum (sqrt(r^2 + eps^2) - eps) + w (|b|^2 + |g|^2)

    over coefficients b of the reflectance, g of the light and log scale_rgb, by Levenberg-Marquardt on
    re-weighted squares. Cast shadows are not modelled.

    Parameters
    ----------
    observation : ImageObservation
        Colours, normals and directions to the camera of the model's V vertices.
    model : MorphableReflectanceModel
    lighting : LightingModel, optional
        `LightingModel.default()` when omitted.
    options : ImageFitOptions
    budget : Budget or float, optional
        Evaluations or seconds after which the best so far is returned with `converged=False`.
    on_progress : callable, optional
        Called with every `TraceRow`.

    Raises
    ------
    ReflectanceError
        When no vertex is both seen and known, or the topologies differ.

    Warns
    -----
    RuntimeWarning
        When it stops without having converged.

    Notes
    -----
    How bright the skin is and how bright the light cannot be told apart but by the models' priors.

    Cost of a step: 3 U (N + M)^2 for U vertices used; 3,700 vertices with 40 and 80 coefficients take 0.7 s
    of CPU in all.

    References
    ----------
    "Learning a 3D morphable face reflectance model from low-cost data", CVPR 2023, supplement.
    """
    if len(np.asarray(observation.seen)) != len(model.known):
        raise ReflectanceError(
            f"the observation has {len(np.asarray(observation.seen))} vertices and the model "
            f"{len(model.known)}; bring both to one topology"
        )
    lighting = LightingModel.default() if lighting is None else lighting
    terms = ImageTerms.of(observation, model, lighting, options.lobe)
    if len(terms.used) == 0:
        raise ReflectanceError("no vertex is both seen and known to the model; check the mask")
    meter = Meter("reflectance.image", "objective", Budget.of(budget), on_progress)
    search = _Search(terms, options, meter)
    search.run()
    if not search.converged:
        warnings.warn(
            f"the image fit stopped after {search.iterations} steps without having converged; the "
            f"objective is {search.value:.4g}",
            RuntimeWarning,
            stacklevel=2,
        )
    return _result(search, model)


def _result(search: _Search, model: MorphableReflectanceModel) -> ImageFit:
    terms = search.terms
    b, g, t = terms.split(search.parameters)
    face = model.reconstruct(b)
    used = terms.used
    specular = np.einsum("vk,vkj->vj", face.reflectance.weights[used], search.prediction.lobe_light)
    radiance = np.full(model.diffuse_mean.shape, np.nan)
    radiance[used] = face.reflectance.diffuse_linear[used] * search.prediction.diffuse_light + specular
    off = np.linalg.norm(radiance[used] - terms.observed) / np.linalg.norm(terms.observed)
    return ImageFit(
        face=face,
        light_coefficients=g.copy(),
        scale_rgb=np.exp(t),
        light=search.prediction.light,
        radiance_linear=radiance,
        relative_rmse=float(off),
        objective=search.value,
        converged=search.converged,
        iterations=search.iterations,
        trace=search.meter.trace,
    )


_FLAT_STEPS = 3
_LARGEST_DAMPING = 1e10


class _Search:
    """State of the Levenberg-Marquardt search."""

    def __init__(self, terms: ImageTerms, options: ImageFitOptions, meter: Meter) -> None:
        self.terms, self.options, self.meter = terms, options, meter
        self.unit = _unit(terms.observed)
        components = terms.basis[1].shape[1] + terms.lighting.components
        self.prior = np.concatenate([np.full(components, 2 * options.prior_weight), np.zeros(3)])
        self.parameters = np.zeros(components + 3)
        self.parameters[-3:] = self._first_scale()
        self.prediction = terms.predict(self.parameters)
        self.value = self._objective(self.parameters, self.prediction)
        self.iterations, self.converged, self.damping = 0, False, 1e-3
        self.meter.count()
        self.meter.record(self.value)

    def run(self) -> None:
        """Step until the objective hardly falls, or the budget or the steps end."""
        flat = 0
        while self.iterations < self.options.iterations and not self.meter.exhausted:
            before = self.value
            if not self._step():
                # No step along the descent direction helps any more, or the budget cut the trials short.
                self.converged = self.damping > _LARGEST_DAMPING
                return
            self.iterations += 1
            self.meter.record(self.value)
            flat = flat + 1 if before - self.value < self.options.tolerance * before else 0
            if flat == _FLAT_STEPS:
                self.converged = True
                return

    def _step(self) -> bool:
        """Go down by one damped step, damping more until the objective falls; tell whether it did."""
        hessian, gradient = self._normal_equations()
        diagonal = np.diag(hessian)
        floor = 1e-12 * max(diagonal.max(), 1e-300)
        while self.damping <= _LARGEST_DAMPING and not self.meter.exhausted:
            damped = hessian + np.diag(self.damping * diagonal + floor)
            trial = self.parameters - np.linalg.solve(damped, gradient)
            # A scale that grows by e^5 in a step is a runaway, and would overflow in the exponential.
            trial[-3:] = self.parameters[-3:] + np.clip(trial[-3:] - self.parameters[-3:], -5, 5)
            prediction = self.terms.predict(trial)
            value = self._objective(trial, prediction)
            self.meter.count()
            if np.isfinite(value) and value < self.value:
                self.parameters, self.prediction, self.value = trial, prediction, value
                self.damping = max(self.damping / 5, 1e-9)
                return True
            self.damping *= 4
        return False

    def _normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton matrix and the gradient, Charbonnier's penalty as weighted squares."""
        jacobian = self.terms.jacobian(self.parameters, self.prediction) / self.unit
        off = ((self.prediction.color - self.terms.observed) / self.unit).ravel()
        rows = jacobian.reshape(len(off), -1)
        weight = self.options.photometric_weight / len(off) / np.hypot(off, self.options.softness)
        root = np.sqrt(weight)
        scaled = rows * root[:, None]
        gradient = scaled.T @ (root * off) + self.prior * self.parameters
        return scaled.T @ scaled + np.diag(self.prior), gradient

    def _objective(self, parameters: FloatArray, prediction: Prediction) -> float:
        off = (prediction.color - self.terms.observed) / self.unit
        soft = self.options.softness
        photometric = float(np.mean(np.hypot(off, soft) - soft))
        return self.options.photometric_weight * photometric + 0.5 * float(self.prior @ parameters**2)

    def _first_scale(self) -> FloatArray:
        """Return log scale_rgb with which the mean face under mean light is as bright as the image."""
        color = np.median(self.terms.predict(self.parameters).color, axis=0)
        observed = np.maximum(np.median(self.terms.observed, axis=0), 1e-4 * self.unit)
        return np.asarray(np.log(observed / np.maximum(color, 1e-4 * max(float(color.max()), 1e-12))))


def _unit(observed: FloatArray) -> float:
    """Return the median over vertices of the colour, which specks do not move; the mean where that is 0."""
    grey = np.abs(observed).mean(1)
    return float(np.median(grey)) or float(grey.mean())
