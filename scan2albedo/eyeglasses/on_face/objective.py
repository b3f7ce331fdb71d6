"""What registration minimises: reprojection errors of key points and outlines, and the priors (S3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import EPSILON, FloatArray, IntArray, dots, finite_rows, norms
from scan2albedo.eyeglasses.mean_keypoints import FRONT
from scan2albedo.eyeglasses.on_face import frame_motion as moving
from scan2albedo.eyeglasses.on_face.inputs import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.outline import ObservedView, OutlineSamples
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.pinhole import projected
from scan2albedo.optimization.least_squares import Damping, NormalEquations, minimize
from scan2albedo.statistics.robust import huber_loss, huber_weights

ROBUST = 2.0
"""Standard deviations from which labels count less and less (Cauchy), outlines by their size (Huber)."""
_OFFSET_MM = 0.5
"""How far what is labelled usually is from the mesh's key point, along each axis and alike in all views."""
BIAS_PX = 1.0
"""How far a mask usually reaches beyond the frame, or falls short of it, all around."""
VOTE = 1 / 20
"""Of a pixel of the outline: a mask's errors are alike over 20 pixels, which share one vote."""
_REWEIGHTINGS = 3
"""Times that offsets and biases are found with the weights of robust errors."""
_CANDIDATES = 200
"""Front vertices nearest to the head that are looked at until they are chosen anew."""


@dataclass(frozen=True)
class Linearization:
    """The objective at a state: cost, half gradient (P,) and Gauss-Newton matrix (P, P).

    `labels_px` (C, K), NaN where there are none, and `outline_px` (N,) are the errors.
    """

    cost: float
    gradient: FloatArray
    matrix: FloatArray
    labels_px: FloatArray
    outline_px: FloatArray

    @property
    def median_label_px(self) -> float:
        """Outliers do not show in it."""
        errors = self.labels_px[np.isfinite(self.labels_px)]
        return float(np.median(errors)) if len(errors) else np.nan

    @property
    def mean_outline_px(self) -> float:
        """A median of whole pixels would stand still."""
        return np.abs(self.outline_px).mean() if len(self.outline_px) else np.nan


class HeadContact:
    """The least signed distance of a frame's front from a head in the world, (H, 3) and (G, 3)."""

    def __init__(self, points: moving.SkinnedPoints, vertices: FloatArray, faces: IntArray) -> None:
        self._query = ClosestPointQuery(vertices, faces)
        self._normals = face_normals(vertices, faces)
        self._front = self._candidates = points[np.flatnonzero(FRONT[points.weights.argmax(1)])]

    def orient(self, motion: moving.FrameMotion, viewers: FloatArray) -> None:
        """Turn the head's normals to the viewers (C, 3) if most of those near the frame's front look away."""
        hits = self._query.query(motion.positions(self._front))
        toward = viewers.mean(0) - hits.points
        if dots(self._normals[hits.face], toward).sum() < 0:
            self._normals = -self._normals

    def select_candidates(self, motion: moving.FrameMotion) -> None:
        """Choose the vertices that may touch next."""
        if len(self._front.rest) > _CANDIDATES:
            distance = self._query.query(motion.positions(self._front)).distance
            self._candidates = self._front[np.argpartition(distance, _CANDIDATES)[:_CANDIDATES]]

    def __bool__(self) -> bool:
        return len(self._front.rest) > 0

    def nearest_point(
        self, motion: moving.FrameMotion
    ) -> tuple[moving.SkinnedPoints, FloatArray, float, FloatArray]:
        """Return the point that is nearest or deepest, its place (1, 3), signed distance, slope (1, 3)."""
        place = motion.positions(self._candidates)
        hits = self._query.query(place)
        normals = self._normals[hits.face]
        height = dots(place - hits.points, normals)
        signed = np.where(height < 0, -hits.distance, hits.distance)
        first = np.argmin(signed)
        away = place[first] - hits.points[first]
        length = np.linalg.norm(away)
        slope = normals[first] if length < 1e-9 else np.sign(signed[first]) * away / length
        return self._candidates[[first]], place[[first]], signed[first], slope[None]


class RegistrationObjective:
    """The sum of squares that is minimised over a frame's state.

    labels:   sum of s^2 log(1 + |r|^2 / s^2), r in standard deviations, s = 2 (Cauchy's), r that of the key
              point moved by an offset of its own, the same in all views, + squares of the offsets
    outlines: sum of Huber's function of the sample's distance from the edge found in mask or picture, across
              it, less a bias of each view, + squares of the biases
    bend:     sum of squares of `bend_prior`
    contact:  square of the frame's distance from the nose in mm, where there is a `contact`

    Offsets and biases are those that make the sum least; gradient and matrix are those of what is left.
    """

    def __init__(
        self,
        keypoints: FloatArray,
        views: tuple[ObservedView, ...],
        options: FaceRegistrationOptions,
        contact: HeadContact | None = None,
    ) -> None:
        self.contact = contact
        self.keypoints, self.views, self.options = keypoints, views, options
        self._cameras = np.stack([view.camera for view in views])
        self._labels = np.stack([view.labels for view in views])
        self._labelled = finite_rows(self._labels) & finite_rows(keypoints)

    def motion(self, state: moving.FrameState) -> moving.FrameMotion:
        """Return the frame's motion at a state."""
        return moving.FrameMotion(self.keypoints, state)

    def linearize(
        self, state: moving.FrameState, samples: OutlineSamples | None, *, rigid: bool = False
    ) -> Linearization:
        """Return the objective at a state, with outlines where there are `samples`.

        `rigid`: of turn and translation alone, without a prior.
        """
        motion = self.motion(state)
        sums = _Sums(motion, rigid)
        labels_px = self._add_labels(sums)
        outline_px = np.zeros(0) if samples is None else self._add_outlines(samples, sums)
        if self.contact is not None:
            point, place, distance, slope = self.contact.nearest_point(motion)
            sums.add(sums.rows(point, place, slope), np.array([distance]), np.ones(1))
            sums.cost += distance**2
        if not rigid:
            value, rows = moving.bend_prior(motion)
            sums.add(rows, value, np.ones(len(value)))
            sums.cost += float(value @ value)
        return Linearization(sums.cost, sums.gradient, sums.matrix, labels_px, outline_px)

    def _add_labels(self, sums: _Sums) -> FloatArray:
        marks, noise = sums.motion.marks, self.options.label_noise_px
        place = sums.motion.positions(marks)
        view, mark = np.nonzero(self._labelled)
        pixels, slopes, front = projected(self._cameras[view], place[mark])
        errors = np.full(self._labelled.shape, np.nan)
        difference = pixels - self._labels[view, mark]
        errors[view, mark] = np.where(front, norms(difference), np.inf)
        slopes = np.where(front[:, None, None], slopes, 0.0) / noise
        residual = np.where(front[:, None], difference, 0.0) / noise
        # Where labels are off alike in all views: offsets that leave the least errors, their own included.
        offset, prior = np.zeros((len(place), 3)), np.eye(3) / _OFFSET_MM**2
        for _ in range(_REWEIGHTINGS):
            moved = residual + np.einsum("nij,nj->ni", slopes, offset[mark])
            # Behind a camera a label is off by a thousand standard deviations.
            square = np.where(front, (moved**2).sum(1), 1e6)
            weight = 1 / (1 + square / ROBUST**2)
            matrix, pull = np.zeros((len(place), 3, 3)), np.zeros((len(place), 3))
            np.add.at(matrix, mark, np.einsum("n,nki,nkj->nij", weight, slopes, slopes))
            np.add.at(pull, mark, np.einsum("n,nki,nk->ni", weight, slopes, residual))
            offset = -np.asarray(np.linalg.solve(matrix + prior, pull[:, :, None])[:, :, 0], float)
        # What is left of each key point's sums without its offset, as three values along the matrix's axes.
        values, axes = np.linalg.eigh(matrix - matrix @ np.linalg.inv(matrix + prior) @ matrix)
        # Less than rounding leaves, of labels in standard deviations a mm, says nothing.
        size, least = np.sqrt(np.maximum(values, 0.0)), np.sqrt(EPSILON)
        along = np.einsum("nji,nj->ni", axes, -offset / _OFFSET_MM**2)
        three = np.repeat(np.arange(len(place)), 3)
        slopes = (size[:, :, None] * axes.transpose(0, 2, 1)).reshape(-1, 3)
        values, votes = (along / np.maximum(size, least)).ravel(), (size > least).astype(float).ravel()
        sums.add(sums.rows(marks[three], place[three], slopes), values, votes)
        sums.cost += ROBUST**2 * np.log1p(square / ROBUST**2).sum()
        sums.cost += (offset**2).sum() / _OFFSET_MM**2
        return errors

    def _add_outlines(self, samples: OutlineSamples, sums: _Sums) -> FloatArray:
        motion, noise = sums.motion, np.hypot(self.options.outline_noise_px, samples.noise_px)
        place = motion.positions(samples.points)
        pixels, slopes, _ = projected(self._cameras[samples.view], place)
        error = dots(samples.outward, pixels - samples.edges)
        slope = np.einsum("ni,nij->nj", samples.outward, slopes)
        residual = error / noise
        rows = sums.rows(samples.points, place, slope / noise[:, None])
        for number in range(len(self.views)):
            mine = np.flatnonzero(samples.view == number)
            if not len(mine):
                continue
            bias = 0.0
            along = 1 / noise[mine]
            for _ in range(_REWEIGHTINGS):
                weight = VOTE * huber_weights(residual[mine] - bias * along, ROBUST)
                tight = float(weight @ along**2) + 1 / BIAS_PX**2
                bias = float((weight * along) @ residual[mine]) / tight
            residual[mine] -= bias * along
            weight = VOTE * huber_weights(residual[mine], ROBUST)
            error[mine] -= bias
            sums.cost += (bias / BIAS_PX) ** 2
            # What the bias takes from the matrix: all values may be off by one amount.
            common = rows[mine].T @ (weight * along)
            sums.matrix -= np.outer(common, common) / (weight @ along**2 + 1 / BIAS_PX**2)
        sums.add(rows, residual, VOTE * huber_weights(residual, ROBUST))
        sums.cost += 2 * VOTE * huber_loss(residual, ROBUST).sum()
        return error


class _Sums:
    """Cost, gradient and matrix at a motion."""

    def __init__(self, motion: moving.FrameMotion, rigid: bool) -> None:
        size = moving.RIGID + (0 if rigid else motion.keypoints.size)
        self.cost = 0.0
        self.gradient, self.matrix = np.zeros(size), np.zeros((size, size))
        self.motion, self.rows = motion, partial(motion.rows, rigid=rigid)

    def add(self, rows: FloatArray, values: FloatArray, votes: FloatArray) -> None:
        """Add values (N,) of derivatives (N, P), each squared as often as it has votes."""
        self.gradient += rows.T @ (votes * values)
        self.matrix += (votes[:, None] * rows).T @ rows


@dataclass(frozen=True)
class FrameEstimate:
    """Where a descent ended: a state and the objective there."""

    state: moving.FrameState
    at: Linearization
    converged: bool


class _Point:
    """A state with the objective there, for `minimize`."""

    def __init__(
        self,
        linearize: Callable[[moving.FrameState], Linearization],
        state: moving.FrameState,
        meter: Meter,
    ) -> None:
        self._linearize, self._meter = linearize, meter
        self.state, self.at = state, linearize(state)
        self.cost = self.at.cost
        meter.count()

    def normal_equations(self) -> NormalEquations:
        return NormalEquations(self.at.matrix, self.at.gradient)

    def moved(self, step: FloatArray) -> _Point:
        return _Point(self._linearize, self.state.moved(step), self._meter)


def descend(
    linearize: Callable[[moving.FrameState], Linearization],
    state: moving.FrameState,
    meter: Meter,
    *,
    steps: int = 40,
    error: Literal["median_label_px", "mean_outline_px", "cost"],
    tolerance: float = 1e-5,
) -> FrameEstimate:
    """Return the best state that `steps` Levenberg-Marquardt steps from `state` reach.

    It ends early when a step lowers the cost by less than the part `tolerance`, or with the budget.
    """
    found = minimize(
        _Point(linearize, state, meter),
        trials=steps,
        tolerance=tolerance,
        damping=Damping(largest=1e6),
        meter=meter,
        on_better=lambda point: meter.record(getattr(point.at, error)),
    )
    return FrameEstimate(found.best.state, found.best.at, found.converged)
