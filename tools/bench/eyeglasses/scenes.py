"""Frames that no model knows: real ones and others, bent by hand-made smooth deformations, in pictures.

Neither the deformations nor the errors of labels and masks are those that `register_on_face` assumes:
labels miss the key point by an amount that all views share, by heavy-tailed errors of their own, and masks
are too wide or too narrow throughout.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from worlds.files import DATA
from worlds.glasses_on_head import fan

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES, bounded_biharmonic_weights
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.pinhole import camera_centers, look_at, pixel_directions, pixel_grid, project
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.synthetic import GlassesShape, eyeglasses
from scan2albedo.synthetic.renderer import RayScene
from scan2albedo.synthetic.sitter import join

REAL_FRAMES: dict[str, dict[str, Any]] = json.loads(
    Path(__file__).with_name("real_frames.json").read_text(encoding="utf-8")
)
"""Of the frames of ../shared/data: key points `placed` (vertices, or mm where they lie between vertices), and
`marks` and `rims`, vertices at the key points and around the lenses' edges at every ten degrees. The rules
that placed them are those of commit 509f8dd5."""
_YAWS = (-0.65, 0.0, 0.65)
_DISTANCE_MM = 600.0
_WAVES_PX = 8.0


_SOLVED: dict[str, FloatArray] = {}
"""Weights by the frame's name: they take seconds."""


@dataclass(frozen=True, eq=False)
class BareFrame:
    """A frame before it is bent, mm: x to the wearer's left, y up, z to the front."""

    name: str
    vertices: FloatArray
    """(V, 3)"""
    faces: IntArray
    """(F, 3)"""
    glass: BoolArray
    """(F,) faces of lenses."""
    keypoints: FloatArray
    """(20, 3), NaN where it lacks them."""

    @property
    def rims(self) -> IntArray:
        """(G, 3) faces without the lenses."""
        return self.faces[~self.glass]

    def weights(self) -> FloatArray:
        """Return weights (V, 20), 0 for key points that it lacks."""
        if self.name not in _SOLVED:
            known = np.asarray(np.isfinite(self.keypoints).all(1))
            weights = np.zeros((len(self.vertices), len(known)))
            weights[:, known] = bounded_biharmonic_weights(self.vertices, self.faces, self.keypoints[known])
            _SOLVED[self.name] = weights
        return _SOLVED[self.name]


@cache
def khronos() -> BareFrame:
    """Return real sunglasses of loose parts, lenses among them."""
    scan = load_scan(DATA / "sunglasses_khronos.glb")
    part = vertex_components(len(scan.vertices), scan.faces)
    glass = np.zeros(len(scan.faces), bool)
    for number in np.unique(part):
        own = part == number
        corners = scan.vertices[own]
        # Two shells a lens, as large as a rim but of fewer faces.
        if np.ptp(corners, axis=0)[:2].min() > 40 and own[scan.faces[:, 0]].sum() < 1000:
            glass |= own[scan.faces[:, 0]]
    placed = REAL_FRAMES["sunglasses_khronos.glb"]["placed"]
    marks = scan.vertices[[placed[name] for name in KEY_POINT_NAMES]]
    return BareFrame("khronos", scan.vertices, scan.faces, glass, marks)


@cache
def giraut() -> BareFrame:
    """Return a real front without temples and lenses: round rims, 33 mm off the middle."""
    scan = load_scan(DATA / "frame_giraut.stl")
    vertices, faces = scan.vertices[:, [0, 2, 1]], scan.faces[:, ::-1]
    placed = REAL_FRAMES["frame_giraut.stl"]["placed_mm"]
    marks = np.array([placed.get(name, [np.nan] * 3) for name in KEY_POINT_NAMES])
    return BareFrame("giraut", vertices, faces, np.zeros(len(faces), bool), marks)


SHAPES = {
    "aviator": GlassesShape(58, 50, 2.1, 14, 4.2, 2.2, 2.4, 180, 145, 2, 4.2, 2.4, 38),
    "slab": GlassesShape(48, 30, 4.5, 20, 7, 6.0, 4.6, 420, 140, 0, 8, 4.2, 50),
    "round": GlassesShape(42, 42, 2.0, 22, 4.5, 2.6, 3.0, 300, 135, 6, 4.5, 2.6, 30),
    "shield": GlassesShape(62, 44, 3.0, 12, 6, 4.0, 4.0, 120, 130, 1, 6, 3.2, 25),
}
"""Measures at the ends of what opticians sell, and past them."""


@cache
def synthetic(name: str) -> BareFrame:
    """Return one of `SHAPES` with flat lenses."""
    glasses = eyeglasses(shape=SHAPES[name])
    lenses = [fan(outline) for outline in glasses.lens_outlines]
    vertices, faces = join([(glasses.vertices, glasses.faces), *lenses])
    glass = np.arange(len(faces)) >= len(glasses.faces)
    return BareFrame(name, vertices, faces, glass, glasses.keypoints)


def named(name: str, drawn: Callable[[int], GlassesShape | int] = int) -> BareFrame:
    """Return a frame without lenses: "khronos", "giraut", one of `SHAPES`, or "drawn N"."""
    if name == "giraut":
        return giraut()
    if name.startswith("drawn"):
        made = drawn(int(name.split()[1]))
        glasses = eyeglasses(made) if isinstance(made, int) else eyeglasses(shape=made)
        none = np.zeros(len(glasses.faces), bool)
        return BareFrame(name, glasses.vertices, glasses.faces, none, glasses.keypoints)
    return without_lenses(khronos() if name == "khronos" else synthetic(name))


def without_lenses(frame: BareFrame) -> BareFrame:
    """Return the frame without its lenses."""
    used = np.unique(frame.rims)
    number = np.full(len(frame.vertices), -1)
    number[used] = np.arange(len(used))
    faces = number[frame.rims]
    name = f"{frame.name} without lenses"
    return BareFrame(name, frame.vertices[used], faces, np.zeros(len(faces), bool), frame.keypoints)


def own_bend(frame: BareFrame, rng: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Return a smooth deformation of points (..., 3) in the frame's own axes.

    The halves are twisted about x and turned about y at the bridge, one rim drops, the front curls, temples
    spread, drop and curl each by its own amount, and all is a little too large or too small.
    """
    low, high = frame.vertices.min(0), frame.vertices.max(0)
    half, depth = (high[0] - low[0]) / 2, max(high[2] - low[2] - 20.0, 1.0)
    twist, wrap = np.deg2rad(rng.normal(0, (1.5, 1.5)))
    drop, curl = rng.normal(0, (0.8, 0.8))
    spread, sink, roll = rng.normal((3.0, 0.0, 0.0), (3.0, 2.0, 1.5), (2, 3)).T
    scale = 1 + rng.normal(0, 0.007)

    def bent(points: FloatArray) -> FloatArray:
        x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
        side = np.tanh(x / 9.0)
        behind = np.clip((high[2] - 15.0 - z) / depth, 0.0, 1.2)
        left = np.where(x > 0, 0, 1)
        out = np.sign(x)
        far = behind**2 * (1.5 - 0.5 * behind)
        new_x = x + out * (spread[left] * far + roll[left] * np.sin(np.pi * behind) * 0.7)
        new_y = y + sink[left] * behind**1.5 - drop * (side + 1) / 2
        new_z = z + curl * np.cos(np.pi * x / half) * 0.5
        angle = twist * side
        new_y, new_z = (
            new_y * np.cos(angle) - (new_z - high[2]) * np.sin(angle),
            high[2] + new_y * np.sin(angle) + (new_z - high[2]) * np.cos(angle),
        )
        new_z = new_z - wrap * np.abs(x) * np.tanh(np.abs(x) / 9.0)
        return scale * np.stack([new_x, new_y, new_z], -1)

    return bent


@dataclass(frozen=True)
class Errors:
    """Of people and programs that label."""

    shared_mm: float = 0.4
    """Deviation along each axis of what is taken for a key point, the same in all views."""
    label_px: float = 1.3
    """Scale of each label's own error, of Student's t with four degrees of freedom."""
    bias_px: float = 1.0
    """Deviation of how far a view's mask reaches beyond the frame, all around."""
    wander_px: float = 1.0
    """Deviation of its outline's smooth error."""


EVEN = Errors(shared_mm=0.0, label_px=0.7, bias_px=0.0, wander_px=0.7)
"""Errors that are not alike anywhere."""


@dataclass(frozen=True)
class BentFrame:
    """A bent frame in three pictures; mm in the world, pixels."""

    vertices: FloatArray
    """(V, 3)"""
    keypoints: FloatArray
    """(20, 3)"""
    cameras: FloatArray
    """(C, 3, 4)"""
    masks: BoolArray
    """(C, H, W)"""
    labels: FloatArray
    """(C, 20, 2)"""


def photographed(
    frame: BareFrame,
    seed: int,
    *,
    errors: Errors = Errors(),
    glass: bool = True,
    size: int = 1024,
    bend: bool = True,
) -> BentFrame:
    """Return a frame bent by `own_bend`, seen by three cameras; with `glass` its lenses are in the masks."""
    rng = np.random.default_rng([seed, *frame.name.encode()])
    bent = own_bend(frame, rng) if bend else np.asarray
    turn = rotation_from_vector(rng.normal(0, 0.15, 3))
    vertices, marks = (bent(points) @ turn.T for points in (frame.vertices, frame.keypoints))
    target = np.array([0.0, vertices[:, 1].mean(), vertices[:, 2].max() - 50])
    shape, focal = (size, size), 1800 * size / 1024
    cameras = np.stack(
        [
            look_at(
                target + _DISTANCE_MM * np.array([np.sin(yaw), 0.13, np.cos(yaw)]),
                target,
                focal_px=focal,
                shape=shape,
            )
            for yaw in _YAWS
        ]
    )
    meant = marks + errors.shared_mm * rng.normal(size=marks.shape)
    labels = np.stack([project(camera, meant)[0] for camera in cameras])
    labels += errors.label_px * rng.standard_t(4, labels.shape)
    faces = frame.faces if glass else frame.rims
    masks = np.stack([_mask(vertices, faces, camera, shape, errors, rng) for camera in cameras])
    return BentFrame(vertices, marks, cameras, masks, labels)


def _mask(
    vertices: FloatArray,
    faces: IntArray,
    camera: FloatArray,
    shape: tuple[int, int],
    errors: Errors,
    rng: np.random.Generator,
) -> BoolArray:
    rays = pixel_directions(camera, pixel_grid(shape))
    center = np.broadcast_to(camera_centers(camera[None])[0], rays.shape)
    shown = (RayScene(vertices, faces).first_hit(center, rays).face >= 0).reshape(shape)
    if errors.bias_px == errors.wander_px == 0:
        return shown
    wander = gaussian_filter(rng.normal(size=shape), _WAVES_PX / 2, mode="wrap")
    wander *= errors.wander_px / wander.std()
    inside = distance_transform_edt(shown) - distance_transform_edt(~shown) - np.where(shown, 0.5, -0.5)
    return np.asarray(inside + wander + errors.bias_px * rng.normal() > 0)
