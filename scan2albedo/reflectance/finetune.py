"""Improve a morphable reflectance model with plain images of other faces."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import Budget, BudgetLike, Meter, OnProgress, Trace
from scan2albedo.core.arrays import SMALLEST, FloatArray, checked_mesh
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.fields import surface_diffusion
from scan2albedo.geometry.rays import blocks
from scan2albedo.reflectance.image_fit import ImageFit, common_vertices, fit_image
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import BLOCK, require_one_topology
from scan2albedo.statistics.robust import normal_deviation

ROUNDS = 10
"""Most rounds of fitting all images and changing the model."""
MEAN_CHANGE = 0.1
"""Prior standard deviation of a change of the means, as a share of the mean albedo (the mean sum of
weights)."""
BASIS_CHANGES = (0.1, 0.3)
"""The same of the directions, as shares of the means': the held-out images choose among them."""
SMOOTHING_MM = 6.0
"""Standard deviation, along the surface, of the smoothing of changes."""
SIGNIFICANCE_LEVEL = 0.025
"""Probability that a change without effect on images like the held-out ones is accepted."""
_LEAST_GAIN = 1e-3
"""Relative fall of the held-out images' objective and RMSE below which no change is accepted."""


@dataclass(frozen=True)
class FineTuning:
    """A model after `finetune`, and its errors on images it was not tuned with."""

    model: MorphableReflectanceModel
    """The one given when nothing was accepted."""
    accepted_steps: tuple[float, ...]
    """Share of its change that each accepted round took."""
    held_out_before: float
    held_out_after: float
    """`held_out_before`, `held_out_after`: mean objective of fits to the held-out images with each model."""
    converged: bool
    """False when the budget or the rounds ended while changes still helped."""
    trace: Trace
    """Of the held-out objective."""


def finetune(
    model: MorphableReflectanceModel,
    observations: Sequence[ImageObservation],
    held_out: Sequence[ImageObservation],
    faces: ArrayLike,
    vertices: ArrayLike,
    *,
    lighting: LightingModel | None = None,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> FineTuning:
    """Return a model with c and s moved to explain images of faces better that it was not learned from.

    Each round fits all images (`fit_image`), finds the most probable changes of means and directions under
    two anchors (`best_change`), smooths them over the mesh, and takes that one, or a half or quarter of it,
    with which objectives and RMSE of the held-out images fall most surely, if they fall by more than by
    chance (`is_improvement`). Changes are counted from the model given, so that rounds cannot drift. The
    shares w' stay. Raises `ReflectanceError` when there are no images or no held-out ones, an image cannot be
    fitted, or the mesh is not that of the model, or not finite.

    Parameters
    ----------
    model : MorphableReflectanceModel
    observations, held_out : sequence of ImageObservation
        One or more of different faces and lights, and best six or more of other faces: the fewer, the more
        they must agree.
    faces, vertices : (F, 3) array_like of int, (V, 3) array_like of float
        Of any face at rest, mm, for smoothing.
    lighting : LightingModel, optional
    budget, on_progress : optional
        Image fits or seconds, the best model so far is returned when it ends; called with every `TraceRow`.

    Notes
    -----
    Images determine the albedo only up to the light: the anchor keeps it. Tuning adds no directions.
    """
    count = len(model.known)
    positions, triangles = checked_mesh(vertices, faces, "the face at rest", ReflectanceError)
    require_one_topology("the face at rest", len(positions), "the model", count)
    triangles = triangles[model.known[triangles].all(1)]
    if not observations or not held_out:
        counts = f"{len(observations)} images to tune with, {len(held_out)} held out"
        raise ReflectanceError(f"{counts}; give one or more of each")
    smooth = surface_diffusion(positions, triangles, SMOOTHING_MM)
    lighting = LightingModel.default() if lighting is None else lighting
    meter = Meter("reflectance.finetune", "held-out objective", budget, on_progress)

    def fit(observation: ImageObservation, tried: MorphableReflectanceModel, late: bool = False) -> ImageFit:
        # Raises `TimeoutError` when the deadline cut the fit short, unless that is allowed (`late`).
        if meter.out_of_time and not late:
            raise TimeoutError
        meter.count()
        left = Budget(seconds=meter.sub_meter(meter.stage, meter.unit).budget.seconds)
        with warnings.catch_warnings():
            # One of many fits; the held-out objective shows whether they were good enough.
            warnings.filterwarnings("ignore", message="the image fit stopped", category=RuntimeWarning)
            found = fit_image(observation, tried, lighting, budget=left)
        if meter.out_of_time and not late:
            raise TimeoutError
        return found

    def held_out_errors(tried: MorphableReflectanceModel, late: bool = False) -> FloatArray:
        """Return (n, 2) objectives and relative RMSE: a change has to lower both."""
        fits = [fit(observation, tried, late) for observation in held_out]
        return np.array([[one.objective, one.relative_rmse] for one in fits])

    current, change = model, np.zeros((1 + model.components, count, 4))
    steps: list[float] = []
    errors = held_out_errors(model, late=True)
    before, converged = float(errors[:, 0].mean()), False
    meter.record(before)
    with suppress(TimeoutError):
        while len(steps) < ROUNDS and not meter.exhausted and not converged:
            fits = [fit(observation, current) for observation in observations]
            best = partial(best_change, model, observations, fits, mean_change=MEAN_CHANGE)
            changes = [smoothed(best(basis_change=share), smooth) for share in BASIS_CHANGES]
            for step in (1.0, 0.5, 0.5**2):  # a change that does not help is halved, then given up
                if meter.exhausted:
                    break
                parts = [(1 - step) * change + step * one for one in changes]
                trials = [(part, held_out_errors(with_change(model, part))) for part in parts]
                helping = [trial for trial in trials if is_improvement(errors, trial[1])]
                if helping:
                    change, errors = max(helping, key=lambda trial: assured_gains(errors, trial[1]).min())
                    current = with_change(model, change)
                    steps.append(step)
                    meter.record(errors[:, 0].mean())
                    break
            else:
                converged = not meter.exhausted
    return FineTuning(current, tuple(steps), before, float(errors[:, 0].mean()), converged, meter.trace)


def is_improvement(before: FloatArray, after: FloatArray) -> bool:
    """Return whether the errors (n, E) of n held-out images fell, each kind of error by more than chance.

    The mean, and the mean of the images' relative falls, must fall by over 0.1 %, `assured_gains` be above 0.
    """
    falls = after.mean(0) < (1 - _LEAST_GAIN) * before.mean(0)
    gains = (1 - after / np.maximum(before, SMALLEST)).mean(0)
    return bool((falls & (gains > _LEAST_GAIN) & (assured_gains(before, after) > 0)).all())


def assured_gains(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return (E,) lower bounds m - t s / sqrt(n) of the mean relative fall, by Student's paired test."""
    from scipy.special import stdtrit

    gains = 1 - after / np.maximum(before, SMALLEST)
    count = len(gains)
    if count == 1:
        return gains[0]
    chance = stdtrit(count - 1, 1 - SIGNIFICANCE_LEVEL) * gains.std(axis=0, ddof=1)
    return gains.mean(0) - chance / np.sqrt(count)


def with_change(model: MorphableReflectanceModel, change: FloatArray) -> MorphableReflectanceModel:
    """Return a model with a change (1 + N, V, 4): of mean and directions, of red, green, blue and s."""
    whole = np.pad(change, ((0, 0), (0, 0), (0, 3)))
    moved = replace(model, mean=model.mean + whole[0], basis=model.basis + whole[1:])
    more = np.sum(moved.deviation**2 - model.deviation**2)
    return replace(moved, total_variance=model.total_variance + more)


def smoothed(change: FloatArray, smooth: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return a change (1 + N, V, 4) with a smoother of values (V, ...) applied."""
    return np.ascontiguousarray(np.moveaxis(smooth(np.moveaxis(change, 1, 0)), 0, 1))


def best_change(
    model: MorphableReflectanceModel,
    observations: Sequence[ImageObservation],
    fits: Sequence[ImageFit],
    *,
    mean_change: float,
    basis_change: float,
) -> FloatArray:
    """Return the most probable change (1 + N, V, 4) of the model given the images, each vertex for itself.

    With b_i and L_i of image i held, its colours are linear in the change of the means c0, s0 and of the
    directions C, S. Changes of the means have a normal prior with standard deviation m = `mean_change`, a
    share of the mean albedo (of the mean s), those of the directions n = `basis_change` times that; the noise
    is that of each image's fit. With x_i = (1, n b_i), light d_ij on the diffuse part and h_ij on lobes w',
    rows (i, j) of a vertex have the covariance

        (x_i . x_i') (m_c^2 [j = j'] d_ij d_i'j' + m_s^2 h_ij h_i'j') + noise,

    a system of 3 M equations for M images. Cost: V (3 M)^3 / 3. The `fits` may be those of another model with
    the same directions.
    """
    scores = np.stack([fit.face.coefficients for fit in fits])
    features = np.concatenate([np.ones((len(fits), 1)), basis_change * scores], axis=1)
    diffuse, specular, off, noise = _images_linearized(model, observations, fits)
    of_diffuse = mean_change * model.mean[model.known, :3].mean()
    of_sum = mean_change * model.mean[model.known, 3].mean()
    diffuse *= of_diffuse
    specular *= of_sum
    kernel = features @ features.T
    same_channel = np.kron(kernel, np.eye(3))
    any_channel = np.kron(kernel, np.ones((3, 3)))
    size = 3 * len(fits)
    dual = np.empty_like(off)
    for block in blocks(len(off), BLOCK):
        d = diffuse[block].reshape(-1, size)
        h = specular[block].reshape(-1, size)
        system = same_channel * (d[:, :, None] * d[:, None]) + any_channel * (h[:, :, None] * h[:, None])
        system[:, np.arange(size), np.arange(size)] += noise[block].reshape(-1, size)
        solution = np.linalg.solve(system, off[block].reshape(-1, size, 1))
        dual[block] = solution.reshape(-1, len(fits), 3)
    albedo = np.einsum("in,vij->nvj", features, of_diffuse * diffuse * dual)
    total = np.einsum("in,vij->nv", features, of_sum * specular * dual)
    change = np.concatenate([albedo, total[..., None]], axis=2)
    change[1:] *= basis_change
    return change


def _images_linearized(
    model: MorphableReflectanceModel, observations: Sequence[ImageObservation], fits: Sequence[ImageFit]
) -> FloatArray:
    """Return (4, V, M, 3): of M images the light on the diffuse part and on the lobes, what the model leaves
    of the colours, and the variance of their noise; 0 and a variance of 1 where an image shows no vertex.
    """
    found = np.zeros((4, len(model.known), len(fits), 3))
    found[3] = 1.0
    for i, (observation, fit) in enumerate(zip(observations, fits, strict=True)):
        used = common_vertices(observation, model)
        response = observation.response(used)
        albedo, total, share = np.split(model.at(fit.face.coefficients)[used], [3, 4], axis=1)
        diffuse = response.diffuse @ fit.light
        specular = np.einsum("vk,vkj->vj", share, response.specular @ fit.light)
        colors = observation.observed_linear[used]
        error = colors - albedo * diffuse - total * specular
        spread = max(normal_deviation(error), 1e-6 * np.abs(colors).mean())
        # Large differences count by their size rather than its square, as in the fit.
        noise = spread * np.maximum(np.abs(error), spread)
        found[:, used, i] = diffuse, specular, error, noise
    return found
