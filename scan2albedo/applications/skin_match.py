"""What two albedos differ by beside the skin itself: their level, the tint of light, places on the chart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, zoom

from scan2albedo.applications.face_features import AROUND
from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.area_mean import area_mean

_LEAST_TEXELS = 100
"""Of skin that both faces must have."""
LOCAL = 0.04
"""Part of the image's side over which the albedo's mean is taken away before features are matched; the
displacement is averaged over half as much."""


def skin_gains(source: ProcessedFace, target: ProcessedFace) -> FloatArray:
    """Return (3,) the factors that give the source's skin the target's median colour.

    The colour of a scan's light is left in its albedo, so two scans' skins differ by it. Texels count that
    are skin in both faces; seen ones where skin is not known. The factors are 1 for black albedos.
    """
    for texels in (source.bare & target.bare, source.image.seen & target.image.seen):
        if texels.sum() >= _LEAST_TEXELS:
            ours, theirs = (np.median(f.albedo_linear[texels], 0).astype(float) for f in (source, target))
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
    d = blurred_inside(more, both, sigma)
    ours, others = (blurred_inside(error.astype(np.float64) ** 2, both, sigma) for error in errors)
    people = max(np.mean(d[both] ** 2) - np.mean((ours + others)[both]), 0.0)
    share = np.divide(ours, ours + others + people, out=np.zeros_like(ours), where=ours > 0)
    return np.asarray(albedo * np.exp(d * share[..., None]))


def displacement(
    a: FloatArray, b: FloatArray, mask: BoolArray, marks: Sequence[tuple[BoolArray, BoolArray]] = ()
) -> FloatArray:
    """Return (H, W, 2) by how many texels (across, down) the features of albedo `b` lie beside those of `a`.

    Albedos are (H, W, 3), 0 outside `mask` (H, W). Two fits put one nostril, or one brow, on texels that
    differ a little, and a mean of both shows it twice. The fields f are the local contrast of log V and the
    `marks`, texels (H, W) of one feature in either face. From coarse to fine, the most probable u of
    |f_a(x) - f_b(x + u)|^2 / s^2 + |u|^2 / t^2 over a neighbourhood is found by Gauss-Newton steps: s^2 is
    what a field differs by where it has slopes, t the reach of features (B. Lucas, T. Kanade, "An iterative
    image registration technique", IJCAI 1981).
    """
    # What departs by more than three deviations does not count more; a side of 128 texels is fine enough.
    contrasts = [np.clip(local_contrast(skin, mask) / 3, -1, 1) for skin in (a, b)]
    pairs = [contrasts, *(pair for pair in marks if pair[0].any() and pair[1].any())]
    coarse = min(128 / max(mask.shape), 1.0)
    shape = int(np.ceil(coarse * mask.shape[0])), int(np.ceil(coarse * mask.shape[1]))
    fields = np.array([[area_mean(field, shape) for field in pair] for pair in pairs])
    window, reach = LOCAL / 2 * max(shape), AROUND * max(shape)
    moved, places, tiny = np.zeros((2, *shape)), np.indices(shape), np.finfo(np.float64).eps
    for blur in (2 * reach, reach, reach / 2):
        ours, theirs = np.moveaxis(gaussian_filter(fields, (0, 0, blur, blur), mode="nearest"), 1, 0)
        layers = np.concatenate([theirs[None], np.gradient(theirs, axis=(1, 2))])
        for _ in range(10):
            at = places + moved
            seen = [[map_coordinates(f, at, order=1, mode="nearest") for f in layer] for layer in layers]
            rest, slopes = ours - seen[0], np.array(seen[1:])
            steep = (slopes**2).sum(0)
            noise = (np.sum(rest**2 * steep) + tiny) / (np.sum(steep) + tiny)
            # In a neighbourhood there are as many independent differences as blurred spots.
            weight = (window / blur) ** 2 / max(noise, tiny)
            products = np.concatenate([rest * slopes, slopes[:1] * slopes, slopes[1:] * slopes[1:]])
            means = gaussian_filter(weight * products.sum(1), (0, window, window))
            down, across = means[:2] - moved / reach**2
            yy, yx, xx = means[2:] + np.reshape([1, 0, 1], (3, 1, 1)) / reach**2
            step = np.array([xx * down - yx * across, yy * across - yx * down]) / (yy * xx - yx**2)
            moved = gaussian_filter(moved + step, (0, window / 2, window / 2))
    up = np.divide(mask.shape, shape)
    moved = zoom(moved, (1, *up), order=1, mode="nearest", grid_mode=True)
    return np.moveaxis(moved[::-1], 0, -1) * up[::-1]


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
    """Return the Gaussian means of a field (H, W) or (H, W, C) over the texels of `mask` (H, W) alone."""
    inside = mask.reshape(*mask.shape, *[1] * (field.ndim - 2)).astype(np.float64)
    parts = [gaussian_filter(part, sigma, mode="mirror", axes=(0, 1)) for part in (field * inside, inside)]
    return np.asarray(parts[0] / np.maximum(parts[1], 1e-6))
