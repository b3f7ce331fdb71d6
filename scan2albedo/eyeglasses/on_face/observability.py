"""How well the pictures fix a frame, and where they contradict it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.on_face.objective import Linearization
from scan2albedo.eyeglasses.on_face.outline_samples import OutlineSampler
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import project

_RIDGE = 1e-12
"""Least eigenvalue of the scaled matrix, as a part of the largest: open directions stay finite."""
_MEDIAN_OF_RAYLEIGH, _MEDIAN_OF_NORMAL = 1.1774, 0.6745
"""Medians of a label's distance and of an outline's absolute error at a deviation of 1 a coordinate."""
_NEAR_PX, _NEAR = 3.0, 4.0
"""Pixels of one mask this near to the other agree with it: at least, and in deviations of outlines."""
_PATCH_PX = 25.0
"""Pixels by which a key point's surroundings may differ: a patch as wide as a temple is more."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations in pixels that the fit's own residuals show."""

    label_px: float
    outline_px: float


def measured_noise(at: Linearization, least_px: float, otherwise: Noise) -> Noise:
    """Return robust deviations of labels and outlines, `otherwise` where there are fewer than five."""
    labels = at.labels_px[np.isfinite(at.labels_px)]
    outline = np.abs(at.outline_px[np.isfinite(at.outline_px)])
    label_px, outline_px = otherwise.label_px, otherwise.outline_px
    if len(labels) > 4:
        label_px = max(least_px, float(np.median(labels)) / _MEDIAN_OF_RAYLEIGH)
    if len(outline) > 4:
        outline_px = max(least_px, float(np.median(outline)) / _MEDIAN_OF_NORMAL)
    return Noise(label_px, outline_px)


class PointDeviations:
    """Standard deviations of the frame's points, from the Gauss-Newton matrix of squared deviations.

    The matrix is (6, 6) for a rigid frame, (6 + 3 K, 6 + 3 K) otherwise.
    """

    def __init__(self, motion: FrameMotion, matrix: FloatArray) -> None:
        self._motion = motion
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        values, vectors = np.linalg.eigh(matrix / scale[:, None] / scale)
        values = np.maximum(values, _RIDGE * values.max())
        self._root = vectors / np.sqrt(values) / scale[:, None]

    def covariances(self, points: SkinnedPoints) -> FloatArray:
        """Return (N, 3, 3) of points in the world."""
        return self._motion.covariances(points, self._root)


def worst_deviation(covariances: FloatArray) -> FloatArray:
    """Return (N,) standard deviations in the worst direction."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))


def expected_distance(covariances: FloatArray) -> FloatArray:
    """Return (N,) root mean squares of the distances that points are off."""
    return np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.0))


def deviation_along(covariances: FloatArray, directions: FloatArray) -> FloatArray:
    """Return (N,) standard deviations along directions (N, 3)."""
    heading = normalized(directions)
    return np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", heading, covariances, heading), 0.0))


@dataclass(frozen=True)
class MaskAgreement:
    """How a view's mask and the frame's own compare."""

    iou: float
    differing: FloatArray
    """(K,) pixels of either mask away from the other, by the key point they belong to."""


def compare_masks(
    sampler: OutlineSampler, motion: FrameMotion, number: int, mask: BoolArray, noise_px: float
) -> MaskAgreement:
    """Return how a view's mask (H, W) agrees with the pixels that the frame covers, the head in front.

    A pixel of the mask far from the frame is counted for the vertex nearest to it in the picture.
    """
    import cv2
    from scipy.spatial import cKDTree

    vertices, weights = motion.positions(sampler.mesh.points), sampler.mesh.points.weights
    view, faces = sampler.views[number], sampler.shown[number]
    own, face = sampler.mask(motion, number)
    union = own | mask
    if not union.any():
        return MaskAgreement(0.0, np.zeros(weights.shape[1]))
    box, corner = _box_around(union)
    limit = max(_NEAR_PX, _NEAR * noise_px)
    differing = np.zeros(weights.shape[1])
    for here, there in ((mask, own), (own, mask)):
        # Distances in the box around both masks are those of the whole picture.
        away = cv2.distanceTransform((~there[box]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        rows, columns = np.nonzero(here[box] & (away > limit)) + corner[:, None]
        if not len(rows):
            continue
        if here is own:
            owner = faces[face[rows, columns], 0]
        else:
            # Vertices that the head should hide too: the mask may be what shows that it does not.
            pixels, depth = project(view.camera, vertices)
            front = np.flatnonzero(depth > 0)
            if not len(front):
                continue
            owner = front[cKDTree(pixels[front]).query(np.stack([columns, rows], 1))[1]]
        differing += weights[owner].sum(0)
    return MaskAgreement(float((own & mask).sum() / max(union.sum(), 1)), differing)


def _box_around(mask: BoolArray) -> tuple[tuple[slice, slice], IntArray]:
    """Return the smallest box that holds a mask, which is not empty, and its first row and column."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return box, np.array([rows[0], columns[0]])


def contradicted(agreements: list[MaskAgreement], count: int) -> BoolArray:
    """Return (K,) True for key points whose surroundings a view's mask shows elsewhere, or not at all."""
    worst = np.max([a.differing for a in agreements], axis=0) if agreements else np.zeros(count)
    return np.asarray(worst > _PATCH_PX)
