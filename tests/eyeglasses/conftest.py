"""Wire glasses: tubes along a path, with key points on them."""

from types import SimpleNamespace

import numpy as np
import pytest

from scan2albedo.core.arrays import grid_faces
from scan2albedo.geometry.mesh import normalized


def build_tube(path, radius=2.0, sides=12):
    """Return a closed tube along a path of points (P, 3) that stays near the xz-plane, rings 2 mm apart."""
    path = np.asarray(path, float)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    place = np.linspace(0, length[-1], max(int(length[-1] / 2), 2))
    center = np.stack([np.interp(place, length, values) for values in path.T], 1)
    along = normalized(np.gradient(center, axis=0))
    across = normalized(np.cross(along, [0, 1, 0]))
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * np.cross(across, along)[:, None]
    vertices = (center[:, None] + radius * ring).reshape(-1, 3)
    number, k = len(vertices), np.arange(sides)
    first = np.column_stack([np.full(sides, number), k, np.roll(k, -1)])
    last = np.column_stack([np.full(sides, number + 1), np.roll(k, -1) + number - sides, k + number - sides])
    faces = np.concatenate([grid_faces(len(center), sides, wrap=True), first, last])
    return np.concatenate([vertices, center[[0, -1]]]), faces


@pytest.fixture(scope="session")
def tube():
    return build_tube


@pytest.fixture(scope="session")
def glasses():
    """A mesh (V, 3), (F, 3) in mm with key points (K, 3)."""
    corner = [[64 + 6 * np.sin(t), 0, 6 * np.cos(t) - 6] for t in np.linspace(0, np.pi / 2, 5)]
    right = np.array([*corner, [70, 0, -120]])
    vertices, faces = build_tube(np.concatenate([right[::-1] * [-1, 1, 1], right]))
    side = np.array([[70.0, 0, -118], [70, 0, -60], [66, 0, -2]])
    handles = np.concatenate([side * [-1, 1, 1], [[0, 0, 0]], side[::-1]])
    return SimpleNamespace(vertices=vertices, faces=faces, handles=handles)
