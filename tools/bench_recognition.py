"""Cost of comparing templates, in blocks beside one pair after the other; choices on synthetic faces.

    python tools/bench_recognition.py [--templates 1000] [--plain 200] [--sizes 128 ...] [--faces 24]

Templates of random fields. CPU time of all threads; a pair one by one is `cw_ssim`'s own arithmetic (NumPy,
running sums in float64) on finished templates. The largest difference between the two is printed too.

With --faces, that many synthetic persons are identified by their true albedo, made worse in three ways at
once as an estimate is: the chart slips smoothly, smooth light is left in it, and there is noise. `separation`
is the distance of the mean similarities, right person and others, over the root of their summed variances.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from scan2albedo.recognition import (
    TemplateOptions,
    Templates,
    albedo_templates,
    identify,
    roc_curve,
    similarity_matrix,
)
from scan2albedo.recognition.similarity import pair_similarity
from scan2albedo.synthetic import face

BAR_S = 60.0
"""CPU seconds that 1,000 probes against 1,000 templates may take."""


def random_fields(count: int, size: int) -> NDArray[np.float64]:
    """Return fields (count, size, size) within [0.1, 0.9] whose amplitude falls with frequency."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size))
    frequency[0, 0] = np.inf
    noise = np.random.default_rng(0).standard_normal((count, size, size))
    fields = np.fft.ifft2(np.fft.fft2(noise) / frequency).real
    low, high = (f(axis=(1, 2), keepdims=True) for f in (fields.min, fields.max))
    return 0.1 + 0.8 * (fields - low) / (high - low)


def one_by_one(templates: Templates, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the similarity of each pair (N, 2)."""
    held, weight = templates.coefficients, templates.weight
    return np.array([pair_similarity(held[i], weight[i], held[j], weight[j]) for i, j in pairs])


def bench(count: int, plain: int, size: int) -> None:
    fields = random_fields(count, size)
    albedo_templates(
        fields[:1], ["0"], options=TemplateOptions(size=size)
    )  # loads the library, makes the filters
    start = time.process_time()
    templates = albedo_templates(fields, [str(k) for k in range(count)], options=TemplateOptions(size=size))
    made = time.process_time() - start
    similarity_matrix(templates.select([0]), templates.select([0]))
    start, start_wall = time.process_time(), time.perf_counter()
    matrix = similarity_matrix(templates, templates)
    blocks, wall = time.process_time() - start, time.perf_counter() - start_wall
    pairs = np.random.default_rng(1).integers(count, size=(plain, 2))
    start = time.process_time()
    values = one_by_one(templates, pairs)
    single = (time.process_time() - start) / plain
    pair = blocks / count**2
    difference = np.abs(values - matrix[pairs[:, 0], pairs[:, 1]]).max()
    print(
        f"{size} pixels, {templates.mask.shape[1]} coefficients a side, {count} x {count} templates:\n"
        f"  making one          {1e3 * made / count:9.2f} ms\n"
        f"  a pair, in blocks   {1e6 * pair:9.2f} us ({blocks:.1f} s CPU, {wall:.1f} s wall in all; "
        f"1,000 x 1,000: {1e6 * pair:.1f} s, bar {BAR_S:.0f} s)\n"
        f"  a pair, one by one  {1e6 * single:9.2f} us "
        f"({single / pair:.0f} times; difference {difference:.1e})"
    )


def worsened(
    albedo: NDArray[np.float64], mask: NDArray[np.bool_], slip: float, light: float, noise: float, seed: int
) -> NDArray[np.float64]:
    """Return an albedo (H, W, 3) that slips by so many pixels rms, with so much light and noise in it."""
    random = np.random.default_rng(seed)
    side = len(albedo)

    def smooth(width: float, deviation: float) -> NDArray[np.float64]:
        field = gaussian_filter(random.standard_normal((side, side)), width * side, mode="wrap")
        return deviation * field / field.std()

    places = np.mgrid[:side, :side] + np.stack([smooth(0.1, slip), smooth(0.1, slip)])
    filled = np.where(mask[..., None], albedo, albedo[mask].mean(axis=0))
    moved = np.stack(
        [map_coordinates(filled[..., k], places, order=1, mode="nearest") for k in range(3)], axis=2
    )
    return moved * np.exp(smooth(0.15, light))[..., None] + noise * random.standard_normal(moved.shape)


def bench_faces(count: int, side: int = 256) -> None:
    scenes = [face(k, size=side) for k in range(count)]
    names, masks = [str(k) for k in range(count)], [scene.image.mask for scene in scenes]
    albedos = [scene.albedo_linear.astype(np.float64) for scene in scenes]
    print(f"{count} synthetic persons at {side} pixels: rank 1, equal error rate, separation")
    for slip, light, noise in ((1, 0.15, 0.02), (2, 0.25, 0.04), (3, 0.3, 0.06)):
        seen = [
            worsened(a, m, slip, light, noise, k) for k, (a, m) in enumerate(zip(albedos, masks, strict=True))
        ]
        for size in (64, 128, 256):
            for channel in ("value", "luminance"):
                options = TemplateOptions(size=size)
                gallery, probes = (
                    albedo_templates(
                        [x.max(2) for x in images] if channel == "value" else images,
                        names,
                        masks=masks,
                        options=options,
                    )
                    for images in (albedos, seen)
                )
                found = identify(gallery, probes)
                own, others = found.similarities[found.genuine], found.similarities[~found.genuine]
                separation = (own.mean() - others.mean()) / np.hypot(own.std(), others.std())
                error = roc_curve(found, resamples=0).equal_error_rate
                print(
                    f"  slip {slip} px, light {light:.0%}, noise {noise:.0%}, size {size:3}, {channel:9}: "
                    f"{found.rate():6.1%} {error:6.1%} {separation:5.2f}"
                )


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--templates", type=int, default=1000)
    parser.add_argument("--plain", type=int, default=200, help="pairs that are compared one by one")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128])
    parser.add_argument("--faces", type=int, default=0, help="synthetic persons to identify")
    arguments = parser.parse_args()
    for size in arguments.sizes:
        bench(arguments.templates, arguments.plain, size)
    if arguments.faces:
        bench_faces(arguments.faces)


if __name__ == "__main__":
    main()
