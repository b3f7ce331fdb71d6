"""People painted on the face model's surface, their colours in everyday light, and models learned from them.

Light with shadows is summed over the middles of 8,192 quarter texels of a map, and the shadows are cast by a
surface four times finer than the one that is fitted: neither knows harmonics or the sums of `light_transfer`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import get_args

import numpy as np

import scan2albedo as s2a
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.lighting.environment import texel_directions, texel_solid_angles
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance import (
    EXPONENTS,
    ImageObservation,
    MorphableReflectanceModel,
    MorphableShapeModel,
    VertexReflectance,
    shade_environment,
)
from scan2albedo.synthetic import Portrait, face_photograph, face_shape
from scan2albedo.synthetic.textures import PaintedFeatures, paint_face
from worlds.environments import SHAPE, generated_environment

CAMERA_MM = np.array([0.0, 0.0, 900.0])
"""Where the camera stands."""
_SHAPE_LEVEL = 1
"""Subdivisions of the surface of `shape_model`."""
_QUARTERS = (2 * SHAPE[0], 2 * SHAPE[1])
"""Rows and columns of quarter texels of a map."""
_BLOCK = 128
"""Vertices whose light is summed at a time."""


@dataclass(frozen=True)
class Surface:
    """The default model's limit surface and how the camera sees it."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    normals: np.ndarray
    view: np.ndarray
    seen: np.ndarray


@cache
def surface(levels: int = 1) -> Surface:
    """Return the surface after `levels` refinements."""
    model = s2a.AnnotatedFaceModel.default()
    vertices, faces = model.surface(levels)
    uv = model.subdivision(levels).matrix @ model.uv
    normals, view = vertex_normals(vertices, faces), normalized(CAMERA_MM - vertices)
    normals[~normals.any(1)] = [0, 0, 1]
    return Surface(vertices, faces, uv, normals, view, np.einsum("vi,vi->v", normals, view) > 0.15)


def person(seed: int, levels: int = 1) -> VertexReflectance:
    """Painted skin with lobes that vary smoothly over the face and from person to person."""
    s, rng = surface(levels), np.random.default_rng([seed, 1])
    features = PaintedFeatures(
        brow_thickness=float(rng.uniform(0.65, 1.35)), lip_fullness=float(rng.uniform(-0.004, 0.004))
    )
    paint = np.random.default_rng([seed, 2])
    tone = float(rng.uniform(0.15, 0.6))
    albedo = paint_face(s.uv, s2a.AnnotatedFaceModel.default(), paint, tone=tone, features=features)
    waves = harmonics(normalized(s.vertices - [0, 0, s.vertices[:, 2].min() - 40.0]), 4)
    fields = np.random.default_rng(9).normal(size=(6, 4, 25)) @ waves.T
    gloss, *lobes = 0.25 * np.einsum("r,frv->fv", rng.normal(size=4), fields[:4])
    share = np.exp(0.5 * np.stack(lobes, 1)) * [0.15, 0.45, 0.4]
    total = 0.22 * np.exp(gloss)
    weights = total[:, None] * share / share.sum(1, keepdims=True)
    return VertexReflectance(np.clip(albedo, 0, None), weights, np.ones(len(albedo), bool))


@cache
def learned(count: int, components: int) -> MorphableReflectanceModel:
    """Return the model of `count` people."""
    people = [person(1000 + k) for k in range(count)]
    return MorphableReflectanceModel.from_samples(people, components=components)


def shot(face: VertexReflectance, seed: int) -> ImageObservation:
    """Return colours of a face in generated light, with 1 % noise."""
    s, rng = surface(), np.random.default_rng([seed, 3])
    light = project_environment(generated_environment(50_000 + seed))
    color = shade_environment(face, s.normals, s.view, light).radiance_linear
    color = color * (1 + 0.01 * rng.normal(size=color.shape))
    return ImageObservation(color, s.normals, s.view, s.seen)


def albedo_error(found: np.ndarray, face: VertexReflectance, levels: int = 1) -> float:
    """Return the relative RMSE of an albedo (V, 3) after the best single scale, over what is seen."""
    seen = surface(levels).seen
    return scaled_error(found[seen], face.diffuse_linear[seen])


def scaled_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Return the relative RMSE after the best single scale."""
    scale = np.sum(found * truth) / np.sum(found * found)
    return float(np.linalg.norm(scale * found - truth) / np.linalg.norm(truth))


@cache
def shape_model(people: int = 120) -> MorphableShapeModel:
    """Return the shape model of as many people, and of their expressions."""
    model = s2a.AnnotatedFaceModel.default()
    to_surface = model.subdivision(_SHAPE_LEVEL).matrix
    rest, faces = model.surface(_SHAPE_LEVEL)
    rng = np.random.default_rng(1)
    neutral = [to_surface @ face_shape.person(model, rng) for _ in range(people)]
    offsets = [
        to_surface @ face_shape.person(model, rng, strength=0.0, expression=name) - rest
        for name in get_args(face_shape.Expression)[1:]
        for _ in range(8)
    ]
    assert model.landmarks is not None
    nearest = np.linalg.norm(rest - model.landmarks[:, None], axis=2).argmin(1)
    return MorphableShapeModel.from_samples(neutral, offsets, faces, nearest)


@dataclass(frozen=True)
class GeometryScene:
    """A photograph of a face, in linear colours, and the truth, as `refine_geometry` wants it."""

    image_linear: np.ndarray
    skin: np.ndarray
    camera: np.ndarray
    landmarks_px: np.ndarray
    vertices: np.ndarray
    reflectance: VertexReflectance
    light: np.ndarray


@cache
def geometry_scene(seed: int) -> GeometryScene:
    """Return a person under generated light, without hair, whose reflectance and light are known."""
    environment = generated_environment(80_000 + seed)
    portrait = Portrait(gamma=1.0, bits=None, saturated_part=0.0)
    taken = face_photograph(seed, environment, hair=False, lights=128, portrait=portrait)
    known = np.ones(len(taken.vertices), bool)
    light = taken.exposure * project_environment(environment)
    return GeometryScene(
        np.asarray(taken.image, float),
        taken.skin,
        taken.camera,
        taken.landmarks_px,
        taken.vertices,
        VertexReflectance(taken.diffuse_linear, taken.weights, known),
        light,
    )


def rigid_error_mm(vertices: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean distance of corresponding vertices after the best rigid alignment."""
    pose = procrustes(vertices, truth)
    return float(np.linalg.norm(transform_points(pose, vertices) - truth, axis=1).mean())


class ShadowedSurface:
    """V vertices, and the occluder (vertices, faces) that may be finer than their own mesh."""

    def __init__(self, vertices, normals, view, occluder) -> None:  # type: ignore[no-untyped-def]
        self.normals, self.view = normals, view
        shadows = ShadowMap(RayCaster(*occluder), vertices, normals)
        self.visible = shadows.table(texel_directions(_QUARTERS).reshape(-1, 3)).visibility

    def received(self, environments: Sequence[np.ndarray], *, shadows: bool = True) -> np.ndarray:
        """Return (K, V, 4, 3): what a white diffuse surface and each lobe of weight 1 send under K maps."""
        toward = texel_directions(_QUARTERS).reshape(-1, 3)
        solid_angle = np.repeat(texel_solid_angles(*_QUARTERS), _QUARTERS[1])
        fine = [np.repeat(np.repeat(e, 2, 0), 2, 1).reshape(-1, 3) for e in environments]
        light = np.concatenate(fine, axis=1) * solid_angle[:, None]
        result = np.empty((len(self.normals), 4, light.shape[1]))
        for start in range(0, len(result), _BLOCK):
            block = slice(start, start + _BLOCK)
            n, v = self.normals[block], self.view[block]
            lit = self.visible[:, block].T if shadows else 1.0
            n_l, n_v = n @ toward.T, np.einsum("vi,vi->v", n, v)[:, None]
            half = np.sqrt(np.maximum(2 + 2 * (v @ toward.T), 1e-12))
            n_h = np.maximum(np.where(n_l > 0, (n_l + n_v) / half, 0.0), 0.0)
            result[block, 0] = (lit * np.maximum(n_l, 0) / np.pi) @ light
            for k, s in enumerate(EXPONENTS):
                result[block, 1 + k] = (lit * (n_l > 0) * (s + 2) / (8 * np.pi) * n_h**s) @ light
        return np.moveaxis(result.reshape(len(result), 4, len(environments), 3), 2, 0)


def sent(face: VertexReflectance, received: np.ndarray) -> np.ndarray:
    """Return (V, 3) radiance of a face that receives (V, 4, 3)."""
    specular = np.einsum("vk,vkj->vj", face.weights, received[:, 1:])
    return np.asarray(face.diffuse_linear * received[:, 0] + specular)
