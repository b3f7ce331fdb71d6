"""Rays on their way through lenses: what they pass, what they mirror, where they end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.optics import mirror_on_sphere, refract
from scan2albedo.eyeglasses.lenses.scenes import LensScene, SceneRays

_GLANCING = 1e-3
"""Sine of the angle to the lens plane, and mm from the start to the lens, below which a ray does not count as
passing the lens."""


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

    rays: SceneRays
    """From the last lens passed, or the camera, to the scene."""
    share: FloatArray
    """(N, 3) of the scene behind the lenses in the ray's colour."""
    first: IntArray
    """(N,) side of the first lens passed; -1 for none."""
    bent: BoolArray
    """(N,) whether a lens with power changed the direction."""
    crossings: list[LensCrossings] = field(default_factory=list)
    glancing: int = 0
    """Rays along a lens plane, for which that lens was left out."""


def trace_lenses(scene: LensScene, lenses: Sequence[InsertedLens], rays: SceneRays) -> LensPaths:
    """Follow rays through lenses to the scene; no ray passes a lens twice."""
    count = len(rays.origins)
    own = rays.chosen(np.arange(count))
    paths = LensPaths(own, np.ones((count, 3)), np.full(count, -1), np.zeros(count, bool))
    ahead = np.ones((count, len(lenses)), bool)
    waiting = np.arange(count if len(lenses) else 0)
    while len(waiting):
        distance = np.full((len(waiting), len(lenses)), np.inf)
        for k, lens in enumerate(lenses):
            open_ = ahead[waiting, k]
            ray = waiting[open_]
            distance[open_, k] = lens.caster.first_hit(own.origins[ray], own.directions[ray]).distance
        which, nearest = distance.argmin(1), distance.min(1)
        meets = nearest < own.hits.distance[waiting]
        waiting, which, nearest = waiting[meets], which[meets], nearest[meets]
        ahead[waiting, which] = False
        for k, lens in enumerate(lenses):
            here = which == k
            glancing = np.abs(own.directions[waiting] @ np.asarray(lens.optics.normal)) <= _GLANCING
            glancing |= nearest <= _GLANCING
            paths.glancing += int((here & glancing).sum())
            if (here & ~glancing).any():
                _cross(scene, lens, paths, waiting[here & ~glancing], nearest[here & ~glancing])
    return paths


def _cross(
    scene: LensScene, lens: InsertedLens, paths: LensPaths, rays: IntArray, distance: FloatArray
) -> None:
    """Take rays (M,) through a lens that lies `distance` (M,) ahead of them."""
    own, material = paths.rays, lens.material
    normal, center = np.asarray(lens.optics.normal), np.asarray(lens.optics.center)
    heading, before = own.directions[rays], own.origins[rays]
    position = before + heading * distance[:, None]
    # Rims are not flat: the plane of the thin lens is moved along its normal to where each ray meets the
    # mesh; otherwise slanting rays would bend far beside it.
    height = ((position - center) @ normal)[:, None] * normal
    mirrored = mirror_on_sphere(position - height, heading, center, normal, material.front_radius_mm)
    alpha, beta = np.full(len(rays), material.alpha), np.full(len(rays), material.beta)
    if material.fresnel:
        cosine = np.sqrt(np.clip((1 - np.einsum("ni,ni->n", heading, mirrored)) / 2, 0, 1))
        beta = material.beta + (1 - material.beta) * (1 - cosine) ** 5
        # All other shares shrink alike, so that together they stay 1.
        alpha = alpha * (1 - beta) / max(1 - material.beta, np.finfo(float).tiny)
    rest, tint = np.maximum(1 - alpha - beta, 0.0)[:, None], alpha[:, None]
    if material.tinting == "filter":
        rest, tint = rest + tint * np.asarray(material.tint_linear), np.zeros_like(tint)
    arriving = paths.share[rays]
    paths.crossings.append(
        LensCrossings(rays, lens, position, heading, mirrored, arriving * tint, arriving * beta[:, None])
    )
    paths.share[rays] = arriving * rest
    paths.first[rays] = np.where(paths.first[rays] < 0, lens.side, paths.first[rays])
    if lens.optics.dioptres != 0:
        own.origins[rays] = position
        own.directions[rays] = refract(lens.optics, before - height, position - height).directions
        paths.bent[rays] = True
        hits = scene.caster.first_hit(position, own.directions[rays])
        own.hits.face[rays], own.hits.barycentric[rays] = hits.face, hits.barycentric
        own.hits.distance[rays] = hits.distance
