"""Light on heads: in closed form on a square."""

import numpy as np
from helpers.meshes import grid
from worlds.lit_heads import Surface, photographed, slopes


def test_light_falls_on_what_faces_it():
    flat, faces = grid(2, 2)
    corners = 100 * (flat - [0.5, 0.5, 0])
    surface = Surface(corners, corners, faces, [1])
    face, weights = np.arange(200) % 2, np.random.default_rng(0).dirichlet(np.ones(3), 200)
    bright, dark = (photographed(surface, face, weights, np.full((200, 3), a), 10, [2]) for a in (0.6, 0.3))
    assert bright.shape == (200, 3)
    assert 0.5 < bright.mean() < 1
    np.testing.assert_allclose(bright.mean(), dark.mean(), rtol=0.1)  # exposed alike
    heights, gradient = slopes(corners, [3], (5.0, 20.0))
    step = slopes(corners + [1e-5, 0, 0], [3], (5.0, 20.0))[0]
    np.testing.assert_allclose((step - heights) / 1e-5, gradient[:, 0], atol=1e-4)
