"""What two albedos differ by beside the skin itself: their level, the tint of light, places on the chart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import needs_extra

_LEAST_TEXELS = 100
"""Of skin that both faces must have."""
LOCAL = 0.04
"""Part of the image's side over which the albedo's mean is taken away before features are matched; the
displacement is averaged over half as much."""
_FARTHEST = 0.03
_AGREE = 0.004
"""Of the image's side: how far a feature is followed, and how far off it may end, there and back."""
_CONTRASTS, _LEAST_CONTRAST = 3.0, 0.25
"""Departure of log V, in its deviations: what is clipped, and below which there is no feature to follow."""


def skin_gains(source: ProcessedFace, target: ProcessedFace) -> FloatArray:
    """Return (3,) the factors that give the source's skin the target's median colour.

    The colour of a scan's light is left in its albedo, so two scans' skins differ by it. Texels count that
    are skin in both faces; seen ones where skin is not known. The factors are 1 for black albedos.
    """
    for texels in (source.bare & target.bare, source.image.seen & target.image.seen):
        if texels.sum() >= _LEAST_TEXELS:
            ours, theirs = (
                np.median(face.albedo_linear[texels], axis=0).astype(np.float64) for face in (source, target)
            )
            if min(*ours, *theirs) > 0:
                return np.asarray(theirs / ours)
    return np.ones(3)


def without_light_left(albedo: FloatArray, face: ProcessedFace, other: ProcessedFace) -> FloatArray:
    """Return a face's albedo (H, W, 3) with the posterior mean of its smooth part, given the other's.

    Light that was left is smooth. With d the local mean of what the other's log albedo has more, s_1 and s_2
    the expected errors and t^2 = mean d^2 - s_1^2 - s_2^2, by which people differ, the mean moves by
    d s_1^2 / (s_1^2 + s_2^2 + t^2). Nothing moves where errors are not known.
    """
    errors = [given.expected_error for given in (face, other) if given.expected_error is not None]
    both = face.bare & other.bare & (albedo.min(-1) > 0) & (other.albedo_linear.min(-1) > 0)
    if len(errors) < 2 or both.sum() < _LEAST_TEXELS:
        return albedo
    more, sigma = np.zeros(albedo.shape), LOCAL * max(both.shape)
    more[both] = np.log(skin_gains(other, face) * other.albedo_linear[both] / albedo[both])
    d = np.dstack([blurred_inside(channel, both, sigma) for channel in np.moveaxis(more, -1, 0)])
    ours, others = (blurred_inside(error.astype(np.float64) ** 2, both, sigma) for error in errors)
    people = max(np.mean(d[both] ** 2) - np.mean((ours + others)[both]), 0.0)
    share = np.divide(ours, ours + others + people, out=np.zeros_like(ours), where=ours > 0)
    return np.asarray(albedo * np.exp(d * share[..., None]))


def displacement(a: FloatArray, b: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (H, W, 2) by how many texels (across, down) the features of albedo `b` lie beside those of `a`.

    Two fits put one nostril on texels that differ a little, and a mean of both shows it twice. Dense optical
    flow (Kroeger et al., ECCV 2016) between the local contrasts of log V, where it agrees there and back and
    something is to be seen, averaged over the neighbourhood; 0 elsewhere. Albedos are (H, W, 3), 0 outside
    `mask`. MissingDependencyError without OpenCV.
    """
    with needs_extra("opencv"):
        import cv2

    side = max(mask.shape)
    contrasts = [local_contrast(field, mask) for field in (a, b)]
    seen = [np.round(127.5 * (1 + np.clip(c / _CONTRASTS, -1, 1))).astype(np.uint8) for c in contrasts]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = (
        np.asarray(flow.calc(one, other, np.zeros((*mask.shape, 2), np.float32)), np.float64)
        for one, other in ((seen[0], seen[1]), (seen[1], seen[0]))
    )
    agrees = np.linalg.norm(there + warped(back, there), axis=-1) < _AGREE * side
    near = np.linalg.norm(there, axis=-1) < _FARTHEST * side
    shown = np.minimum(np.abs(contrasts[0]), np.abs(warped(contrasts[1], there)))
    weight = mask * agrees * near * np.clip(shown / _LEAST_CONTRAST - 1, 0, 1)
    sigma = (LOCAL / 2 * side, LOCAL / 2 * side, 0)
    total, share = (
        gaussian_filter(field, sigma, mode="mirror")
        for field in (weight[..., None] * there, weight[..., None])
    )
    return np.asarray(total / np.maximum(share, 0.1), np.float64)


def warped(field: FloatArray, flow: FloatArray) -> FloatArray:
    """Return the field (H, W) or (H, W, C) looked up `flow` (H, W, 2) texels beside each texel."""
    at = np.indices(flow.shape[:2]) + np.moveaxis(flow[..., ::-1], -1, 0)
    channels = np.moveaxis(np.atleast_3d(field), -1, 0)
    moved = np.stack([map_coordinates(channel, at, order=3, mode="nearest") for channel in channels], -1)
    return np.clip(moved, field.min(), field.max()).reshape(field.shape)


def local_contrast(albedo: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (H, W) log V less its local mean, in its robust deviation; 0 outside the mask."""
    value = np.log(np.maximum(albedo.max(-1), 1e-4 * max(float(albedo.max()), 1e-12)))
    rest = np.where(mask, value - blurred_inside(value, mask, LOCAL * max(mask.shape)), 0.0)
    return np.asarray(rest / max(float(np.std(rest[mask])), 1e-6))


def blurred_inside(field: NDArray[np.floating], mask: BoolArray, sigma: float) -> FloatArray:
    """Return the Gaussian means of a field (H, W) over the texels of `mask` (H, W) alone."""
    inside = mask.astype(np.float64)
    weight = np.maximum(gaussian_filter(inside, sigma, mode="mirror"), 1e-6)
    return np.asarray(gaussian_filter(field * inside, sigma, mode="mirror") / weight)
