"""A ball before a larger ball, photographed with flashes and in the room's light, everything in closed form.

For the benchmark and the tests; nothing of it is the code under test.
"""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, grid_faces
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import look_at, pixel_directions, pixel_grid
from scan2albedo.reflectance import CaptureRig
from worlds.flash_captures import highlights, unit

RADIUS = 90.0
"""Of the larger ball around the origin, mm."""
BALL_RADIUS = 14.0
"""Of the smaller one, mm."""
BALL = np.array([20.0, 10.0, 135.0])
"""Middle of the smaller one, mm."""
SHAPE = (170, 170)
"""Rows and columns of a picture."""
GAMMA = 1.2
"""Of the displayed values."""
ROOM = 0.08
"""Linear light of the room in the picture, the same everywhere."""
WEIGHTS = np.array([0.10, 0.12, 0.08])
"""Of the three lobes of gloss."""
EXPOSURE = 0.7
"""Factor from radiance to the picture."""


def albedo_at(points: FloatArray) -> FloatArray:
    tint = 1 + 0.25 * np.sin(points[:, :1] / 30) * np.cos(points[:, 1:2] / 40)
    return np.array([0.55, 0.40, 0.30]) * tint


def first_hit(origins: FloatArray, directions: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    """Distance along unit directions to a ball, inf for none."""
    offset = origins - center
    b = np.einsum("nc,nc->n", offset, directions)
    square = b**2 - np.einsum("nc,nc->n", offset, offset) + radius**2
    distance = -b - np.sqrt(np.maximum(square, 0))
    return np.where((square > 0) & (distance > 1e-6), distance, np.inf)


def radiance_at(points: FloatArray, normals: FloatArray, camera: FloatArray, light: FloatArray) -> FloatArray:
    """Radiance (N, 3) of points of the large ball, in shadow of both."""
    to_light, to_camera = unit(light - points), unit(camera - points)
    n_l = np.einsum("nc,nc->n", normals, to_light)
    gloss = highlights(WEIGHTS, normals, to_camera, to_light)
    lit = (n_l > 0) & ~np.isfinite(first_hit(points, to_light, BALL, BALL_RADIUS))
    return (
        EXPOSURE * lit[:, None] * (albedo_at(points) / np.pi * np.maximum(n_l, 0)[:, None] + gloss[:, None])
    )


def photograph(camera: FloatArray, position: FloatArray, light: FloatArray) -> FloatArray:
    """Linear flash light (H, W, 3)."""
    rays = pixel_directions(camera, pixel_grid(SHAPE))
    start = np.broadcast_to(position, rays.shape)
    head, ball = first_hit(start, rays, np.zeros(3), RADIUS), first_hit(start, rays, BALL, BALL_RADIUS)
    on_head = np.isfinite(head) & (head < ball)
    picture = np.zeros((len(rays), 3))
    points = start[on_head] + head[on_head, None] * rays[on_head]
    picture[on_head] = radiance_at(points, unit(points), position, light)
    picture[np.isfinite(ball) & ~on_head] = 0.02
    return picture.reshape(*SHAPE, 3)


@dataclass(frozen=True)
class Scene:
    """The large ball's front and the ball before it as one mesh; `head` (V,) marks vertices of the former."""

    rig: CaptureRig
    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    head: BoolArray
    flash: FloatArray
    room: FloatArray


def ball_mesh(rows: int, columns: int) -> tuple[FloatArray, IntArray]:
    """A closed ball of radius 1 around 0: vertices and faces."""
    theta, phi = np.linspace(0, np.pi, rows)[:, None], 2 * np.pi * np.arange(columns) / columns
    height = np.broadcast_to(np.cos(theta), (rows, columns))
    grid = np.stack([np.sin(theta) * np.sin(phi), height, np.sin(theta) * np.cos(phi)], -1)
    return grid.reshape(-1, 3), grid_faces(rows, columns, wrap=True)


def build_scene(rows: int = 48, columns: int = 80) -> Scene:
    """Return 20 pictures, five views by four flashes, three of which stand where cameras do."""
    azimuth = np.radians([-50, -25, 0, 25, 50])
    cameras_at = 900 * np.stack([np.sin(azimuth), np.zeros(5) + 0.05, np.cos(azimuth)], 1)
    lights_at = np.concatenate([cameras_at[[0, 2, 3]], [[-200, 500, 750.0]]])
    cameras = np.stack([look_at(at, [0, 0, 20], focal_px=700, shape=SHAPE) for at in cameras_at])
    view, light = np.repeat(np.arange(5), 4), np.tile(np.arange(4), 5)
    rig = CaptureRig(cameras[view], lights_at[light], light)
    head_vertices, head_faces = ball_mesh(rows, columns)
    ball_vertices, ball_faces = ball_mesh(20, 32)
    parts = (RADIUS * head_vertices, head_faces), (BALL + BALL_RADIUS * ball_vertices, ball_faces)
    vertices, faces = join(parts)
    linear = np.stack(
        [photograph(cameras[c], cameras_at[c], lights_at[k]) for c, k in zip(view, light, strict=True)]
    )
    return Scene(
        rig,
        vertices,
        faces,
        np.concatenate([head_vertices, ball_vertices]),
        np.arange(len(vertices)) < len(head_vertices),
        (linear + ROOM) ** (1 / GAMMA),
        np.full((*SHAPE, 3), ROOM ** (1 / GAMMA)),
    )
