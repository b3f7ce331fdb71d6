"""The photographs a two-pod scanner takes of a sitter, with highlights and cast shadows."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.point_light import PointLight
from scan2albedo.geometry.mesh import normalized
from scan2albedo.synthetic.camera import auto_exposure, photograph
from scan2albedo.synthetic.range_scan import Pod
from scan2albedo.synthetic.ray_scene import RayScene
from scan2albedo.synthetic.renderer import Material, Rendered, render
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import FACE, Sitter

FloatArray = NDArray[np.float64]

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
) -> tuple[NDArray[np.float32], float]:
    """Return both pods' pictures side by side (size, 2 size, 3), linear from 8 bits, and their exposure.

    The exposure keeps the face's brightest pixel just below white; white clothes may clip.

    Parameters
    ----------
    sitter : Sitter
    pods : (left, right)
    lights : tuple of PointLight
    material : Material
        Of everything but the clothes, which have no highlight.
    size : int
        Pixels of each picture's side.
    noise : float
        Standard deviation, white = 1.
    rng : numpy.random.Generator
    colors : (1 + L, 3) float64, optional
        Of the ambient light and of each lamp; all white when omitted.
    """
    scene = RayScene(sitter.vertices, sitter.faces)
    seen = [_radiance(sitter, scene, pod, lights, material, size, colors) for pod in pods]
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
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return what one pod sees (H, H, 3) and which pixels show the face (H, H)."""
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
    radiance[hit] = under(lights).radiance_linear if colors is None else _colored(under, lights, colors)
    on_face[hit] = sitter.part[face] == FACE
    return radiance.reshape(size, size, 3), on_face.reshape(size, size)


def _colored(
    under: Callable[[tuple[PointLight, ...]], Rendered], lights: tuple[PointLight, ...], colors: FloatArray
) -> FloatArray:
    """Return the radiance (N, 3) under ambient light and lamps of colours (1 + L, 3): light adds up."""
    ambient = under(()).radiance_linear
    lamps = [under((light,)).radiance_linear - ambient for light in lights]
    return np.asarray(sum(color * part for color, part in zip(colors, (ambient, *lamps), strict=True)))
