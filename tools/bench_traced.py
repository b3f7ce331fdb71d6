"""Albedo error on scenes whose albedo is known, beside simple peers: people's skin before painted heads.

    S2A_TRACED=FOLDER python tools/bench_traced.py [--set skin|flashes|scans|images] [--only NAME ...]
        [--peers slow]

FOLDER holds raw scans with photographed skin, path-traced (`skin`; ../shared/data/real_skin), photographs of
people under single flashes (`flashes`; Extended Yale B, ../shared/data/yale), or what
`python tools/worlds` makes of painted heads: raw scans and images with exact shape. A row a scene.
Errors are in percent, after the best single scale, on V = max(R, G, B):

- relative RMSE of the texture as it is, divided by ambient occlusion, by nine harmonics (SH), by the same
  with the face's own shadows, and of ours;
- what half of the texels and 95 in 100 err by at most, each of its own albedo: of the texture, of ours;
- relative RMSE of colour, and 100 x MSE of V, the paper's figure: of the texture, of ours;
- parts of the texels that err by less than `expected_error`, and than twice that; outlines in the albedo that
  the photograph lacks (share, and mean excess in log units); lamps found of all lamps; CPU seconds.

Texels that got less than 3 % of the median light do not count; under single flashes those count that the
flash explains to a quarter. `--peers slow` adds the paper's objective and inverse rendering by Mitsuba's
gradients (one lamp and an environment of 24 directions; needs `mitsuba` and libLLVM).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.judging import (
    DIMMEST,
    PATTERNS,
    VARIABLE,
    AlbedoScore,
    InventedOutlines,
    Received,
    ScanTruth,
    TracedImage,
    calibration,
    invented_outlines,
    judged_scan,
    load_flashes,
    load_image,
    received,
    scene_names,
    score,
    simple_peers,
    traced_folder,
)
from benchmarks.albedo_peers_slow import DescentOptions, mitsuba_inverse

import scan2albedo as s2a
from scan2albedo.albedo import AlbedoEstimate, EstimateOptions
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import Scan2AlbedoError

OURS = "ours"
PAPER = EstimateOptions(objective="albedo-deviation")
RENDERED = DescentOptions(environment=24, trial_steps=60, steps=300)


@dataclass(frozen=True)
class Row:
    """One scene: scores by method, outlines, lamps as text, CPU seconds, and what else there is to say.

    `said` is what parts of the texels err by less than `expected_error`, and than twice that.
    """

    name: str
    scores: dict[str, AlbedoScore]
    outlines: InventedOutlines
    lamps: str
    cpu_s: float
    said: tuple[float, float]
    note: str = ""


def slow_peers(image: s2a.GeometryImage) -> dict[str, FloatArray]:
    """Return albedos (H, W, 3) by name: of the paper's objective, and of inverse rendering on V."""
    assert image.texture_linear is not None
    texture = np.asarray(image.texture_linear, np.float64)
    rendered = mitsuba_inverse(image, 1, RENDERED).albedo_value
    light = np.where(rendered > 0, texture.max(2) / np.maximum(rendered, 1e-9), 0.0)
    # As much darkness as the other peers may divide by.
    light = np.maximum(light, DIMMEST * np.median(light[image.mask]))
    paper = s2a.estimate_albedo(image, seed=0, options=PAPER).albedo_linear.astype(np.float64)
    return {"paper's": paper, "Mitsuba": texture / light[..., None]}


def scored(
    name: str,
    image: s2a.GeometryImage,
    estimate: AlbedoEstimate,
    truth: FloatArray,
    judged: BoolArray,
    *,
    lamps: str,
    cpu_s: float,
    slow: bool,
    note: str = "",
    light: Received | None = None,
) -> Row:
    """Return the row of an estimate, beside `slow` peers too if asked for; `light` saves the peers' rays."""
    ours = np.asarray(estimate.albedo_linear, np.float64)
    peers = simple_peers(image, light) | (slow_peers(image) if slow else {})
    scores = {peer: score(albedo, truth, judged) for peer, albedo in peers.items()}
    shading = np.asarray(estimate.shading, np.float64)
    outlines = invented_outlines(
        np.asarray(image.texture_linear, np.float64).max(2),
        shading.max(2) if shading.ndim == 3 else shading,
        ours.max(2),
        image.mask,
    )
    assert estimate.expected_error is not None
    said = calibration(ours.max(2), truth.max(2), estimate.expected_error, judged)
    return Row(name, scores | {OURS: score(ours, truth, judged)}, outlines, lamps, cpu_s, said, note)


def image_row(scene: TracedImage, slow: bool, light: Received | None = None) -> Row:
    """Estimate the albedo of a geometry image."""
    start = time.process_time()
    estimate = s2a.estimate_albedo(scene.image, seed=0)
    cpu_s = time.process_time() - start
    return scored(
        scene.name,
        scene.image,
        estimate,
        scene.albedo_linear,
        scene.judged,
        lamps=f"{len(estimate.lights)} of {len(scene.lamps)}",
        cpu_s=cpu_s,
        slow=slow,
        light=light,
    )


def scan_row(folder: Path, name: str, slow: bool) -> Row:
    """Process a raw scan."""
    truth = ScanTruth.read(folder, name)
    with tempfile.TemporaryDirectory() as out:
        start = time.process_time()
        result = s2a.process(folder / f"{name}.obj", out, seed=0)
        cpu_s = time.process_time() - start
    judged = judged_scan(result, truth)
    lamps = f"{len(result.albedo.lights)} of {truth.lamps}"
    note = f"surface {judged.surface_mm:.2f} mm"
    return scored(
        name,
        result.geometry_image,
        result.albedo,
        judged.albedo_linear,
        judged.judged,
        lamps=lamps,
        cpu_s=cpu_s,
        slow=slow,
        note=note,
    )


def rows(folder: Path, kind: str, only: list[str], slow: bool) -> Iterator[Row | str]:
    """Yield a row a scene, or what went wrong with it."""
    for name in scene_names(folder, kind):
        if only and name not in only:
            continue
        try:
            if kind == "flashes":
                light = None
                for scene in load_flashes(folder, name):
                    # All photographs of a person have one shape.
                    light = light or received(scene.image)
                    yield image_row(scene, slow, light)
            elif kind == "images":
                yield image_row(load_image(folder, name), slow)
            else:
                yield scan_row(folder, name, slow)
        except Scan2AlbedoError as error:
            yield f"{name:22} - {error}"


def line(name: str, numbers: list[float], last: str = "") -> str:
    """Return a row as text; the last of its numbers are `said`, outlines and CPU seconds."""
    *errors, mse_before, mse_after, said, twice, share, excess, cpu_s = numbers
    found = f"{said:.2f} {twice:.2f} | {share:4.0%} {excess:5.3f} | {cpu_s:5.1f} s"
    return (
        f"{name:22}"
        + "".join(f"{x:7.1f}" for x in errors)
        + f"{mse_before:8.2f}{mse_after:7.2f} | {found}{last}"
    )


def numbers_of(row: Row) -> list[float]:
    """Return the numbers of a row in the order of the heading."""
    before, after = row.scores["as is"], row.scores[OURS]
    pairs = [(getattr(before, key), getattr(after, key)) for key in ("half", "most", "color_rmse", "mse")]
    return [
        *(each.rmse for each in row.scores.values()),
        *(number for pair in pairs for number in pair),
        *row.said,
        row.outlines.share,
        row.outlines.mean_excess,
        row.cpu_s,
    ]


def heading(slow: bool) -> str:
    """Return the table's first line."""
    peers = ("RMSE %", "AO", "SH", "SH+sh.", *(("paper's", "Mitsuba") if slow else ()), OURS)
    pairs = ("50 %", OURS, "95 %", OURS, "colour", OURS)
    columns = "".join(f"{name:>7}" for name in (*peers, *pairs))
    return f"{'':22}{columns}{'MSE':>8}{OURS:>7} | {'as said':9} | {'outlines':10} | {'CPU':7} | lamps"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--set", choices=tuple(PATTERNS), help="all that are there when omitted")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes, or of people")
    parser.add_argument("--peers", choices=["slow"], help="the paper's objective and Mitsuba's gradients too")
    arguments = parser.parse_args()
    folder, slow = traced_folder(), arguments.peers == "slow"
    if folder is None:
        raise SystemExit(f"{VARIABLE} names no folder with scenes; `python tools/worlds` makes one")
    failed = []
    for kind in (arguments.set,) if arguments.set else tuple(PATTERNS):
        done = []
        for row in rows(folder, kind, arguments.only, slow):
            if not done:
                print(heading(slow), flush=True)
            if isinstance(row, Row):
                print(line(row.name, numbers_of(row), f" | {row.lamps} {row.note}"), flush=True)
                done.append(numbers_of(row))
            else:
                print(row, flush=True)
                failed.append(row)
        for title, reduce in (("least", np.min), ("mean", np.mean), ("worst", np.max)):
            if done:
                print(line(title, [float(number) for number in reduce(done, axis=0)]))
    if failed:
        raise SystemExit(f"{len(failed)} scenes are not in these means")


if __name__ == "__main__":
    main()
