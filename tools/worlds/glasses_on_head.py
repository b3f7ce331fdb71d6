"""Glasses on any head, as a scanner sees them: a frame with opaque lenses."""

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic import GlassesShape, eyeglasses
from scan2albedo.synthetic.renderer import RayScene
from scan2albedo.synthetic.sitter import Mesh, join
from scan2albedo.synthetic.wearer import fit_temples, seat


def fan(outline: FloatArray) -> Mesh:
    """Return a flat lens in an outline (R, 3): triangles from its middle."""
    rim = 1 + np.arange(len(outline))
    points = np.concatenate([outline.mean(0, keepdims=True), outline])
    return points, np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], axis=1)


def worn_glasses(head: Mesh, eyes: FloatArray, seed: int = 0, lens_mm: float = 15.0) -> Mesh:
    """Return a frame with lenses that sits on a head, mm, that looks along +z.

    `eyes` (3,) is the middle between the eyes' lids; the lenses stand `lens_mm` before it, about 5 mm less
    before the corneas. `seed` draws the frame. A lens is flat: the triangles from the middle of its outline,
    which a scanner sees where it is dusted or dark.
    """
    scene = RayScene(*head)
    shape = GlassesShape.drawn(np.random.default_rng(seed))
    glasses = eyeglasses(shape=shape, bend=fit_temples(shape, seed, scene, eyes))
    parts = [(glasses.vertices, glasses.faces)]
    for outline in glasses.lens_outlines:
        points, faces = fan(outline)
        looks_back = np.cross(*(points[faces[0, 1:]] - points[0]))[2] < 0
        parts.append((points, faces[:, ::-1] if looks_back else faces))
    vertices, faces = join(parts)
    world_from_glasses = seat(glasses, scene, eyes)
    lenses = transform_points(world_from_glasses, glasses.lens_centers)
    world_from_glasses[2, 3] += eyes[2] + lens_mm - lenses[:, 2].mean()
    return transform_points(world_from_glasses, vertices), faces
