"""How surely each texel of a face is skin: from its region, its colour and grain, its relief and residual."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.area_mean import area_mean
from scan2albedo.sampling.skin_color import color_evidence, local_mean, odd_side

SURE = 0.95
"""Prior of skin where the annotation speaks of nothing else."""
TEXEL_MM = 1.4
"""Colours are compared at about this size: pores and a picture's noise are averaged there, hairs are not."""
_FEWEST_TEXELS, _LEAST_PART, _STEPS = 64, 0.25, 32
_TOLERATED_DEVIATIONS, _PER_DEVIATION = 2.0, 0.9
_TOLERATED_GRAIN, _PER_GRAIN = 0.29, 13.0
_TOLERATED_DARKNESS, _PER_DARKNESS = 0.1, 4.0
_TOLERATED_RELIEF, _PER_RELIEF = 1.5, 2.0
"""What skin itself shows, and the log odds against skin of what goes beyond, set on path-traced faces."""
_SPOT, _SPOT_MM2 = 0.75, 80.0
"""Islands below this weight, up to the size of a large mole and its rim, are moles."""
_LIKELY = 0.9
"""Prior below which islands are left: eyes and brows are not moles."""
_CLOSE_MM, _FAR_MM = 1.0, 3.0
"""Residuals of a good fit, and of hair or glasses over it."""
_RELIEF_MM, _SMOOTH_MM = 12.0, 0.05
"""Side of the squares over which relief is averaged, and the residual of skin without noise."""

Coarse = NDArray[np.float32]


def skin_weight(
    position: FloatArray,
    normal: FloatArray,
    seen: BoolArray,
    texture_linear: NDArray[np.float32] | None = None,
    *,
    prior: NDArray[np.floating] | None = None,
    anchor: BoolArray | None = None,
    residual_mm: FloatArray | None = None,
) -> NDArray[np.float32]:
    """Return (H, W) how surely a texel is skin, 0 to 1; 0 where the surface was not seen.

    `position` in mm and unit `normal` are (H, W, 3). `seen` (H, W) are texels of the surface with texture, or
    with scan near; the others are not read. Linear colour `texture_linear` (H, W, 3) is compared with that of
    the face's own skin, which is learned where `anchor` (H, W) is skin on most faces, from all texels when
    None. `prior` (H, W) is how probably the region of a texel is skin, `SURE` when None, and `residual_mm`
    (H, W) the distance of the fitted surface to the scan, NaN where there is no scan.

    Log odds of the region, less those of colour, grain, darkness and relief, at texels of `TEXEL_MM`.
    Islands of the size of moles become skin. O(H W); 0.1 s at 512 x 512.
    """
    seen = seen if residual_mm is None else seen & np.isfinite(residual_mm)
    if not seen.any():
        return np.zeros(seen.shape, np.float32)
    # The grid on which colours are compared, and the side of its texels.
    every = max(1, len(seen) // _STEPS)
    both = seen[::every, 1:] & seen[::every, :-1]
    steps = (position[::every, 1:] - position[::every, :-1])[both]
    side = float(np.median(np.linalg.norm(steps, axis=1))) if len(steps) else TEXEL_MM
    factor = max(1, round(TEXEL_MM / max(side, TEXEL_MM / min(seen.shape))))
    shape, texel_mm = tuple(-(-texels // factor) for texels in seen.shape), side * factor
    part = _resized(seen.astype(np.float32), shape)
    region = np.full(shape, SURE, np.float32) if prior is None else _mean(prior, seen, part)
    likely = np.clip(region, 1 - SURE, SURE)
    odds = np.log(likely / (1 - likely))
    known = part > _LEAST_PART
    trusted = known if anchor is None else known & (_resized(anchor.astype(np.float32), shape) > 0.5)
    if np.count_nonzero(trusted) < _FEWEST_TEXELS:
        trusted = known
    if np.count_nonzero(known) >= _FEWEST_TEXELS:
        if texture_linear is not None:
            means = _mean(texture_linear, seen, part), _mean(normal, seen, part)
            found = color_evidence(*means, known, trusted, texel_mm)
            # Darkness counts as far as the region is in doubt: elsewhere dark skin lies in the shade.
            against: Coarse = _PER_DEVIATION * np.maximum(found.chroma - _TOLERATED_DEVIATIONS, 0)
            against += _PER_GRAIN * np.maximum(found.grain - _TOLERATED_GRAIN, 0)
            dark = np.maximum(found.darkness - _TOLERATED_DARKNESS, 0)
            against += (1 - likely / SURE) * _PER_DARKNESS * dark
            odds -= against
        if residual_mm is not None:
            # How rough the scan is around, in parts of the face's own skin: the fitted surface is smooth.
            off = _mean(np.minimum(residual_mm, _CLOSE_MM), seen, part)
            rough = local_mean(off, part, odd_side(_RELIEF_MM / texel_mm))
            relief = rough / np.float32(max(float(np.median(rough[trusted])), _SMOOTH_MM))
            odds -= _PER_RELIEF * np.maximum(relief - _TOLERATED_RELIEF, 0)
    coarse = np.minimum(1 / (1 + np.exp(-odds)) / SURE, 1)
    # Small islands become skin where the region is skin.
    around = np.ones((3, 3), bool)
    spot = label(coarse < _SPOT, around)[0]
    small = np.bincount(spot.ravel()) * texel_mm**2 <= _SPOT_MM2
    small[0] = False
    mole = binary_dilation(small[spot], around)
    coarse = np.where(mole & (likely > _LIKELY), np.float32(1), coarse).astype(np.float32)
    skin = _resized(coarse, seen.shape)
    if residual_mm is not None:
        skin *= np.clip((_FAR_MM - residual_mm) / (_FAR_MM - _CLOSE_MM), 0, 1)
    return np.where(seen, skin, np.float32(0)).astype(np.float32, copy=False)


def _resized(field: NDArray[np.float32], shape: tuple[int, ...]) -> Coarse:
    """Return the means of `field` (H, W) or (H, W, C) over the texels of a coarser grid, or between those."""
    from skimage.transform import resize

    if shape[0] < field.shape[0]:
        return area_mean(field, (shape[0], shape[1])).astype(np.float32)
    return np.asarray(resize(field, shape[:2], order=1, mode="edge", anti_aliasing=False), np.float32)


def _mean(field: NDArray[np.floating], seen: BoolArray, part: Coarse) -> Coarse:
    """Return the means over the seen texels of each coarse one; 0 where there is none."""
    known = np.where(seen if field.ndim == 2 else seen[..., None], field, 0).astype(np.float32)
    weight = np.maximum(part, np.float32(1e-6))
    weights = weight if field.ndim == 2 else weight[..., None]
    return np.asarray(_resized(known, part.shape) / weights, np.float32)
