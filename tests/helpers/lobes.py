"""How a vertex responds to light, as a plain sum over many distant lights."""

import numpy as np

from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.reflectance import EXPONENTS

LIGHTS = 20_000


def response_by_sums(normal, view, *, hidden=lambda toward: False, horizon=True):
    """Return (4, 81): responses of max(0, n.l) / pi and of each Blinn-Phong lobe to light in harmonics.

    `hidden` tells of directions (L, 3) from which no light comes; without `horizon` highlights are not cut
    where the light is behind the vertex.
    """
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    toward = distant_directions(LIGHTS) @ turn
    half = toward + view
    n_h = np.maximum(half @ normal, 0) / np.maximum(np.linalg.norm(half, axis=1), 1e-12)
    diffuse = np.maximum(toward @ normal, 0) / np.pi
    lobes = np.stack([diffuse, *((s + 2) / (8 * np.pi) * n_h**s for s in EXPONENTS)])
    free = np.logical_not(hidden(toward)) & ((toward @ normal > 0) | (not horizon))
    return (free * lobes) @ (harmonics(toward) * (4 * np.pi / LIGHTS))
