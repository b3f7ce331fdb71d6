"""Saturated highlights: our resynthesis beside leaving them and skimage's biharmonic inpainting.

Glossy, over-exposed hemispheres and faces are divided by their *true* light, so that nothing but the clipped
texels errs; `saturation.inpainted` decides and fills. Over the texels that it fills, relative to what the
true texture has, or to leaving the texels as divided:

- error: mean |A - A_true|, relative to that of leaving them;
- variance: median local variance of log V in windows of 7 x 7 texels, relative to the true texture's;
- seam: mean step of log V across the region's border, relative to the true texture's.

`--pictures` gets the region's surroundings: left, filled by each method, truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, uniform_filter

from bench.runner import Bench, Case
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.options import SATURATION_LINEAR, EstimateOptions
from scan2albedo.albedo.saturation import inpainted
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import LightingError
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at

MAKERS = {"hemisphere": hemisphere, "face": face}
TEXTURES = (("skin", 1.0), ("skin", 2.5), ("wood", 1.0))
GLOSSES = {"glossy": 0.35, "wet": 1.0}
AZIMUTHS_DEG = (20, -15, 30)
EXPOSURES = (1.3, 1.5, 1.8)
SIZES = (256, 512)


@dataclass(frozen=True)
class Scene:
    """A scene, its texture (H, W, 3) without its true light, and the texels (H, W) that ours fills."""

    scene: SyntheticScene
    left: FloatArray
    target: BoolArray
    usable: BoolArray


def ours(scene: SyntheticScene, left: FloatArray) -> tuple[FloatArray, bool]:
    usable = usable_texels(scene.image)
    filled, step = inpainted(left.astype(np.float32), scene.image, usable, EstimateOptions(), 0)
    return filled.astype(np.float64), step.ran


def overexposed(shape: str, texture: str, grain: float, size: int, gloss: str, seed: int) -> Scene:
    scene = MAKERS[shape](
        texture=texture,
        grain=grain,
        size=size,
        seed=seed,
        lights=[light_at(AZIMUTHS_DEG[seed], 10)],
        material=Material(specular_strength=GLOSSES[gloss]),
        exposure=EXPOSURES[seed],
    )
    image = scene.image
    light = np.where(image.mask, scene.shading, 1.0)[..., None]
    diffuse = image.texture_linear.astype(np.float64) / scene.gain - scene.specular[..., None]
    left = np.maximum(diffuse, 0) / light
    filled, ran = ours(scene, left)
    if not ran:
        raise LightingError("nothing is filled")
    allowed = image.seen if image.inpaint is None else image.seen & image.inpaint
    changed = (filled != left.astype(np.float32)).any(-1)
    clipped = (image.texture_linear >= SATURATION_LINEAR).any(-1)
    return Scene(scene, left, allowed & (changed | clipped), usable_texels(image))


def cases(quick: bool) -> Iterator[Case]:
    for size, shape, (texture, grain) in product(SIZES[:1] if quick else SIZES, MAKERS, TEXTURES):
        for gloss, seed in product(GLOSSES, range(1 if quick else 3)):
            name = f"{shape} {texture} {grain:g} {size} {gloss} {seed}"
            yield Case(name, partial(overexposed, shape, texture, grain, size, gloss, seed))


def biharmonic(scene: Scene) -> FloatArray:
    from skimage.restoration import inpaint_biharmonic

    return inpaint_biharmonic(scene.left, scene.target, channel_axis=-1)


def log_value(image: FloatArray) -> FloatArray:
    return np.log(np.maximum(image.max(-1), 1e-4))


def local_variance(image: FloatArray, target: BoolArray, window: int = 7) -> float:
    """Return the median variance of log V over windows that lie in `target` wholly (or its inmost texels)."""
    value = log_value(image)
    variance = uniform_filter(value**2, window) - uniform_filter(value, window) ** 2
    inner = binary_erosion(target, np.ones((window, window)))
    return float(np.median(variance[inner if inner.any() else target]))


def seam(image: FloatArray, target: BoolArray, usable: BoolArray) -> float:
    """Return the mean |step| of log V between filled texels and usable ones beside them."""
    value = log_value(image)
    either = target | usable
    steps = []
    for axis in (0, 1):
        first, second = (np.take(either, range(end, either.shape[axis] - 1 + end), axis) for end in (0, 1))
        border = (np.diff(target.astype(np.int8), axis=axis) != 0) & first & second
        steps.append(np.abs(np.diff(value, axis=axis))[border])
    return float(np.concatenate(steps).mean())


def figures(scene: Scene, filled: FloatArray) -> dict[str, float]:
    truth = scene.scene.albedo_linear.astype(np.float64)
    target = scene.target
    off, off_left = (np.abs(image - truth)[target].mean() for image in (filled, scene.left))
    return {
        "error": float(off / off_left),
        "variance": local_variance(filled, target) / local_variance(truth, target),
        "seam": seam(filled, target, scene.usable) / seam(truth, target, scene.usable),
        "texels": float(target.sum()),
    }


def close_up(scene: Scene, answers: Mapping[str, Any]) -> NDArray[np.uint8]:
    truth = scene.scene.albedo_linear.astype(np.float64)
    rows, columns = (np.nonzero(scene.target.any(axis))[0] for axis in (1, 0))
    window = tuple(slice(max(0, at[0] - 20), at[-1] + 20) for at in (rows, columns))
    joined = np.concatenate([image[window] for image in (scene.left, *answers.values(), truth)], axis=1)
    return encode_srgb_bytes(np.clip(joined / np.quantile(truth[window], 0.995), 0, 1))


BENCH = Bench(
    cases,
    methods={"scan2albedo": lambda scene: ours(scene.scene, scene.left)[0]},
    peers={"biharmonic": biharmonic},
    score=figures,
    picture=close_up,
)
