"""A square patch in place of a fitted face, and scans of it."""

from dataclasses import dataclass, field

import numpy as np

from helpers.meshes import grid
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.rigid import invert_rigid, transform_points


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
    """A surface with a chart, what a fit knows of it, and where the scan lies."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    model_from_scan: np.ndarray = field(default_factory=lambda: np.eye(4))
    region: np.ndarray = field(init=False)
    residual_mm: np.ndarray = field(init=False)
    model: FlatAnnotation = field(default_factory=FlatAnnotation)

    def __post_init__(self):
        self.region = np.full(len(self.faces), 3, np.uint8)
        self.residual_mm = np.zeros(len(self.vertices))


def patch(height=lambda x, y: 0 * x, n=41, **more):
    """Return z(x, y) over 100 mm with uv = position."""
    flat, faces = grid(n, n)
    uv = flat[:, :2]
    xy = 100 * (uv - 0.5)
    return Patch(np.column_stack([xy, height(*xy.T)]), faces, uv, **more)


def textured_scan(fitted, texture):
    """Return the patch itself as a raw scan, in the scan's own frame, with uv = chart."""
    vertices = transform_points(invert_rigid(fitted.model_from_scan), fitted.vertices)
    return RawScan(vertices, fitted.faces, fitted.uv[fitted.faces], texture)
