"""What a scan's colours say of a pose: dark brows, eyes, nostrils and mouth, red lips, both sides alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.polylines import polyline_distance
from scan2albedo.geometry.rigid import invert_rigid, transform_points

_SPACING_MM = 5.0
_MARGINS_MM = (6.0, 22.0, 20.0)
"""How far points reach beyond the landmarks of brows, eyes, nose and mouth: sideways, up and down."""
_MOST_FACES = 50_000
"""Of more faces of a scan every so-manieth is looked at: they are far smaller than a feature then."""
_NEAR_MM = 8.0
_BLACK = 0.02
"""Added to brightness, relative to the usual, before the logarithm: a shadow is not a feature."""
_LEAST_SEEN, _LEAST_PART, _LEAST_PAIRS = 0.25, 0.4, 0.3
"""Least share of all points, of a feature or the skin around it, and of pairs of points that must be seen."""
_GAP_MM, _SURROUND_MM = 3.0, 15.0
"""Skin around a feature, from here to there; the gap is kept to the other features too."""
_GRAIN, _TINT = 0.05, 0.02
"""Contrasts of log brightness and of log red over green that count half where all else is even."""
_MIDLINE_MM = 3.0
_SMOOTH_ORDER = 3
"""Of the polynomial in x and y that is taken for light where the sides of the face are compared."""
_FAINT, _PLAIN = 0.01, 0.04
"""Deviations of log brightness up to which a texture says nothing, and from which it says all it can."""
_BRIGHTNESS = np.array([0.25, 0.6, 0.15])


@dataclass(frozen=True)
class _Feature:
    """Polylines of landmarks (indices), what lies within `reach_mm` of them, and where people's differ.

    `shifts_mm` are displacements up at which it is looked for. It is `red`, or dark.
    """

    lines: tuple[tuple[int, ...], ...]
    reach_mm: float
    shifts_mm: tuple[float, ...]
    red: bool = False


_FEATURES = {
    "brows": _Feature(((17, 18, 19, 20, 21), (22, 23, 24, 25, 26)), 4.0, (-9, -6, -3, 0, 3)),
    "eyes": _Feature(((36, 39), (42, 45)), 6.0, (-3, 0, 3)),
    "nostrils": _Feature(((31, 32, 33), (33, 34, 35)), 4.0, (-3, 0, 3, 6)),
    "lips": _Feature(((48, 51, 54, 57, 48),), 5.0, (-3, 0, 3, 6, 9), red=True),
    "mouth": _Feature(((48, 60, 61, 62, 63, 64, 54),), 3.0, (-3, 0, 3, 6, 9)),
}
_WEIGHTS = {"brows": 2.8, "eyes": 3.4, "nostrils": 1.2, "lips": 2.5, "mouth": 2.6, "symmetry": 1.4}
_MIDDLES = {"brows": 0.18, "eyes": 0.08, "nostrils": 0.1, "lips": 0.28, "mouth": 0.19, "symmetry": 0.25}
"""`_WEIGHTS`, `_MIDDLES`: log odds = sum of weight (score - middle), each as far as it is seen; a logistic
regression of right poses on wrong ones over 100 synthetic people (`tools/fit_texture_evidence.py`). Of people
left out of the fit the area under the ROC curve is 0.93 against poses upside down, 0.94 against refined wrong
candidates, 0.88 and 0.86 against turns by 90 degrees and shifts by 30 mm; where log odds of +2, 0 and -2 are
stated, they are +3.1, -0.2 and -2.1."""
_CAPS = (-2.0, 3.0)
"""Noise, paint or another's picture look like a wrong pose: such textures alone must not refuse a face."""


@dataclass(frozen=True)
class TextureEvidence:
    """Scores of a pose, -1 ... 1, 0 where too little of the feature is seen; about 0 for any even colour.

    A score is d / (|d| + s): d is the contrast of a feature to the skin around it, s the deviation of both.
    """

    brows: float
    eyes: float
    nostrils: float
    mouth: float
    """`brows`, `eyes`, `nostrils`, `mouth`: how much darker than the skin around."""
    lips: float
    """How much redder than the skin around."""
    symmetry: float
    """Correlation of the left side with the right, smooth light taken off."""
    log_odds: float
    """Natural logarithm of how much likelier these scores are in a right pose than in a wrong one, capped;
    0 where the texture says nothing."""


@dataclass(frozen=True)
class _Part:
    """One side of a feature at one place: `inside` (N,) of its points and `around` (N,) of skin beside it."""

    inside: BoolArray
    around: BoolArray

    def contrast(self, values: FloatArray, seen: BoolArray, floor: float) -> float | None:
        """Return the score of values (N,) that are greater on the feature, None where it is not seen."""
        here, beside = values[self.inside & seen], values[self.around & seen]
        enough = min(len(here) / max(1, self.inside.sum()), len(beside) / max(1, self.around.sum()))
        if enough < _LEAST_PART:
            return None
        difference = here.mean() - beside.mean()
        spread = np.sqrt((here.var() + beside.var()) / 2)
        return float(difference / (abs(difference) + spread + floor))


class ColourScorer:
    """A coloured scan, prepared to say of many poses how a face's colours speak for them.

    `of` returns None where there is nothing to say: a scan without colours, a model without landmarks.
    Preparing takes about 20 ms, and each pose 5.
    """

    def __init__(self, scan: RawScan, model: AnnotatedSurface, landmarks: FloatArray) -> None:
        self._scan = scan
        self._stride = len(scan.faces) // _MOST_FACES + 1
        self._surface = NearestSurface(scan.vertices, scan.faces[:: self._stride])
        # Points spread over the model between brows and mouth and somewhat beyond.
        points, (sideways, up, down) = oriented_points(*model.surface(1), _SPACING_MM).points, _MARGINS_MM
        low = landmarks[17:, :2].min(0) - [sideways, down]
        high = landmarks[17:, :2].max(0) + [sideways, up]
        inside = np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1)
        self._points, self._front = points[inside], model.front
        self._places = _places(self._points, landmarks)
        self._mirror: IntArray = cKDTree(self._points * [-1, 1, 1]).query(self._points)[1]
        x, y = self._points[:, 0] / 100, self._points[:, 1] / 100
        powers = [(i, j) for i in range(_SMOOTH_ORDER + 1) for j in range(_SMOOTH_ORDER + 1 - i)]
        self._smooth = np.stack([x**i * y**j for i, j in powers], axis=1)

    @classmethod
    def of(cls, scan: RawScan, model: AnnotatedSurface) -> ColourScorer | None:
        """Prepare a scan (mm)."""
        if not scan.has_color or model.landmarks is None:
            return None
        return cls(scan, model, model.landmarks)

    def evidence(self, model_from_scan: FloatArray, face_scale: float = 1.0) -> TextureEvidence | None:
        """Return the scores of a pose, see `texture_evidence`; None where too little of the face is seen."""
        found = self.scores(model_from_scan, face_scale)
        if found is None:
            return None
        scores, weights = found
        total = sum(_WEIGHTS[name] * weights[name] * (scores[name] - _MIDDLES[name]) for name in _WEIGHTS)
        return TextureEvidence(**scores, log_odds=float(np.clip(total, *_CAPS)))

    def scores(
        self, model_from_scan: FloatArray, face_scale: float
    ) -> tuple[dict[str, float], dict[str, float]] | None:
        """Return the scores by name, and of how much of each, 0 ... 1, the texture says something."""
        sized = self._front + face_scale * (self._points - self._front)
        placed = transform_points(invert_rigid(model_from_scan), sized)
        color, seen = self._colors(placed)
        if seen.mean() < _LEAST_SEEN:
            return None
        bright = color @ _BRIGHTNESS
        black = _BLACK * np.median(bright[seen])
        light = np.log(bright + black)
        light = np.clip(light, *np.percentile(light[seen], [1, 99]))
        redness = np.log((color[:, 0] + black) / (color[:, 1] + black))
        scores, weights = dict[str, float](), dict[str, float]()
        for name, places in self._places.items():
            values, floor = (redness, _TINT) if _FEATURES[name].red else (-light, _GRAIN)
            scores[name], weights[name] = _best(places, values, seen, floor)
        rough = light - self._smooth @ np.linalg.lstsq(self._smooth[seen], light[seen], rcond=None)[0]
        # The correlation with the mirror image, where enough of it is seen.
        pairs = np.abs(self._points[:, 0]) > _MIDLINE_MM
        both = pairs & seen & seen[self._mirror]
        scores["symmetry"] = weights["symmetry"] = 0.0
        if both.sum() >= _LEAST_PAIRS * pairs.sum():
            here, there = rough[both], rough[self._mirror][both]
            power = np.mean(here * here + there * there) / 2 + _GRAIN**2
            scores["symmetry"], weights["symmetry"] = float(np.mean(here * there) / power), 1.0
        clear = float(np.clip((rough[seen].std() - _FAINT) / (_PLAIN - _FAINT), 0, 1))
        return scores, {name: clear * weight for name, weight in weights.items()}

    def _colors(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the colours (N, 3) of the scan nearest to points (N, 3) in its frame, and which are near."""
        scan, hits = self._scan, self._surface.query(points)
        face = hits.face * self._stride
        if scan.uv is not None and scan.texture_linear is not None:
            height, width = scan.texture_linear.shape[:2]
            u, v = (np.einsum("nk,nkc->nc", hits.barycentric, scan.uv[face]) % 1.0).T
            row = np.minimum(((1 - v) * height).astype(np.int64), height - 1)
            column = np.minimum((u * width).astype(np.int64), width - 1)
            color = scan.texture_linear[row, column].astype(np.float64)
            shown = True if scan.color_seen is None else scan.color_seen[row, column]
        else:
            assert scan.vertex_color_linear is not None
            color = np.einsum("nk,nkc->nc", hits.barycentric, scan.vertex_color_linear[scan.faces[face]])
            shown = True if scan.color_seen is None else scan.color_seen[scan.faces[face]].all(1)
        color = np.maximum(color, 0)
        return color, shown & (hits.distance < _NEAR_MM) & (color @ _BRIGHTNESS > 0)


def texture_evidence(
    scan: RawScan, model: AnnotatedSurface, model_from_scan: FloatArray, face_scale: float = 1.0
) -> TextureEvidence | None:
    """Return what a scan's colours say of one pose, None without any; for several see `ColourScorer`.

    The scan is in mm, the model has landmarks, `model_from_scan` (4, 4) is rigid, and `face_scale` the face's
    size relative to the model's, which keeps the place of its front.
    """
    witness = ColourScorer.of(scan, model)
    return None if witness is None else witness.evidence(model_from_scan, face_scale)


def _places(points: FloatArray, landmarks: FloatArray) -> dict[str, list[list[_Part]]]:
    """Return of each feature, at each place where it is looked for, its sides."""
    shifts = sorted({shift for feature in _FEATURES.values() for shift in feature.shifts_mm})
    places: dict[str, list[list[_Part]]] = {name: [] for name in _FEATURES}
    for shift in shifts:
        beyond = {
            name: [
                polyline_distance(points[:, :2], landmarks[list(line), :2] + [0, shift]) - feature.reach_mm
                for line in feature.lines
            ]
            for name, feature in _FEATURES.items()
        }
        skin = np.min([d for each in beyond.values() for d in each], axis=0) > _GAP_MM
        for name, feature in _FEATURES.items():
            if shift in feature.shifts_mm:
                places[name].append([_Part(d <= 0, skin & (d < _SURROUND_MM)) for d in beyond[name]])
    return places


def _best(
    places: list[list[_Part]], values: FloatArray, seen: BoolArray, floor: float
) -> tuple[float, float]:
    """Return the score at the best place, and of how many of the sides there, 0 ... 1.

    Sides count by their mean, and the lesser one once more: a shadow or hair is on one side.
    """
    found = []
    for sides in places:
        scores = [side.contrast(values, seen, floor) for side in sides]
        there = [score for score in scores if score is not None]
        if there:
            found.append(((float(np.mean(there)) + min(there)) / 2, len(there) / len(sides)))
    return max(found, default=(0.0, 0.0))
