"""Brows, eyes and lips in a scan's colours: where they lie beside the model's, and how sure that is.

A feature is darker or redder than the skin around it. Of each there is a template in the model's front view:
points on the feature and beside it. It is moved over the scan's picture; the partial correlation rho of label
and colour, given place (light falls off smoothly), has the likelihood (1 - rho^2)^(-n/2) of n independent
points. Shading is divided out. Or the colours do not show the feature (lids are shut, a brow has no hair);
then the likelihood is 1 wherever it is. Brows and eyes of both sides have one normal prior. The posterior
of their motions pulls landmarks, the more the narrower it is beside the prior, and nowhere at even colours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
from scipy.linalg import block_diag
from scipy.ndimage import gaussian_filter
from scipy.special import logsumexp, ndtri
from skimage.measure import points_in_poly

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.compiled import compiled
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import LANDMARK_LEVELS
from scan2albedo.face_model.materials import light_basis
from scan2albedo.fitting.landmark_pull import SHOWN_BY_COLOR, STILL, LandmarkPull
from scan2albedo.geometry.rasterization import FrontPicture, front_picture, polyline_distance
from scan2albedo.statistics.robust import cauchy_weights

_STEP_MM = 0.8
"""Side of the picture's squares."""
_SPACING_MM = 1.5
"""Distance of a template's points."""
_MARGIN_MM = 25.0
"""Picture around the inner landmarks: a feature may lie so far off."""
_BLACK = 0.03
"""Added to colours, relative to the usual brightness, before the logarithm: in the dark is noise."""
_BRIGHTNESS = np.array([0.25, 0.6, 0.15])
_FLOOR = np.array([0.06, 0.025])
"""Deviations of log darkness and log redness that are none of a feature."""
_BROW_MM = 3.8
"""Half width of a brow."""
_BROW_BELOW_MM = 1.2
"""How far a brow's middle lies below its landmarks."""
_LINE_MM = 1.0
"""Half width of the line between shut lips, and of lashes."""
_OPEN_MM = 3.0
"""Distance of lips between which there is no line."""
_HALF_WIDTH_MM = 25.0
"""Half width of a mouth or a brow."""
_SAMPLES = 512
"""Draws of a round."""
_POWERS = (0.2, 0.5, 1.0, 1.0, 1.0)
"""Powers of the likelihood in each round (tempering): a low one first, to find what is far."""
_UNSEEN = 3.0
"""Log odds that colours do not show a feature."""
_CHANCE = 0.25
"""What they seem to tell then, as a part of the prior."""
_EXACT_MM = {"brow": 1.5, "eye": 1.0, "lips": 0.6}
"""Standard deviation of a landmark of a feature whose motion is known."""
_DEVIATIONS = {
    "brow": np.array([1.2, 6.0, 0.08, 0.02, 0.3, 0.3, 1.0]),
    "eye": np.array([1.5, 2.0, 0.06, 0.05, 0.3, 0.3, 0.5]),
    "lips": np.array([1.5, 5.0, 0.04, 0.08, 0.3, 0.3, 2.5]),
}
_ALONE = np.array([0.5, 2.0, 0.04, 0.02, 0.1, 0.1, 0.5])
"""Standard deviations of a motion: to the side and up (mm), turn (radians), the logarithms of width and of
height above and below the feature's own line, and how far its ends rise (mm, _HALF_WIDTH_MM from its middle);
`_ALONE` of one side beside the other. Those up are what light-stage shapes and two real faces have, for the
shape alone puts eyes far better than brows and lips; the others are by eye."""
_MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
_MOTIONS = len(_MIRROR)

_SMOOTH_MM = 2.0
"""Depth is smoothed by it before it is derived: scanners' noise tilts normals."""
_DARKEST = 0.15
"""Least light, relative to the usual one."""
_EVEN = 0.02
"""A deviation that nothing has to explain."""


@dataclass(frozen=True)
class _Places:
    """Points (N,) of a feature by its line: `along` (N, 2) on the line, and `up` (N,) from there."""

    along: FloatArray
    up: FloatArray

    @classmethod
    def of(cls, points: FloatArray, line: FloatArray) -> Self:
        """Return points (N, 2) by a line (K, 2)."""
        height = np.interp(points[:, 0], *line[np.argsort(line[:, 0])].T)
        return cls(np.stack([points[:, 0], height], axis=1), points[:, 1] - height)

    def moved(self, motions: FloatArray, middle: FloatArray) -> FloatArray:
        """Return (M, N, 2) for motions (M, 7)."""
        right, up, turn, wide, above, below, bend = motions.T
        (x, y), one = (self.along - middle).T, np.ones(len(self.up))
        parts = x, y, np.minimum(self.up, 0), np.maximum(self.up, 0), (x / _HALF_WIDTH_MM) ** 2, one
        rise = np.stack([np.ones(len(motions)), np.exp(below), np.exp(above), bend])[:, None]
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        factors = [np.exp(wide) * axes[:1], rise * axes[1], [middle[:, None] + [right, up]]]
        return np.stack(parts, axis=1) @ np.concatenate(factors).transpose(2, 0, 1)


@dataclass(frozen=True)
class _Cue:
    """The colour that is high where `label` (N,) is 1 and low where 0 (NaN: either): redness or darkness.

    It counts as `independent` points. What is linear in `light` (N, 2), two functions of place, is taken for
    light that falls off, and not for a feature.
    """

    label: FloatArray
    light: FloatArray
    independent: float
    red: bool = False


@dataclass(frozen=True)
class _Template:
    """A feature around its `middle` (2,): points, landmarks, and cues of colour.

    Motions are given as those of the right side; times `mirror` (7,) they are those of its own.
    """

    name: str
    numbers: tuple[int, ...]
    points: _Places
    marks: _Places
    cues: tuple[_Cue, ...]
    middle: FloatArray
    mirror: FloatArray

    def places(self, mean: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return draws (M, L, 2) of the landmarks for motions of mean (7,) and covariance (7, 7)."""
        motions = mean + _draws() @ np.linalg.cholesky(covariance).T
        return self.marks.moved(motions * self.mirror, self.middle)

    def log_likelihood(self, channels: FloatArray, picture: FrontPicture, motions: FloatArray) -> FloatArray:
        """Return (M,): of motions (M, 7)."""
        motions = np.vstack([np.zeros(_MOTIONS), motions * self.mirror])
        moved, total = self.points.moved(motions, self.middle), np.zeros(len(motions))
        for cue in self.cues:
            used = np.flatnonzero(np.isfinite(cue.label))
            label, channel = cue.label[used], int(cue.red)
            share = np.where(label > 0, 0.5 / max(label.sum(), 1), 0.5 / max((1 - label).sum(), 1))
            known = np.column_stack([np.ones_like(label), cue.light[used], label])
            gram = _grams(channels[channel], moved, used, picture.low, picture.step_mm, known, np.sqrt(share))
            # Points count as far as they are seen, on the feature and beside it, here and at the model's own
            # place: the scan may have a hole for an eye, and nothing beside the hole is one.
            least = 2 * np.minimum(gram[:, 0, 3], gram[:, 0, 0] - gram[:, 0, 3])
            gram[:, 4, 4] += _FLOOR[channel] ** 2 * gram[:, 0, 0]
            inverse = np.linalg.inv(gram + 1e-9 * np.eye(5))
            rho = -inverse[:, 3, 4] / np.sqrt(inverse[:, 3, 3] * inverse[:, 4, 4])
            total -= cue.independent * least * least[0] / 2 * np.log(1 - np.clip(rho, 0, 0.999) ** 2)
        return total[1:]


def painted_pull(
    scan: RawScan, frame_from_scan: FloatArray, model: AnnotatedSurface, control_points: FloatArray
) -> LandmarkPull | None:
    """Return the pull of the model's landmarks to where the scan's colours show them; None for nowhere."""
    landmarks = model.landmarks_of(control_points)
    found = [] if landmarks is None else painted_features(scan, frame_from_scan, landmarks)
    if landmarks is None or model.landmark_points is None or not found:
        return None
    sides, shown, sigma_mm = zip(*found, strict=True)
    numbers = [number for side in sides for number in side.numbers]
    places = np.concatenate(shown)
    return LandmarkPull(
        numbers=np.full(len(numbers), SHOWN_BY_COLOR),
        matrix=model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)[numbers],
        targets=np.column_stack([places, landmarks[numbers, 2]]),
        sigma_mm=np.concatenate(sigma_mm),
        wrong_mm=np.full(len(numbers), np.inf),
        axes=np.concatenate([np.tile([*_axes(f.name), 0.0], (len(f.numbers), 1)) for f in sides]),
        still=np.isin(numbers, STILL),
    )


def painted_features(
    scan: RawScan, frame_from_scan: FloatArray, landmarks: FloatArray
) -> list[tuple[_Template, FloatArray, FloatArray]]:
    """Return brows, eyes and lips that a scan's colours show, near landmarks (68, 3) of the model.

    Each with the places (L, 2) of its landmarks and their deviations (L,), mm.
    """
    if not scan.has_color:
        return []
    low, high = landmarks[17:, :2].min(0) - _MARGIN_MM, landmarks[17:, :2].max(0) + _MARGIN_MM
    picture = front_picture(scan, frame_from_scan, low, high, _STEP_MM)
    color, seen = picture.color, picture.seen
    if not seen.any() or not np.median(color[seen]) > 0:
        return []
    # Channels are log darkness and log redness; NaN where there is no scan.
    bright = color @ _BRIGHTNESS
    black = _BLACK * np.median(bright[seen])
    dark = -np.log(without_shading(picture, bright) + _BLACK)
    red = np.log((color[..., 0] + black) / (color[..., 1] + black))
    dark, red = (np.clip(values, *np.percentile(values[seen], [1, 99])) for values in (dark, red))
    channels = np.where(seen, [dark, red], np.nan)
    here = landmarks[:, :2]
    sides = _lips(here), _eye(here, 36), _eye(here, 42), _brow(here, 17), _brow(here, 22)
    found = []
    for side, motion in zip(sides, _posterior(sides, channels, picture), strict=True):
        places, axes = side.places(*motion), _axes(side.name)
        still = np.zeros(_MOTIONS), np.diag(_shared(side, side))
        variance, before = (p.var(axis=0) @ axes / axes.sum() for p in (places, side.places(*still)))
        # What the colours tell beyond the prior, which the fit has in its own way.
        information = 1 / variance - (1 + _CHANCE) / before
        if information.min() > 0:
            error = _EXACT_MM[side.name] ** 2 + 1 / information
            # Its landmarks err alike: they count as six.
            sigma_mm = np.sqrt(error * max(len(side.numbers) / 6, 1))
            found.append((side, places.mean(axis=0), sigma_mm))
    return found


def without_shading(picture: FrontPicture, brightness: FloatArray) -> FloatArray:
    """Return brightness (H, W) without what the light did to it.

    Of a matt surface it is about an albedo times a quadratic in the normal (Ramamoorthi and Hanrahan,
    SIGGRAPH 2001), fitted robustly here.
    """
    # The slopes of the depth, smoothed over the squares that have one.
    slopes, radius = [], _SMOOTH_MM / picture.step_mm
    for axis in (1, 0):
        known = picture.seen & np.roll(picture.seen, -1, axis) & np.roll(picture.seen, 1, axis)
        rise = np.roll(picture.depth, -1, axis) - np.roll(picture.depth, 1, axis)
        slope = gaussian_filter(np.where(known, rise / (2 * picture.step_mm), 0.0), radius)
        slopes.append(slope / np.maximum(gaussian_filter(known.astype(float), radius), 1e-3))
    normals = np.stack([-slopes[0], -slopes[1], np.ones_like(slopes[0])])
    basis = light_basis(np.moveaxis(normals / np.linalg.norm(normals, axis=0), 0, -1))
    used = np.zeros(picture.seen.shape, bool)
    # Squares in each second row and column are enough.
    used[::2, ::2] = picture.seen[::2, ::2]
    rows, values = basis[used], np.minimum(brightness, np.percentile(brightness[used], 99))[used]
    darkest = _DARKEST * max(float(np.median(values)), 1e-12)
    weight = np.ones(len(values))
    for _ in range(6):
        weighted = rows * weight[:, None]
        light = np.linalg.solve(weighted.T @ rows + 1e-4 * len(values) * np.eye(9), weighted.T @ values)
        off = np.abs(values - rows @ light) / np.maximum(rows @ light, darkest)
        weight = cauchy_weights(off, max(1.5 * float(np.median(off)), _EVEN))
    return np.where(picture.seen, brightness / np.maximum(basis @ light, darkest), 0.0)


def _axes(name: str) -> FloatArray:
    """Return (2,) 1 along the axes on which a feature is known: brows fade away at their ends."""
    return np.array([0.0, 1.0]) if name == "brow" else np.ones(2)


def _brow(landmarks: FloatArray, first: int) -> _Template:
    numbers = tuple(range(first, first + 5))
    line = landmarks[list(numbers)] - [0, _BROW_BELOW_MM]
    points = _around(line, 12.0)
    away = polyline_distance(points, line)
    used = (away < 10.0) & (np.abs(away - _BROW_MM) > 0.5)
    cue = _Cue((away[used] < _BROW_MM).astype(float), _place(points[used]), 20.0)
    return _template("brow", numbers, landmarks, line, points[used], cue)


def _eye(landmarks: FloatArray, first: int) -> _Template:
    numbers = tuple(range(first, first + 6))
    lids = landmarks[first : first + 6]
    points = _around(lids, 9.0)
    away, inside = polyline_distance(points, _closed(lids)), points_in_poly(points, lids)
    used = (inside | (away < 6.0)) & (away > 0.4)
    label, light = inside[used].astype(float), _place(points[used])
    # The eyeball is less red than skin; iris, pupil and lashes are dark.
    white, dark = _Cue(1 - label, light, 20.0, red=True), _Cue(label, light, 12.0)
    return _template("eye", numbers, landmarks, lids[[0, 3]], points[used], white, dark)


def _lips(landmarks: FloatArray) -> _Template:
    outer, inner = landmarks[48:60], landmarks[60:68]
    line = np.concatenate([outer[:1], (inner[[1, 2, 3]] + inner[[7, 6, 5]]) / 2, outer[6:7]])
    points = _around(outer, 10.0)
    away, inside = polyline_distance(points, _closed(outer)), points_in_poly(points, outer)
    used = (inside | (away < 8.0)) & (away > 0.4) & ~points_in_poly(points, inner)
    distance = polyline_distance(points[used], line)
    label = np.where(distance < _LINE_MM, 1.0, np.where((distance > 1.8) & (distance < 4.0), 0.0, np.nan))
    # Lamps stand above: the upper lip is darker than the lower one.
    up = _Places.of(points[used], line).up
    shut = np.exp(-np.sum((inner[2] - inner[6]) ** 2) / _OPEN_MM**2)
    lips = _Cue(inside[used].astype(float), _place(points[used]), 40.0, red=True)
    between = _Cue(label, np.stack([up / 2, np.sign(up)], axis=1), 12.0 * shut)
    return _template("lips", tuple(range(48, 68)), landmarks, line, points[used], lips, between)


def _template(
    name: str, numbers: tuple[int, ...], places: FloatArray, line: FloatArray, points: FloatArray, *cues: _Cue
) -> _Template:
    marks = _Places.of(places[list(numbers)], line)
    mirror = _MIRROR if numbers[0] in (22, 42) else np.ones(_MOTIONS)
    return _Template(name, numbers, _Places.of(points, line), marks, cues, line.mean(0), mirror)


def _around(line: FloatArray, margin: float) -> FloatArray:
    """Return the points (N, 2) of a grid around a line (K, 2)."""
    low, high = line.min(0) - margin, line.max(0) + margin
    axes = [np.arange(a, b, _SPACING_MM) for a, b in zip(low, high, strict=True)]
    return np.stack([values.ravel() for values in np.meshgrid(*axes)], axis=1)


def _place(points: FloatArray) -> FloatArray:
    return (points - points.mean(0)) / points.std(0)


def _closed(line: FloatArray) -> FloatArray:
    return np.concatenate([line, line[:1]])


def _shared(one: _Template, other: _Template) -> FloatArray:
    """Return the covariance of the motions of two features, that of each of the seven numbers (7,).

    Both sides of a pair move alike, and each a little; a brow and an eye are displaced alike as far as the
    surer of them is. Lips move by themselves.
    """
    variance = np.minimum(_DEVIATIONS[one.name], _DEVIATIONS[other.name]) ** 2
    place = (np.arange(_MOTIONS) < 2) & ("lips" not in (one.name, other.name))
    return variance * (place | (one.name == other.name)) + _ALONE**2 * (one is other)


def _posterior(
    sides: Sequence[_Template], channels: FloatArray, picture: FrontPicture
) -> list[tuple[FloatArray, FloatArray]]:
    """Return mean (7,) and covariance (7, 7) of each side's motion, given the colours of all.

    Expectation propagation: each side's likelihood is replaced by the normal one that gives it the mean and
    covariance it has beside the prior and all others (Minka, UAI 2001); importance sampling finds them.
    """
    count, draws, each = len(sides), _draws(), np.arange(_MOTIONS)
    certain, toward = np.zeros((count, _MOTIONS, _MOTIONS)), np.zeros((count, _MOTIONS))
    evidence = np.zeros(count)
    prior = np.zeros((count, _MOTIONS, count, _MOTIONS))
    for i, one in enumerate(sides):
        for j, other in enumerate(sides):
            prior[i, each, j, each] = _shared(one, other)
    precise = np.linalg.inv(prior.reshape(toward.size, toward.size))
    rows, columns = np.indices(picture.seen.shape)
    squares = picture.low + picture.step_mm * np.stack([columns.ravel(), rows.ravel()], axis=1)

    def motion(k: int) -> tuple[FloatArray, FloatArray]:
        covariance = np.linalg.inv(precise + block_diag(*certain))
        own = slice(_MOTIONS * k, _MOTIONS * (k + 1))
        return covariance[own] @ toward.ravel(), covariance[own, own]

    for power in _POWERS:
        for k, side in enumerate(sides):
            (now, covariance), shown = motion(k), channels
            if side.name == "brow":
                # What is dark in and about an eye is no brow, nor skin below one. It stands two before.
                lids = sides[k - 2].places(*motion(k - 2)).mean(axis=0)
                near = np.flatnonzero(np.all(np.abs(squares - lids.mean(0)) < _MARGIN_MM, axis=1))
                away = polyline_distance(squares[near], _closed(lids))
                hidden = near[points_in_poly(squares[near], lids) | (away < _LINE_MM)]
                shown = channels.copy()
                shown.reshape(len(channels), -1)[:, hidden] = np.nan
            precision = np.linalg.inv(covariance)
            others = precision - certain[k]
            middle = np.linalg.solve(others, precision @ now - toward[k])
            motions = now + draws @ np.linalg.cholesky(covariance).T
            off = motions - middle
            # The density of the prior and all others, by that of the draws.
            density = np.sum(draws**2, axis=1) - np.einsum("mi,ij,mj->m", off, others, off)
            density = (density + np.linalg.slogdet(others)[1] - np.linalg.slogdet(precision)[1]) / 2
            likelihood = side.log_likelihood(shown, picture, motions)
            evidence[k] = logsumexp(likelihood + density) - np.log(_SAMPLES)
            # Both sides of a pair are seen, or neither.
            pair = sum(evidence[j] for j in range(count) if j != k and sides[j].name == side.name)
            weight = power * np.logaddexp(0, likelihood + pair - _UNSEEN) + density
            weight = np.exp(weight - logsumexp(weight))
            mean = weight @ motions
            spread = (motions - mean) * np.sqrt(weight)[:, None]
            gained = np.linalg.inv(spread.T @ spread + 1e-4 * covariance) - others
            values, vectors = np.linalg.eigh(gained)
            certain[k] = (vectors * np.maximum(values, 0)) @ vectors.T
            toward[k] = (others + certain[k]) @ mean - others @ middle
    return [motion(k) for k in range(count)]


@cache
def _draws() -> FloatArray:
    """Return (_SAMPLES, _MOTIONS) normal numbers, evenly spread, always the same: mean 0, covariance 1."""
    # Multiples of roots of primes, modulo 1, are spread evenly (Richtmyer's lattice).
    draws = ndtri(np.outer(np.arange(1, _SAMPLES + 1), np.sqrt([2, 3, 5, 7, 11, 13, 17])) % 1)
    draws -= draws.mean(axis=0)
    return np.linalg.solve(np.linalg.cholesky(draws.T @ draws / _SAMPLES), draws.T).T


@compiled
def _grams(channel, moved, used, low, step_mm, known, root):  # type: ignore[no-untyped-def]
    """Return (M, 5, 5), sums over the points seen of products of `known` (N, 4) and colour, times root^2."""
    rows, columns = channel.shape
    gram, values = np.empty((len(moved), 5, 5)), np.empty((len(used), 5))
    for m in range(len(moved)):
        count = 0
        for n in range(len(used)):
            column = (moved[m, used[n], 0] - low[0]) / step_mm
            row = (moved[m, used[n], 1] - low[1]) / step_mm
            if not (0 <= column < columns - 1 and 0 <= row < rows - 1):
                continue
            left, under = int(column), int(row)
            right, up = column - left, row - under
            below = (1 - right) * channel[under, left] + right * channel[under, left + 1]
            above = (1 - right) * channel[under + 1, left] + right * channel[under + 1, left + 1]
            color = (1 - up) * below + up * above
            if np.isnan(color):
                continue
            for i in range(4):
                values[count, i] = root[n] * known[n, i]
            values[count, 4] = root[n] * color
            count += 1
        gram[m] = values[:count].T @ values[:count]
    return gram
