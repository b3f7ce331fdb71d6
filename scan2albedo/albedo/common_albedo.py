"""`estimate_common_albedo`: one albedo from several images of a surface or person, each in its own light."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from scan2albedo.albedo.estimate import divided, shaded_image
from scan2albedo.albedo.levels import cell_field
from scan2albedo.albedo.light_colour import light_colours
from scan2albedo.albedo.light_priors import parts_steps
from scan2albedo.albedo.light_search import LightSearch
from scan2albedo.albedo.node_field import FAINT, TINY, deviation_of_light
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.posterior import Point, robust_weights
from scan2albedo.albedo.result import AlbedoEstimate
from scan2albedo.albedo.shaded_image import Explanation, LightFound, ShadedImage
from scan2albedo.albedo.shared_light import shared_lights
from scan2albedo.albedo.texel_light import light_on_texels
from scan2albedo.albedo.uncertainty import light_uncertainty
from scan2albedo.core import (
    BudgetLike,
    GeometryImage,
    Meter,
    OnProgress,
    Plan,
    PlanStep,
    Trace,
)
from scan2albedo.core.arrays import Float32Array, FloatArray, NDArray, on_grid
from scan2albedo.errors import LightingError

_PASSES = 6
"""Rounds of robust weights and gains."""


@dataclass(frozen=True)
class CommonAlbedo:
    """Result of `estimate_common_albedo`; images are zero outside the mask."""

    albedo_linear: Float32Array
    """(H, W, 3): up to one global scale, in the mean colours of all cameras."""
    expected_error: Float32Array
    """(H, W): relative error that two texels in three stay below, best scale removed; 1 where nothing was
    measured. It falls with the number of images that show a texel well lit."""
    coverage: NDArray[np.uint16]
    """(H, W): how many images show each texel."""
    disagreement: Float32Array
    """(H, W): root mean square by which the images' own albedos differ from it, relative: make-up, a tan,
    another expression or person; 0 where fewer than two images show a texel."""
    gains: FloatArray
    """(K, 3): by what the colours of each image's own albedo are multiplied to agree."""
    estimates: tuple[AlbedoEstimate, ...]
    """Each image in its own light, beside the common albedo; empty where `on_estimate` took them."""
    plan: Plan
    """What ran, and why."""
    trace: Trace
    """Error against run time."""
    converged: bool
    """False when the budget ended the search."""


def estimate_common_albedo(
    images: Iterable[GeometryImage],
    *,
    lights: str | int = "auto",
    brdf: str = "oren-nayar",
    budget: BudgetLike = None,
    seed: int = 0,
    options: EstimateOptions = EstimateOptions(),
    on_estimate: Callable[[int, AlbedoEstimate], None] | None = None,
    on_progress: OnProgress = None,
) -> CommonAlbedo:
    """Estimate one albedo, and a light for each of several images of it.

    Photographs of one surface in several lights, or scans of one person on one chart: each image has its own
    shape, camera and light. The light of each is sought alone (`estimate_albedo`); then all are refined at
    once with one albedo between them (`SharedLight`), which separates what moves with the light from what
    stays. Texels are averaged with gains a channel and an image, weighed by how well each is lit and seen, by
    Student's t: what one image shows otherwise, a shadow that no ray finds or a brow a millimetre away,
    counts little. Raises LightingError without images or where their charts differ, ValueError for a light
    without lamps; see `estimate_albedo`.

    Parameters
    ----------
    images : iterable of GeometryImage
        Walked through twice, and not kept: it may read them from files.
    lights, brdf, seed, options
        As in `estimate_albedo`, with a diffuse model of lamps; their number is that of each image.
    budget : Budget or float, optional
        Of the whole search.
    on_estimate : callable, optional
        Called with the number and the estimate of each image, which are then not kept.
    on_progress : callable, optional
        Called with each trace row.

    Returns
    -------
    CommonAlbedo

    Notes
    -----
    The memory is that of one image, and three numbers a texel and some thousand a cell for each. Lights of
    one albedo are told apart by the ratios of images, which no albedo changes [1]_.

    .. [1] R. Basri, D. Jacobs, I. Kemelmacher, "Photometric stereo with general, unknown lighting", IJCV
       72(3), 2007.
    """
    if brdf == "spherical-harmonics" or options.objective != "residual":
        raise ValueError("a common albedo is found with lamps and the objective 'residual'")
    meter = Meter("albedo", "perplexity a cell", budget, on_progress)
    plan = Plan()
    searched = list[LightFound]()
    charts = set[tuple[int, ...]]()

    def scene_of(image: GeometryImage) -> tuple[ShadedImage, Plan]:
        return shaded_image(image, brdf, (0.0, 0.0, 1.0), options, meter)

    # The systems are small: further threads of BLAS would wait for work.
    with threadpool_limits(1, "blas"):
        for image in images:
            scene, steps = scene_of(image)
            found = LightSearch(scene).run(None if lights == "auto" else int(lights))
            searched.append(found)
            plan += steps
            charts.add((*image.shape, _best(found).problem.level.factor))
        if not searched:
            raise LightingError("no image was given: give one or more geometry images with a texture")
        if len(charts) > 1:
            raise LightingError("the images lie on different charts: process all with one model and size")
        reason = "the lights of one albedo, found together"
        plan += [PlanStep("albedo.shared", len(searched) > 1, reason, f"{len(searched)} image(s)")]
        light_deviation = None
        if len(searched) > 1:
            shared = shared_lights([_best(found) for found in searched], image.shape[1], meter)
            searched = [
                _with_shared(found, point, options)
                for found, point in zip(searched, shared.points, strict=True)
            ]
            light_deviation = shared.deviation
        estimates = list[AlbedoEstimate]()
        measured = list[tuple[NDArray, NDArray, NDArray]]()
        for number, (image, found) in enumerate(zip(images, searched, strict=True)):
            scene, _ = scene_of(image)
            estimate = divided(scene, light_on_texels(scene, found), found, Plan(), seed)
            measured.append(_measured(scene, estimate))
            if on_estimate is None:
                estimates.append(estimate)
            else:
                on_estimate(number, estimate)
    mask = image.mask
    logs, weights, errors = map(np.array, zip(*measured, strict=True))
    mean, gains, weight, spread = _averaged(logs, weights)
    variance = ((weight * errors) ** 2).sum(0) / weight.sum(0) ** 2
    if light_deviation is not None:
        level, deviation = light_deviation
        variance += cell_field(level, deviation[:, None], mask)[:, 0] ** 2
    shown = (weights > 1).sum(0)
    return CommonAlbedo(
        albedo_linear=on_grid(mask, np.exp(mean).astype(np.float32)),
        expected_error=on_grid(mask, np.minimum(np.sqrt(variance), 1).astype(np.float32)),
        coverage=on_grid(mask, shown.astype(np.uint16)),
        disagreement=on_grid(mask, np.where(shown > 1, spread, 0).astype(np.float32)),
        gains=gains,
        estimates=tuple(estimates),
        plan=plan,
        trace=meter.trace,
        converged=not meter.exhausted,
    )


def _measured(scene: ShadedImage, estimate: AlbedoEstimate) -> tuple[NDArray, NDArray, NDArray]:
    """Return log albedo (N, 3) on the masked texels, weights (N,), and the errors that it expects (N,)."""
    mask = scene.image.mask
    assert estimate.expected_error is not None
    error = estimate.expected_error[mask]
    light = np.maximum(estimate.shading.mean(-1), TINY)
    # Light that no part stands for is a share of the lamps': an image that is mostly dark knows less. Its
    # brightest texels, but for those of bad normals, say how bright the lamps are.
    dark = deviation_of_light(light[mask], float(np.quantile(light[scene.usable], 0.98)))
    known = np.where(scene.usable[mask], 1.0, TINY)
    log = np.log(np.maximum(estimate.albedo_linear[mask], FAINT)).astype(np.float32)
    return log, known / (error**2 + dark**2), error


def _best(found: LightFound) -> Point:
    assert found.explanation is not None
    return found.explanation.best


def _with_shared(found: LightFound, point: Point, options: EstimateOptions) -> LightFound:
    """Return what a search found with the light of `point`, which knows the albedo of all images."""
    colours = light_colours(point, options.choice("albedo.light_colour"))
    rows = parts_steps(point.model, point.x, point.covariance(), point.prior, options)
    cells = len(point.light)
    explained = Explanation(point, colours, point.problem.level, *np.zeros((2, cells)))
    # Shadows, lamps and their sizes stay as they were.
    steps = [*found.steps[:3], *rows, colours.step]
    return LightFound(point.solution(), steps, light_uncertainty(point), explained)


def _averaged(
    logs: Float32Array, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the mean (N, 3) of log albedos (K, N, 3), gains (K, 3), weights (K, N) and spread (N,).

    Gains and mean are the least squares of log a_k + log g_k = log a, weighed anew by Student's t. With gains
    known, what is brighter than the mean has heavier tails: highlights, and light from skin to skin in
    hollows. Shadows of the cells are no part of it: texels have those that the picture shows.
    """
    robust, gains = weights, np.zeros((len(logs), 3))
    for again in range(2 * _PASSES if len(logs) > 1 else 1):
        total = robust.sum(0)
        mean = np.einsum("kn,knc->nc", robust, logs) / total[:, None]
        if again < _PASSES:
            share = robust.sum(1)
            # The last term holds the mean gain, which nothing tells, at 0.
            system = np.diag(share) - robust @ (robust / total).T + np.outer(share, share) / share.sum()
            right = np.array([weight @ (mean - log) for weight, log in zip(robust, logs, strict=True)])
            gains = np.linalg.solve(system, right)
        mean += np.einsum("kn,kc->nc", robust / total, gains)
        residual = [log + gain - mean for log, gain in zip(logs, gains, strict=True)]
        square = np.array([(each**2).mean(-1) for each in residual])
        bright = again >= _PASSES and np.array([each.mean(-1) > 0 for each in residual])
        robust = robust_weights(np.sqrt(square), 1 / weights, 1.0, bright)
    spread = np.sqrt((weights * square).sum(0) / weights.sum(0))
    return mean, np.exp(gains), robust, spread
