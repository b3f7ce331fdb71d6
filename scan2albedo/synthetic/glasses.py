"""Synthetic eyeglasses with key points, lenses and a known bend, mirrored from their left half."""

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from scipy.integrate import cumulative_trapezoid

from scan2albedo.core.arrays import FloatArray, IntArray, Texts, arc_lengths, norms, smoothstep
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.geometry.mesh import normalized, vertex_components, without_unreferenced
from scan2albedo.synthetic.textures import drawn

RIM_POINTS = 72
"""Rings around a rim."""
CORNER_RINGS = 8
"""Rings of a temple around the corner at the hinge."""
STRAIGHT_RINGS = 34
"""Rings of a temple straight back."""
BEND_RINGS = 10
"""Rings of a temple down behind the ear."""
_SECTION = 12
"""Vertices of a ring around a rim."""
_HINGE = 5
"""Ring in the middle of the patch that the temple grows from."""
_BRIDGE = 31
"""Ring in the middle of the patch that the bridge grows from."""
_BRIDGE_FRAME = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Tangent, across and up of the bridge's middle line."""
_LINE_POINTS = 4001
"""Places along a bent line."""


@dataclass(frozen=True)
class GlassesShape:
    """Measures of a frame; lengths in mm."""

    lens_width: float = 50.0
    lens_height: float = 38.0
    """`lens_width`, `lens_height`: of a lens."""
    squareness: float = 2.6
    """Exponent of the superellipse |x/a|^n + |y/b|^n = 1 of a lens; 2 is an ellipse."""
    bridge_width: float = 18.0
    """Between the rims."""
    bridge_height: float = 5.0
    """Of the bridge's section."""
    rim_width: float = 3.2
    """In the plane of the lens."""
    rim_depth: float = 3.6
    """Along the line of sight."""
    wrap_radius: float = 260.0
    """Radius of the curve that the front follows around the face."""
    temple_length: float = 142.0
    """From hinge to tip, along the temple."""
    temple_spread: float = 3.0
    """How far the temple leans outward where it bends behind the ear."""
    temple_height: float = 5.0
    temple_width: float = 3.0
    """`temple_height`, `temple_width`: of the temple's section."""
    ear_angle_deg: float = 45.0
    """By which the temple bends behind the ear."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Self:
        """Return measures in the range that opticians sell."""
        return cls(**drawn("glasses", rng))

    @property
    def lens_center(self) -> FloatArray:
        """(3,) of the left lens, on the front's curve."""
        x = self.bridge_width / 2 + self.rim_width + self.lens_width / 2
        return np.array([x, 0.0, self.depth(np.array(x))])

    def depth(self, x: FloatArray) -> FloatArray:
        """Return z of the front at `x`."""
        return -(x**2) / (2 * self.wrap_radius)


def rim_curve(shape: GlassesShape) -> tuple[FloatArray, FloatArray]:
    """Return the left rim's middle line (72, 3) and its outward normals (72, 3) in the xy-plane.

    Points are equally spaced, counterclockwise seen from the front, and begin at the temple.
    """
    angle = np.linspace(0, 2 * np.pi, 4097)
    half = np.array([shape.lens_width, shape.lens_height]) / 2 + shape.rim_width / 2
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    radius = (np.abs(direction / half) ** shape.squareness).sum(1) ** (-1 / shape.squareness)
    outline = radius[:, None] * direction
    run = arc_lengths(outline)
    place = np.linspace(0, run[-1], RIM_POINTS, endpoint=False)
    flat = np.stack([np.interp(place, run, outline[:, k]) for k in range(2)], 1)
    slope = np.sign(flat) * np.abs(flat / half) ** (shape.squareness - 1) / half
    normal = np.zeros((RIM_POINTS, 3))
    normal[:, :2] = slope / norms(slope)[:, None]
    x = flat[:, 0] + shape.lens_center[0]
    return np.stack([x, flat[:, 1], shape.depth(x)], 1), normal


def temple_path(shape: GlassesShape, start: FloatArray) -> FloatArray:
    """Return the middle line (68, 3) of the left temple from `start` (3,) on the rim to the tip."""
    radius = 6.0
    ear_radius = 22.0
    corner = np.linspace(0, np.pi / 2, CORNER_RINGS, endpoint=False)
    around = start + np.stack([radius * np.sin(corner), 0 * corner, radius * (np.cos(corner) - 1)], 1)
    straight_length = 0.66 * shape.temple_length
    u = np.linspace(0, 1, STRAIGHT_RINGS)
    zero = np.zeros(STRAIGHT_RINGS)
    behind = np.stack([shape.temple_spread * u**2, zero, -straight_length * u], 1)
    back = start + [radius, 0, -radius] + behind
    turn = np.linspace(0, np.deg2rad(shape.ear_angle_deg), BEND_RINGS + 1)[1:]
    level = np.array([2 * shape.temple_spread / straight_length, 0, -1.0])
    level /= np.linalg.norm(level)
    down = np.array([0, -1.0, 0])
    bend = back[-1] + ear_radius * (np.sin(turn)[:, None] * level + (1 - np.cos(turn))[:, None] * down)
    rest = shape.temple_length - straight_length - ear_radius * turn[-1]
    heading = np.cos(turn[-1]) * level + np.sin(turn[-1]) * down
    tail = bend[-1] + rest * np.linspace(0, 1, 17)[1:, None] * heading
    return np.concatenate([around, back, bend, tail])


@dataclass(frozen=True)
class GlassesBend:
    """How a frame is bent; zero leaves it alone."""

    temple_spread_mm: float = 0.0
    """How far each temple's tip moves outward, about; both bend like beams held at the hinge."""
    bridge_deg: float = 0.0
    """How far each half of the front turns around the bridge; positive wraps it tighter around the face."""
    twist_deg: float = 0.0
    """Turns the left half around the x-axis against the right one, as by sitting on the frame."""


def bend_points(
    points: FloatArray, bend: GlassesBend, hinge: FloatArray, temple_depth: float, bridge_width: float
) -> FloatArray:
    """Return points (..., 3) moved by the bend; the left temple begins at `hinge` (3,).

    The section of a temple at distance t behind the hinge turns outward by theta(t), where tan theta is the
    slope of a cantilever loaded at its end, s u^2 (3 - u) / 2 with u = t / temple_depth. The front's middle
    line turns by phi(x) about y, which rises within the bridge as a sine. Both lines keep their lengths, and
    points keep their distances from them, as in thin rods; volumes change to second order only.
    """
    if bend == GlassesBend():
        return np.array(points, float)
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    # The temples bend outward from the hinges on.
    way = np.clip(hinge[2] - z, 0, None)
    reach = np.linspace(0, max(float(way.max(initial=1.0)), 1.0), _LINE_POINTS)
    u = reach / temple_depth
    angle = np.arctan(bend.temple_spread_mm / temple_depth * (3 * u - 1.5 * u**2))
    along, out = (np.interp(way, reach, line) for line in _line(angle, reach[1]))
    theta, off, bent = np.interp(way, reach, angle), np.abs(x) - hinge[0], way > 0
    x = np.where(bent, np.sign(x) * (hinge[0] + out + off * np.cos(theta)), x)
    z = np.where(bent, hinge[2] - along + off * np.sin(theta), z)
    turn = _rise(x, bridge_width) * np.deg2rad(bend.twist_deg) / 2
    y, z = np.cos(turn) * y - np.sin(turn) * z, np.sin(turn) * y + np.cos(turn) * z
    reach = np.linspace(0, max(float(np.abs(x).max(initial=1.0)), 1.0), _LINE_POINTS)
    wrap = np.deg2rad(bend.bridge_deg)
    lines = _line(wrap * _rise(reach, bridge_width), reach[1])
    forward, back = (np.interp(np.abs(x), reach, line) for line in lines)
    phi = wrap * _rise(np.abs(x), bridge_width)
    return np.stack([np.sign(x) * (forward + z * np.sin(phi)), y, z * np.cos(phi) - back], -1)


def _line(angle: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return how far lines (N,) that turn by an angle at each step have come, straight on and across."""
    along, across = (cumulative_trapezoid(f, dx=step, initial=0) for f in (np.cos(angle), np.sin(angle)))
    return along, across


def _rise(x: FloatArray, bridge_width: float) -> FloatArray:
    """Return a smooth step from -1 to 1 across the bridge."""
    return np.sin(np.pi / 2 * np.clip(2 * x / bridge_width, -1, 1))


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
    def names(self) -> Texts:
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
    half = _half_glasses(measures, welded=welded, nose_pads=nose_pads, double_bridge=double_bridge)
    points = np.concatenate(half.points)
    # Vertices on the plane x = 0 are their own mirror images; those of others are new.
    apart = np.flatnonzero(points[:, 0])
    mirror = np.arange(half.count + len(apart))
    mirror[apart] = half.count + np.arange(len(apart))
    mirror[half.count :] = apart
    vertices = np.concatenate([points, points[apart] * [-1.0, 1, 1]])
    sheet = np.concatenate(half.faces)
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
    how = bend, hinge, depth, measures.bridge_width
    moved, moved_centers = (bend_points(points, *how) for points in (rest, centers))
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


@dataclass
class _Half:
    """Vertices, faces and named vertices so far; what lies on the plane x = 0 joins the other half."""

    points: list[FloatArray] = field(default_factory=list)
    faces: list[IntArray] = field(default_factory=list)
    marks: dict[str, int] = field(default_factory=dict)
    lens_edge: IntArray = field(default_factory=lambda: np.zeros(0, int))
    count: int = 0

    def add(self, points: FloatArray) -> IntArray:
        """Append points (..., 3) and return their numbers (...)."""
        flat = points.reshape(-1, 3)
        numbers = self.count + np.arange(len(flat))
        self.points.append(flat)
        self.count += len(flat)
        return numbers.reshape(points.shape[:-1])

    def add_tube(self, rings: FloatArray, loop: IntArray | None = None) -> IntArray:
        """Append rings (R, S, 3) of a tube, from `loop` (S,) or closed; return their numbers (R, S)."""
        if loop is not None:
            numbers = np.vstack([loop, self.add(rings[1:])])
        else:
            numbers = self.add(rings)
            self.add_cap(numbers[0], rings[0], end=False)
        self.faces.append(_ring_faces(numbers))
        return numbers

    def add_cap(self, ring: IntArray, points: FloatArray, *, end: bool) -> int:
        """Close a ring (S,) at points (S, 3), a tube's first or its `end`; return the middle vertex."""
        middle = int(self.add(points.mean(0)[None])[0])
        fan = np.stack([ring, np.roll(ring, -1), np.full(len(ring), middle)], 1)
        self.faces.append(fan if end else fan[:, ::-1])
        return middle


def _half_glasses(shape: GlassesShape, *, welded: bool, nose_pads: bool, double_bridge: bool) -> _Half:
    """Return the half at x >= 0; `welded` grows bridge and temple out of the rim's surface."""
    half, line = _Half(), rim_curve(shape)[0]
    bridge, hinge = _add_rim(half, shape, welded)
    _add_bridge(half, shape, bridge, welded)
    _add_temple(half, shape, hinge, welded)
    if nose_pads:
        # A thin arm out of the rim with a pad at its end.
        t = np.linspace(0, 1, 14)
        path = line[44] + np.stack([-2.5 * t, np.zeros_like(t), -11 * t], 1)
        pad = np.sqrt(np.clip(1 - ((t - 0.72) / 0.29) ** 2, 0, None))
        scale = np.stack([np.zeros_like(t), 0.6 + 0.9 * pad, 0.6 + 3.2 * pad], 1)
        local = _ellipse(8, 1.0, 1.0, 0.0) * scale[:, None]
        rings = path[:, None] + local @ _path_frames(path)
        half.add_cap(half.add_tube(rings)[-1], rings[-1], end=True)
    if double_bridge:
        # Half a second bridge; the key point at the top of the bridge goes to it.
        path = line[24] * np.linspace(1, 0, 17)[:, None] ** [1, 0, 2]
        ellipse = _ellipse(12, 0.45 * shape.rim_depth, shape.bridge_height / 2, np.pi / 2)
        rings = path[:, None] + ellipse @ _BRIDGE_FRAME
        rings[-1, :, 0] = 0.0
        last = half.add_tube(rings)[-1]
        half.marks["bridge_top"] = int(last[0])
    return half


def _add_rim(half: _Half, shape: GlassesShape, welded: bool) -> list[IntArray]:
    """Append a rim, open at its patches if `welded`; return those of bridge and temple, (S,) each."""
    line, normal = rim_curve(shape)
    angle = -2 * np.pi * np.arange(_SECTION) / _SECTION
    sections = (
        line[:, None]
        + shape.rim_width / 2 * np.cos(angle)[:, None] * normal[:, None]
        + shape.rim_depth / 2 * np.sin(angle)[:, None] * np.array([0, 0, 1.0])
    )
    rim = half.add(sections)
    faces = _ring_faces(np.concatenate([rim, rim[:1]]))
    half.lens_edge = rim[:, _SECTION // 2]
    # Patches reach two segments to each side of their middle, along and around the rim.
    s = 2
    side, full, patches = np.arange(2 * s), np.full(2 * s, s), []
    for middle in (_BRIDGE, _HINGE):
        i = (middle + np.concatenate([s - side, -full, side - s, full])) % RIM_POINTS
        j = np.concatenate([-full, side - s, full, s - side]) % _SECTION
        patches.append(rim[i, j])
        rows, columns = np.meshgrid(middle + np.arange(-s, s + 1), np.arange(-s, s + 1), indexing="ij")
        if welded:
            faces = faces[~np.isin(faces, rim[rows % RIM_POINTS, columns % _SECTION]).all(1)]
    half.faces.append(faces)
    outward = {"rim_top": 18, "rim_inner": 42, "rim_bottom": 54, "rim_outer": 66}
    half.marks |= {name: int(rim[i, 0]) for name, i in outward.items()}
    half.marks["rim_bridge"] = int(rim[_BRIDGE, _SECTION // 2])
    return patches


def _add_bridge(half: _Half, shape: GlassesShape, loop: IntArray, welded: bool) -> None:
    """Append half the bridge, which ends in the plane x = 0, from the outline `loop` (S,) on the rim."""
    points = half.points[0][loop]
    start, t = points.mean(0), np.linspace(0, 1, 9)
    path = np.stack([start[0] * (1 - t), start[1] + 1.5 * t * (2 - t), start[2] * (1 - t) ** 2], 1)
    path[-1, 0] = 0.0
    frames = np.broadcast_to(_BRIDGE_FRAME, (len(path), 3, 3))
    ellipse = _ellipse(len(loop), 0.45 * shape.rim_depth, shape.bridge_height / 2, -0.75 * np.pi)
    rings = _blended(path, frames, points, ellipse, np.clip(2 * t, 0, 1))
    if not welded:
        rings[0] = path[0] + [0.6 * shape.rim_width, 0, 0] + 0.6 * ellipse @ frames[0]
    seam = half.add_tube(rings, loop if welded else None)[-1]
    half.marks |= {"bridge_top": int(seam[6]), "bridge_bottom": int(seam[14])}


def _add_temple(half: _Half, shape: GlassesShape, loop: IntArray, welded: bool) -> None:
    """Append the temple; over 8 mm its section turns from the outline `loop` (S,) into an ellipse."""
    points = half.points[0][loop]
    start = points.mean(0) + (0.0 if welded else np.array([1.0 + 0.25 * shape.rim_width, 0, 0]))
    path = temple_path(shape, start)
    frames = _path_frames(path)
    frames[0] = [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
    ellipse = _ellipse(len(loop), shape.temple_width / 2, shape.temple_height / 2, np.pi / 4)
    run = arc_lengths(path)
    blend = np.clip(run / 8.0, 0, 1) if welded else np.ones(len(path))
    rings = _blended(path, frames, points, ellipse, blend)
    numbers = half.add_tube(rings, loop if welded else None)
    outside = 2
    half.marks |= {
        "hinge": int(numbers[CORNER_RINGS // 2, outside]),
        "temple_middle": int(numbers[CORNER_RINGS + STRAIGHT_RINGS // 2, outside]),
        "ear_bend": int(numbers[CORNER_RINGS + STRAIGHT_RINGS + BEND_RINGS // 2, outside]),
        "temple_tip": half.add_cap(numbers[-1], rings[-1], end=True),
    }


def _blended(
    path: FloatArray, frames: FloatArray, loop: FloatArray, ellipse: FloatArray, part: FloatArray
) -> FloatArray:
    """Return rings (R, S, 3): from the outline `loop` (S, 3) around path[0] to ellipses, by `part` (R,)."""
    first, blend = (loop - path[0]) @ frames[0].T, smoothstep(part)[:, None, None]
    return path[:, None] + ((1 - blend) * first + blend * ellipse) @ frames


def _ring_faces(rings: IntArray) -> IntArray:
    """Return triangles (F, 3), outward where rings of vertex numbers (R, S) run clockwise along the tube."""
    a, c = rings[:-1], rings[1:]
    b, d = np.roll(a, -1, 1), np.roll(c, -1, 1)
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])


def _path_frames(path: FloatArray) -> FloatArray:
    """Return (R, 3, 3) rows tangent, tangent x up, up along a path (R, 3) that never runs along y."""
    tangent = normalized(np.gradient(path, axis=0))
    across = normalized(np.cross(tangent, [0.0, 1.0, 0.0]))
    return np.stack([tangent, across, np.cross(across, tangent)], 1)


def _ellipse(count: int, across: float, up: float, first_angle_rad: float) -> FloatArray:
    """Return (count, 3) offsets in (tangent, across, up), clockwise along the tangent."""
    angle = first_angle_rad - 2 * np.pi * np.arange(count) / count
    return np.stack([np.zeros(count), across * np.cos(angle), up * np.sin(angle)], 1)
