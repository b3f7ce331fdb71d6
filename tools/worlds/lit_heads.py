"""Sixteen MIT-licensed heads (../shared/data/heads) with an expression, under many lights, for recognition.

Each head has two scans, the second with an expression, both fitted to the model, and one view from the front,
as of photographs of one pose. All are photographed under lights that everybody shares, single hard flashes up
to 60 degrees off among them. Light falls on the true surface with relief that no mesh has; the estimate is
given the fitted surface, or in the view one that is off by a smooth error.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo import (
    AnnotatedFaceModel,
    GeometryImage,
    RawScan,
    geometry_image,
    load_scan,
)
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.synthetic import Material
from scan2albedo.synthetic.face_shape import Expression, person
from scan2albedo.synthetic.raw_scan import random_pose
from scan2albedo.synthetic.renderer import SHADOW_OFFSET_MM, RayScene, render
from worlds.files import face_data
from worlds.fits import fitted_face
from worlds.pictures import bilinear
from worlds.population import Population, random_lights
from worlds.rooms import random_room

SIZE = 256
"""Rows and columns of a chart."""
VIEW = (192, 168)
"""Rows and columns of a photograph."""
VIEW_MM = (160.0, 140.0)
"""Height and width that a photograph shows."""
SCAN_LIGHTS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 3))
"""Numbers of the lights of each sitting."""
VIEWED = "view"
VIEW_LIGHTS = (10, 11, 12, 13, 14)
"""Of the photographs, whose light is one flash."""
RELIEF_MM = (4.0, 20.0)
"""Wavelengths of relief that is not in the meshes."""
SURFACE_MM = (25.0, 60.0)
"""Wavelengths of errors of a measured surface."""
SLOPE = 0.08
"""Root mean square of the slope of both."""


@dataclass(frozen=True)
class Surface:
    """The true surface now: `vertices`, `at_rest` (V, 3) mm, looking along +z, `faces` (F, 3), `relief` a
    seed."""

    vertices: FloatArray
    at_rest: FloatArray
    faces: IntArray
    relief: list[int]


def slopes(points: FloatArray, seed: list[int], lengths_mm: tuple[float, float]) -> tuple[FloatArray, ...]:
    """Return heights (N,) and their gradient (N, 3) of a smooth random field, its slope's RMS `SLOPE`."""
    random = np.random.default_rng(seed)
    waves = 60
    k = (
        2
        * np.pi
        / np.exp(random.uniform(np.log(lengths_mm[0]), np.log(lengths_mm[1]), (waves, 1)))
        * normalized(random.standard_normal((waves, 3)))
    )
    phase = points @ k.T + random.uniform(0, 2 * np.pi, waves)
    height = SLOPE * np.sqrt(3 / waves) / np.linalg.norm(k, axis=1)
    return np.cos(phase) @ height, -(np.sin(phase) * height) @ k


def tilted(normals: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return normals (N, 3) of a surface with heights of that gradient along them."""
    along = np.einsum("ij,ij->i", gradient, normals)[:, None] * normals
    return normalized(normals - gradient + along)


def photographed(
    surface: Surface, face: IntArray, barycentric: FloatArray, albedo: FloatArray, light: int, seed: list[int]
) -> FloatArray:
    """Return linear colours (N, 3), of 8 bits and with noise, of points on a surface under a light."""
    of_light, now = np.random.default_rng([light, 51]), np.random.default_rng([*seed, light, 52])
    flash_alone = light in VIEW_LIGHTS
    room = random_room(of_light, 0.0 if flash_alone else 0.1)
    lamps = random_lights(of_light, Population())[: 1 if flash_alone else None]
    stronger = np.exp(of_light.uniform(np.log(2 if flash_alone else 0.3), np.log(5)))
    lamps = tuple(replace(lamp, intensity=lamp.intensity * stronger) for lamp in lamps)
    at = partial(_interpolated, surface.faces[face], barycentric)
    points, smooth = at(surface.vertices), normalized(at(vertex_normals(surface.vertices, surface.faces)))
    n = tilted(smooth, slopes(at(surface.at_rest), surface.relief, RELIEF_MM)[1])
    scene, toward = RayScene(surface.vertices, surface.faces), distant_directions(64)
    around = np.zeros((len(points), 3))
    for direction, radiance in zip(toward, room.radiance(toward) * (4 / len(toward)), strict=True):
        facing = np.flatnonzero(n @ direction > 0)
        start = points[facing] + SHADOW_OFFSET_MM * n[facing]
        open_to = facing[~scene.occluded(start, np.broadcast_to(direction, start.shape))]
        around[open_to] += (n[open_to] @ direction)[:, None] * radiance
    material = Material(0.3, float(now.uniform(0.05, 0.15)), 14.0)
    flashed = render(points, n, albedo, lamps, material=material, occluder=scene).radiance_linear
    radiance = flashed + albedo * (around - 1)
    radiance *= 0.9 / np.percentile(radiance, 99)
    noisy = radiance + now.standard_normal(radiance.shape) * (0.004 + 0.012 * np.sqrt(radiance))
    return np.asarray(np.round(np.clip(noisy, 0, 1) ** (1 / 2.2) * 255) / 255) ** 2.2


def _interpolated(corners: IntArray, barycentric: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (N, K) of vertices at points with corners (N, 3)."""
    return np.einsum("nk,nkc->nc", barycentric, values[corners])


Places = tuple[IntArray, FloatArray]
"""Faces (N,) of the true surface and barycentric coordinates (N, 3): where texels lie."""
Scan = tuple[RawScan, Surface, FloatArray]
"""Scan, coloured with its albedo, true surface, and the map (4, 4) from one to the other."""
View = tuple[GeometryImage, Surface, Places, FloatArray]
"""What is measured, true surface, places of the texels and their albedo (N, 3)."""


@dataclass(frozen=True)
class _Head:
    """A scan of a head, the model fitted to it, and its vertices (V, 3) in the model's frame."""

    name: str
    scan: RawScan
    fitted: FittedFace
    vertices: FloatArray

    @property
    def number(self) -> list[int]:
        """A seed of its own."""
        return list(self.name.encode())

    def sitting(self, k: int) -> Scan:
        """Return the scan of a sitting; all but the first have an expression."""
        random, now = np.random.default_rng([*self.number, k, 53]), self.vertices
        if k > 0:
            names = get_args(Expression)[1:]
            expression = names[random.integers(len(names))]
            strength = float(random.uniform(0.2, 0.8))
            model = AnnotatedFaceModel.default()
            moved = person(model, random, strength=0.0, expression=expression, expression_strength=strength)
            steps = model.subdivision(2).matrix @ (moved - model.control_vertices)
            far, near = cKDTree(self.fitted.vertices).query(now, 6)
            now = now + steps[near].mean(1) * np.exp(-((far[:, :1] / 15.0) ** 2))
        pose = random_pose(random, 40.0)
        noisy = now + random.normal(0, 0.2, now.shape)
        posed = replace(self.scan, vertices=transform_points(pose, noisy), name=f"{self.name}_{k}")
        return posed, Surface(now, self.vertices, self.scan.faces, self.number), invert_rigid(pose)

    def view(self) -> View:
        """Return the view from the front; its surface is off by a smooth error."""
        scan, vertices = self.scan, self.vertices
        assert scan.uv is not None
        assert scan.texture_linear is not None
        rows, columns = ((np.arange(n) + 0.5) / n - 0.5 for n in VIEW)
        y, x = np.meshgrid(-rows * VIEW_MM[0], columns * VIEW_MM[1], indexing="ij")
        start = np.stack([x, y, np.full(VIEW, 300.0)], -1).reshape(-1, 3)
        hits = RayScene(vertices, scan.faces).first_hit(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape))
        mask = (hits.face >= 0) & (start[:, 2] - hits.distance > -60)
        face, weights = hits.face[mask], hits.barycentric[mask]
        at = partial(_interpolated, scan.faces[face], weights)
        points, normals = at(vertices), normalized(at(vertex_normals(vertices, scan.faces)))
        height, width = scan.texture_linear.shape[:2]
        u, v = np.einsum("nk,nkc->nc", weights, scan.uv[face]).T
        place = np.stack([(1 - v) * height, u * width]) - 0.5
        albedo = bilinear(scan.texture_linear, place).astype(float)
        off, gradient = slopes(points, [*self.number, 54], SURFACE_MM)
        position, normal = np.zeros((2, *VIEW, 3))
        there = mask.reshape(VIEW)
        position[there], normal[there] = points + off[:, None] * normals, tilted(normals, gradient)
        surface = Surface(vertices, vertices, scan.faces, self.number)
        return GeometryImage(position, normal, there), surface, (face, weights), albedo


def head(name: str) -> tuple[Callable[[int], Scan], Callable[[], View]]:
    """Return what gives a head's scan of a sitting, and what gives its frontal view."""
    scan = load_scan(face_data(f"heads/{name}.obj"))
    fitted = fitted_face(scan)
    one = _Head(name, scan, fitted, transform_points(fitted.model_from_scan, scan.vertices))
    return one.sitting, one.view


def scanned(scan: RawScan, surface: Surface, surface_from_scan: FloatArray) -> tuple[GeometryImage, Places]:
    """Return the geometry image of a fitted scan, coloured with albedo, and where its texels truly lie."""
    fitted = fitted_face(scan)
    image = geometry_image(fitted, scan, size=SIZE)
    points = transform_points(invert_rigid(fitted.model_from_scan), image.position[image.seen].astype(float))
    query = ClosestPointQuery(surface.vertices, surface.faces)
    hits = query.query(transform_points(surface_from_scan, points))
    return image, (hits.face, hits.barycentric)
