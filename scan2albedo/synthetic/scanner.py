"""A two-pod stereo scanner: the triangle mesh it measures of a scene, and the flash photographs it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.point_light import PointLight
from scan2albedo.geometry.mesh import face_normals, normalized
from scan2albedo.synthetic.camera import auto_exposure, photograph
from scan2albedo.synthetic.renderer import Material, RayScene, Rendered, render
from scan2albedo.synthetic.room_light import Room, room_light_on
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import FACE, Sitter


@dataclass(frozen=True)
class Pod:
    """A pinhole camera at `position_mm` (3,) that looks at `target_mm` (3,), +y up in its square picture.

    `half_angle_rad` is half the angle that the picture spans.
    """

    position_mm: FloatArray
    target_mm: FloatArray
    half_angle_rad: float

    @property
    def axes(self) -> FloatArray:
        """(3, 3) rows: to the right of the picture, up, and forward."""
        forward = normalized(self.target_mm - self.position_mm)
        right = normalized(np.cross(forward, [0.0, 1.0, 0.0]))
        return np.stack([right, np.cross(right, forward), forward])

    def directions(self, plane: ArrayLike) -> FloatArray:
        """Return (N, 3) unit rays through picture-plane points (N, 2) in [-1, 1], +x right, +y up."""
        xy = np.asarray(plane, float) * np.tan(self.half_angle_rad)
        right, up, forward = self.axes
        rays = xy[:, :1] * right + xy[:, 1:] * up + forward
        rays /= np.sqrt(1 + np.einsum("ij,ij->i", xy, xy))[:, None]
        return rays

    def project(self, points: ArrayLike) -> FloatArray:
        """Return (N, 2) picture-plane coordinates in [-1, 1] of points (N, 3) in front of the pod."""
        seen = (np.asarray(points, float) - self.position_mm) @ self.axes.T
        return seen[:, :2] / seen[:, 2:] / np.tan(self.half_angle_rad)


_DISTANCE_MM, _YAW_DEG, _ELEVATION_DEG = 1000.0, 35.0, 5.0
"""Of the pods from the head."""


def two_pods(center: FloatArray, *, reach_mm: float) -> tuple[Pod, Pod]:
    """Return the pods at the subject's left and right; pictures span +-`reach_mm` about `center` (3,)."""
    pods = []
    for yaw in np.deg2rad([_YAW_DEG, -_YAW_DEG]):
        lift = np.deg2rad(_ELEVATION_DEG)
        toward = np.array([np.cos(lift) * np.sin(yaw), np.sin(lift), np.cos(lift) * np.cos(yaw)])
        pods.append(Pod(center + _DISTANCE_MM * toward, center, float(np.arctan(reach_mm / _DISTANCE_MM))))
    return pods[0], pods[1]


@dataclass(frozen=True)
class RangeMesh:
    """The mesh that the pods measured: `vertices` (V, 3) mm, exactly on the scene, `faces` (F, 3) outward.

    `face_pod` (F,) is the number of the pod that sees the face best and colours it.
    """

    vertices: FloatArray
    faces: IntArray
    face_pod: IntArray


def capture(
    vertices: FloatArray,
    faces: IntArray,
    pods: Sequence[Pod],
    *,
    spacing_mm: float,
    rng: np.random.Generator,
    axis_mm: FloatArray,
) -> RangeMesh:
    """Sample a scene irregularly and keep what at least one pod sees.

    Jittered horizontal rays toward a vertical axis through `axis_mm` (3,), about `spacing_mm` apart where
    they pass a head's surface, are triangulated in the unrolled cylinder. Triangles that bridge a jump in
    depth, lean too far away, or hide from all pods are dropped, as stereo matching does.
    """
    scene = RayScene(vertices, faces)
    origins, rays, unrolled = _cylinder_rays(vertices, axis_mm, spacing_mm, rng)
    hits = scene.first_hit(origins, rays)
    seen = hits.face >= 0
    points = origins[seen] + hits.distance[seen, None] * rays[seen]
    triangles = _triangulated(unrolled[seen], 2.5 * spacing_mm)
    normals = face_normals(points, triangles)
    outward = -np.einsum("ij,ij->i", normals, rays[seen][triangles[:, 0]])
    facing = np.stack([_facing(scene, pod, points, triangles, normals) for pod in pods], 1)
    kept = (outward > 0.12) & (facing.max(1) > 0.12)
    used, renumbered = np.unique(triangles[kept], return_inverse=True)
    return RangeMesh(
        points[used],
        renumbered.reshape(-1, 3).astype(np.int64),
        _best_pod(facing[kept], renumbered.reshape(-1, 3)),
    )


def _cylinder_rays(
    vertices: FloatArray, axis_mm: FloatArray, spacing_mm: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return origins (N, 3), unit directions (N, 3) and unrolled coordinates (N, 2), mm at 100 mm radius."""
    radius, far, widest = 100.0, 600.0, np.deg2rad(115)
    across = np.arange(-widest * radius, widest * radius, spacing_mm)
    up = np.arange(vertices[:, 1].min(), vertices[:, 1].max(), spacing_mm)
    unrolled = np.stack(np.meshgrid(across, up), -1).reshape(-1, 2)
    unrolled = unrolled + rng.uniform(-0.42, 0.42, unrolled.shape) * spacing_mm
    azimuth = unrolled[:, 0] / radius
    outward = np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], 1)
    foot = np.column_stack(
        [np.full(len(up) * len(across), axis_mm[0]), unrolled[:, 1], np.full(len(azimuth), axis_mm[2])]
    )
    return foot + far * outward, -outward, unrolled


def _triangulated(plane: FloatArray, longest: float) -> IntArray:
    """Return Delaunay triangles (F, 3), counter-clockwise, without edges longer than `longest`."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(plane).simplices.astype(np.int64)
    a, b, c = (plane[triangles[:, k]] for k in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] < 0
    triangles[clockwise] = triangles[clockwise][:, ::-1]
    edges = np.stack([b - a, c - b, a - c], 1)
    return triangles[np.linalg.norm(edges, axis=2).max(1) < longest]


def _facing(
    scene: RayScene, pod: Pod, points: FloatArray, triangles: IntArray, normals: FloatArray
) -> FloatArray:
    """Return (F,) cosine between each triangle's normal and the pod, -1 where the pod cannot see it."""
    toward = normalized(pod.position_mm - points)
    hidden = np.asarray((np.abs(pod.project(points)) > 0.995).any(1))
    hidden[~hidden] = scene.occluded((points + 0.5 * toward)[~hidden], toward[~hidden])
    cosine = np.einsum("ij,ij->i", normals, toward[triangles[:, 0]])
    return np.where(hidden[triangles].any(1), -1.0, cosine)


def _best_pod(facing: FloatArray, faces: IntArray) -> IntArray:
    """Return (F,) the pod that sees each face best; averaged around, so that the seam is one line."""
    pods = range(facing.shape[1])
    lead = np.stack([facing[:, k] - np.delete(facing, k, axis=1).max(1) for k in pods], 1)
    count = np.bincount(faces.ravel(), minlength=faces.max() + 1)
    for k in pods:
        for _ in range(12):
            around = np.bincount(faces.ravel(), np.repeat(lead[:, k], 3), minlength=len(count)) / count
            lead[:, k] = around[faces].mean(1)
    best = lead.argmax(1)
    hidden = np.take_along_axis(facing, best[:, None], 1)[:, 0] < 0
    return np.where(hidden, facing.argmax(1), best)


_BACKDROP = np.array([0.010, 0.016, 0.030])


def flash_pictures(
    sitter: Sitter,
    pods: tuple[Pod, Pod],
    lights: tuple[PointLight, ...],
    material: Material,
    *,
    size: int,
    noise: float,
    rng: np.random.Generator,
    colors: FloatArray | None = None,
    room: Room | None = None,
) -> tuple[NDArray[np.float32], float]:
    """Return both pods' pictures side by side (size, 2 size, 3), linear from 8 bits, and their exposure.

    The exposure keeps the face's brightest pixel just below white; clothes may clip, and have no highlight.
    `noise` is a standard deviation, white = 1; `colors` (1 + L, 3) are those of the ambient light and of each
    lamp, all white when None. The light of a `room` takes the place of constant ambient light.
    """
    scene = RayScene(sitter.vertices, sitter.faces)
    soft = None if room is None else room_light_on(sitter, scene, room, rng)
    seen = [_radiance(sitter, scene, pod, lights, material, size, colors, soft) for pod in pods]
    exposure = auto_exposure(np.concatenate([radiance[on_face] for radiance, on_face in seen]))
    both = np.concatenate([radiance for radiance, _ in seen], axis=1)
    picture = photograph(both, exposure=exposure, noise=noise, bits=8, rng=rng)
    return picture, exposure


def _radiance(
    sitter: Sitter,
    scene: RayScene,
    pod: Pod,
    lights: tuple[PointLight, ...],
    material: Material,
    size: int,
    colors: FloatArray | None,
    soft: FloatArray | None,
) -> tuple[FloatArray, BoolArray]:
    """Return what one pod sees (H, H, 3) and which pixels show the face (H, H).

    `soft` (V, 3) is the ambient light on the vertices, 1 when None.
    """
    rays = pod.directions(2 * texel_coordinates(size) - 1)
    hits = scene.first_hit(np.broadcast_to(pod.position_mm, rays.shape), rays)
    hit = hits.face >= 0
    face, barycentric = hits.face[hit], hits.barycentric[hit]
    corners = sitter.faces[face]
    under = partial(
        render,
        np.einsum("nk,nkc->nc", barycentric, sitter.vertices[corners]),
        normalized(np.einsum("nk,nkc->nc", barycentric, sitter.normals[corners])),
        sitter.albedo_at(face, barycentric),
        material=material,
        occluder=scene,
        view_direction=-rays[hit],
        specular_scale=sitter.specular_scale_at(face),
    )
    radiance, on_face = np.tile(_BACKDROP, (size * size, 1)), np.zeros(size * size, bool)
    if colors is None and soft is None:
        radiance[hit] = under(lights).radiance_linear
    else:
        tints = np.ones((1 + len(lights), 3)) if colors is None else colors
        ambient = np.ones(3) if soft is None else np.einsum("nk,nkc->nc", barycentric, soft[corners])
        radiance[hit] = _colored(under, lights, [tints[0] * ambient, *tints[1:]])
    on_face[hit] = sitter.part[face] == FACE
    return radiance.reshape(size, size, 3), on_face.reshape(size, size)


def _colored(
    under: Callable[[tuple[PointLight, ...]], Rendered],
    lights: tuple[PointLight, ...],
    colors: Sequence[FloatArray],
) -> FloatArray:
    """Return the radiance (N, 3) under ambient light and lamps, each of a colour (3,) or (N, 3)."""
    ambient = under(()).radiance_linear
    lamps = [under((light,)).radiance_linear - ambient for light in lights]
    return np.asarray(sum(color * part for color, part in zip(colors, (ambient, *lamps), strict=True)))
