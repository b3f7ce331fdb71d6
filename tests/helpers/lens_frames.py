"""Frames that lack pieces around a lens, and where cameras see a frame."""

import numpy as np

from scan2albedo.rendering.pictures import seen_samples


def from_lens(glasses, side=0):
    """Return (F, 3) ways to the middles of a frame's faces from the centre of a lens."""
    return glasses.vertices[glasses.faces].mean(1) - glasses.lens_centers[side]


def half_rimless(glasses):
    """Return the faces without those of the left rim's lower half."""
    x, y, z = from_lens(glasses).T
    return glasses.faces[(y > -6) | (np.abs(x) > 45) | (np.abs(z) > 20)]


def frame_mask(vertices, faces, camera, shape):
    """Return the mask (H, W) of what a camera sees of a mesh."""
    mask = np.zeros(shape, bool)
    mask.flat[seen_samples(vertices, faces, camera, shape).index] = True
    return mask
