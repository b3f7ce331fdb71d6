"""Rays on their way through lenses: what they pass, what they mirror, where they end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene
from scan2albedo.eyeglasses.lenses.lens_shading import mirror_on_sphere
from scan2albedo.eyeglasses.lenses.refraction import ThinLens, refract
from scan2albedo.geometry.rays import RayHits

_GLANCING = 1e-3
"""Sine of the angle to the lens plane below which a ray does not count as passing the lens."""
_TOUCHING_MM = 1e-6
"""Rays that start this near to a lens start on it."""


@dataclass(frozen=True)
class LensCrossings:
    """M rays at one lens."""

    ray: IntArray
    """(M,) which of the rays that were traced."""
    lens: InsertedLens
    position: FloatArray
    """(M, 3) mm, on the lens."""
    direction: FloatArray
    """(M, 3) unit, of the ray that arrives."""
    mirrored: FloatArray
    """(M, 3) unit, of the reflection."""
    tint_share: FloatArray
    """(M, 3) of the tint in the ray's colour; 0 for filters."""
    mirror_share: FloatArray
    """(M, 3) of the reflection."""


@dataclass
class LensPaths:
    """N rays behind all lenses they pass; changed while they are traced."""

    origins: FloatArray
    """(N, 3) mm: the last lens passed, or the camera."""
    directions: FloatArray
    """(N, 3) unit."""
    hits: RayHits
    """On the scene, from the origins along the directions."""
    share: FloatArray
    """(N, 3) of the scene behind the lenses in the ray's colour."""
    first: IntArray
    """(N,) side of the first lens passed; -1 for none."""
    bent: BoolArray
    """(N,) whether a lens with power changed the direction."""
    used: BoolArray
    """(N, L) whether a ray has passed each lens; none is passed twice."""
    crossings: list[LensCrossings] = field(default_factory=list)
    glancing: int = 0
    """Rays along a lens plane, for which that lens was left out."""


def trace_lenses(
    scene: LensScene,
    lenses: Sequence[InsertedLens],
    origin: FloatArray,
    directions: FloatArray,
    hits: RayHits,
) -> LensPaths:
    """Follow rays from one origin (3,) along unit directions (N, 3) through lenses to the scene.

    `hits` are those of the rays on the scene without lenses.
    """
    count = len(directions)
    paths = LensPaths(
        np.tile(origin, (count, 1)),
        directions.copy(),
        RayHits(hits.face.copy(), hits.barycentric.copy(), hits.distance.copy()),
        np.ones((count, 3)),
        np.full(count, -1),
        np.zeros(count, bool),
        np.zeros((count, len(lenses)), bool),
    )
    waiting = np.arange(count)
    while len(waiting):
        distance = _distances(lenses, paths, waiting)
        which = distance.argmin(1) if len(lenses) else np.zeros(len(waiting), np.int64)
        ahead = distance.min(1, initial=np.inf)
        meets = ahead < paths.hits.distance[waiting]
        waiting, which, ahead = waiting[meets], which[meets], ahead[meets]
        for number, lens in enumerate(lenses):
            at = which == number
            if at.any():
                paths.used[waiting[at], number] = True
                _cross(scene, lens, paths, waiting[at], ahead[at])
    return paths


def _distances(lenses: Sequence[InsertedLens], paths: LensPaths, rays: IntArray) -> FloatArray:
    """Return (M, L) distances of lenses ahead, inf for those missed or passed already."""
    distance = np.full((len(rays), len(lenses)), np.inf)
    for number, lens in enumerate(lenses):
        open_ = ~paths.used[rays, number]
        ray = rays[open_]
        distance[open_, number] = lens.caster.first_hit(paths.origins[ray], paths.directions[ray]).distance
    return distance


def _cross(
    scene: LensScene, lens: InsertedLens, paths: LensPaths, rays: IntArray, distance: FloatArray
) -> None:
    """Take rays (M,) through a lens that lies `distance` (M,) ahead of them."""
    normal = np.asarray(lens.optics.normal)
    glancing = (np.abs(paths.directions[rays] @ normal) <= _GLANCING) | (distance <= _TOUCHING_MM)
    paths.glancing += int(glancing.sum())
    rays, distance = rays[~glancing], distance[~glancing]
    if len(rays) == 0:
        return
    heading, before = paths.directions[rays], paths.origins[rays]
    position = before + heading * distance[:, None]
    crossings, behind_share = _shares(lens, rays, position, heading, paths.share[rays])
    paths.crossings.append(crossings)
    paths.share[rays] = behind_share
    paths.first[rays] = np.where(paths.first[rays] < 0, lens.side, paths.first[rays])
    if lens.optics.dioptres == 0:
        return
    paths.origins[rays], paths.directions[rays] = position, _bend(lens.optics, before, position)
    paths.bent[rays] = True
    hits = scene.caster.first_hit(position, paths.directions[rays])
    paths.hits.face[rays] = hits.face
    paths.hits.barycentric[rays] = hits.barycentric
    paths.hits.distance[rays] = hits.distance


def _bend(lens: ThinLens, before: FloatArray, position: FloatArray) -> FloatArray:
    """Return unit directions (M, 3) behind a lens of rays from `before` that meet its mesh at `position`.

    Rims are not flat. The plane of the thin lens is moved along its normal to where each ray meets the mesh;
    otherwise slanting rays would bend far beside it.
    """
    normal = np.asarray(lens.normal)
    height = ((position - np.asarray(lens.center)) @ normal)[:, None] * normal
    return refract(lens, before - height, position - height).directions


def _shares(
    lens: InsertedLens, rays: IntArray, position: FloatArray, heading: FloatArray, arriving: FloatArray
) -> tuple[LensCrossings, FloatArray]:
    """Return the crossings of a lens and the share (M, 3) of the scene behind it in the colour."""
    material, normal = lens.material, np.asarray(lens.optics.normal)
    flat = position - ((position - np.asarray(lens.optics.center)) @ normal)[:, None] * normal
    mirrored = mirror_on_sphere(flat, heading, lens.optics.center, normal, material.front_radius_mm)
    alpha, beta = np.full(len(rays), material.alpha), np.full(len(rays), material.beta)
    if material.fresnel:
        cosine = np.sqrt(np.clip((1 - np.einsum("ni,ni->n", heading, mirrored)) / 2, 0, 1))
        beta = material.beta + (1 - material.beta) * (1 - cosine) ** 5
        # All other shares shrink alike, so that together they stay 1.
        alpha = alpha * (1 - beta) / max(1 - material.beta, np.finfo(float).tiny)
    rest = np.maximum(1 - alpha - beta, 0.0)[:, None]
    tint = np.zeros((len(rays), 1))
    if material.tinting == "filter":
        rest = rest + alpha[:, None] * np.asarray(material.tint_linear)
    else:
        tint = alpha[:, None]
    crossings = LensCrossings(
        rays, lens, position, heading, mirrored, arriving * tint, arriving * beta[:, None]
    )
    return crossings, arriving * rest
