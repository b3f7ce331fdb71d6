"""Cost of comparing templates, in blocks beside one pair after the other; choices on synthetic faces.

    python tools/bench_recognition.py [--templates 1000] [--plain 200] [--sizes 128 ...] [--faces 24]
    python tools/bench_recognition.py --lights | --windows | --make FOLDER [--persons 12] [--seed 101]
    python tools/bench_recognition.py --calibrate FOLDER | --pairs FOLDER ... [--cache lights_cache]

Templates of random fields. CPU time of all threads; a pair one by one is `cw_ssim`'s own arithmetic (NumPy,
running sums in float64) on finished templates. The largest difference between the two is printed too.

With --faces, that many synthetic persons are identified by their true albedo, made worse in three ways at
once as an estimate is: the chart slips smoothly, smooth light is left in it, and there is noise. `separation`
is the distance of the mean similarities, right person and others, over the root of their summed variances.

--lights: rank 1 of the six people in ../shared/data/yale, one photograph a person as gallery, by texture,
nine robust harmonics, multi-scale retinex, albedo, and fused; galleries of one lamp (all choices) and of
random lamps; no number is learned from these people, whose data are free for research only. Shares of log
odds above 0, pairs of one person and of two. --windows: the same for sizes and windows. --make: what
`CALIBRATION` is learned from: sixteen MIT-licensed heads in many lights (FOLDER/heads) and synthetic
people, processed
(FOLDER/people). --calibrate: the numbers of `CALIBRATION`, and what a calibration by one half of the heads
says of the other half. --pairs: one person or two, of all pairs of results PERSON_SCAN in a folder.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from benchmarks.lit_people import head_similarities, make_heads
from benchmarks.people_in_lights import (
    KINDS,
    Judged,
    calibrated_on,
    light_similarities,
    make_people,
    pair_similarities,
    photographs,
    rates,
    verified,
)
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from scan2albedo.recognition import (
    Calibration,
    TemplateOptions,
    Templates,
    albedo_templates,
    identify,
    roc_curve,
    similarity_matrix,
)
from scan2albedo.recognition.result_identification import CALIBRATION
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


def print_shares(judged: Judged, calibration: Calibration) -> None:
    """Print how many pairs of one person and of two have log odds above 0, by each kind and by all."""
    kinds = [kind for kind in KINDS if kind in judged.similarities and kind != "shading"]
    for name, cues in (*((kind, [kind]) for kind in kinds), ("fused", KINDS)):
        same, other, own, others = verified(judged, cues, calibration)
        print(f"  {name:10} above 0: one person {same:6.1%} of {own} pairs, two {other:6.1%} of {others}")


def bench_lights(cache: Path, windows: bool) -> None:
    rows = photographs(cache)
    people, lights = [row["person"] for row in rows], [row["light"] for row in rows]
    for size, window in [(s, w) for s in (128, 256) for w in (3, 5, 7)] if windows else ():
        found = light_similarities(rows, ("texture", "albedo"), size, window)
        shown = rates(found, people, lights, CALIBRATION)
        print(
            f"{size} pixels, window {window}: " + ", ".join(f"{k} {one:.1%}" for k, (one, _) in shown.items())
        )
    found = light_similarities(rows, ("texture", "harmonics", "retinex", "albedo", "shading"))
    print("rank 1: gallery in one lamp, in random lamps; probes of one photograph, of three")
    threes = rates(found, people, lights, CALIBRATION, together=3)
    for name, (one, mixed) in rates(found, people, lights, CALIBRATION).items():
        print(f"  {name:10} {one:6.1%} {mixed:6.1%} | {threes[name][0]:6.1%} {threes[name][1]:6.1%}")
    print_shares(Judged(found, people, [f"{k}" for k in range(len(rows))], lights), CALIBRATION)


def calibrate(folder: Path) -> None:
    sets = head_similarities(folder / "heads", False), head_similarities(folder / "heads", True)
    synthetic = pair_similarities(folder / "people")
    print(calibrated_on([*sets, synthetic]))
    heads = sorted(set(sets[0].persons))
    for learned, left in ((heads[::2], heads[1::2]), (heads[1::2], heads[::2])):
        calibration = calibrated_on([*(judged.part(learned) for judged in sets), synthetic])
        for what, judged in zip(("scans", "views"), sets, strict=True):
            print(f"{what} of {', '.join(left)}, calibrated without them")
            print_shares(judged.part(left), calibration)


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--templates", type=int, default=1000)
    parser.add_argument("--plain", type=int, default=200, help="pairs that are compared one by one")
    parser.add_argument("--sizes", type=int, nargs="+", default=[128])
    parser.add_argument("--faces", type=int, default=0, help="synthetic persons to identify")
    parser.add_argument("--lights", action="store_true", help="rank 1 over lights")
    parser.add_argument("--windows", action="store_true", help="rank 1 by size and window")
    parser.add_argument("--make", type=Path, help="folder for heads and synthetic people")
    parser.add_argument("--persons", type=int, default=12)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--calibrate", type=Path, help="folder that --make filled")
    parser.add_argument("--pairs", type=Path, nargs="+", default=[])
    parser.add_argument("--cache", type=Path, default=Path("lights_cache"), help="keeps the albedos")
    arguments = parser.parse_args()
    if arguments.make:
        make_heads(arguments.make / "heads")
        make_people(arguments.make / "people", arguments.persons, arguments.seed)
    for folder in arguments.pairs:
        print(folder)
        print_shares(pair_similarities(folder), CALIBRATION)
    if arguments.calibrate:
        calibrate(arguments.calibrate)
    if arguments.lights or arguments.windows:
        bench_lights(arguments.cache, arguments.windows)
    if arguments.make or arguments.pairs or arguments.lights or arguments.windows or arguments.calibrate:
        return
    for size in arguments.sizes:
        bench(arguments.templates, arguments.plain, size)
    if arguments.faces:
        bench_faces(arguments.faces)


if __name__ == "__main__":
    main()
