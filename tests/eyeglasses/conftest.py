"""Wire glasses of three rods, with key points on them."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.rods import rod

from scan2albedo.eyeglasses import solve_weights
from scan2albedo.geometry.mesh import join


@pytest.fixture(scope="session")
def glasses():
    """A mesh (V, 3), (F, 3) in mm with key points (7, 3)."""
    temples = [rod([x, 0, -120], [x, 0, 0]) for x in (-70, 70)]
    vertices, faces = join([rod([-70, 0, 0], [70, 0, 0]), *temples])
    left = np.array([[70.0, 0, -118], [70, 0, -60], [66, 0, -2]])
    return SimpleNamespace(
        vertices=vertices, faces=faces, handles=np.vstack([left * [-1, 1, 1], np.zeros(3), left[::-1]])
    )


@pytest.fixture(scope="session")
def solved(glasses):
    return solve_weights(**vars(glasses), spacing=3.0)
