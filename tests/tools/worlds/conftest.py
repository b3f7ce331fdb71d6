from __future__ import annotations

import numpy as np
import pytest

from scan2albedo.core.arrays import grid_faces


@pytest.fixture(scope="session")
def head() -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid with a nose on +z: the least that raw_like needs."""
    rows = 60
    columns = 120
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], -1)
    vertices = unit * [74.0, 110.0, 95.0]
    nose = np.exp(-((vertices[..., 0] / 12) ** 2) - ((vertices[..., 1] + 10) / 20) ** 2)
    vertices[..., 2] += 22 * nose * (vertices[..., 2] > 0)
    return vertices.reshape(-1, 3), grid_faces(rows, columns)
