"""A face-sized dome with a nose: what stands for a face where nothing is to be recognised."""

import igl
import numpy as np


def mask_surface(size, *, nose_mm=25.0, width_mm=70.0):
    """Return it in closed form: vertices (size^2, 3) mm and faces."""
    plane, faces = igl.triangulated_grid(size, size)
    u, v = 2 * plane.T - 1
    z = 60 * np.sqrt(np.maximum(1.7 - u**2 - 0.6 * v**2, 0)) + nose_mm * np.exp(-(u**2) / 0.04 - v**2 / 0.08)
    return np.column_stack([width_mm * u, 95 * v, z]), np.asarray(faces, np.int64)
