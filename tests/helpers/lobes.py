"""The lobes of a vertex under many distant lights, written out once more."""

import numpy as np

from scan2albedo.reflectance import EXPONENTS


def lobes_under(normal, view, toward):
    """Return (4, L): max(0, n.l) / pi and each Blinn-Phong lobe, of light from `toward` (L, 3) unhindered.

    Highlights are not cut where the light is behind the vertex.
    """
    half = toward + view
    n_h = np.maximum(half @ normal, 0) / np.maximum(np.linalg.norm(half, axis=1), 1e-12)
    diffuse = np.maximum(toward @ normal, 0) / np.pi
    return np.stack([diffuse, *((s + 2) / (8 * np.pi) * n_h**s for s in EXPONENTS)])
