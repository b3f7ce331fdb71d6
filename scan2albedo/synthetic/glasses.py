"""Synthetic eyeglasses with key points, lenses and a known bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.geometry.mesh import vertex_components, without_unreferenced
from scan2albedo.synthetic.glasses_shape import GlassesBend, GlassesShape, bend_points
from scan2albedo.synthetic.half_glasses import HalfGlasses, build_half


@dataclass(frozen=True)
class SyntheticEyeglasses:
    """A frame in mm: x to the wearer's left, y up, z to the front, the bridge at x = 0."""

    vertices: FloatArray
    """(V, 3) after the bend."""
    rest_vertices: FloatArray
    """(V, 3) before it; symmetric about x = 0."""
    faces: IntArray
    """(F, 3), outward; the same for all seeds and bends."""
    keypoint_vertices: IntArray
    """(20,) vertices at the key points."""
    lens_outlines: FloatArray
    """(2, 72, 3) inner edges of the left and the right rim after the bend, as closed polygons."""
    lens_centers: FloatArray
    """(2, 3) after the bend."""
    part: IntArray
    """(V,) numbers of the connected parts."""
    mirror: IntArray
    """(V,) each vertex's counterpart on the other side."""
    shape: GlassesShape
    """Its measures."""
    bend: GlassesBend
    """How it was bent."""

    @property
    def keypoints(self) -> FloatArray:
        """(20, 3) after the bend, in the order of `names`."""
        return self.vertices[self.keypoint_vertices]

    @property
    def rest_keypoints(self) -> FloatArray:
        """(20, 3) before the bend."""
        return self.rest_vertices[self.keypoint_vertices]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the 20 key points."""
        return KEY_POINT_NAMES


def eyeglasses(
    seed: int | np.random.Generator = 0,
    *,
    shape: GlassesShape | None = None,
    bend: GlassesBend = GlassesBend(),
    welded: bool = True,
    nose_pads: bool = True,
    double_bridge: bool = False,
) -> SyntheticEyeglasses:
    """Return a synthetic frame with ground truth.

    Parameters
    ----------
    seed : int or numpy.random.Generator
        Draws the measures; the topology stays the same, so that vertices of all seeds correspond.
    shape : GlassesShape, optional
        Measures in place of drawn ones.
    bend : GlassesBend
        A smooth deformation; `rest_vertices` are the vertices before it.
    welded : bool
        One closed surface around rims, bridge and temples. Otherwise five: temples apart from the rims by
        the hinges' gap of a millimetre, the bridge stuck into the rims.
    nose_pads : bool
        Pads on thin arms, stuck into the rims as parts of their own.
    double_bridge : bool
        A second bridge between the tops of the rims, stuck into them, which has the key point `bridge_top`.
    """
    measures = shape if shape is not None else GlassesShape.drawn(np.random.default_rng(seed))
    half = build_half(measures, welded=welded, nose_pads=nose_pads, double_bridge=double_bridge)
    points = np.concatenate(half.points)
    other = _counterparts(half)
    new = np.flatnonzero(other >= len(points))
    vertices = np.concatenate([points, points[new] * [-1.0, 1, 1]])
    sheet = np.concatenate(half.faces)
    mirror = np.concatenate([other, new])
    kept, faces = without_unreferenced(vertices, np.concatenate([sheet, mirror[sheet][:, ::-1]]))
    renumbered = np.full(len(vertices), -1)
    renumbered[kept] = np.arange(len(kept))
    marks = {**half.marks, **{f"left_{name}": v for name, v in half.marks.items()}}
    marks |= {f"right_{name}": int(mirror[v]) for name, v in half.marks.items()}
    rest = vertices[kept]
    edges = renumbered[np.stack([half.lens_edge, mirror[half.lens_edge]])]
    hinge = rest[renumbered[half.marks["hinge"]]]
    depth = float(hinge[2] - rest[:, 2].min())
    centers = measures.lens_center * np.array([[1.0, 1, 1], [-1, 1, 1]])
    moved, moved_centers = (
        bend_points(p, bend, hinge, depth, measures.bridge_width) for p in (rest, centers)
    )
    return SyntheticEyeglasses(
        vertices=moved,
        rest_vertices=rest,
        faces=faces,
        keypoint_vertices=renumbered[[marks[name] for name in KEY_POINT_NAMES]],
        lens_outlines=moved[edges],
        lens_centers=moved_centers,
        part=vertex_components(len(rest), faces),
        mirror=renumbered[mirror[kept]],
        shape=measures,
        bend=bend,
    )


def _counterparts(half: HalfGlasses) -> IntArray:
    """Return (n,) numbers of the mirrored vertices: the seam's own, then new ones."""
    other = np.zeros(half.count, np.int64)
    apart = np.ones(half.count, bool)
    apart[half.seam] = False
    other[half.seam] = half.seam
    other[apart] = half.count + np.arange(apart.sum())
    return other
