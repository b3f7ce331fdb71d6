"""Frames of several makers, whole and bent: key points by a rule, bends that the package does not contain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from worlds.files import DATA

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.io import load_scan
from scan2albedo.synthetic import GlassesShape, eyeglasses

_UPRIGHT = {
    "sunglasses_khronos.glb": np.eye(3),
    "frame_giraut.stl": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Rotations that turn the files to x the wearer's left, y up, z to the front."""
_RIM_ANGLES_DEG = {"rim_top": 90, "rim_inner": 200, "rim_bottom": 270, "rim_outer": 0}
"""Of a left rim's key points around the centre of its lens, seen from the front."""
_MIDDLE_MM = 3.0
"""Distance from the middle up to which a vertex of the front counts to the middle of the bridge."""
_BRIDGE_MM = 8.0
"""Half the way over which the bends of the bridge rise."""


@dataclass(frozen=True)
class WholeFrame:
    """A frame at rest in mm: x to the wearer's left, y up, z to the front, its middle at x = 0.

    `vertices` (V, 3), `faces` (F, 3); `marks` (20,) vertices at the key points, -1 for those it lacks;
    `rims`: vertices (R,) of the left and the right lens's edge, in order around it.
    """

    name: str
    vertices: FloatArray
    faces: IntArray
    marks: IntArray
    rims: tuple[IntArray, IntArray]

    def key_points(self, vertices: FloatArray) -> FloatArray:
        """Return (20, 3) of vertices (V, 3) that correspond to the frame's, NaN for missing ones."""
        return np.where(self.marks[:, None] >= 0, vertices[self.marks], np.nan)


@dataclass(frozen=True)
class OwnBend:
    """A bend of arcs and hyperbolic tangents: none of the curves of `GlassesBend`."""

    left_spread_mm: float = 0.0
    right_spread_mm: float = 0.0
    """Of the temples' tips, outward: temples become arcs of a circle."""
    left_curl_mm: float = 0.0
    """Of the left temple's tip, downward, an arc again."""
    twist_deg: float = 0.0
    """Of the left half of the front against the right one, about the x-axis."""
    drop_mm: float = 0.0
    """How far the left rim hangs below the right one."""
    fold_deg: float = 0.0
    """How far the left half of the front, with its temple, is turned backwards."""


OWN_BENDS = (
    OwnBend(left_spread_mm=9, right_spread_mm=-3, twist_deg=4),
    OwnBend(left_spread_mm=-6, right_spread_mm=8, left_curl_mm=7, drop_mm=2),
    OwnBend(left_spread_mm=8, right_spread_mm=8, drop_mm=-3, twist_deg=-3),
    OwnBend(left_spread_mm=2, left_curl_mm=-8, fold_deg=4, twist_deg=2),
    OwnBend(right_spread_mm=10, drop_mm=2.5, fold_deg=-3),
    OwnBend(left_spread_mm=-7, right_spread_mm=-7, left_curl_mm=5, twist_deg=5),
)


def _arc(along: FloatArray, off: FloatArray, shift_mm: float, reach: float) -> tuple[FloatArray, FloatArray]:
    """Return (along, off) with the line off = 0 bent to an arc whose end, at `reach`, has moved sideways."""
    turn = 2 * shift_mm / reach**2
    if turn == 0:
        return along, off
    angle = turn * np.maximum(along, 0)
    return (
        np.where(along > 0, np.sin(angle) / turn - off * np.sin(angle), along),
        np.where(along > 0, (1 - np.cos(angle)) / turn + off * np.cos(angle), off),
    )


def bend_frame(frame: WholeFrame, bend: OwnBend) -> FloatArray:
    """Return the vertices (V, 3) of a frame, bent."""
    x, y, z = frame.vertices.T.copy()
    points = frame.key_points(frame.vertices)
    start = float(np.nanmin(points[:, 2])) if np.isnan(points[8, 0]) else points[7, 2]
    reach = max(float(start - z.min()), 1.0)
    for sign, spread, curl in (
        (1, bend.left_spread_mm, bend.left_curl_mm),
        (-1, bend.right_spread_mm, 0.0),
    ):
        side = (sign * x > 0) & (z < start)
        if not np.isnan(points[8, 0]):
            hinge = points[7 if sign > 0 else 16]
            along, off = _arc(start - z[side], sign * (x[side] - hinge[0]), spread, reach)
            along, down = _arc(along, hinge[1] - y[side], curl, reach)
            x[side], y[side], z[side] = hinge[0] + sign * off, hinge[1] - down, start - along
    rise = np.tanh(x / _BRIDGE_MM * 1.5)
    twist = np.deg2rad(bend.twist_deg) * rise / 2
    middle = points[:2].mean(0)
    v, w = y - middle[1], z - middle[2]
    y, z = (
        middle[1] + np.cos(twist) * v - np.sin(twist) * w,
        middle[2] + np.sin(twist) * v + np.cos(twist) * w,
    )
    y = y - bend.drop_mm * (1 + rise) / 2
    fold = np.deg2rad(bend.fold_deg) * (1 + rise) / 2
    w = z - middle[2]
    return np.stack(
        [np.cos(fold) * x + np.sin(fold) * w, y, middle[2] - np.sin(fold) * x + np.cos(fold) * w], 1
    )


def synthetic_frame(name: str, shape: GlassesShape, *, double_bridge: bool = False) -> WholeFrame:
    """Return a frame of the package's own maker."""
    made = eyeglasses(0, shape=shape, double_bridge=double_bridge)
    edges = [np.linalg.norm(made.vertices - p[:, None], axis=2).argmin(1) for p in made.lens_outlines]
    return WholeFrame(name, made.vertices, made.faces, made.keypoint_vertices, (edges[0], edges[1]))


def real_frame(file: str) -> WholeFrame:
    """Return a frame of ../shared/data, upright, with key points at given angles around its lenses."""
    scan = load_scan(DATA / file)
    turn = _UPRIGHT[file]
    vertices = scan.vertices @ turn.T
    vertices[:, 0] -= (vertices[:, 0].min() + vertices[:, 0].max()) / 2
    marks = _bridge(vertices)
    rims: dict[str, IntArray] = {}
    for part, center in rims_of(scan.vertices, scan.faces, 2 if turn[2, 2] == 1 else 1).values():
        middle = turn @ center
        side, sign = ("left", 1) if middle[0] > 0 else ("right", -1)
        own = np.unique(scan.faces[part])
        offset = (vertices[own] - middle) * [sign, 1, 1]
        angle, radius = np.rad2deg(np.arctan2(offset[:, 1], offset[:, 0])), np.hypot(*offset[:, :2].T)

        def edge(degrees: float, width: float) -> int:
            near = np.abs((angle - degrees + 180) % 360 - 180) < width  # noqa: B023
            return int(own[near][radius[near].argmin()])  # noqa: B023

        marks |= {f"{side}_{name}": edge(degrees, 6) for name, degrees in _RIM_ANGLES_DEG.items()}
        joint = np.linalg.norm(vertices[own] - vertices[marks["bridge_bottom"]], axis=1).argmin()
        marks[f"{side}_rim_bridge"] = edge(float(angle[joint]), 4)
        rims[side] = np.array([edge(degrees, 5) for degrees in range(0, 360, 10)])
        marks |= _temple(vertices, side, sign)
    numbers = np.array([marks.get(name, -1) for name in KEY_POINT_NAMES])
    stem = file.partition(".")[0].split("_")[-1]
    return WholeFrame(stem, vertices, scan.faces, numbers, (rims["left"], rims["right"]))


def rims_of(vertices: FloatArray, faces: IntArray, axis: int) -> dict[str, tuple[BoolArray, FloatArray]]:
    """Return faces and centre of both rims: parts of lens width, or the halves of a front in one piece."""
    if axis == 1:  # round rims, centred 33 mm off the middle
        across = vertices[faces].mean(1)[:, 0]
        sides = {"left": -33.0, "right": 33.0}
        return {side: (x * across > 0, np.array([x, 0.0, 0.0])) for side, x in sides.items()}
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    found = {}
    for number in np.unique(part):
        own = part == number
        corners = vertices[faces[own]].reshape(-1, 3)
        if 50 < np.ptp(corners[:, 0]) < 75 and own.sum() > 1000:  # the lenses have fewer faces
            side = "left" if corners[:, 0].mean() < 0 else "right"
            found[side] = (own, (corners.min(0) + corners.max(0)) / 2)
    return found


def _bridge(vertices: FloatArray) -> dict[str, int]:
    front = vertices[:, 2] > vertices[:, 2].max() - 0.2 * np.ptp(vertices[:, 0])
    bridge = np.flatnonzero(front & (np.abs(vertices[:, 0]) < _MIDDLE_MM))
    top, bottom = vertices[bridge, 1].argmax(), vertices[bridge, 1].argmin()
    return {"bridge_top": int(bridge[top]), "bridge_bottom": int(bridge[bottom])}


def _temple(vertices: FloatArray, side: str, sign: int) -> dict[str, int]:
    """Return the vertices at the hinge and, where there is a temple, in the middle of slices of it."""
    back = vertices[:, 2].max() - vertices[:, 2]
    outer = sign * vertices[:, 0] > 0.8 * np.abs(vertices[:, 0]).max()
    depth = back.max()

    def slice_middle(way: float, width: float) -> int:
        part = np.flatnonzero(outer & (np.abs(back - way) < width))
        return int(part[np.linalg.norm(vertices[part] - vertices[part].mean(0), axis=1).argmin()])

    if depth < 60:
        return {f"{side}_hinge": slice_middle(0.8 * depth, 0.2 * depth)}
    places = {"hinge": 0.1, "temple_middle": 0.45, "ear_bend": 0.72, "temple_tip": 0.99}
    return {f"{side}_{name}": slice_middle(way * depth, 0.04 * depth) for name, way in places.items()}


def frames_of_many_makers() -> list[WholeFrame]:
    """Return rectangular, round and usual synthetic frames, and the real ones where they are there."""
    frames = [
        synthetic_frame("rectangular", GlassesShape(lens_width=54, lens_height=28, squareness=6)),
        synthetic_frame("round", GlassesShape(lens_width=44, lens_height=44, squareness=2)),
        synthetic_frame("usual", GlassesShape(temple_spread=1.0)),
        synthetic_frame("tall", GlassesShape(lens_width=52, lens_height=46, squareness=2.3, bridge_width=16)),
    ]
    return frames + [real_frame(name) for name in _UPRIGHT if (DATA / name).exists()]
