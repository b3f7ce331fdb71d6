"""Saturated highlights: our resynthesis beside skimage's biharmonic inpainting.

Glossy, over-exposed faces are divided by their true light, so that nothing but the clipped texels errs. Over
the texels that ours fills: "error" is the mean |A - A_true|, relative to that of leaving them as divided.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from bench.runner import Bench, Case
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.saturation import inpainted
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.synthetic import Material, SyntheticScene, face, light_at

EXPOSURES = (1.25, 1.5, 2)


@dataclass(frozen=True)
class Overexposed:
    """A scene and its texture (H, W, 3) without its true light."""

    scene: SyntheticScene
    left: FloatArray

    @cached_property
    def target(self) -> BoolArray:
        """The texels (H, W) that ours fills."""
        return (resynthesis(self) != self.left.astype(np.float32)).any(-1)


def overexposed(texture: str, exposure: float) -> Overexposed:
    scene = face(
        texture=texture,
        lights=[light_at(20, 10)],
        material=Material(specular_strength=1.0),
        exposure=exposure,
    )
    light = np.where(scene.image.mask, scene.shading, 1.0)[..., None]
    diffuse = scene.image.texture_linear / scene.gain - scene.specular[..., None]
    return Overexposed(scene, np.maximum(diffuse, 0) / light)


def cases(quick: bool) -> Iterator[Case]:
    for texture in ("skin", "wood"):
        for exposure in EXPOSURES[: 1 if quick else None]:
            yield Case(f"{texture} {exposure}", partial(overexposed, texture, exposure))


def resynthesis(scan: Overexposed) -> FloatArray:
    image = scan.scene.image
    left = scan.left.astype(np.float32)
    return inpainted(left, image, usable_texels(image), EstimateOptions(), 0)[0]


def biharmonic(scan: Overexposed) -> FloatArray:
    from skimage.restoration import inpaint_biharmonic

    return inpaint_biharmonic(scan.left, scan.target, channel_axis=-1)


def error(scan: Overexposed, filled: FloatArray) -> dict[str, float]:
    truth = scan.scene.albedo_linear
    off, off_left = (np.abs(image - truth)[scan.target].mean() for image in (filled, scan.left))
    return {"error": float(off / off_left)}


BENCH = Bench(cases, {"scan2albedo": resynthesis}, peers={"biharmonic": biharmonic}, score=error, warm=True)
