"""Improve a morphable reflectance model with plain images of other faces."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core import Budget, Meter, ProgressCallback, Trace
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.reflectance.finetune_step import ModelChange, best_change, neighbour_smoothing, no_change
from scan2albedo.reflectance.image_fit import ImageFit, fit_image
from scan2albedo.reflectance.image_observation import ImageObservation
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel

Smoother = Callable[[NDArray[np.float64]], NDArray[np.float64]]

_SMALLEST_STEP = 0.25
"""A change that does not help is halved down to this share of it, then given up."""
_LEAST_GAIN = 1e-3
"""Relative fall of the held-out images' objective and RMSE below which a change is not accepted."""


@dataclass(frozen=True)
class FineTuneOptions:
    """Settings of `finetune`."""

    rounds: int = 10
    """Most rounds of fitting all images and changing the model."""
    mean_change: float = 0.1
    """Prior of the change of the means: its standard deviation, as a share of the mean albedo
    (the mean sum of weights)."""
    basis_changes: tuple[float, ...] = (0.1, 0.3)
    """The same of the directions, as a share of the means'. The held-out images choose among several."""
    smoothing_mm: float = 6.0
    """Standard deviation, along the surface, of the smoothing of changes. Needs vertex positions."""
    smoothing_steps: int = 4
    """Without positions: steps to the neighbours' mean. How far they reach depends on the mesh."""
    significance_level: float = 0.025
    """Probability that a change without effect on images like the held-out ones is accepted; 0.5 tests their
    mean alone. One image cannot be tested."""

    def __post_init__(self) -> None:
        if not self.mean_change > 0:
            raise ValueError(f"mean_change must be above 0, got {self.mean_change}")
        for name in ("rounds", "smoothing_mm", "smoothing_steps"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be 0 or more, got {getattr(self, name)}")
        if not self.basis_changes or not min(self.basis_changes) >= 0:
            raise ValueError(
                f"basis_changes must be one or more numbers of 0 or more, got {self.basis_changes}"
            )
        if not 0 < self.significance_level <= 0.5:
            raise ValueError(
                f"significance_level must be above 0 and at most 0.5, got {self.significance_level}"
            )


@dataclass(frozen=True)
class FineTuning:
    """A model after `finetune`, and its errors on images it was not tuned with."""

    model: MorphableReflectanceModel
    """The one given when nothing was accepted."""
    accepted_steps: tuple[float, ...]
    """Share of its change that each accepted round took."""
    held_out_before: float
    """Mean objective of fits to the held-out images with the model given."""
    held_out_after: float
    """The same with `model`."""
    converged: bool
    """False when the budget or the rounds ended while changes still helped."""
    trace: Trace
    """Of the held-out objective."""


def finetune(
    model: MorphableReflectanceModel,
    observations: Sequence[ImageObservation],
    held_out: Sequence[ImageObservation],
    faces: ArrayLike,
    *,
    vertices: ArrayLike | None = None,
    lighting: LightingModel | None = None,
    options: FineTuneOptions = FineTuneOptions(),
    budget: Budget | float | None = None,
    on_progress: ProgressCallback | None = None,
) -> FineTuning:
    """Return a model with c and s moved to explain images of faces better that it was not learned from.

    Each round fits all images (`fit_image`), finds the most probable changes of means and directions under
    several anchors (`best_change`), smooths them over the mesh, and takes that one, or a half or quarter of
    it, with which objectives and RMSE of the held-out images fall most surely, if they fall by more than by
    chance (`is_improvement`). Changes are counted from the model given, so that rounds cannot drift. The
    shares w' stay.

    Parameters
    ----------
    model : MorphableReflectanceModel
    observations : sequence of ImageObservation
        M, one or more; different faces and lights.
    held_out : sequence of ImageObservation
        Best six or more, of faces that are not in `observations`: the fewer, the more they must agree.
    faces : (F, 3) array_like of int
        Triangles over the model's V vertices, for smoothing.
    vertices : (V, 3) array_like of float, optional
        Their positions in mm, of any face at rest: with them `smoothing_mm` holds, without `smoothing_steps`.
    lighting : LightingModel, optional
        `LightingModel.default()` when omitted.
    options : FineTuneOptions
    budget : Budget or float, optional
        Image fits or seconds; the best model so far is returned when it ends.
    on_progress : callable, optional
        Called with every `TraceRow`, whose error is the held-out objective.

    Raises
    ------
    ReflectanceError
        When there are no images or no held-out ones, or an image cannot be fitted.
    ValueError
        When `faces` point outside the vertices.

    Notes
    -----
    Images determine the albedo only up to the light, and held-out images do not resolve that either: the
    anchor keeps the albedo. It is Gaussian, for then each vertex has a closed form and a smooth error is
    corrected everywhere a little; the absolute differences of Han, Wang and Xu, who tune networks by
    gradients, favour few vertices. Tuning adds no directions: differences between faces beyond them, marks
    for instance, stay unexplained. tools/bench_reflectance_finetune.py measures tuning on pictures that
    neither step used.
    """
    smooth = _smoother(model, faces, vertices, options)
    if not observations or not held_out:
        raise ReflectanceError(
            f"{len(observations)} images to tune with and {len(held_out)} held out; give one or more of each"
        )
    lighting = LightingModel.default() if lighting is None else lighting
    meter = Meter("reflectance.finetune", "held-out objective", Budget.of(budget), on_progress)
    tuning = _Tuning(model, lighting, options, meter, list(held_out))
    before = tuning.error
    converged = tuning.run(observations, smooth)
    return FineTuning(tuning.current, tuple(tuning.steps), before, tuning.error, converged, meter.trace)


class _OutOfTime(Exception):
    """The budget's seconds have ended amid the fits of a round."""


class _Tuning:
    """The model accepted so far and its error."""

    def __init__(
        self,
        model: MorphableReflectanceModel,
        lighting: LightingModel,
        options: FineTuneOptions,
        meter: Meter,
        held_out: list[ImageObservation],
    ) -> None:
        self.initial, self.lighting, self.options, self.meter = model, lighting, options, meter
        self.held_out = held_out
        self.current, self.change = model, no_change(model)
        self.steps: list[float] = []
        self.errors = self._held_out_errors(model, even_late=True)
        meter.record(self.error)

    @property
    def error(self) -> float:
        """Mean objective of the held-out images."""
        return float(self.errors[:, 0].mean())

    def run(self, observations: Sequence[ImageObservation], smooth: Smoother) -> bool:
        """Change the model round by round; return whether it ended because no change helps."""
        for _ in range(self.options.rounds):
            if self.meter.exhausted:
                break
            try:
                helped = self._try_steps(self._changes(observations, smooth))
            except _OutOfTime:
                break
            if not helped:
                return not self.meter.exhausted
        return False

    def _changes(self, observations: Sequence[ImageObservation], smooth: Smoother) -> list[ModelChange]:
        """Return the most probable changes, smooth ones, by fits of all images with the current model."""
        fits = [self._fit(observation, self.current) for observation in observations]
        return [
            best_change(
                self.initial,
                observations,
                fits,
                mean_change=self.options.mean_change,
                basis_change=basis_change,
            ).smoothed(smooth)
            for basis_change in self.options.basis_changes
        ]

    def _try_steps(self, changes: Sequence[ModelChange]) -> bool:
        """Go as far towards one of the changes as helps, and return whether any step does."""
        step = 1.0
        while step >= _SMALLEST_STEP and not self.meter.exhausted:
            trials = [self._trial(change, step) for change in changes]
            helping = [trial for trial in trials if is_improvement(self.errors, trial[1], self.options)]
            if helping:
                level = self.options.significance_level
                part, errors = max(helping, key=lambda t: assured_gains(self.errors, t[1], level).min())
                self.current, self.change, self.errors = part.applied(self.initial), part, errors
                self.steps.append(step)
                self.meter.record(self.error)
                return True
            step /= 2
        return False

    def _trial(self, change: ModelChange, step: float) -> tuple[ModelChange, NDArray[np.float64]]:
        part = self.change.toward(change, step)
        return part, self._held_out_errors(part.applied(self.initial))

    def _held_out_errors(
        self, model: MorphableReflectanceModel, *, even_late: bool = False
    ) -> NDArray[np.float64]:
        """Return (n, 2) objectives and relative RMSE: a change has to lower both."""
        fits = [self._fit(observation, model, even_late=even_late) for observation in self.held_out]
        return np.array([[fit.objective, fit.relative_rmse] for fit in fits])

    def _fit(
        self, observation: ImageObservation, model: MorphableReflectanceModel, *, even_late: bool = False
    ) -> ImageFit:
        """Fit an image; raise `_OutOfTime` when the deadline cut the fit short, unless `even_late`."""
        if self.meter.out_of_time and not even_late:
            raise _OutOfTime
        self.meter.count()
        left = Budget(seconds=self.meter.sub_meter(self.meter.stage, self.meter.unit).budget.seconds)
        with warnings.catch_warnings():
            # One of many fits; the held-out objective shows whether they were good enough.
            warnings.filterwarnings("ignore", message="the image fit stopped", category=RuntimeWarning)
            fit = fit_image(observation, model, self.lighting, budget=left)
        if self.meter.out_of_time and not even_late:
            raise _OutOfTime
        return fit


def is_improvement(before: NDArray[np.float64], after: NDArray[np.float64], options: FineTuneOptions) -> bool:
    """Return whether the errors (n, E) of n held-out images fell, each kind of error by more than chance.

    The mean, and the mean of the images' relative falls, must fall by over 0.1 %, `assured_gains` be above 0.
    """
    falls = after.mean(0) < (1 - _LEAST_GAIN) * before.mean(0)
    gains = (1 - after / np.maximum(before, 1e-300)).mean(0)
    assured = assured_gains(before, after, options.significance_level)
    return bool((falls & (gains > _LEAST_GAIN) & (assured > 0)).all())


def assured_gains(
    before: NDArray[np.float64], after: NDArray[np.float64], significance_level: float
) -> NDArray[np.float64]:
    """Return (E,) lower bounds of the mean relative fall m of errors (n, E), as in Student's paired test.

    m - t s / sqrt(n), with s the standard deviation over images and t for n - 1 degrees of freedom; m itself
    of one image.
    """
    from scipy.special import stdtrit

    gains = 1 - after / np.maximum(before, 1e-300)
    count = len(gains)
    if count == 1:
        return np.asarray(gains[0])
    chance = stdtrit(count - 1, 1 - significance_level) * gains.std(axis=0, ddof=1)
    return np.asarray(gains.mean(0) - chance / np.sqrt(count))


def _smoother(
    model: MorphableReflectanceModel,
    faces: ArrayLike,
    vertices: ArrayLike | None,
    options: FineTuneOptions,
) -> Smoother:
    """Return a smoother of columns (V, C) over the vertices that the model knows."""
    count = len(model.known)
    triangles = _checked_faces(faces, count)
    triangles = triangles[model.known[triangles].all(1)]
    if vertices is None:
        return neighbour_smoothing(count, triangles, options.smoothing_steps)
    positions = np.asarray(vertices, np.float64)
    if positions.shape != (count, 3):
        raise ValueError(f"vertices must have shape ({count}, 3), got {positions.shape}")
    if not np.isfinite(positions[triangles]).all():
        raise ReflectanceError("vertices hold NaN or infinite values; give positions in mm, or none")
    return surface_diffusion(np.nan_to_num(positions), triangles, options.smoothing_mm)


def _checked_faces(faces: ArrayLike, count: int) -> NDArray[np.int64]:
    triangles = np.asarray(faces, np.int64)
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"faces must have shape (F, 3), got {triangles.shape}")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= count):
        raise ValueError(f"faces point outside 0 ... {count - 1}")
    return triangles
