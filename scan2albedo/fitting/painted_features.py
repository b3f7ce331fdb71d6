"""Brows, eyes and lips in a scan's colours: where they lie beside the model's, and how sure that is.

A feature is darker or redder than the skin around it. Of each there is a template in the model's front view:
points on the feature and beside it. It is moved over the scan's picture; the partial correlation rho of label
and colour, given place (light falls off smoothly), has the likelihood (1 - rho^2)^(-n/2) of n independent
points. Shading is divided out. Importance sampling with a normal prior gives the posterior of the motion;
even colours leave the prior as it was, and then nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numba import njit
from scipy.stats import norm, qmc

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import LANDMARK_LEVELS
from scan2albedo.fitting.even_light import evenly_lit
from scan2albedo.fitting.landmark_pull import SHOWN_BY_COLOR, STILL, LandmarkPull
from scan2albedo.geometry.front_picture import FrontPicture, front_picture
from scan2albedo.geometry.polylines import inside_polygon, polyline_distance

_STEP_MM, _SPACING_MM, _MARGIN_MM = 0.8, 1.5, 25.0
"""Of the picture's squares, of a template's points, and of the picture around the inner landmarks: a feature
may lie so far off."""
_BLACK = 0.03
"""Added to colours, relative to the usual brightness, before the logarithm: in the dark is noise."""
_BRIGHTNESS = np.array([0.25, 0.6, 0.15])
DARKNESS, REDNESS = 0, 1
_FLOOR = np.array([0.06, 0.025])
"""Deviations of log darkness and log redness that are none of a feature."""
_LEAST_SEEN, _SURE = 0.5, 0.65
"""Part of a feature's points, and of those beside it, that the scan must show; of the picture half that. A
feature is used where the posterior deviation of its height is below _SURE of the prior's."""
_BROW_MM, _BROW_BELOW_MM, _LASHES_MM = 3.8, 1.2, 1.5
"""Half width of a brow, how far its middle lies below its landmarks, and how far beside the lids what is dark
may be lashes and shadows."""
_LINE_MM, _OPEN_MM, _HALF_WIDTH_MM = 1.0, 3.0, 25.0
"""Half width of the line between shut lips; lips farther apart have none; half width of a mouth or a brow."""
_SAMPLES, _POWERS, _WIDER = 256, (0.2, 0.5, 1.0), 1.5
"""Draws of a round, and the powers of the likelihood (tempering): a low one first, to find what is far.
Proposals are wider than what they are to find, in variance."""
_LEAST_LOG_LIKELIHOOD = {"brow": 4.0, "eye": 4.0, "lips": 10.0}
"""Above no feature at all, by eye: on faces of one colour creases beside shut lips reach 9."""
_EXACT_MM = {"brow": 1.5, "eye": 1.5, "lips": 0.8}
"""Standard deviation of a landmark of a feature whose motion is known."""
_INDEPENDENT, _NEVER_WRONG_MM = 6, 50.0
"""The landmarks of a feature err alike: they count as so many. Farther than is looked: left to the
posterior."""
_BROWS = np.array([1.2, 4.0, 0.08, 0.02, 0.3, 0.3, 1.0])
_EYES = np.array([1.5, 2.5, 0.06, 0.05, 0.3, 0.3, 0.5])
_LIPS = np.array([1.5, 3.0, 0.04, 0.08, 0.3, 0.3, 2.5])
_ALONE = np.array([0.5, 2.0, 0.04, 0.02, 0.1, 0.1, 0.5])
"""Standard deviations of a motion: to the side and up (mm), turn (radians), the logarithms of width and of
height above and below the feature's own line, and how far its ends rise (mm, _HALF_WIDTH_MM from its middle);
`_ALONE` of one side beside the other. By eye, from what people and the model's places differ by."""
_MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class PaintedFeature:
    """Landmarks `numbers` (L,) seen in the colours at `places` (L, 2), `sigma_mm` (L,) each."""

    name: str
    numbers: tuple[int, ...]
    places: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True)
class _Places:
    """Points (N,) of a feature by its line: `along` (N, 2) on the line, and `up` (N,) from there."""

    along: FloatArray
    up: FloatArray

    @classmethod
    def of(cls, points: FloatArray, line: FloatArray) -> _Places:
        """Return points (N, 2) by a line (K, 2)."""
        order = np.argsort(line[:, 0])
        height = np.interp(points[:, 0], *line[order].T)
        return cls(np.stack([points[:, 0], height], axis=1), points[:, 1] - height)

    def moved(self, motions: FloatArray, middle: FloatArray) -> FloatArray:
        """Return (M, N, 2) for motions (M, 7)."""
        right, up, turn, wide, above, below, bend = motions.T[:, :, None]
        x = self.along[:, 0] - middle[0]
        y = self.along[:, 1] - middle[1] + self.up * np.exp(np.where(self.up < 0, below, above))
        x, y = x * np.exp(wide), y + bend * (x / _HALF_WIDTH_MM) ** 2
        cosine, sine = np.cos(turn), np.sin(turn)
        return np.stack(
            [cosine * x - sine * y + middle[0] + right, sine * x + cosine * y + middle[1] + up], axis=-1
        )


@dataclass(frozen=True)
class _Cue:
    """A colour `channel` that is high where `label` (N,) is 1 and low where 0 (NaN: either).

    It counts as `independent` points. What is linear in `light` (N, 2), two functions of place, is taken for
    light that falls off, and not for a feature.
    """

    channel: int
    label: FloatArray
    light: FloatArray
    independent: float
    sign: float = 1.0


@dataclass(frozen=True)
class _Template:
    """A feature around its `middle` (2,): points, landmarks, and cues of colour; `mirrored` on the left."""

    name: str
    numbers: tuple[int, ...]
    points: _Places
    marks: _Places
    cues: tuple[_Cue, ...]
    middle: FloatArray
    mirrored: bool = False

    def motions(self, motions: FloatArray) -> FloatArray:
        """Return motions (M, 7) that are given as those of the right side."""
        return motions * _MIRROR if self.mirrored else motions


def painted_pull(
    scan: RawScan, frame_from_scan: FloatArray, model: AnnotatedSurface, control_points: FloatArray
) -> LandmarkPull | None:
    """Return the pull of the model's landmarks to where the scan's colours show them; None for nowhere."""
    landmarks = model.landmarks_of(control_points)
    found = [] if landmarks is None else painted_features(scan, frame_from_scan, landmarks)
    if landmarks is None or model.landmark_points is None or not found:
        return None
    numbers = [number for feature in found for number in feature.numbers]
    sigma_mm = np.concatenate([feature.sigma_mm for feature in found])
    places = np.concatenate([feature.places for feature in found])
    count = len(numbers)
    return LandmarkPull(
        numbers=np.full(count, SHOWN_BY_COLOR),
        matrix=model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)[numbers],
        targets=np.column_stack([places, landmarks[numbers, 2]]),
        sigma_mm=sigma_mm,
        wrong_mm=np.full(count, _NEVER_WRONG_MM),
        axes=np.concatenate([np.tile([*_axes(f.name), 0.0], (len(f.numbers), 1)) for f in found]),
        still=np.isin(numbers, STILL),
    )


def painted_features(
    scan: RawScan, frame_from_scan: FloatArray, landmarks: FloatArray
) -> list[PaintedFeature]:
    """Return what a scan's colours show of brows, eyes and lips, near landmarks (68, 3) of the model."""
    if not scan.has_color:
        return []
    inner = landmarks[17:, :2]
    picture = front_picture(
        scan, frame_from_scan, inner.min(0) - _MARGIN_MM, inner.max(0) + _MARGIN_MM, _STEP_MM
    )
    if picture.seen.mean() < _LEAST_SEEN / 2 or not np.median(picture.color[picture.seen]) > 0:
        return []
    # Channels are log darkness, log redness, and 1 where there is scan; 0 elsewhere.
    color, seen, here = picture.color, picture.seen, landmarks[:, :2].copy()
    bright = color @ _BRIGHTNESS
    black = _BLACK * np.median(bright[seen])
    dark = -np.log(evenly_lit(picture, bright) + _BLACK)
    red = np.log((color[..., 0] + black) / (color[..., 1] + black))
    dark, red = (np.clip(values, *np.percentile(values[seen], [1, 99])) for values in (dark, red))
    channels = np.stack([dark, red, np.ones_like(dark)], axis=-1) * seen[..., None]
    lips = _located((_lips(here),), channels, picture, _LIPS)
    eyes = _located((_eye(here, 36), replace(_eye(here, 42), mirrored=True)), channels, picture, _EYES)
    for eye in eyes:
        here[list(eye.numbers)] = eye.places
    # What is dark in and about an eye is not a brow, nor skin below one.
    rows, columns = np.indices(seen.shape)
    places = picture.low + picture.step_mm * np.stack([columns.ravel(), rows.ravel()], axis=1)
    hidden = np.zeros(len(places), bool)
    for lids in (here[36:42], here[42:48]):
        hidden |= inside_polygon(places, lids) | (polyline_distance(places, _closed(lids)) < _LASHES_MM)
    channels = np.where(hidden.reshape(rows.shape)[..., None], 0.0, channels)
    brows = (_brow(here, 17), replace(_brow(here, 22), mirrored=True))
    return [*lips, *eyes, *_located(brows, channels, picture, _BROWS)]


def _axes(name: str) -> FloatArray:
    """Return (2,) 1 along the axes on which a feature is known: brows fade away at their ends."""
    return np.array([0.0, 1.0]) if name == "brow" else np.ones(2)


def _brow(landmarks: FloatArray, first: int) -> _Template:
    numbers = tuple(range(first, first + 5))
    line = landmarks[list(numbers)] - [0, _BROW_BELOW_MM]
    points = _around(line, 12.0)
    away = polyline_distance(points, line)
    used = (away < 10.0) & (np.abs(away - _BROW_MM) > 0.5)
    cue = _Cue(DARKNESS, (away[used] < _BROW_MM).astype(float), _place(points[used]), 20.0)
    return _template("brow", numbers, landmarks, line, points[used], (cue,))


def _eye(landmarks: FloatArray, first: int) -> _Template:
    numbers = tuple(range(first, first + 6))
    lids = landmarks[first : first + 6]
    points = _around(lids, 9.0)
    away, inside = polyline_distance(points, _closed(lids)), inside_polygon(points, lids)
    used = (inside | (away < 6.0)) & (away > 0.4)
    label = inside[used].astype(float)
    # The eyeball is less red than skin; iris, pupil and lashes are dark.
    light = _place(points[used])
    cues = (_Cue(REDNESS, label, light, 20.0, -1.0), _Cue(DARKNESS, label, light, 12.0))
    return _template("eye", numbers, landmarks, lids[[0, 3]], points[used], cues)


def _lips(landmarks: FloatArray) -> _Template:
    outer, inner = landmarks[48:60], landmarks[60:68]
    middle = (inner[[1, 2, 3]] + inner[[7, 6, 5]]) / 2
    line = np.concatenate([outer[:1], middle, outer[6:7]])
    points = _around(outer, 10.0)
    away, inside = polyline_distance(points, _closed(outer)), inside_polygon(points, outer)
    is_open = float(np.linalg.norm(inner[2] - inner[6])) > _OPEN_MM
    between = inside_polygon(points, inner) & is_open
    used = (inside | (away < 8.0)) & (away > 0.4) & ~between
    cues = [_Cue(REDNESS, inside[used].astype(float), _place(points[used]), 40.0)]
    if not is_open:
        beside = polyline_distance(points[used], line)
        label = np.where(beside < _LINE_MM, 1.0, np.where((beside > 1.8) & (beside < 4.0), 0.0, np.nan))
        # Lamps stand above: the upper lip is darker than the lower one.
        up = _Places.of(points[used], line).up
        cues.append(_Cue(DARKNESS, label, np.stack([up / 2, np.sign(up)], axis=1), 12.0))
    return _template("lips", tuple(range(48, 68)), landmarks, line, points[used], tuple(cues))


def _template(
    name: str,
    numbers: tuple[int, ...],
    landmarks: FloatArray,
    line: FloatArray,
    points: FloatArray,
    cues: tuple[_Cue, ...],
) -> _Template:
    marks = _Places.of(landmarks[list(numbers)], line)
    return _Template(name, numbers, _Places.of(points, line), marks, cues, line.mean(0))


def _around(line: FloatArray, margin: float) -> FloatArray:
    """Return the points (N, 2) of a grid around a line (K, 2)."""
    low, high = line.min(0) - margin, line.max(0) + margin
    axes = [np.arange(a, b, _SPACING_MM) for a, b in zip(low, high, strict=True)]
    return np.stack([values.ravel() for values in np.meshgrid(*axes)], axis=1)


def _place(points: FloatArray) -> FloatArray:
    return np.asarray((points - points.mean(0)) / points.std(0))


def _closed(line: FloatArray) -> FloatArray:
    return np.concatenate([line, line[:1]])


def _located(
    sides: tuple[_Template, ...], channels: FloatArray, picture: FrontPicture, deviation: FloatArray
) -> list[PaintedFeature]:
    """Return what is found of a feature; both sides of a pair move alike first, then each a little."""
    prior = _Normal(np.zeros(7), np.diag(deviation**2))
    found, likelihood = _posterior(sides, channels, picture, prior)
    located = []
    for side in sides:
        motion = found
        if len(sides) > 1:
            own = _Normal(found.mean, found.covariance + np.diag(_ALONE**2))
            motion, likelihood = _posterior((side,), channels, picture, own)
        sure = np.sqrt(motion.covariance[1, 1]) < _SURE * deviation[1]
        if not sure or likelihood < _LEAST_LOG_LIKELIHOOD[side.name]:
            continue
        axes = _axes(side.name)
        draws = side.motions(motion.mean + _draws() @ np.linalg.cholesky(motion.covariance).T)
        places = side.marks.moved(draws, side.middle)
        variance = (places.var(axis=0) @ axes) / axes.sum()
        sigma_mm = np.sqrt((_EXACT_MM[side.name] ** 2 + variance) * max(len(side.numbers) / _INDEPENDENT, 1))
        located.append(PaintedFeature(side.name, side.numbers, places.mean(axis=0), sigma_mm))
    return located


@dataclass(frozen=True)
class _Normal:
    """A normal distribution of motions: `mean` (7,), `covariance` (7, 7)."""

    mean: FloatArray
    covariance: FloatArray


def _posterior(
    sides: tuple[_Template, ...], channels: FloatArray, picture: FrontPicture, prior: _Normal
) -> tuple[_Normal, float]:
    """Return the posterior of a motion that all sides make alike, and the log likelihood at its best.

    Importance sampling, the proposals moved and narrowed to what they found.
    """
    precision = np.linalg.inv(prior.covariance)
    proposal = replace(prior, covariance=_WIDER * prior.covariance)
    for power in _POWERS:
        draws = _draws()
        motions = proposal.mean + draws @ np.linalg.cholesky(proposal.covariance).T
        likelihood = sum(_log_likelihood(side, channels, picture, motions) for side in sides)
        off = motions - prior.mean
        weight = (
            power * likelihood - np.einsum("mi,ij,mj->m", off, precision, off) / 2 + np.sum(draws**2, 1) / 2
        )
        weight = np.exp(weight - weight.max())
        weight /= weight.sum()
        mean = weight @ motions
        spread = (motions - mean) * np.sqrt(weight)[:, None]
        found = _Normal(mean, spread.T @ spread + 1e-4 * prior.covariance)
        proposal = replace(found, covariance=_WIDER * found.covariance + 0.02 * prior.covariance)
    return found, float(np.max(likelihood))


@cache
def _draws() -> FloatArray:
    """Return (_SAMPLES, 7) standard normal numbers, evenly spread and always the same."""
    even = qmc.Sobol(7, seed=1).random(_SAMPLES)
    return np.asarray(norm.ppf(np.clip(even, 1e-6, 1 - 1e-6)))


def _log_likelihood(
    template: _Template, channels: FloatArray, picture: FrontPicture, motions: FloatArray
) -> FloatArray:
    """Return (M,): of motions (M, 7), given as those of the right side."""
    moved = template.points.moved(template.motions(motions), template.middle)
    total = np.zeros(len(motions))
    for cue in template.cues:
        used = np.flatnonzero(np.isfinite(cue.label))
        label = cue.label[used]
        share = np.where(label > 0, 0.5 / max(label.sum(), 1), 0.5 / max((1 - label).sum(), 1))
        gram, least = _grams(
            channels, moved, used, picture.low, picture.step_mm, cue.channel, cue.light[used], label, share
        )
        gram[:, 4, 4] += _FLOOR[cue.channel] ** 2 * gram[:, 0, 0]
        gram += 1e-9 * np.eye(5)
        inverse = np.linalg.inv(gram)
        rho = -inverse[:, 3, 4] / np.sqrt(inverse[:, 3, 3] * inverse[:, 4, 4])
        rho = np.where(least > _LEAST_SEEN, np.clip(cue.sign * rho, 0, 0.999), 0)
        total -= cue.independent / 2 * np.log(1 - rho**2)
    return total


@njit(cache=True, nogil=True)
def _grams(channels, moved, used, low, step_mm, channel, light, label, share):  # type: ignore[no-untyped-def]
    """Return (M, 5, 5), products of 1, light (2), label and colour, and (M,) least share of a label seen."""
    count, points = len(moved), len(used)
    rows, columns = channels.shape[:2]
    gram, least = np.zeros((count, 5, 5)), np.zeros(count)
    values = np.empty(5)
    for m in range(count):
        on, beside = 0.0, 0.0
        for n in range(points):
            column = (moved[m, used[n], 0] - low[0]) / step_mm
            row = (moved[m, used[n], 1] - low[1]) / step_mm
            if not (0 <= column < columns - 1 and 0 <= row < rows - 1):
                continue
            left, under = int(column), int(row)
            right, up = column - left, row - under
            a, b = channels[under, left], channels[under, left + 1]
            c, d = channels[under + 1, left], channels[under + 1, left + 1]
            if a[2] * b[2] * c[2] * d[2] == 0:
                continue
            k = channel
            color = (1 - up) * ((1 - right) * a[k] + right * b[k]) + up * ((1 - right) * c[k] + right * d[k])
            values[0], values[1], values[2] = 1.0, light[n, 0], light[n, 1]
            values[3], values[4] = label[n], color
            for i in range(5):
                for j in range(i + 1):
                    gram[m, i, j] += share[n] * values[i] * values[j]
            if label[n] > 0:
                on += share[n]
            else:
                beside += share[n]
        for i in range(5):
            for j in range(i):
                gram[m, j, i] = gram[m, i, j]
        least[m] = 2 * min(on, beside)
    return gram, least
