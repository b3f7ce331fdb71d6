"""Light on a sitter, path-traced with Mitsuba one emitter at a time, toward any camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.mitsuba_bake import ABOVE_MM, textured_mesh, trace
from benchmarks.traced_lights import Emitter, Rig
from benchmarks.traced_people import Part, bsdf_of
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic.renderer import photograph, toward

DEPTH = 6
"""Longest path in edges: four bounces between a lamp and the camera, and the camera's own edge."""
_CHUNK = 2**16
"""Rays at a time: 64 paths of each fill Mitsuba's batch, spread evenly."""
_GRAZING = 0.15
_FRONT_LEAD = 0.4
"""The first camera is preferred by this much of the cosine."""
_LIGHT_LEVEL, _LIGHT_QUANTILE = 0.80, 0.98
NOISE = 0.008
"""Standard deviation of a white pixel's noise; it falls with the square root of the light."""


@dataclass(frozen=True)
class Seen:
    """Which camera (N,) sees each point, -1 for none, and the unit direction (N, 3) toward it."""

    camera: IntArray
    toward: FloatArray

    @property
    def any(self) -> BoolArray:
        """(N,) True where some camera sees the point."""
        return self.camera >= 0


def camera_positions(
    angles_deg: list[tuple[float, float]], distance_mm: float, center: FloatArray
) -> FloatArray:
    """Return (K, 3) positions around `center` (3,) for azimuths and elevations."""
    return np.array([center + distance_mm * toward(*pair) for pair in angles_deg])


def best_views(points: FloatArray, normals: FloatArray, caster: RayCaster, cameras: FloatArray) -> Seen:
    """Return who sees points (N, 3) with normals (N, 3) best: the largest cosine among free views."""
    score, chosen = np.full(len(points), _GRAZING), np.full(len(points), -1)
    direction = np.zeros_like(points)
    for k, camera in enumerate(cameras):
        view = normalized(camera - points)
        cosine = np.einsum("ij,ij->i", normals, view)
        lead = _FRONT_LEAD if k == 0 else 0.0
        better = (cosine > _GRAZING) & (cosine + lead > score)
        better[better] = ~caster.occluded((points + ABOVE_MM * view)[better], view[better])
        score[better], chosen[better], direction[better] = cosine[better] + lead, k, view[better]
    return Seen(chosen, direction)


class Studio:
    """A sitter's parts in Mitsuba.

    Parameters
    ----------
    parts : list of Part
    nearest : bool
        Look the face's texels up without interpolation, for points that are texels.
    threads : int
    """

    def __init__(self, parts: list[Part], *, nearest: bool, threads: int = 1) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        drjit.set_thread_count(threads)
        self._mi, self._dr = mitsuba, drjit
        self._shapes = {part.name: self._shape(part, nearest and part.name == "face") for part in parts}

    def _shape(self, part: Part, nearest: bool) -> Any:
        mitsuba = self._mi
        properties = mitsuba.Properties()
        properties["bsdf"] = mitsuba.load_dict(bsdf_of(part, nearest=nearest, mitsuba=mitsuba))
        return textured_mesh(mitsuba, part.vertices, part.normals, part.faces, part.uv, properties, part.name)

    def radiance(
        self, emitter: Emitter, start: FloatArray, direction: FloatArray, *, paths: int, seed: int = 0
    ) -> FloatArray:
        """Return (N, 3) the radiance along rays under one emitter, white, of strength 1."""
        mi, dr = self._mi, self._dr
        scene = mi.load_dict({"type": "scene", **self._shapes, **emitter.plugins(mi)})
        wanted = max(64, int(paths * emitter.path_factor))
        chunks = range(0, len(start), _CHUNK)
        parts = [
            trace(
                mi,
                dr,
                scene,
                start[first : first + _CHUNK],
                direction[first : first + _CHUNK],
                paths=wanted,
                depth=DEPTH,
                seed=seed + 17 * number,
                sampler="multijitter",
            )
            for number, first in enumerate(chunks)
        ]
        return np.concatenate(parts)


class LightTable:
    """Radiance of N rays under emitters, each traced once and shared between the rigs that hold it."""

    def __init__(
        self, studio: Studio, start: FloatArray, direction: FloatArray, paths: int, seed: int
    ) -> None:
        self._studio, self._rays, self._paths, self._seed = studio, (start, direction), paths, seed
        self._known: dict[Emitter, FloatArray] = {}

    def under(self, rig: Rig) -> FloatArray:
        """Return (N, 3) radiance under all parts of a rig."""
        return np.sum([part.linear * self._of(part.emitter) for part in rig.parts], axis=0)

    def _of(self, emitter: Emitter) -> FloatArray:
        if emitter not in self._known:
            seed = self._seed + 100 * len(self._known)
            self._known[emitter] = self._studio.radiance(emitter, *self._rays, paths=self._paths, seed=seed)
        return self._known[emitter]


def exposure_of(radiance: FloatArray) -> float:
    """Return the factor that puts the brightest skin (98 of 100 texels are darker) at 0.8 of white.

    >>> exposure_of(np.full((4, 3), 2.0))
    0.4
    """
    return _LIGHT_LEVEL / max(float(np.quantile(radiance.max(1), _LIGHT_QUANTILE)), 1e-9)


def stored(linear: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the linear picture decoded from 8 bits sRGB, with a sensor's noise: NOISE sqrt(light)."""
    noise = NOISE * np.sqrt(np.clip(linear, 0.01, 1)) * rng.standard_normal(linear.shape)
    return photograph(linear + noise, exposure=1.0, noise=0.0, bits=8, rng=rng).astype(np.float64)
