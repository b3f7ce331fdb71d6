"""The left half of a frame: rim, half a bridge, temple, nose pad, as one surface or in parts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic.glasses_shape import (
    BEND_RINGS,
    CORNER_RINGS,
    RIM_POINTS,
    STRAIGHT_RINGS,
    GlassesShape,
    rim_curve,
    temple_path,
)


def ring_faces(rings: IntArray) -> IntArray:
    """Return triangles (F, 3), outward where rings of vertex numbers (R, S) run clockwise along the tube."""
    a, c = rings[:-1], rings[1:]
    b, d = np.roll(a, -1, 1), np.roll(c, -1, 1)
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])


def path_frames(path: FloatArray, up: FloatArray) -> FloatArray:
    """Return (R, 3, 3) rows tangent, tangent x up, up along a path (R, 3) that never runs along `up`."""
    tangent = normalized(np.gradient(path, axis=0))
    across = normalized(np.cross(tangent, up))
    return np.stack([tangent, across, np.cross(across, tangent)], 1)


def ellipse_offsets(count: int, across: float, up: float, first_angle_rad: float) -> FloatArray:
    """Return (count, 3) offsets in (tangent, across, up), clockwise along the tangent."""
    angle = first_angle_rad - 2 * np.pi * np.arange(count) / count
    return np.stack([np.zeros(count), across * np.cos(angle), up * np.sin(angle)], 1)


_SECTION = 12
"""Points around a rim."""
_HINGE, _BRIDGE = 5, 31
"""Rim points in the middle of the patch that the temple, the bridge grow from."""
_BROW = 24
"""Rim point that a second bridge is stuck into."""
_HALF_PATCH = 2
"""Segments of the patch on each side of its middle, along and around the rim."""
_BRIDGE_RINGS, _BROW_RINGS = 9, 17
_BLEND_MM = 8.0
"""Way on which a tube's section turns from the patch's outline into an ellipse."""
_HINGE_GAP_MM = 1.0
_UP = np.array([0.0, 1.0, 0.0])


@dataclass
class HalfGlasses:
    """Vertices, faces and named vertices so far; `seam` (S,) are those on the plane x = 0."""

    points: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    marks: dict[str, int] = field(default_factory=dict)
    seam: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    lens_edge: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    count: int = 0

    def add(self, points: FloatArray) -> IntArray:
        """Append points (..., 3) and return their numbers (...)."""
        flat = points.reshape(-1, 3)
        numbers = self.count + np.arange(len(flat))
        self.points.append(flat)
        self.count += len(flat)
        return numbers.reshape(points.shape[:-1])

    def add_cap(self, ring: IntArray, points: FloatArray, *, end: bool) -> int:
        """Close the first ring of a tube, or the last (`end`), with a fan and return its middle vertex.

        The ring (S,) is at points (S, 3).
        """
        middle = int(self.add(points.mean(0)[None])[0])
        fan = np.stack([ring, np.roll(ring, -1), np.full(len(ring), middle)], 1)
        self.faces.append(fan if end else fan[:, ::-1])
        return middle


def build_half(
    shape: GlassesShape, *, welded: bool, nose_pads: bool, double_bridge: bool = False
) -> HalfGlasses:
    """Return the half at x >= 0; `welded` grows bridge and temple out of the rim's surface."""
    half = HalfGlasses()
    line, normal = rim_curve(shape)
    angle = -2 * np.pi * np.arange(_SECTION) / _SECTION
    sections = (
        line[:, None]
        + shape.rim_width / 2 * np.cos(angle)[:, None] * normal[:, None]
        + shape.rim_depth / 2 * np.sin(angle)[:, None] * np.array([0, 0, 1.0])
    )
    rim = half.add(sections)
    faces = ring_faces(np.concatenate([rim, rim[:1]]))
    half.lens_edge = rim[:, _SECTION // 2]
    loops = {}
    for middle in (_HINGE, _BRIDGE):
        patch, loop = _patch(middle)
        loops[middle] = (rim[loop], sections[loop])
        if welded:
            faces = faces[~np.isin(faces, rim[patch]).all(1)]
    half.faces.append(faces)
    outward = {"rim_top": 18, "rim_inner": 42, "rim_bottom": 54, "rim_outer": 66}
    half.marks |= {name: int(rim[i, 0]) for name, i in outward.items()}
    half.marks["rim_bridge"] = int(rim[_BRIDGE, _SECTION // 2])
    _add_bridge(half, shape, *loops[_BRIDGE], welded=welded)
    _add_temple(half, shape, *loops[_HINGE], welded=welded)
    if nose_pads:
        _add_nose_pad(half, line[44])
    if double_bridge:
        _add_brow_bar(half, shape, line[_BROW])
    return half


def _patch(middle: int) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """Return (rows, columns) of a patch on the rim's outside, and of its outline as a tube's first ring."""
    s = _HALF_PATCH
    side = np.arange(2 * s)
    i = middle + np.concatenate([s - side, np.full(2 * s, -s), side - s, np.full(2 * s, s)])
    j = np.concatenate([np.full(2 * s, -s), side - s, np.full(2 * s, s), s - side])
    rows, columns = np.meshgrid(middle + np.arange(-s, s + 1), np.arange(-s, s + 1), indexing="ij")
    return (rows % RIM_POINTS, columns % _SECTION), (i % RIM_POINTS, j % _SECTION)


def _tube(
    path: FloatArray, frames: FloatArray, loop: FloatArray, ellipse: FloatArray, blend: FloatArray
) -> FloatArray:
    """Return rings (R, S, 3) that `blend` (R,) from the outline `loop` (S, 3) around path[0] to ellipses."""
    first = (loop - path[0]) @ frames[0].T
    local = (1 - blend)[:, None, None] * first + blend[:, None, None] * ellipse
    return path[:, None] + local @ frames


def _add_bridge(
    half: HalfGlasses, shape: GlassesShape, loop: IntArray, points: FloatArray, *, welded: bool
) -> None:
    start = points.mean(0)
    t = np.linspace(0, 1, _BRIDGE_RINGS)
    path = np.stack([start[0] * (1 - t), start[1] + 1.5 * t * (2 - t), start[2] * (1 - t) ** 2], 1)
    path[-1, 0] = 0.0
    frames = np.broadcast_to(np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), (len(path), 3, 3))
    ellipse = ellipse_offsets(len(loop), 0.45 * shape.rim_depth, shape.bridge_height / 2, -0.75 * np.pi)
    blend = np.clip(2 * t, 0, 1) ** 2 * (3 - 2 * np.clip(2 * t, 0, 1))
    rings = _tube(path, frames, points, ellipse, blend)
    if welded:
        numbers = np.vstack([loop, half.add(rings[1:])])
    else:
        rings[0] = path[0] + [0.6 * shape.rim_width, 0, 0] + 0.6 * ellipse @ frames[0]
        numbers = half.add(rings)
        half.add_cap(numbers[0], rings[0], end=False)
    half.faces.append(ring_faces(numbers))
    half.seam = numbers[-1]
    half.marks |= {"bridge_top": int(half.seam[6]), "bridge_bottom": int(half.seam[14])}


def _add_brow_bar(half: HalfGlasses, shape: GlassesShape, start: FloatArray) -> None:
    """Add half a second bridge from a rim point (3,); the key point at the top of the bridge goes to it."""
    path = start * np.linspace(1, 0, _BROW_RINGS)[:, None] ** [1, 0, 2]
    ellipse = ellipse_offsets(12, 0.45 * shape.rim_depth, shape.bridge_height / 2, np.pi / 2)
    rings = path[:, None] + ellipse @ np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rings[-1, :, 0] = 0.0
    numbers = half.add(rings)
    half.add_cap(numbers[0], rings[0], end=False)
    half.faces.append(ring_faces(numbers))
    half.seam = np.concatenate([half.seam, numbers[-1]])
    half.marks["bridge_top"] = int(numbers[-1, 0])


def _add_temple(
    half: HalfGlasses, shape: GlassesShape, loop: IntArray, points: FloatArray, *, welded: bool
) -> None:
    start = points.mean(0) + (0.0 if welded else np.array([_HINGE_GAP_MM + 0.25 * shape.rim_width, 0, 0]))
    path = temple_path(shape, start)
    frames = path_frames(path, _UP)
    frames[0] = [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
    ellipse = ellipse_offsets(len(loop), shape.temple_width / 2, shape.temple_height / 2, np.pi / 4)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    part = np.clip(run / _BLEND_MM, 0, 1)
    blend = part**2 * (3 - 2 * part) if welded else np.ones(len(path))
    rings = _tube(path, frames, points, ellipse, blend)
    if welded:
        numbers = np.vstack([loop, half.add(rings[1:])])
    else:
        numbers = half.add(rings)
        half.add_cap(numbers[0], rings[0], end=False)
    half.faces.append(ring_faces(numbers))
    tip = half.add_cap(numbers[-1], rings[-1], end=True)
    outside, middle = 2, CORNER_RINGS + STRAIGHT_RINGS // 2
    half.marks |= {
        "hinge": int(numbers[CORNER_RINGS // 2, outside]),
        "temple_middle": int(numbers[middle, outside]),
        "ear_bend": int(numbers[CORNER_RINGS + STRAIGHT_RINGS + BEND_RINGS // 2, outside]),
        "temple_tip": tip,
    }


def _add_nose_pad(half: HalfGlasses, start: FloatArray) -> None:
    """Add a thin arm out of the rim with a pad at its end."""
    t = np.linspace(0, 1, 14)
    path = start + np.stack([-2.5 * t, np.zeros_like(t), -11 * t], 1)
    pad = np.sqrt(np.clip(1 - ((t - 0.72) / 0.29) ** 2, 0, None))
    width, height = 0.6 + 0.9 * pad, 0.6 + 3.2 * pad
    ellipse = ellipse_offsets(8, 1.0, 1.0, 0.0)
    local = ellipse * np.stack([np.zeros_like(t), width, height], 1)[:, None]
    rings = path[:, None] + local @ path_frames(path, _UP)
    numbers = half.add(rings)
    half.faces.append(ring_faces(numbers))
    half.add_cap(numbers[0], rings[0], end=False)
    half.add_cap(numbers[-1], rings[-1], end=True)
