"""Geometry of a face from one image: landmarks alone, and landmarks with photometry.

Faces of `scan2albedo.synthetic` that the shape model was not learned from, with painted skin, random lobes
and a mild expression, under generated environments. Pictures are made pixel by pixel on a mesh sixteen times
finer than the model's, by sums over 400 distant lights, with 1 % noise, and cast shadows or not; nothing of
the fit's shading is in them. Landmarks have 1 px noise (0.5 mm). Errors are means over the vertices that the
camera sees: positions after the best rigid alignment, the same with the best scale too (size and distance
cannot be told apart in one image), and normals; "believed" counts fits that kept the photometry. Slow methods
have other weights of the landmarks.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, get_args
from unittest.mock import patch

import numpy as np
from scipy.spatial import cKDTree
from worlds.environments import generated_environment
from worlds.model_faces import learned, person, shape_model, surface

import scan2albedo as s2a
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, look_at, project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.reflectance import (
    EXPONENTS,
    GeometryFit,
    ImageObservation,
    VertexReflectance,
    fit_image,
    geometry_terms,
    refine_geometry,
)
from scan2albedo.reflectance.geometry_terms import SmoothImage
from scan2albedo.synthetic import face_shape

LEVEL = 1
"""Subdivisions of the shape model's mesh."""
FINE = 3
"""Subdivisions of the mesh that is photographed."""
SHAPE = (440, 440)
CAMERA = look_at([0.0, 0.0, 900.0], [0.0, 0.0, 0.0], focal_px=1800.0, shape=SHAPE)
"""Half a millimetre a pixel."""
LIGHTS = 400
LANDMARK_WEIGHTS = (0.02, 0.5)
SKIN_WIDTH_MM = 1.5
"""Over which skin of the fine mesh is averaged for the coarse one."""


@dataclass(frozen=True)
class Scene:
    """A picture and the truth about it; `vertices` are of the model's topology, in the scene."""

    image: FloatArray
    landmarks: FloatArray
    vertices: FloatArray
    reflectance: VertexReflectance
    light: FloatArray

    @property
    def start(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.image, CAMERA, self.landmarks


@cache
def scene(seed: int, shadows: bool) -> Scene:
    model, rng = s2a.AnnotatedFaceModel.default(), np.random.default_rng([seed, 21])
    name = get_args(face_shape.Expression)[rng.integers(6)]
    control = face_shape.person(model, rng, expression=name, expression_strength=0.6)
    angles = np.radians([rng.uniform(-12, 12), rng.uniform(-25, 25), rng.uniform(-8, 8)])
    pose = compose(rotation_from_vector(angles), rng.normal(size=3) * [8, 8, 30])
    fine, coarse = (transform_points(pose, model.subdivision(n).matrix @ control) for n in (FINE, LEVEL))
    lights = DistantLights.from_environment(generated_environment(70_000 + seed), LIGHTS)
    light = harmonics(lights.directions).T @ np.asarray(lights.irradiance_linear)
    image = photograph(fine, model.subdivision(FINE).faces, person(seed, FINE), lights, shadows)
    image += 0.01 * np.median(image[image > 0]) * rng.normal(size=image.shape)
    landmarks, _ = project(CAMERA, coarse[shape_model().landmark_vertices])
    return Scene(image, landmarks + rng.normal(size=(68, 2)), coarse, coarse_skin(seed), light)


def coarse_skin(seed: int) -> VertexReflectance:
    """Return skin of the fine mesh averaged around the vertices of the coarse one."""
    skin, coarse = person(seed, FINE), surface(LEVEL)
    distance, near = cKDTree(surface(FINE).vertices).query(coarse.vertices, k=60)
    weight = np.exp(-(distance**2) / (2 * SKIN_WIDTH_MM**2))
    weight /= weight.sum(1, keepdims=True)
    numbers = [np.einsum("vk,vkc->vc", weight, of[near]) for of in (skin.diffuse_linear, skin.weights)]
    return VertexReflectance(*numbers, np.ones(len(coarse.vertices), bool))


def photograph(
    vertices: FloatArray, faces: np.ndarray, skin: VertexReflectance, lights: DistantLights, shadows: bool
) -> FloatArray:
    """Return the picture (H, W, 3), grey behind the face."""
    pixels, depth = project(CAMERA, vertices)
    raster = rasterize(pixels, 1 / depth, faces, SHAPE)
    # Barycentric weights in the picture are nearly those on the surface: faces are small.
    points, n, diffuse, weights = (
        interpolate(raster, faces, values)[raster.covered]
        for values in (vertices, vertex_normals(vertices, faces), skin.diffuse_linear, skin.weights)
    )
    n, view = normalized(n), normalized(camera_centers(CAMERA[None])[0] - points)
    caster, color = RayCaster(vertices, faces), np.zeros_like(points)
    directions, irradiances = np.asarray(lights.directions), np.asarray(lights.irradiance_linear)
    for toward, irradiance in zip(directions, irradiances, strict=True):
        lit = n @ toward > 0
        if shadows:
            lit[lit] = ~caster.occluded(points[lit] + 0.3 * n[lit], toward)
        n_h = np.maximum((n[lit] * normalized(toward + view[lit])).sum(1), 0)
        lobes = np.stack([(s + 2) / 8 * n_h**s for s in EXPONENTS], 1)
        sent = diffuse[lit] * (n[lit] @ toward)[:, None] + (weights[lit] * lobes).sum(1)[:, None]
        color[lit] += irradiance / np.pi * sent
    image = np.full((*SHAPE, 3), 0.3 * np.median(color))
    image[raster.covered] = color
    return image


def refined(scene: Scene, **given: Any) -> GeometryFit:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return refine_geometry(*scene.start, shape_model(), **given)


def known_light(scene: Scene) -> GeometryFit:
    return refined(scene, reflectance=scene.reflectance, light=scene.light)


def with_landmark_weight(value: float, scene: Scene) -> GeometryFit:
    with patch.object(geometry_terms, "LANDMARK_WEIGHT", value):
        return known_light(scene)


def alternated(scene: Scene) -> GeometryFit:
    """Find reflectance and light by `fit_image` on the geometry so far, geometry with them, in turn."""
    fit = refined(scene)
    for _ in range(3):
        smooth = SmoothImage(scene.image, None, 1.0)
        pixels, _ = project(CAMERA, fit.vertices)
        view = normalized(camera_centers(CAMERA[None])[0] - fit.vertices)
        seen = (np.einsum("vi,vi->v", fit.normals, view) > 0.25) & smooth.covers(pixels)
        image = ImageObservation(smooth.look_up(pixels), fit.normals, view, seen)
        found = fit_image(image, learned(60, 40))
        fit = refined(
            scene,
            reflectance=found.face.reflectance,
            light=found.light,
            initial_scene_from_model=fit.scene_from_model,
            initial_identity=fit.identity,
            initial_expression=fit.expression,
        )
    return fit


def errors(scene: Scene, answer: GeometryFit | FloatArray) -> dict[str, float]:
    vertices = answer.vertices if isinstance(answer, GeometryFit) else answer
    faces = shape_model().faces
    true_normals = vertex_normals(scene.vertices, faces)
    view = normalized(camera_centers(CAMERA[None])[0] - scene.vertices)
    seen = np.einsum("vi,vi->v", true_normals, view) > 0.1
    row = {}
    for column, scale in (("scaled mm", True), ("rigid mm", False)):
        aligned = transform_points(procrustes(vertices[seen], scene.vertices[seen], scale=scale), vertices)
        row[column] = float(np.linalg.norm(aligned - scene.vertices, axis=1)[seen].mean())
    cosine = np.sum(vertex_normals(aligned, faces) * true_normals, axis=1)[seen]
    row["normals deg"] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    if isinstance(answer, GeometryFit):
        row["believed"] = float(answer.plan.ran("reflectance.geometry.photometry"))
    return row


def cases(quick: bool) -> Iterator[Case]:
    for shadows in (False, True):
        group = "cast shadows" if shadows else "no shadows"
        for seed in range(1 if quick else 6):
            yield Case(f"person {seed}, {group}", partial(scene, seed, shadows), group)


METHODS: dict[str, Callable[[Scene], GeometryFit]] = {
    "photometry, both known": known_light,
    "photometry, both estimated": alternated,
    "landmarks": refined,
}
SWEEP = {f"LANDMARK_WEIGHT {value:g}": partial(with_landmark_weight, value) for value in LANDMARK_WEIGHTS}
BENCH = Bench(
    cases,
    methods={**METHODS, **SWEEP},
    peers={"mean shape": lambda scene: shape_model().mean},
    score=errors,
    slow=list(SWEEP),
)
