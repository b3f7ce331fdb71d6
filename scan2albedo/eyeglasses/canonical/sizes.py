"""Sizes of frames: their unit from the width of the front, and frames unlike the others of a set."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.mean_keypoints import align_key_points, fullest, usual_size_factor
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.geometry.rigid import transform_points

WIDTHS_MM = (110.0, 170.0)
"""Width of the fronts of spectacles, from children's to large sunglasses: less than a decade, so that the
width alone tells mm, cm and m apart."""
_FRONT = np.array(["temple" not in name and "ear" not in name for name in KEY_POINT_NAMES])
_LEFT_OUTER = np.array([KEY_POINT_NAMES.index(name) for name in ("left_hinge", "left_rim_outer")])
_MIRRORED = np.array(MIRROR)
_REACH = 0.3
"""Distance from the nearest key point, as a part of their width, up to which a vertex counts to the front."""
_INSIDE = 0.85
"""Width between the outermost key points of a front as a part of its own, at least."""
_FEWEST = 4
"""Frames in the smallest set that can have an outlier."""
_DEVIATIONS, _MAD = 4.0, 1.4826
"""Distance of an outlier from the median in standard deviations, each 1.4826 median absolute deviations."""
_ROUNDS = 5
"""Of aligning key points to their medians, which the first frame's oddities then no longer reach."""
_TWO_BRIDGES = 0.07
"""Height of bridges, as a part of the front's width, above which they are taken for two: 10 mm of 140."""
_LEAST_WIDTH, _LEAST_SHAPE = 0.04, 0.01
"""Least standard deviation of widths and of key points, as parts of the median width."""


def front_width(points: FloatArray, vertices: FloatArray | None = None) -> float:
    """Return the width of the front of key points (20, 3): the greater of those at hinges and outer rims.

    With the mesh's `vertices` (V, 3) it is that of the mesh there, of vertices nearest to a key point of the
    front. NaN unless hinges or outer rims are known on both sides.
    """
    apart = points[_LEFT_OUTER] - points[_MIRRORED[_LEFT_OUTER]]
    lengths = np.linalg.norm(apart, axis=1)
    width = float(np.fmax.reduce(lengths))
    if vertices is None or not width > 0:
        return width
    known = np.flatnonzero(np.isfinite(points).all(1))
    distance, nearest = cKDTree(points[known]).query(vertices)
    front = vertices[_FRONT[known[nearest]] & (distance < _REACH * width)]
    along = front @ (apart[np.nanargmax(lengths)] / width)
    return float(np.ptp(along)) if len(along) else width


def unit_exponent(points: FloatArray, widths_mm: tuple[float, float], mesh_width: float | None = None) -> int:
    """Return k so that key points (20, 3) times 10^k are in mm, decided from the width of the front.

    Without the mesh's (`front_width`), the width is that of the key points, which may be less by 15 %. Where
    it is not known, the median length of the bones decides. Raises EyeglassesError when no power of ten makes
    the front as wide as that of spectacles.
    """
    width = front_width(points) if mesh_width is None else mesh_width
    low, high = widths_mm if mesh_width is not None else (_INSIDE * widths_mm[0], widths_mm[1])
    if math.isnan(width):
        return round(math.log10(usual_size_factor(points)))
    exponent = 0 if low <= width <= high else math.ceil(math.log10(low / width))
    if not low <= width * 10.0**exponent <= high:
        raise EyeglassesError(
            f"its front is {width:.4g} units wide, which is no width of spectacles in mm, cm, m or another "
            f"decimal unit (expected {low:g} to {high:g} mm): bring mesh and key points to their true size, "
            "check the key points, or admit other widths (widths_mm; in the shell --widths)"
        )
    return exponent


def unit_factors(exponents: Sequence[int], reference: int | None) -> FloatArray:
    """Return (n,) powers of ten that bring frames to one unit; all 1 where they are in one.

    `exponents` are those of `unit_exponent`. Frames go to the unit of a reference, if there is one,
    otherwise to mm where their units differ.
    """
    common = reference
    if common is None:
        common = exponents[0] if len(set(exponents)) == 1 else 0
    return np.array([10.0 ** (k - common) if k >= common else 1 / 10.0 ** (common - k) for k in exponents])


def outliers(keypoints: Sequence[FloatArray], widths: FloatArray) -> dict[int, str]:
    """Return what is unusual about frames of a set, by their place in it.

    Key points (20, 3) and `widths` (n,) of the fronts, NaN where unknown, are in one unit.

    A frame is an outlier when its width, or the root mean square distance of its key points from the set's
    medians, is more than four robust standard deviations from the median one.
    """
    if len(keypoints) < _FEWEST:
        return {}
    usual = float(np.nanmedian(widths)) if np.isfinite(widths).any() else math.nan
    center = fullest(keypoints)
    for _ in range(_ROUNDS):
        aligned = np.array([transform_points(align_key_points(p, center), p) for p in keypoints])
        center = _median(aligned)
    off = np.linalg.norm(aligned - center, axis=2)
    shapes = np.sqrt(np.nanmean(off**2, axis=1))
    found: dict[int, str] = {}
    for i in np.flatnonzero(np.abs(_deviations(widths, _LEAST_WIDTH * usual)) > _DEVIATIONS):
        found[int(i)] = f"its front is {widths[i]:.4g} wide, the median of the set is {usual:.4g}"
    for i in np.flatnonzero(_deviations(shapes, _LEAST_SHAPE * usual) > _DEVIATIONS):
        worst = int(np.nanargmax(off[i]))
        reason = (
            f"its key points are {shapes[i]:.3g} rms from the medians of the set, the median frame's "
            f"{np.median(shapes):.3g}; the farthest is {KEY_POINT_NAMES[worst]} ({off[i, worst]:.3g}): check "
            "its key points and its shape"
        )
        found[int(i)] = "; ".join(filter(None, (found.get(int(i)), reason)))
    return found


def single_bridges(
    keypoints: Sequence[FloatArray], widths: FloatArray, mean: FloatArray | None = None
) -> tuple[int, ...]:
    """Return the places of frames with one bridge, if others, or a mean given, have two; otherwise none.

    Two are farther apart, from the top of the upper to the bottom of the lower one, than one is high. Key
    points (20, 3), those of the `mean`, and `widths` (n,) of the fronts are in one unit.
    """

    def heights(points: Sequence[FloatArray]) -> FloatArray:
        return np.array([np.linalg.norm(p[0] - p[1]) for p in points])

    found = heights(keypoints) / widths
    others = found if mean is None else np.append(found, heights([mean]) / front_width(mean))
    return tuple(np.flatnonzero(found <= _TWO_BRIDGES).tolist()) if (others > _TWO_BRIDGES).any() else ()


def _median(aligned: FloatArray) -> FloatArray:
    """Return the medians (20, 3) over frames (n, 20, 3), NaN where no frame has the key point."""
    result = np.full(aligned.shape[1:], np.nan)
    known = np.isfinite(aligned).any((0, 2))
    result[known] = np.nanmedian(aligned[:, known], axis=0)
    return result


def _deviations(values: FloatArray, least: float) -> FloatArray:
    """Return how many robust standard deviations, each at least `least`, values (n,) are above the median."""
    center = np.nanmedian(values) if np.isfinite(values).any() else math.nan
    spread = np.nanmedian(np.abs(values - center)) if np.isfinite(center) else math.nan
    return np.nan_to_num((values - center) / np.fmax(_MAD * spread, least))
