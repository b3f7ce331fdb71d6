"""Key points of frames: the pose, size and unit they fix, their mean, and frames unlike the others."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import Meter
from scan2albedo.core.arrays import EPSILON, FloatArray, finite_rows, norms
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR, SKELETON, typical_key_points
from scan2albedo.geometry.rigid import procrustes, transform_points

WIDTHS_MM = (110.0, 170.0)
"""Width of the fronts of spectacles, from children's to large sunglasses: less than a decade, so that the
width alone tells mm, cm and m apart."""
_FLAT = 1e-3
"""Spread across a line, as a part of that along it, below which points fix no pose."""
_REACH = 0.3
"""Distance from the nearest key point up to which a vertex counts to the front, as a part of its width."""
_INSIDE = 0.85
"""Least width between the outermost key points of a front, as a part of the mesh's."""
_DEVIATIONS = 6.0
"""Distance of an outlier from the median in median absolute deviations: four standard deviations."""
_TWO_BRIDGES = 0.07
"""Height of bridges, as a part of the front's width, above which they are taken for two: 10 mm of 140."""
_LEAST = 0.04
"""Distance of an outlier's key points from the median frame's, by the median width; of widths four times."""
BEHIND = np.array(["temple" in name or "ear" in name for name in KEY_POINT_NAMES])
FRONT = np.array(["rim" in name or "bridge" in name for name in KEY_POINT_NAMES])
"""(20,) True for the key points behind the hinges, and for those before them."""
SIDES = ("left", "right")
RIMS = [np.flatnonzero([n.startswith(f"{side}_rim_") for n in KEY_POINT_NAMES]) for side in SIDES]
"""Numbers of each rim's key points: top, bridge, inner, bottom, outer."""
_LEFT_OUTER = np.array([KEY_POINT_NAMES.index(name) for name in ("left_hinge", "left_rim_outer")])


def require_posable(points: FloatArray, owner: str = "") -> None:
    """Raise EyeglassesError, naming their owner, unless key points (20, 3) fix a pose and a size."""
    of = f"{owner}: " if owner else ""
    seen = points[finite_rows(points)]
    if not is_posable(seen):
        cause = f"{len(seen)} key points are known"
        if len(seen) >= 3:
            cause = f"all {len(seen)} known key points lie on one line, or in one place"
        raise EyeglassesError(f"{of}{cause}; a pose takes three that span a plane: label more of them")
    if not key_point_size(points) > 0:
        raise EyeglassesError(f"{of}no two neighbouring key points are known and apart; label more of them")


def is_posable(seen: FloatArray) -> bool:
    """Return whether finite points (K, 3) span a plane."""
    spread = np.linalg.svd(seen - seen.mean(0), compute_uv=False) if len(seen) >= 3 else np.zeros(3)
    return bool(spread[1] > _FLAT * spread[0])


def typical_size_factor(points: FloatArray) -> float:
    """Return the factor that brings a frame's median bone to 30 mm, as that of usual spectacles."""
    return 30 / key_point_size(points)


def mean_key_points(keypoints: Sequence[FloatArray], meter: Meter) -> tuple[FloatArray, bool, int]:
    """Return the mean of frames' key points (20, 3), NaN for missing ones, whether it settled, and rounds.

    Alternates x_k = mean over frames of (R_i p_ik + t_i) and the rigid Procrustes transforms (R_i, t_i) of
    each frame to x [1]_. The mean lies in the glasses' own axes, the centroid at 0. The meter records its
    change in lengths of the skeleton's median bone.

    .. [1] J. C. Gower, "Generalized Procrustes analysis", Psychometrika 40(1), 1975.
    """
    mean = fullest(keypoints)
    size = key_point_size(mean)
    iteration = 0
    settled = False
    while not settled and iteration < 200 and not (iteration and meter.exhausted):
        iteration += 1
        aligned = np.array([_laid_on(mean, points) for points in keypoints])
        seen = finite_rows(aligned)
        count = seen.sum(0)[:, None]
        total = np.where(seen[..., None], aligned, 0.0).sum(0)
        new = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        both = finite_rows(mean)
        change = np.abs((new - _laid_on(new, mean))[both]).max()
        # Up to rounding.
        settled = bool(change <= 400 * EPSILON * size and (both == (count[:, 0] > 0)).all())
        mean = new
        meter.count()
        meter.record(change / size)
    return in_own_axes(mean), settled, iteration


def fullest(keypoints: Sequence[FloatArray]) -> FloatArray:
    """Return the first of the frames' key points (20, 3) that lack fewest: what the others are aligned to."""
    return max(keypoints, key=lambda points: np.isfinite(points).sum())


def align_key_points(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the rigid `target_from_source` (4, 4) of the key points that both have, three or more."""
    both = finite_rows(source) & finite_rows(target)
    return procrustes(source[both], target[both])


def _laid_on(target: FloatArray, points: FloatArray) -> FloatArray:
    return transform_points(align_key_points(points, target), points)


def key_point_size(points: FloatArray) -> float:
    """Return the median length of the bones between known key points (20, 3); 0 where there is none."""
    bones = np.array(SKELETON)
    lengths = norms(points[bones[:, 0]] - points[bones[:, 1]])
    lengths = lengths[np.isfinite(lengths)]
    return float(np.median(lengths)) if len(lengths) else 0.0


def own_axes(points: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) that turns key points (20, 3) as those of a typical frame are.

    Its rows are the ways to the wearer's left, up and to the front; those of 1 where the points fix none.
    """
    if not is_posable(points[finite_rows(points)]):
        return np.eye(3)
    return align_key_points(points, typical_key_points())[:3, :3]


def in_own_axes(points: FloatArray) -> FloatArray:
    """Return key points (20, 3) turned by `own_axes`, the centroid at 0."""
    return (points - np.nanmean(points, axis=0)) @ own_axes(points).T


def front_width(points: FloatArray, vertices: FloatArray | None = None) -> float:
    """Return the width of the front of key points (20, 3): the greater of those at hinges and outer rims.

    With the mesh's `vertices` (V, 3), that of those nearest to one. NaN unless either pair is known.
    """
    apart = points[_LEFT_OUTER] - points[MIRROR[_LEFT_OUTER]]
    lengths = norms(apart)
    width = float(np.fmax.reduce(lengths))
    if vertices is None or not width > 0:
        return width
    known = np.flatnonzero(finite_rows(points))
    distance, nearest = cKDTree(points[known]).query(vertices)
    front = vertices[~BEHIND[known[nearest]] & (distance < _REACH * width)]
    along = front @ (apart[np.nanargmax(lengths)] / width)
    return float(np.ptp(along)) if len(along) else width


def unit_exponent(points: FloatArray, widths_mm: tuple[float, float], mesh_width: float | None = None) -> int:
    """Return k so that key points (20, 3) times 10^k are in mm, decided from the width of the front.

    Without the mesh's (`front_width`), the width is that of the key points; else the bones' lengths decide.
    Raises EyeglassesError when no power of ten makes the front as wide as that of spectacles.
    """
    width = front_width(points) if mesh_width is None else mesh_width
    low, high = widths_mm if mesh_width is not None else (_INSIDE * widths_mm[0], widths_mm[1])
    if math.isnan(width):
        return round(math.log10(typical_size_factor(points)))
    exponent = 0 if low <= width <= high else math.ceil(math.log10(low / width))
    if not low <= width * 10.0**exponent <= high:
        raise EyeglassesError(
            f"its front is {width:.4g} units wide, which is not a width of spectacles in mm, cm, m or "
            f"another decimal unit (expected {low:g} to {high:g} mm): bring mesh and key points to their "
            "true size, check the key points, or admit other widths (widths_mm; in the shell --widths)"
        )
    return exponent


def unit_factors(exponents: Sequence[int], reference: int | None) -> FloatArray:
    """Return (n,) powers of ten that bring frames to one unit: the reference's, or mm where theirs differ."""
    common = reference if reference is not None else exponents[0] if len(set(exponents)) == 1 else 0
    return np.array([10.0 ** (k - common) if k >= common else 1 / 10.0 ** (common - k) for k in exponents])


def outliers(keypoints: Sequence[FloatArray], widths: FloatArray) -> dict[int, str]:
    """Return what is unusual about frames of a set of four or more, by their place in it.

    Key points (20, 3) and `widths` (n,) of the fronts, NaN where unknown, are in one unit.
    """
    if len(keypoints) < 4:
        return {}
    center = fullest(keypoints)
    # Aligned to their medians a few times, which the first frame's oddities then no longer reach.
    for _ in range(5):
        aligned = np.array([_laid_on(center, points) for points in keypoints])
        known = np.isfinite(aligned).any((0, 2))
        center = np.full_like(aligned[0], np.nan)
        center[known] = np.nanmedian(aligned[:, known], axis=0)
    off = norms(aligned - center)
    shapes = np.sqrt(np.nanmean(off**2, axis=1))
    found: dict[int, str] = {}
    least = 0.0
    if np.isfinite(widths).any():
        median_width = np.nanmedian(widths)
        least, away = _LEAST * median_width, np.abs(widths - median_width)
        for i in np.flatnonzero(away > max(_DEVIATIONS * np.nanmedian(away), 4 * least)):
            found[int(i)] = f"its front is {widths[i]:.4g} wide, the median of the set is {median_width:.4g}"
    above = shapes - np.median(shapes)
    for i in np.flatnonzero(above > max(_DEVIATIONS * np.median(np.abs(above)), least)):
        worst = np.nanargmax(off[i])
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

    Key points (20, 3), those of the `mean`, and `widths` (n,) of the fronts are in one unit.
    """
    others = found = np.array([np.linalg.norm(p[0] - p[1]) for p in keypoints]) / widths
    if mean is not None:
        others = np.append(found, np.linalg.norm(mean[0] - mean[1]) / front_width(mean))
    return tuple(np.flatnonzero(found <= _TWO_BRIDGES).tolist()) if (others > _TWO_BRIDGES).any() else ()
