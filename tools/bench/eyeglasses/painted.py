"""People with frames in pictures.

Faces are painted and have brows, eyes and hair; the light has a lamp whose shadows the frame throws on the
skin; lenses are clear with a faint mirror image, or dark. Neither bends (`own_bend`) nor seats are those of
the package.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter
from worlds.glasses_on_head import fan

from bench.eyeglasses.scenes import BareFrame, own_bend
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.mean_keypoints import RIMS
from scan2albedo.face_model import default_model
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.geometry.pinhole import camera_centers, look_at, pixel_directions, pixel_grid, project
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic.renderer import RayScene, toward
from scan2albedo.synthetic.sitter import BodyPart, Sitter, join, sit_down
from scan2albedo.synthetic.textures import smooth_noise

SIDE = 2
"""Rays a pixel, each way."""
SIZE = 768
"""Pixels a side."""
COLORS = {
    "black": (0.02, 0.02, 0.025),
    "tortoise": (0.10, 0.045, 0.02),
    "steel": (0.30, 0.30, 0.32),
    "red": (0.35, 0.03, 0.03),
    "blue": (0.04, 0.07, 0.25),
}


@dataclass(frozen=True)
class Pictured:
    """A worn frame, its truth and its pictures; mm in the face model's frame, pixels."""

    frame: BareFrame
    vertices: FloatArray
    keypoints: FloatArray
    head: tuple[FloatArray, np.ndarray]
    cameras: FloatArray
    pictures: np.ndarray
    """(C, S, S, 3) uint8 sRGB."""
    masks: BoolArray
    labels: FloatArray
    """(C, 20, 2) without noise, NaN where the head hides a key point."""


def pictured(frame: BareFrame, seed: int, color: str, glass: str) -> Pictured:
    """Return a person (`seed`) with a frame in three pictures; `glass` is none, clear or dark."""
    rng = np.random.default_rng([seed, *frame.name.encode()])
    sitter = sit_down(seed, expression="neutral", model=default_model())
    eyes = sitter.face.landmarks[36:48].mean(0)
    placed, points = _put_on(frame, sitter, eyes, rng)
    target = np.array([0.0, eyes[1] - 15, eyes[2] - 40])
    ways = [(rng.normal(yaw, 5), rng.normal(4, 5)) for yaw in (-35, 0, 35)]
    shot = partial(look_at, target=target, focal_px=1.75 * SIZE, shape=(SIZE, SIZE))
    cameras = np.stack([shot(target + 600 * toward(*way)) for way in ways])
    lens = [] if glass == "none" else [_flat_lens(points[rim]) for rim in RIMS]
    pictures, masks = [], []
    lit = _Lit(sitter, (placed, frame.faces), lens, COLORS[color], glass, rng)
    for camera in cameras:
        linear, mask = lit.picture(camera, SIZE)
        noisy = gaussian_filter(linear, (0.6, 0.6, 0)) + rng.normal(0, 0.004, linear.shape)
        pictures.append(encode_srgb_bytes(np.clip(noisy, 0, 1)))
        masks.append(mask)
    head = sitter.vertices, sitter.faces[sitter.part < BodyPart.HAIR]
    labels = _labels(points, cameras, RayScene(sitter.vertices, sitter.faces))
    return Pictured(frame, placed, points, head, cameras, np.stack(pictures), np.stack(masks), labels)


def _put_on(
    frame: BareFrame, sitter: Sitter, eyes: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return the vertices (V, 3) and key points (20, 3) of a frame, bent, on a sitter's nose."""
    skull = RayScene(sitter.vertices, sitter.faces[sitter.part != BodyPart.HAIR])
    bent = own_bend(frame, rng)
    rest, marks = bent(frame.vertices), bent(frame.keypoints)
    # About where frames sit: a little below the eyes' middle, leaning, as far back as the nose lets them.
    middle = np.nanmean(marks[[2, 11, 5, 14]], axis=0)
    turn = rotation_from_vector(np.deg2rad(rng.normal([4.0, 0.0, 0.0], [2.5, 1.0, 1.0])))
    start = compose(turn, eyes + [rng.normal(0, 1), rng.normal(-3, 2), 300.0] - turn @ middle)
    front = rest[:, 2] > np.nanmax(marks[:, 2]) - 12
    hits = skull.first_hit(transform_points(start, rest[front]), np.array([0.0, 0, -1]))
    start[2, 3] -= float(hits.distance[hits.face >= 0].min()) - 0.4
    placed, points = transform_points(start, rest), transform_points(start, marks)
    # Temples spread until they pass the head.
    side, hinge = np.sign(placed[:, 0]), placed[:, 2].max() - 15
    length = hinge - placed[:, 2].min()
    part = np.clip((hinge - placed[:, 2]) / max(length, 1.0), 0, 1)
    behind = (part > 0.4) & (part * length > 30)
    away = np.column_stack([side, np.zeros((len(side), 2))])
    if behind.any():
        inner = skull.first_hit(placed[behind] + 300 * away[behind], -away[behind])
        lacking = np.where(inner.face >= 0, 300.4 - inner.distance, 0.0) / part[behind] ** 1.5
        spread = float(np.clip(lacking.max(initial=0.0), 0, 18))
        placed[:, 0] += side * spread * part**1.5
        u = np.clip((hinge - points[:, 2]) / length, 0, 1)
        points[:, 0] += np.sign(points[:, 0]) * spread * u**1.5
    return placed, points


def _labels(points: FloatArray, cameras: FloatArray, scene: RayScene) -> FloatArray:
    """Return where cameras (C, 3, 4) see points (P, 3), NaN where the scene hides them: (C, P, 2)."""
    labels = np.stack([project(camera, points)[0] for camera in cameras])
    known = np.isfinite(points).all(1)
    for seen, eye in zip(labels, camera_centers(cameras), strict=True):
        hidden = np.ones(len(points), bool)
        hidden[known] = scene.hidden(eye, points[known], 2.0)
        seen[hidden] = np.nan
    labels[((labels < 0) | (labels > SIZE - 1)).any(2)] = np.nan
    return labels


def _flat_lens(rim: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return a fan in Catmull and Rom's curve through a rim's key points (5, 3)."""
    a, b, c, d = (np.roll(rim, -k, axis=0)[:, None] for k in (-1, 0, 1, 2))
    t = np.linspace(0, 1, 8, endpoint=False)[:, None]
    dense = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    ring = dense.reshape(-1, 3)
    middle = ring.mean(0)
    return fan(middle + 0.97 * (ring - middle))


class _Lit:
    """A scene under a sky and a lamp that throws shadows."""

    def __init__(self, sitter, frame, lens, color, glass, rng) -> None:  # type: ignore[no-untyped-def]
        self.sitter, self.glass = sitter, glass
        self.count = len(sitter.faces)
        vertices, faces = join([(sitter.vertices, sitter.faces), frame])
        self.scene, self.normals = RayScene(vertices, faces), face_normals(vertices, faces)
        self.smooth = sitter.normals
        self.lens = RayScene(*join(lens)) if glass != "none" else None
        self.color = np.array(color)
        self.lamp = toward(rng.uniform(-50, 50), rng.uniform(15, 50))
        self.strength = rng.uniform(0.5, 1.3)
        self.warm = np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.7, 1.0)])
        self.tint = np.array([0.12, 0.10, 0.08])
        self.wall = rng.uniform(0.05, 0.6) * rng.uniform(0.7, 1.0, 3)
        self.seed = int(rng.integers(1 << 30))

    def picture(self, camera: FloatArray, size: int) -> tuple[FloatArray, BoolArray]:
        pixels = pixel_grid((size * SIDE, size * SIDE)) / SIDE - (SIDE - 1) / (2 * SIDE)
        ways = pixel_directions(camera, pixels)
        eye = np.broadcast_to(camera_centers(camera[None])[0], ways.shape)
        hit = self.scene.first_hit(eye, ways)
        color = self._background(ways)
        met = np.flatnonzero(hit.face >= 0)
        color[met] = self._shaded(eye[met] + hit.distance[met, None] * ways[met], ways[met], hit, met)
        if self.lens is not None:
            pane = self.lens.first_hit(eye, ways)
            through = (pane.face >= 0) & (pane.distance < hit.distance)
            share = 0.04 if self.glass == "clear" else 0.05
            kept = 1 - share if self.glass == "clear" else (1 - share) * self.tint
            mirrored = ways[through] * [1, 1, -1]
            color[through] = kept * color[through] + share * self._background(mirrored)
        square = color.reshape(size, SIDE, size, SIDE, 3).mean((1, 3))
        frame = (hit.face >= self.count).reshape(size, SIDE, size, SIDE).mean((1, 3)) >= 0.5
        return square, frame

    def _background(self, ways: FloatArray) -> FloatArray:
        rng = np.random.default_rng(self.seed)
        uv = np.stack([np.arctan2(ways[:, 0], -ways[:, 2]) / (2 * np.pi) + 0.5, ways[:, 1] / 2 + 0.5], 1)
        texture = 0.5 * smooth_noise(uv, (24, 16), rng) + 0.3 * smooth_noise(uv, (90, 60), rng)
        return np.asarray(self.wall * np.exp(0.5 * texture)[:, None])

    def _shaded(self, place, ways, hit, met):  # type: ignore[no-untyped-def]
        face, weight = hit.face[met], hit.barycentric[met]
        body = face < self.count
        albedo = np.tile(self.color, (len(face), 1))
        albedo[body] = self.sitter.albedo_at(face[body], weight[body])
        normal = self.normals[face]
        corners = self.sitter.faces[face[body]]
        normal[body] = normalized(np.einsum("nk,nkc->nc", weight[body], self.smooth[corners]))
        normal = np.where((np.einsum("ni,ni->n", normal, ways) > 0)[:, None], -normal, normal)
        start = place + 0.2 * normal
        lit = ~self.scene.occluded(start, self.lamp)
        lamp = np.maximum(normal @ self.lamp, 0) * lit * self.strength
        sky = 0.55 + 0.25 * normal[:, 1] + 0.15 * normal[:, 2]
        made = albedo * (sky[:, None] + lamp[:, None] * self.warm)
        half = normalized(self.lamp - ways)
        gloss = np.where(body, 0.06, 0.35) * np.maximum(np.einsum("ni,ni->n", normal, half), 0) ** np.where(
            body, 18, 60
        )
        return 0.75 * (made + (gloss * lit * self.strength)[:, None])
