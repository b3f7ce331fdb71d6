"""Find a face's reflectance and the light of one image with morphable models of both."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Budget, Meter, ProgressCallback, Trace
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.image_fit_options import ImageFitOptions
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.image_search import ImageSearch
from scan2albedo.reflectance.image_terms import ImageTerms
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import ModelReflectance, MorphableReflectanceModel
from scan2albedo.reflectance.perceptual_term import PerceptualDistance, PerceptualTerm

FloatArray = NDArray[np.float64]


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
    """Fit coefficients of reflectance and light to one image, its geometry and pose being known.

    Minimises, with r the differences over the image's median colour and n their number,

        E = W / n sum (sqrt(r^2 + eps^2) - eps) + w (|b|^2 + |g|^2) + w_p P + w_l |L - mean_rgb L|^2

    over coefficients b of the reflectance, g of the light and log scale_rgb, by Levenberg-Marquardt on
    re-weighted squares. P is a function of the caller's; the last term is left out by default.

    Parameters
    ----------
    observation : ImageObservation
        Colours, normals and directions to the camera of the model's V vertices. Give it the transfer of
        `light_transfer`, or shadows that the face casts on itself pass for skin.
    model : MorphableReflectanceModel
    lighting : LightingModel, optional
        `LightingModel.default()` when omitted.
    perceptual : callable, optional
        P: from predicted and observed linear colours (V, 3), NaN at vertices that are not used, to a value
        and its gradient (V, 3) by the predicted ones; what it returns at vertices not used does not count.
    options : ImageFitOptions
    budget : Budget or float, optional
        Evaluations or seconds after which the best so far is returned with `converged=False`.
    on_progress : callable, optional
        Called with every `TraceRow`.

    Returns
    -------
    ImageFit

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
    The perceptual value is taken to bend alike along every colour: its second derivative is that along the
    step before, and at first that of a squared distance whose least value is 0. A step that does not lower
    the whole objective is refused whatever was assumed, so this decides the pace and not the end. A gradient
    that is not the value's ends the search early.

    How bright the skin is and how bright the light cannot be told apart but by the models' priors.

    In pictures with ray-traced shadows the albedo of faces that the model was not learned from is 0.067 off
    with a transfer, 0.078 without, that of the mean face 0.079 and the nearest of the model 0.052, and
    radiance in other light 0.053 and 0.100 off, as tools/bench_reflectance_model.py tells.

    Cost of a step: 3 U (N + M)^2 for U vertices used; 3,700 vertices with 40 and 80 coefficients take about a
    second of CPU in all.

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
    term = None
    if perceptual is not None:
        term = PerceptualTerm(perceptual, terms.used, terms.observed, len(model.known))
    prior = options.prior_weight_of(shadows_modelled=observation.transfer is not None)
    search = ImageSearch(terms, options, prior, meter, term)
    search.run()
    if not search.converged:
        warnings.warn(
            f"the image fit stopped after {search.iterations} steps without having converged; the "
            f"objective is {search.value:.4g}",
            RuntimeWarning,
            stacklevel=2,
        )
    return _result(search, model)


def _result(search: ImageSearch, model: MorphableReflectanceModel) -> ImageFit:
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
