"""Albedo error on the path-traced set, beside simple peers: images with exact shape, and raw scans.

    S2A_TRACED=FOLDER python tools/bench_traced.py [--set images|scans] [--only NAME ...] [--peers slow]

FOLDER is made by tools/build_traced_scans.py. A row a scene: 100 x MSE after the best single scale, on V and
on colour, of the texture as it is, divided by ambient occlusion, by nine harmonics (SH), by the same with the
face's own shadows, and ours; outlines in the albedo that the photograph lacks (share, and mean excess in log
units); lamps found of all lamps (of those with hard shadows); CPU seconds; parts of the texels that err by
less than `expected_error`, and than twice that. A dash marks what failed. Texels
that got less than 3 % of the median light do not count. `--peers slow` adds the paper's objective and inverse
rendering by Mitsuba's gradients (one lamp and an environment of 24 directions; needs `mitsuba` and libLLVM).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.albedo_peers_slow import DescentOptions, mitsuba_inverse
from benchmarks.traced_set import (
    DIMMEST,
    VARIABLE,
    AlbedoScore,
    InventedOutlines,
    ScanTruth,
    calibration,
    invented_outlines,
    judged_scan,
    load_image,
    scene_names,
    score,
    simple_peers,
    traced_folder,
)

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
) -> Row:
    """Return the row of an estimate, beside `slow` peers too if asked for."""
    ours = np.asarray(estimate.albedo_linear, np.float64)
    peers = simple_peers(image) | (slow_peers(image) if slow else {})
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


def image_row(folder: Path, name: str, slow: bool) -> Row:
    """Estimate the albedo of a geometry image."""
    scene = load_image(folder, name)
    start = time.process_time()
    estimate = s2a.estimate_albedo(scene.image, seed=0)
    cpu_s = time.process_time() - start
    hard = sum(lamp["hard"] for lamp in scene.lamps)
    lamps = f"{len(estimate.lights)} of {len(scene.lamps)} ({hard})"
    truth, judged = scene.albedo_linear, scene.judged
    return scored(name, scene.image, estimate, truth, judged, lamps=lamps, cpu_s=cpu_s, slow=slow)


def scan_row(folder: Path, name: str, slow: bool) -> Row:
    """Process a raw scan."""
    truth = ScanTruth.read(folder, name)
    with tempfile.TemporaryDirectory() as out:
        start = time.process_time()
        result = s2a.process(folder / f"{name}.obj", out, seed=0)
        cpu_s = time.process_time() - start
    judged = judged_scan(result, truth)
    lamps = f"{len(result.albedo.lights)} of {len(truth.light_directions)}"
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


def rows(folder: Path, kinds: tuple[str, ...], only: list[str], slow: bool) -> Iterator[Row | str]:
    """Yield a row a scene, or what went wrong with it."""
    make = {"images": image_row, "scans": scan_row}
    for kind in kinds:
        for name in scene_names(folder, kind):
            if only and name not in only:
                continue
            try:
                yield make[kind](folder, name, slow)
            except Scan2AlbedoError as error:
                yield f"{name:26} - {error}"


def line(row: Row) -> str:
    """Return a row as text."""
    on_value = " ".join(f"{s.value_percent:7.2f}" for s in row.scores.values())
    on_color = " ".join(f"{s.color_percent:7.2f}" for s in row.scores.values())
    found = f"{row.outlines.share:5.0%} {row.outlines.mean_excess:5.3f} of {row.outlines.edges:5d}"
    said = " ".join(f"{part:4.2f}" for part in row.said)
    cost = f"{row.cpu_s:5.1f} s | {said} {row.note}"
    return f"{row.name:26}{on_value} |{on_color} | {found} | {row.lamps:10} | {cost}"


def heading(slow: bool) -> str:
    """Return the table's first line."""
    peers = ("as is", "AO", "SH", "SH+sh.", *(("paper's", "Mitsuba") if slow else ()), OURS)
    methods = " ".join(f"{name[:7]:>7}" for name in peers)
    last = f"{'invented outlines':>20} | {'lamps':10} | {'CPU':7} | as said"
    return f"{'V % | colour %':26}{methods} |{methods} | {last}"


def summary(done: list[Row]) -> str:
    """Return mean and worst of all scenes."""
    lines = []
    for title, reduce in (("mean", np.mean), ("worst", np.max)):
        of = [
            [float(reduce([getattr(row.scores[m], kind) for row in done])) for m in done[0].scores]
            for kind in ("value_percent", "color_percent")
        ]
        value, color = (" ".join(f"{x:7.2f}" for x in numbers) for numbers in of)
        share = float(reduce([row.outlines.share for row in done]))
        excess = float(reduce([row.outlines.mean_excess for row in done]))
        cpu_s = float(reduce([row.cpu_s for row in done]))
        lines.append(
            f"{title:26}{value} |{color} | {share:5.0%} {excess:5.3f}{'':9} | {'':10} | {cpu_s:5.1f} s"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--set", choices=("images", "scans"), help="both when omitted")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes")
    parser.add_argument("--peers", choices=["slow"], help="the paper's objective and Mitsuba's gradients too")
    arguments = parser.parse_args()
    folder, slow = traced_folder(), arguments.peers == "slow"
    if folder is None:
        raise SystemExit(f"{VARIABLE} names no folder with scenes; tools/build_traced_scans.py makes one")
    for kind in (arguments.set,) if arguments.set else ("images", "scans"):
        print(heading(slow), flush=True)
        done = []
        for row in rows(folder, (kind,), arguments.only, slow):
            print(line(row) if isinstance(row, Row) else row, flush=True)
            done += [row] if isinstance(row, Row) else []
        if done:
            print(summary(done))


if __name__ == "__main__":
    main()
