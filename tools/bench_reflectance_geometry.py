"""Geometry from one image: landmarks alone, and landmarks with photometry.

    python tools/bench_reflectance_geometry.py [faces] [weights] [light] [--people 6] [--picture fit.png]

Faces of `scan2albedo.synthetic` that the shape model was not learned from, with painted skin, random lobes
and a mild expression, under generated environments. Pictures are made pixel by pixel on a mesh sixteen times
finer than the model's, by sums over 400 distant lights, with 1 % noise, and cast shadows or not; nothing of
the fit's shading is in them. Landmarks have 1 px noise (0.5 mm). Errors are means over the vertices that the
camera sees and over people: positions after the best rigid alignment, the same with the best scale too (size
and distance cannot be told apart in one image), and normals. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from typing import get_args
from unittest.mock import patch

import numpy as np
from numba import njit
from scipy.spatial import cKDTree
from worlds.environments import generated_environment
from worlds.model_faces import learned, person, shape_model, surface

import scan2albedo as s2a
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, look_at, project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.io.images import write_png
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    GeometryFit,
    ImageObservation,
    VertexReflectance,
    fit_image,
    geometry_fit,
    geometry_terms,
    image_fit,
    refine_geometry,
)
from scan2albedo.reflectance.geometry_terms import SmoothImage
from scan2albedo.synthetic import face_shape

LEVEL, FINE = 1, 3
SHAPE = (440, 440)
CAMERA = look_at([0.0, 0.0, 900.0], [0.0, 0.0, 0.0], focal_px=1800.0, shape=SHAPE)
"""Half a millimetre a pixel."""
LIGHTS = 400


@dataclass(frozen=True)
class Scene:
    """A picture and the truth about it."""

    image: np.ndarray
    landmarks: np.ndarray
    vertices: np.ndarray
    """Of the model's topology, in the scene."""
    reflectance: VertexReflectance
    light: np.ndarray


@cache
def scene(seed: int, shadows: bool) -> Scene:
    model, rng = s2a.AnnotatedFaceModel.default(), np.random.default_rng([seed, 21])
    name = get_args(face_shape.Expression)[rng.integers(6)]
    control = face_shape.person(model, rng, expression=name, expression_strength=0.6)
    angles = np.radians([rng.uniform(-12, 12), rng.uniform(-25, 25), rng.uniform(-8, 8)])
    pose = compose(rotation_from_vector(angles), rng.normal(size=3) * [8, 8, 30])
    fine = transform_points(pose, model.subdivision(FINE).matrix @ control)
    coarse = transform_points(pose, model.subdivision(LEVEL).matrix @ control)
    lights = DistantLights.from_environment(generated_environment(70_000 + seed), LIGHTS)
    light = harmonics(lights.directions).T @ np.asarray(lights.irradiance_linear)
    skin = person(seed, FINE)
    image = photograph(fine, model.subdivision(FINE).faces, skin, lights, shadows)
    image += 0.01 * np.median(image[image > 0]) * rng.normal(size=image.shape)
    landmarks, _ = project(CAMERA, coarse[shape_model().landmark_vertices])
    return Scene(image, landmarks + rng.normal(size=(68, 2)), coarse, coarse_skin(seed), light)


@cache
def coarse_skin(seed: int, width_mm: float = 1.5) -> VertexReflectance:
    """Skin of the fine mesh averaged around the vertices of the coarse one."""
    fine, coarse = surface(FINE), surface(LEVEL)
    distance, near = cKDTree(fine.vertices).query(coarse.vertices, k=60)
    weight = np.exp(-(distance**2) / (2 * width_mm**2))
    weight /= weight.sum(1, keepdims=True)
    skin = person(seed, FINE)
    numbers = [np.einsum("vk,vkc->vc", weight, a[near]) for a in (skin.diffuse_linear, skin.weights)]
    return VertexReflectance(numbers[0], numbers[1], np.ones(len(coarse.vertices), bool))


def photograph(
    vertices: np.ndarray, faces: np.ndarray, skin: VertexReflectance, lights: DistantLights, shadows: bool
) -> np.ndarray:
    """Return the picture (H, W, 3), grey behind the face."""
    pixels, depth = project(CAMERA, vertices)
    raster = rasterize(pixels, 1 / depth, faces, SHAPE)
    normal = vertex_normals(vertices, faces)
    # Barycentric weights in the picture are nearly those on the surface: faces are small.
    on_face = raster.covered
    points, n, diffuse, weights = (
        interpolate(raster, faces, v)[on_face] for v in (vertices, normal, skin.diffuse_linear, skin.weights)
    )
    n = normalized(n)
    view = normalized(camera_centers(CAMERA[None])[0] - points)
    caster, color = RayCaster(vertices, faces), np.zeros_like(points)
    for toward, irradiance in zip(
        np.asarray(lights.directions), np.asarray(lights.irradiance_linear), strict=True
    ):
        lit = n @ toward > 0
        if shadows:
            lit[lit] = ~caster.occluded(points[lit] + 0.3 * n[lit], toward)
        _add_light(color, lit, n, view, diffuse, weights, toward, irradiance)
    image = np.full((*SHAPE, 3), 0.3 * np.median(color))
    image[on_face] = color
    return image


@njit(cache=True)
def _add_light(color, lit, normal, view, diffuse, weights, toward, irradiance):
    for i in range(len(color)):
        if not lit[i]:
            continue
        n_l = n_h = length = 0.0
        for k in range(3):
            half = toward[k] + view[i, k]
            n_l += normal[i, k] * toward[k]
            n_h += normal[i, k] * half
            length += half * half
        n_h = max(n_h / np.sqrt(max(length, 1e-12)), 0.0)
        gloss = (3 * weights[i, 0] * n_h + 10 * weights[i, 1] * n_h**8 + 66 * weights[i, 2] * n_h**64) / 8
        for k in range(3):
            color[i, k] += irradiance[k] * (diffuse[i, k] * n_l + gloss) / np.pi


def visible(s: Scene) -> np.ndarray:
    normals = vertex_normals(s.vertices, shape_model().faces)
    view = normalized(camera_centers(CAMERA[None])[0] - s.vertices)
    return np.einsum("vi,vi->v", normals, view) > 0.1


def errors(vertices: np.ndarray, s: Scene) -> tuple[float, float, float]:
    """Return mean distances in mm, with the best scale too, and angles in degrees, over visible vertices."""
    seen, faces = visible(s), shape_model().faces
    distances = []
    for scale in (True, False):
        aligned = transform_points(procrustes(vertices[seen], s.vertices[seen], scale=scale), vertices)
        distances.append(float(np.linalg.norm(aligned - s.vertices, axis=1)[seen].mean()))
    cosine = np.sum(vertex_normals(aligned, faces) * vertex_normals(s.vertices, faces), axis=1)[seen]
    return distances[1], distances[0], float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def refined(s: Scene, skin=None, light=None, start=None) -> GeometryFit:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        initial: dict[str, np.ndarray] = {}
        if start is not None:
            initial = {
                "initial_scene_from_model": start.scene_from_model,
                "initial_identity": start.identity,
                "initial_expression": start.expression,
            }
        return refine_geometry(
            s.image,
            CAMERA,
            s.landmarks,
            shape_model(),
            reflectance=skin,
            light=light,
            **initial,
        )


def alternated(s: Scene, rounds: int = 3) -> GeometryFit:
    """Reflectance and light by `fit_image` on the geometry so far, then geometry with them, in turn."""
    fit = refined(s)
    for _ in range(rounds):
        skin, light = estimated(s, fit)
        fit = refined(s, skin, light, fit)
    return fit


def estimated(s: Scene, fit: GeometryFit) -> tuple[VertexReflectance, np.ndarray]:
    """Return reflectance and light that `fit_image` finds on a geometry."""
    smooth = SmoothImage(s.image, None, 1.0)
    pixels, _ = project(CAMERA, fit.vertices)
    view = normalized(camera_centers(CAMERA[None])[0] - fit.vertices)
    seen = (np.einsum("vi,vi->v", fit.normals, view) > 0.25) & smooth.covers(pixels)
    found = fit_image(
        ImageObservation(smooth.look_up(pixels), fit.normals, view, seen), learned(60, 40, LEVEL)
    )
    return found.face.reflectance, found.light


Method = Callable[[Scene], GeometryFit]
METHODS: dict[str, Method] = {
    "landmarks": refined,
    "+ photometry, reflectance and light known": lambda s: refined(s, s.reflectance, s.light),
    "+ photometry, both estimated in turn": alternated,
}


def print_faces(people: int, picture: str | None) -> None:
    """Print errors of mean shape, nearest shape, landmarks, and photometry."""
    learned(60, 40, LEVEL)
    for shadows in (False, True):
        scenes = [scene(seed, shadows) for seed in range(people)]
        print_head(f"{people} people, {'with' if shadows else 'no'} cast shadows")
        print_row("mean shape", [errors(shape_model().mean, s) for s in scenes])
        print_row("nearest shape of the model", [errors(nearest(s), s) for s in scenes])
        for name, method in METHODS.items():
            print_method(name, method, scenes)
    if picture:
        draw(picture, scene(0, True))


def print_weights(people: int, picture: str | None) -> None:
    """Print errors by the weights of the objective and the smoothing of the image."""
    scenes = [scene(seed, False) for seed in range(people)]
    known = METHODS["+ photometry, reflectance and light known"]
    print_head("landmarks alone")
    for weight in (0.002, 0.02, 0.1, 0.2, 0.5):
        print_method(f"LANDMARK_WEIGHT {weight:g}", refined, scenes, LANDMARK_WEIGHT=weight)
    print_head("with photometry, reflectance and light known")
    for change in (
        {},
        {"LANDMARK_WEIGHT": 0.02},
        {"PHOTOMETRIC_WEIGHT": 0.5},
        {"PHOTOMETRIC_WEIGHT": 8.0},
        {"PRIOR_WEIGHT": 3e-4},
        {"PRIOR_WEIGHT": 3e-3},
        {"BLUR_EDGES": 0.0},
        {"BLUR_EDGES": 0.6},
    ):
        text = ", ".join(f"{name} {value}" for name, value in change.items()) or "as it is"
        print_method(text, known, scenes, **change)


def print_light(people: int, picture: str | None) -> None:
    """Print what the light of other places does, of the same brightness, and how often it is believed."""
    scenes = [scene(seed, False) for seed in range(people)]
    places = [project_environment(generated_environment(90_000 + seed)) for seed in range(people)]

    def wrong(s: Scene) -> GeometryFit:
        light = places[[other is s for other in scenes].index(True)]
        return refined(s, s.reflectance, light * s.light[0].sum() / light[0].sum())

    print_head("light of other places")
    print_method("landmarks", refined, scenes)
    print_method("+ photometry, wrong light", wrong, scenes)
    print_method("the same, believed always", wrong, scenes, MOST_UNEXPLAINED=99.0)


def print_head(title: str) -> None:
    print(f"\n{title:44}{'rigid mm':>10}{'scaled mm':>11}{'normals deg':>13}{'CPU s':>8}{'believed':>10}")


def print_method(name: str, method: Method, scenes: list[Scene], **settings: float) -> None:
    """Print a row, with constants of the fit set anew."""
    start = time.process_time()
    with ExitStack() as stack:
        for setting, value in settings.items():
            module = next(one for one in (geometry_fit, geometry_terms, image_fit) if hasattr(one, setting))
            stack.enter_context(patch.object(module, setting, value))
        fits = [method(s) for s in scenes]
    used = (time.process_time() - start) / len(scenes)
    believed = sum(fit.plan.ran("reflectance.geometry.photometry") for fit in fits)
    rows = [errors(fit.vertices, s) for fit, s in zip(fits, scenes, strict=True)]
    print_row(name, rows, f"{used:8.2f}{believed:10d}")


def print_row(name: str, rows: list[tuple[float, float, float]], more: str = "") -> None:
    rigid, scaled, degrees = np.mean(rows, axis=0)
    print(f"{name:44}{rigid:10.3f}{scaled:11.3f}{degrees:13.2f}{more}", flush=True)


def draw(path: str, s: Scene) -> None:
    """Draw the image, and by the normals: truth, landmarks, photometry known and estimated; errors below."""
    fits = [method(s).vertices for method in METHODS.values()]
    faces = shape_model().faces
    top = [np.clip(s.image / np.quantile(s.image, 0.98), 0, 1)]
    bottom = [np.ones_like(s.image)]
    for vertices in (s.vertices, *fits):
        aligned = transform_points(procrustes(vertices, s.vertices, scale=True), vertices)
        pixels, depth = project(CAMERA, aligned)
        raster = rasterize(pixels, 1 / depth, faces, SHAPE)
        distance = np.linalg.norm(aligned - s.vertices, axis=1) / 3.0
        heat = np.clip(np.stack([2 * distance, 2 - 2 * distance, np.zeros_like(distance)], 1), 0, 1)
        top.append(interpolate(raster, faces, 0.5 + 0.5 * vertex_normals(aligned, faces)))
        bottom.append(interpolate(raster, faces, heat))
    write_png(path, np.concatenate([np.concatenate(row, axis=1) for row in (top, bottom)]))


def nearest(s: Scene) -> np.ndarray:
    """Return the model's shape nearest to the truth."""
    model = shape_model()
    flat = model.basis.reshape(len(model.basis), -1)
    target = s.vertices
    for _ in range(10):
        target = transform_points(procrustes(target, model.mean), target)
        found = np.linalg.lstsq(
            flat @ flat.T + 1e-3 * np.eye(len(flat)), flat @ (target - model.mean).ravel()
        )[0]
        shape = model.mean + np.tensordot(found, model.basis, 1)
        target = transform_points(procrustes(s.vertices, shape), s.vertices)
    return shape


PARTS = {"faces": print_faces, "weights": print_weights, "light": print_light}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", default="all", choices=[*PARTS, "all"])
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--picture", help="PNG: normals of one face, and its errors (green 0, red 3 mm)")
    arguments = parser.parse_args()
    for part in PARTS if "all" in arguments.parts else arguments.parts:
        PARTS[part](arguments.people, arguments.picture)


if __name__ == "__main__":
    main()
