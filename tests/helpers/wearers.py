"""Synthetic wearers of eyeglasses in small pictures."""

from functools import cache

from scan2albedo.eyeglasses import bounded_biharmonic_weights
from scan2albedo.synthetic import wearer


@cache
def small_wearer(seed, size=256, noise_px=0.0):
    """Return a wearer in pictures of `size` pixels a side, with noise of key points and masks in pixels.

    Made once for all tests of a process, which do not change it.
    """
    focal_px = 900 * size / 512
    return wearer(seed, picture_size=size, focal_px=focal_px, label_noise_px=noise_px, mask_noise_px=noise_px)


@cache
def rest_frame(seed):
    """Return vertices, faces, key points and weights of a wearer's frame before it was bent."""
    glasses = small_wearer(seed).glasses
    mesh = glasses.rest_vertices, glasses.faces
    return *mesh, glasses.rest_keypoints, bounded_biharmonic_weights(*mesh, glasses.rest_keypoints)
