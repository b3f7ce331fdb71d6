"""Synthetic eyeglasses with key points, lenses and a known bend, mirrored from their left half."""

from dataclasses import dataclass, field

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, smoothstep
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.geometry.mesh import normalized, vertex_components, without_unreferenced
from scan2albedo.synthetic import glasses_shape
from scan2albedo.synthetic.glasses_shape import RIM_POINTS, GlassesBend, GlassesShape, bend_points


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
    half = _half_glasses(measures, welded=welded, nose_pads=nose_pads, double_bridge=double_bridge)
    points = np.concatenate(half.points)
    # The mirrored vertices: the seam's own, then new ones.
    other, apart = np.zeros(half.count, np.int64), np.ones(half.count, bool)
    apart[half.seam] = False
    other[half.seam] = half.seam
    other[apart] = half.count + np.arange(apart.sum())
    new = np.flatnonzero(other >= len(points))
    vertices = np.concatenate([points, points[new] * [-1.0, 1, 1]])
    sheet, mirror = np.concatenate(half.faces), np.concatenate([other, new])
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
    half, section = _Half(), 12  # points around a rim
    hinge, bridge = 5, 31  # rim points in the middle of the patches that temple and bridge grow from
    bridge_frame = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    line, normal = glasses_shape.rim_curve(shape)
    angle = -2 * np.pi * np.arange(section) / section
    sections = (
        line[:, None]
        + shape.rim_width / 2 * np.cos(angle)[:, None] * normal[:, None]
        + shape.rim_depth / 2 * np.sin(angle)[:, None] * np.array([0, 0, 1.0])
    )
    rim = half.add(sections)
    faces = _ring_faces(np.concatenate([rim, rim[:1]]))
    half.lens_edge = rim[:, section // 2]
    # Patches (rows, columns) on the rim's outside, and their outlines as a tube's first ring.
    # They reach two segments to each side of their middle, along and around the rim.
    loops, s = {}, 2
    side, full = np.arange(2 * s), np.full(2 * s, s)
    for middle in (hinge, bridge):
        i = (middle + np.concatenate([s - side, -full, side - s, full])) % RIM_POINTS
        j = np.concatenate([-full, side - s, full, s - side]) % section
        loops[middle] = (rim[i, j], sections[i, j])
        rows, columns = np.meshgrid(middle + np.arange(-s, s + 1), np.arange(-s, s + 1), indexing="ij")
        if welded:
            faces = faces[~np.isin(faces, rim[rows % RIM_POINTS, columns % section]).all(1)]
    half.faces.append(faces)
    outward = {"rim_top": 18, "rim_inner": 42, "rim_bottom": 54, "rim_outer": 66}
    half.marks |= {name: int(rim[i, 0]) for name, i in outward.items()}
    half.marks["rim_bridge"] = int(rim[bridge, section // 2])
    # Half the bridge.
    loop, points = loops[bridge]
    start, t = points.mean(0), np.linspace(0, 1, 9)
    path = np.stack([start[0] * (1 - t), start[1] + 1.5 * t * (2 - t), start[2] * (1 - t) ** 2], 1)
    path[-1, 0] = 0.0
    frames = np.broadcast_to(bridge_frame, (len(path), 3, 3))
    ellipse = _ellipse(len(loop), 0.45 * shape.rim_depth, shape.bridge_height / 2, -0.75 * np.pi)
    rings = _blended(path, frames, points, ellipse, np.clip(2 * t, 0, 1))
    if not welded:
        rings[0] = path[0] + [0.6 * shape.rim_width, 0, 0] + 0.6 * ellipse @ frames[0]
    half.seam = half.add_tube(rings, loop if welded else None)[-1]
    half.marks |= {"bridge_top": int(half.seam[6]), "bridge_bottom": int(half.seam[14])}
    # The temple; over 8 mm its section turns from the patch's outline into an ellipse.
    loop, points = loops[hinge]
    start = points.mean(0) + (0.0 if welded else np.array([1.0 + 0.25 * shape.rim_width, 0, 0]))
    path = glasses_shape.temple_path(shape, start)
    frames = _path_frames(path)
    frames[0] = [[1, 0, 0], [0, 0, 1], [0, 1, 0]]
    ellipse = _ellipse(len(loop), shape.temple_width / 2, shape.temple_height / 2, np.pi / 4)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    blend = np.clip(run / 8.0, 0, 1) if welded else np.ones(len(path))
    rings = _blended(path, frames, points, ellipse, blend)
    numbers = half.add_tube(rings, loop if welded else None)
    corner, straight, outside = glasses_shape.CORNER_RINGS, glasses_shape.STRAIGHT_RINGS, 2
    half.marks |= {
        "hinge": int(numbers[corner // 2, outside]),
        "temple_middle": int(numbers[corner + straight // 2, outside]),
        "ear_bend": int(numbers[corner + straight + glasses_shape.BEND_RINGS // 2, outside]),
        "temple_tip": half.add_cap(numbers[-1], rings[-1], end=True),
    }
    if nose_pads:
        # A thin arm out of the rim with a pad at its end.
        t = np.linspace(0, 1, 14)
        path = line[44] + np.stack([-2.5 * t, np.zeros_like(t), -11 * t], 1)
        pad = np.sqrt(np.clip(1 - ((t - 0.72) / 0.29) ** 2, 0, None))
        scale = np.stack([np.zeros_like(t), 0.6 + 0.9 * pad, 0.6 + 3.2 * pad], 1)
        local = _ellipse(8, 1.0, 1.0, 0.0) * scale[:, None]
        rings = path[:, None] + local @ _path_frames(path)
        numbers = half.add(rings)
        half.faces.append(_ring_faces(numbers))
        half.add_cap(numbers[0], rings[0], end=False)
        half.add_cap(numbers[-1], rings[-1], end=True)
    if double_bridge:
        # Half a second bridge; the key point at the top of the bridge goes to it.
        path = line[24] * np.linspace(1, 0, 17)[:, None] ** [1, 0, 2]
        ellipse = _ellipse(12, 0.45 * shape.rim_depth, shape.bridge_height / 2, np.pi / 2)
        rings = path[:, None] + ellipse @ bridge_frame
        rings[-1, :, 0] = 0.0
        last = half.add_tube(rings)[-1]
        half.seam = np.concatenate([half.seam, last])
        half.marks["bridge_top"] = int(last[0])
    return half


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
