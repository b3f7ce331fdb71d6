"""Find a face's reflectance and the light of one image with morphable models of both."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import BudgetLike, Meter, OnProgress, Trace
from scan2albedo.core.arrays import SMALLEST, FloatArray, IntArray, checked_array
from scan2albedo.errors import ReflectanceError
from scan2albedo.optimization.least_squares import LocalTerm, NormalEquations, map_equations, minimize
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import ModelReflectance, MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import among_all, require_one_topology

PerceptualDistance = Callable[[FloatArray, FloatArray], tuple[float, ArrayLike]]
"""See `fit_image`."""

PHOTOMETRIC_WEIGHT = 2.0
"""Of the mean absolute difference, in units of the image's median colour."""
SOFTNESS = 0.01
"""Differences below this share of it count by their squares (Charbonnier's epsilon)."""
PRIOR_WEIGHT = {True: 3e-4, False: 1e-3}
"""Of the squared coefficients, with the face's own shadows and without: those must not pass for skin."""
MOST_UNEXPLAINED = 0.25
"""Where a fit's relative RMSE is larger, light, shape or reflectance are wrong."""
_PERCEPTUAL_WEIGHT = 0.1


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
    converged: bool
    iterations: int
    trace: Trace
    """`objective`, `trace`: of what is minimised. `converged` is False when the budget or the steps
    (`iterations`) ended first."""


def fit_image(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    lighting: LightingModel | None = None,
    *,
    perceptual: PerceptualDistance | None = None,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> ImageFit:
    """Return the reflectance and light that fit one image best, its geometry and pose being known.

    Minimises, with r the differences over the image's median colour and n their number,

        E = 2 / n sum (sqrt(r^2 + eps^2) - eps) + w (|b|^2 + |g|^2) + P / 10,   eps = 0.01,

    over coefficients b of the reflectance, g of the light and log scale_rgb, by Levenberg-Marquardt on
    re-weighted squares; w is 3e-4 where the observation has a transfer and 1e-3 without. P is a function of
    the caller's. Without the penalty of Han, Wang and Xu on coloured light albedos are nearer. Raises
    `ReflectanceError` when no vertex is both seen and known, the topologies differ, or `perceptual` returns
    other things than it should. Warns by `RuntimeWarning` when it stops without having converged.

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
        and its gradient (V, 3) by the predicted ones; its rows for vertices not used do not count. Its second
        derivative is taken as that along the step before.
    budget, on_progress : optional
        When it ends the best so far is returned with `converged=False`; called with every `TraceRow`.

    Notes
    -----
    One image cannot separate bright skin from bright light, but for the models' priors. In pictures with
    ray-traced shadows the albedo of new faces is 0.067 off with a transfer and 0.078 without; the mean face
    is 0.079 and the nearest one of the model 0.052 off (`python tools/bench photographs/shadows`).
    """
    lighting = LightingModel.default() if lighting is None else lighting
    meter = Meter("reflectance.image", "objective", budget, on_progress)
    terms = ImageTerms(observation, model, lighting, meter, perceptual)
    # The mean face in mean light, as bright as the image.
    start = np.zeros(len(terms.prior))
    color = np.median(terms.predict(start).color, axis=0)
    floor = 1e-4 * np.array([terms.unit, max(color.max(), SMALLEST)])
    observed = np.median(terms.observed, axis=0)
    start[-3:] = np.log(np.maximum(observed, floor[0]) / np.maximum(color, floor[1]))
    first, record = terms.predict(start), lambda point: meter.record(point.cost)
    found = minimize(first, steps=200, tolerance=1e-5, flat_steps=3, meter=meter, on_better=record)
    if not found.converged:
        text = f"the image fit stopped after {found.steps} steps without having converged; the objective is "
        warnings.warn(f"{text}{found.best.cost:.4g}", RuntimeWarning, stacklevel=2)
    best, used = found.best, terms.used
    b, g, t = terms.split(best.parameters)
    face, light = model.reconstruct(b), terms.light(best.parameters)
    radiance = terms.response.shade(face.reflectance.chosen(used), light).radiance_linear
    off = np.linalg.norm(radiance - terms.observed) / np.linalg.norm(terms.observed)
    return ImageFit(
        face=face,
        light_coefficients=g.copy(),
        scale_rgb=np.exp(t),
        light=light,
        radiance_linear=among_all(used, len(model.known), radiance),
        relative_rmse=float(off),
        objective=best.cost,
        converged=found.converged,
        iterations=found.steps,
        trace=meter.trace,
    )


def common_vertices(observation: ImageObservation, model: MorphableReflectanceModel) -> IntArray:
    """Return the vertices (U,) both seen and known to the model; `ReflectanceError` when there is none."""
    require_one_topology("the observation", len(observation.seen), "the model", len(model.known))
    used = np.flatnonzero(observation.seen & model.known)
    if not len(used):
        raise ReflectanceError("no vertex is both seen and known to the model; check the mask")
    return used


def usual_color(colors: FloatArray) -> float:
    """Return the median over vertices of colours (V, 3), which specks do not move; the mean where it is 0."""
    grey = np.abs(colors).mean(1)
    return float(np.median(grey)) or float(grey.mean())


def photometric_penalty(off: FloatArray) -> tuple[float, FloatArray]:
    """Return 2 mean(sqrt(r^2 + eps^2) - eps) of differences r, and its derivatives over r, as weights."""
    size = np.hypot(off, SOFTNESS)
    return PHOTOMETRIC_WEIGHT * float(np.mean(size - SOFTNESS)), PHOTOMETRIC_WEIGHT / off.size / size


@dataclass(frozen=True)
class Prediction:
    """Colours (U, 3) of the vertices used at parameters p = (b, g, t), with the objective, for `minimize`."""

    terms: "ImageTerms"
    parameters: FloatArray
    color: FloatArray
    distance: float = 0.0
    gradient: FloatArray | None = None
    """`distance`, `gradient`: of the caller's function, and (U, 3) by the colours; None without one."""
    curvature: float = 0.0
    """Second derivative of the distance, taken as the same along every colour."""

    @cached_property
    def off(self) -> FloatArray:
        """(U, 3) differences in units of the image's."""
        return (self.color - self.terms.observed) / self.terms.unit

    @cached_property
    def cost(self) -> float:
        """Charbonnier's penalty of the differences, the caller's, and the prior."""
        self.terms.meter.count()
        data = photometric_penalty(self.off)[0] + _PERCEPTUAL_WEIGHT * self.distance
        return data + 0.5 * float(self.terms.prior @ self.parameters**2)

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model: Charbonnier's penalty as weighted squares, the caller's by slope."""
        unit, off = self.terms.unit, self.off.ravel()
        jacobian = self.terms.jacobian(self) / unit
        _, curvature = photometric_penalty(off)
        slope = curvature * off
        if self.gradient is not None:
            slope += _PERCEPTUAL_WEIGHT * unit * self.gradient.ravel()
            curvature = curvature + _PERCEPTUAL_WEIGHT * unit**2 * self.curvature
        colors = LocalTerm(jacobian.reshape(len(off), -1), slope, curvature)
        return map_equations([colors], self.terms.prior, self.parameters)

    def moved(self, step: FloatArray) -> "Prediction":
        """Return the prediction a step (P,) on."""
        limited = step.copy()
        limited[-3:] = np.clip(step[-3:], -5, 5)  # a longer one would overflow in the exponential
        return self.terms.predict(self.parameters + limited, self)


class ImageTerms:
    """One image's vertices U that are seen and known to the model; the objective of `fit_image`.

    The parameters are p = (b, g, t): N coefficients of reflectance, those of light, and the logarithms of
    scale_rgb, with

        I_vj = c_v(b)_j D_v . L_j + sum_k s_v(b) w'_vk(b) S_vk . L_j,
        L_j = exp(t_j) (mean + sum g_i basis_i)_j.

    `prior` (P,) are second derivatives of the prior; log scale_rgb has none. `model` is that of the vertices
    `used`.
    """

    def __init__(
        self,
        observation: ImageObservation,
        model: MorphableReflectanceModel,
        lighting: LightingModel,
        meter: Meter,
        perceptual: PerceptualDistance | None = None,
    ) -> None:
        self.used = common_vertices(observation, model)
        self.observed = observation.observed_linear[self.used]
        self.response = observation.response(self.used)
        self.model = model.of(self.used)
        self.lighting = lighting
        self.perceptual = perceptual
        self.count = len(model.known)
        self.meter = meter
        weight = 2 * PRIOR_WEIGHT[observation.transfer is not None]
        self.prior = np.append(np.full(model.components + lighting.components, weight), np.zeros(3))

    @cached_property
    def unit(self) -> float:
        """The usual colour observed."""
        return usual_color(self.observed)

    def split(self, parameters: FloatArray) -> list[FloatArray]:
        """Return b, g and t of parameters."""
        return np.split(parameters, [self.model.components, -3])

    def light(self, parameters: FloatArray) -> FloatArray:
        """Return the harmonics (81, 3) of the light of parameters (P,)."""
        _, g, t = self.split(parameters)
        return self.lighting.light(g, scale_rgb=np.exp(t))

    def reflected(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the reflectance's values c, s, w' (U, 7), and the colours' derivatives (U, 3, 7) by them."""
        light = self.light(parameters)
        values = self.model.at(self.split(parameters)[0])
        lobes = self.response.specular @ light
        by_values = np.zeros((len(values), 3, 7))
        by_values[:, range(3), range(3)] = self.response.diffuse @ light
        by_values[:, :, 3] = np.einsum("vk,vkj->vj", values[:, 4:], lobes)
        by_values[:, :, 4:] = values[:, 3, None, None] * lobes.transpose(0, 2, 1)
        return values, by_values

    def predict(self, parameters: FloatArray, before: Prediction | None = None) -> Prediction:
        """Return the colours of parameters (P,), reached by a step from `before`."""
        values, by_values = self.reflected(parameters)
        color = np.einsum("vjc,vc->vj", by_values[:, :, :4], values[:, :4])
        if self.perceptual is None:
            return Prediction(self, parameters, color)
        distance, gradient = self._perceived(self.perceptual, color)
        if before is not None and before.gradient is not None:
            step = color - before.color
            length = np.sum(step**2)
            bend = np.sum((gradient - before.gradient) * step)
            curvature = max(bend / length, 0.0) if length > 0 else 0.0
        else:
            curvature = np.sum(gradient**2) / (2 * abs(distance)) if distance else 0.0
        return Prediction(self, parameters, color, distance, gradient, curvature)

    def _perceived(self, perceptual: PerceptualDistance, color: FloatArray) -> tuple[float, FloatArray]:
        """Return what the caller's function says of colours (U, 3): a distance and its gradient (U, 3)."""
        # Arrays of their own, so that a function that writes into its arguments harms nobody.
        predicted = among_all(self.used, self.count, color)
        answer = perceptual(predicted, among_all(self.used, self.count, self.observed))
        try:
            distance = float(answer[0])
            gradient = checked_array(answer[1], (self.count, 3), "the gradient")[self.used]
        except (TypeError, ValueError, IndexError) as error:
            raise ReflectanceError(
                f"the perceptual function returned {type(answer).__name__}, expected a number and its "
                f"gradient ({self.count}, 3) by the predicted colours ({error})"
            ) from error
        bad = ~np.isfinite(gradient).all(1)
        if not np.isfinite(distance) or bad.any():
            raise ReflectanceError(
                f"the perceptual function returned the value {distance} and no gradient at {bad.sum()} "
                "vertices; it must leave out vertices that are NaN in the predicted colours"
            )
        return distance, gradient

    def jacobian(self, at: Prediction) -> FloatArray:
        """Return the derivatives (U, 3, P) of the colours by the parameters."""
        values, by_values = self.reflected(at.parameters)
        by_b = by_values @ self.model.basis.transpose(1, 2, 0)
        specular = np.einsum("vk,vkh->vh", values[:, 3:4] * values[:, 4:], self.response.specular)
        scale_rgb = np.exp(at.parameters[-3:])
        by_g = np.empty((*at.color.shape, self.lighting.components))
        by_t = np.zeros((*at.color.shape, 3))
        for channel in range(3):
            reflected = values[:, channel, None] * self.response.diffuse + specular
            by_g[:, channel] = reflected @ (scale_rgb[channel] * self.lighting.basis[:, :, channel].T)
            by_t[:, channel, channel] = at.color[:, channel]
        return np.concatenate([by_b, by_g, by_t], axis=2)
