"""Square patches in place of fitted faces."""

from dataclasses import dataclass, field

import numpy as np

from helpers.meshes import grid


class FlatAnnotation:
    """Region 3 for everything, and region 4 without highlights."""

    face_uv = None

    def region_values(self, attribute):
        table = np.full(256, 0.7 if attribute == "specular_scale" else 1.0)
        table[4] = 0.0
        return table

    def face_regions(self):
        return np.ones(256, bool)


@dataclass
class Patch:
    """A surface in place of a fitted face."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    model_from_scan: np.ndarray
    region: np.ndarray = field(init=False)
    residual_mm: np.ndarray = field(init=False)
    model: FlatAnnotation = field(default_factory=FlatAnnotation)

    def __post_init__(self):
        self.region = np.full(len(self.faces), 3, np.uint8)
        self.residual_mm = np.zeros(len(self.vertices))

    @property
    def centres(self):
        """(F, 3): of the faces."""
        return self.vertices[self.faces].mean(1)


def patch(height=lambda x, y: 0 * x, n=41, model_from_scan=None):
    """Return a square patch z(x, y) of 100 mm with uv = position."""
    flat, faces = grid(n, n)
    uv = flat[:, :2]
    xy = 100 * (uv - 0.5)
    vertices = np.column_stack([xy, height(*xy.T)])
    return Patch(vertices, faces, uv, np.eye(4) if model_from_scan is None else model_from_scan)
