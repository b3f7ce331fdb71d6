"""Wire glasses: tubes along a path, with key points on them."""

from dataclasses import dataclass

import numpy as np
import pytest

from scan2albedo.geometry.mesh import grid_faces


@dataclass(frozen=True)
class Glasses:
    """A mesh (V, 3), (F, 3) in mm with key points (K, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
    handles: np.ndarray


def build_tube(path, radius=2.0, sides=12, step=2.0):
    """Return a closed tube along a path of points (P, 3) that stays near the xz-plane."""
    path = np.asarray(path, float)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    place = np.linspace(0, length[-1], max(int(length[-1] / step), 2))
    center = np.stack([np.interp(place, length, path[:, k]) for k in range(3)], 1)
    along = np.gradient(center, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(along, [0, 1, 0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    up = np.cross(across, along)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rings = (
        center[:, None]
        + radius * np.cos(angle)[:, None] * across[:, None]
        + radius * np.sin(angle)[:, None] * up[:, None]
    )
    sheet = grid_faces(len(center), sides, wrap=True)
    number, k = len(center) * sides, np.arange(sides)
    first = np.column_stack([np.full(sides, number), k, np.roll(k, -1)])
    k += number - sides
    last = np.column_stack([np.full(sides, number + 1), np.roll(k, -1), k])
    return np.concatenate([rings.reshape(-1, 3), center[[0, -1]]]), np.concatenate([sheet, first, last])


def glasses_path():
    corner = [[70 - 6 + 6 * np.sin(t), 0, -6 + 6 * np.cos(t)] for t in np.linspace(0, np.pi / 2, 5)]
    right = [*corner, [70, 0, -120]]
    return np.array([[-x, y, z] for x, y, z in right[::-1]] + right)


@pytest.fixture(scope="session")
def tube():
    return build_tube


@pytest.fixture(scope="session")
def glasses():
    vertices, faces = build_tube(glasses_path())
    handles = [
        [-70, 0, -118],
        [-70, 0, -60],
        [-66, 0, -2],
        [0, 0, 0],
        [66, 0, -2],
        [70, 0, -60],
        [70, 0, -118],
    ]
    return Glasses(vertices, faces, np.array(handles, float))
