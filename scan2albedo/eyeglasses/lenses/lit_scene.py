"""Colours of a scene under distant lights, with shadows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.lenses.inserted_lenses import InsertedLens
from scan2albedo.eyeglasses.lenses.lens_scene import LensScene
from scan2albedo.eyeglasses.lenses.light_kernels import shade
from scan2albedo.eyeglasses.lenses.light_paths import all_at_once, light_paths, pixel_stages
from scan2albedo.eyeglasses.lenses.traced_rays import Illumination, RayColors, SceneRays, Surroundings
from scan2albedo.geometry.rays import blocks, each_block

_MATTE = (0.0, 0.0, 1.0)
"""Roughness, highlight and exponent of painted tints."""
_BLOCK = 2**14


@dataclass(frozen=True)
class LitSamples:
    """N rays, M of which meet a surface: all that their colours depend on but for the light."""

    count: int
    """N"""
    ray: IntArray
    """(M,)"""
    normal: FloatArray
    """(M, 3)"""
    toward_viewer: FloatArray
    """(M, 3)"""
    albedo: FloatArray
    """(M, 3)"""
    surface: IntArray
    """(M,) row in the scene's table of glosses."""
    paths: NDArray[np.uint8]
    """(M, K) as from `light_paths`."""
    surroundings: Surroundings
    scene: LitScene

    @property
    def unknown(self) -> BoolArray:
        """(N,) nowhere is the colour a guess."""
        return np.zeros(self.count, bool)

    def colors(self, light: Illumination) -> RayColors:
        """Return the colours in a light."""
        bare, shaded = np.empty((2, len(self.ray), 3))

        def work(part: slice) -> None:
            shade(
                self.normal[part],
                self.toward_viewer[part],
                self.albedo[part],
                self.surface[part],
                self.scene.gloss,
                self.paths[part],
                self.scene.passed,
                self.scene.toward,
                light.irradiance_linear,
                bare[part],
                shaded[part],
            )

        each_block(work, blocks(len(self.ray), _BLOCK))
        return RayColors(self._placed(bare, light), self._placed(shaded, light))

    def _placed(self, of_hits: FloatArray, light: Illumination) -> FloatArray:
        colors = np.zeros((self.count, 3))
        colors[self.ray] = of_hits
        self.surroundings.add(colors, light)
        return colors


class LitScene:
    """A scene under K distant lights in the unit directions `toward` (K, 3).

        radiance = sum over lights k of E_k V_k (albedo f_d / pi + specular f_s)

    with visibility V from rays, f_d of Oren and Nayar and f_s of Phong. Lenses take their share of light that
    passes them on its way to a surface, but do not bend it. With `background` the environment is seen past
    all surfaces, not only in mirrors; with `every_pixel` each pixel shoots shadow rays of its own.
    """

    def __init__(
        self,
        scene: LensScene,
        lenses: Sequence[InsertedLens],
        toward: FloatArray,
        *,
        background: bool,
        offset_mm: float,
        every_pixel: bool,
    ) -> None:
        self._scene, self._background, self._every_pixel = scene, background, every_pixel
        self._dimming = [lens for lens in lenses if not lens.material.clear]
        self.toward = np.ascontiguousarray(toward)
        self.gloss = np.array([[s.roughness_rad, s.specular, s.shininess] for s in scene.surfaces] + [_MATTE])
        self.passed = _passed(self._dimming)
        self._paths = partial(light_paths, scene.caster, toward=self.toward, offset_mm=offset_mm)

    def straight(self, pixels: FloatArray, rays: SceneRays) -> LitSamples:
        """Look at straight rays through pixels (N, 2)."""
        return self._samples(rays, self._background, pixels)

    def seen(self, rays: SceneRays) -> LitSamples:
        """Look at rays behind a lens."""
        return self._samples(rays, self._background)

    def mirrored(self, rays: SceneRays) -> LitSamples:
        """Look at rays that a lens mirrors."""
        return self._samples(rays, True)

    def matte(self, position: FloatArray, normal: FloatArray, albedo: FloatArray) -> LitSamples:
        """Look at a matte plate."""
        count = len(position)
        paths = self._paths((), position, normal, stages=all_at_once(count))
        gloss = np.full(count, len(self.gloss) - 1)
        colors = np.tile(np.asarray(albedo, np.float64), (count, 1))
        return LitSamples(
            count, np.arange(count), normal, normal, colors, gloss, paths, Surroundings.none(), self
        )

    def _samples(self, rays: SceneRays, around: bool, pixels: FloatArray | None = None) -> LitSamples:
        hit = np.flatnonzero(rays.hits.face >= 0)
        on = rays.chosen(hit)
        points = self._scene.points(on.origins, on.directions, on.hits)
        shared = None if self._every_pixel else pixels
        stages = all_at_once(len(hit)) if shared is None else pixel_stages(shared[hit], points)
        paths = self._paths(self._dimming, points.position, points.normal, stages=stages)
        return LitSamples(
            len(rays.origins),
            hit,
            points.normal,
            points.toward_viewer,
            self._scene.albedo(points),
            points.surface,
            paths,
            Surroundings.of(rays) if around else Surroundings.none(),
            self,
        )


def _passed(lenses: Sequence[InsertedLens]) -> FloatArray:
    """Return (2^L, 3) shares of light for each set of lenses, numbered by the sum of 2^j."""
    passed = np.ones((1, 3))
    for lens in lenses:
        passed = np.concatenate([passed, passed * lens.material.transmission])
    return passed
