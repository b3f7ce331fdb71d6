"""Frames of several makers, whole and bent: key points by a rule, bends that the package does not contain."""

from dataclasses import dataclass

import numpy as np
from worlds.files import DATA

from bench.eyeglasses.scenes import REAL_FRAMES
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES
from scan2albedo.io import load_scan
from scan2albedo.synthetic import GlassesShape, eyeglasses

_UPRIGHT = {
    "sunglasses_khronos.glb": np.eye(3),
    "frame_giraut.stl": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Rotations that turn the files to x the wearer's left, y up, z to the front."""
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
    """Return one of `REAL_FRAMES`, upright."""
    scan, known = load_scan(DATA / file), REAL_FRAMES[file]
    vertices = scan.vertices @ _UPRIGHT[file].T
    vertices[:, 0] -= (vertices[:, 0].min() + vertices[:, 0].max()) / 2
    marks = np.array([known["marks"].get(name, -1) for name in KEY_POINT_NAMES])
    left, right = (np.array(known["rims"][side]) for side in ("left", "right"))
    return WholeFrame(file.partition(".")[0].split("_")[-1], vertices, scan.faces, marks, (left, right))


def frames_of_many_makers() -> list[WholeFrame]:
    """Return rectangular, round and usual synthetic frames, and the real ones where they are there."""
    frames = [
        synthetic_frame("rectangular", GlassesShape(lens_width=54, lens_height=28, squareness=6)),
        synthetic_frame("round", GlassesShape(lens_width=44, lens_height=44, squareness=2)),
        synthetic_frame("usual", GlassesShape(temple_spread=1.0)),
        synthetic_frame("tall", GlassesShape(lens_width=52, lens_height=46, squareness=2.3, bridge_width=16)),
    ]
    return frames + [real_frame(name) for name in _UPRIGHT if (DATA / name).exists()]
