"""Saturated highlights: our resynthesis beside leaving them and skimage's biharmonic inpainting.

    python tools/bench_inpainting.py [--sizes 256 512] [--seeds 3] [--out DIR]

Glossy, over-exposed hemispheres and faces are divided by their *true* light, so that nothing but the clipped
texels errs; `saturation.inpainted` decides and fills. Printed for every scene, over the texels it filled:

- error: mean |A - A_true|, relative to that of leaving them as divided;
- variance: median local variance of log V in windows of 7 x 7 texels, relative to the true texture's;
- seam: mean step of log V across the region's border, relative to the true texture's;
- milliseconds for a thousand texels of the filling alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion, uniform_filter
from skimage.restoration import inpaint_biharmonic

from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.options import SATURATION_LINEAR, EstimateOptions
from scan2albedo.albedo.saturation import inpainted
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at

MAKERS = {"hemisphere": hemisphere, "face": face}
TEXTURES = (("skin", 1.0), ("skin", 2.5), ("wood", 1.0))
GLOSSES = {"glossy": 0.35, "wet": 1.0}
OPTIONS = EstimateOptions()


@dataclass(frozen=True)
class Filled:
    """What each method made of the same `target`."""

    target: BoolArray
    lost: BoolArray
    usable: BoolArray
    truth: FloatArray
    left: FloatArray
    ours: FloatArray
    biharmonic: FloatArray
    ours_s: float
    biharmonic_s: float


def glossy_scene(shape: str, texture: str, grain: float, size: int, seed: int, gloss: str) -> SyntheticScene:
    azimuth = (20, -15, 30)[seed % 3]
    return MAKERS[shape](
        texture=texture,
        grain=grain,
        size=size,
        seed=seed,
        lights=[light_at(azimuth, 10)],
        material=Material(specular_strength=GLOSSES[gloss]),
        exposure=(1.3, 1.5, 1.8)[seed % 3],
    )


def divided_by_true_light(scene: SyntheticScene) -> FloatArray:
    """Return (H, W, 3) the texture without its true light: exact wherever nothing is clipped."""
    assert scene.image.texture_linear is not None
    light = np.where(scene.image.mask, scene.shading, 1.0)[..., None]
    texture = scene.image.texture_linear.astype(np.float64) / scene.gain
    return np.maximum(texture - scene.specular[..., None], 0) / light


def fill(scene: SyntheticScene, seed: int = 0) -> Filled | None:
    """Return the region that `saturation.inpainted` chose, filled by every method; None without a region."""
    left = divided_by_true_light(scene)
    usable = usable_texels(scene.image)
    finished, step = inpainted(left.astype(np.float32), scene.image, usable, OPTIONS, seed)
    if not step.ran:
        return None
    target = allowed_texels(scene) & ~(finished == left.astype(np.float32)).all(-1)
    clipped = scene.image.texture_linear >= SATURATION_LINEAR
    target |= allowed_texels(scene) & clipped.any(-1)
    start = time.perf_counter()
    inpainted(left.astype(np.float32), scene.image, usable, OPTIONS, seed)
    middle = time.perf_counter()
    biharmonic = inpaint_biharmonic(left, target, channel_axis=-1)
    return Filled(
        target,
        target & clipped.all(-1),
        usable,
        scene.albedo_linear.astype(np.float64),
        left,
        finished.astype(np.float64),
        biharmonic,
        middle - start,
        time.perf_counter() - middle,
    )


def allowed_texels(scene: SyntheticScene) -> BoolArray:
    return scene.image.seen if scene.image.inpaint is None else scene.image.seen & scene.image.inpaint


def error(image: FloatArray, filled: Filled) -> float:
    return float(np.abs(image - filled.truth)[filled.target].mean())


def local_variance(image: FloatArray, target: BoolArray, window: int = 7) -> float:
    """Return the median variance of log V over windows that lie in `target` wholly (or its inmost texels)."""
    value = np.log(np.maximum(image.max(-1), 1e-4))
    variance = uniform_filter(value**2, window) - uniform_filter(value, window) ** 2
    inner = binary_erosion(target, np.ones((window, window)))
    return float(np.median(variance[inner if inner.any() else target]))


def seam(image: FloatArray, filled: Filled) -> float:
    """Return the mean |step| of log V between filled texels and usable ones beside them."""
    value = np.log(np.maximum(image.max(-1), 1e-4))
    either = filled.target | filled.usable
    steps = []
    for axis in (0, 1):
        first, second = (np.take(either, range(end, either.shape[axis] - 1 + end), axis) for end in (0, 1))
        border = (np.diff(filled.target.astype(np.int8), axis=axis) != 0) & first & second
        steps.append(np.abs(np.diff(value, axis=axis))[border])
    return float(np.concatenate(steps).mean())


def scenes(sizes: list[int], seeds: int) -> Iterator[tuple[str, SyntheticScene]]:
    for size in sizes:
        for shape in MAKERS:
            for texture, grain in TEXTURES:
                for gloss, seed in product(GLOSSES, range(seeds)):
                    name = f"{shape} {texture} {grain:g} {size} {gloss} {seed}"
                    yield name, glossy_scene(shape, texture, grain, size, seed, gloss)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="folder for pictures: left, ours, biharmonic, truth")
    arguments = parser.parse_args()
    print(f"{'scene':36} texels  lost  error/left      variance/true   seam/true       ms per 1000")
    print(f"{'':36}               ours  biharm    ours  biharm    ours  biharm    ours  biharm")
    for name, scene in scenes(arguments.sizes, arguments.seeds):
        filled = fill(scene)
        if filled is None:
            print(f"{name:36} nothing filled")
            continue
        print(f"{name:36} {_row(filled)}", flush=True)
        if arguments.out:
            _picture(filled, arguments.out / f"{name.replace(' ', '_')}.png")


def _row(filled: Filled) -> str:
    target, methods = filled.target, (filled.ours, filled.biharmonic)
    thousands = target.sum() / 1000
    columns = [
        [error(image, filled) / error(filled.left, filled) for image in methods],
        [local_variance(image, target) / local_variance(filled.truth, target) for image in methods],
        [seam(image, filled) / seam(filled.truth, filled) for image in methods],
        [1000 * seconds / thousands for seconds in (filled.ours_s, filled.biharmonic_s)],
    ]
    return f"{int(target.sum()):6d} {int(filled.lost.sum()):5d}  " + "  ".join(
        f"{ours:7.3f} {other:7.3f}" for ours, other in columns
    )


def _picture(filled: Filled, path: Path) -> None:
    """Write the region's surroundings, enlarged: left, ours, biharmonic, truth side by side."""
    from PIL import Image

    rows, columns = (np.nonzero(filled.target.any(axis))[0] for axis in (1, 0))
    window = tuple(slice(max(0, at[0] - 20), at[-1] + 20) for at in (rows, columns))
    pictures = [image[window] for image in (filled.left, filled.ours, filled.biharmonic, filled.truth)]
    joined = np.concatenate(pictures, axis=1) / np.quantile(filled.truth[window], 0.995)
    encoded = (255 * np.clip(joined, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    factor = max(1, 1600 // encoded.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(encoded.repeat(factor, 0).repeat(factor, 1)).save(path)


if __name__ == "__main__":
    main()
