"""Frames with lenses and without, registered on masks that show lenses and on masks that do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.eyeglasses_scenes import BareFrame, Errors, khronos, photographed, synthetic, without_lenses
from scan2albedo.eyeglasses import register_on_face

EVEN = Errors(shared_mm=0.0, label_px=0.7, bias_px=0.0, wander_px=0.7)


def bench_glass(data: Path, seeds: int) -> None:
    """Print errors of the vertices and what the result calls observed, for all four combinations."""
    print(f"{'frame':12}{'mesh':>10}{'masks':>10}{'rms mm':>9}{'observed':>10}{'IoU':>7}  told")
    real = [khronos(data)] if data.is_dir() else []
    if not real:
        print(f"real sunglasses are left out: {data} is not there")
    for frame in (*real, synthetic("aviator"), synthetic("slab")):
        for mesh in (frame, without_lenses(frame)):
            for shown in (True, False):
                _row(frame, mesh, shown, seeds)


def _row(frame: BareFrame, mesh: BareFrame, shown: bool, seeds: int) -> None:
    errors, observed, iou, told = [], [], [], set()
    for seed in range(seeds):
        seen = photographed(frame, seed, errors=EVEN, glass=shown)
        given = (mesh.vertices, mesh.faces, mesh.keypoints, mesh.weights())
        found = register_on_face(given, seen.labels, list(seen.masks), seen.cameras)
        truth = seen.vertices if mesh is frame else seen.vertices[np.unique(frame.rims)]
        rims = np.unique(mesh.rims)
        errors.append(((found.vertices - truth)[rims] ** 2).sum(1).mean())
        observed.append(found.observed[rims].mean())
        iou.append(np.nanmin(found.iou))
        told |= {
            step.stage.partition(".")[2] + (": " + step.evidence if step.stage.endswith("lenses") else "")
            for step in found.plan
            if step.stage.partition(".")[2] in ("masks", "lenses", "contradicted", "misfit")
        }
    own, masks = ("lenses" if there else "none" for there in (mesh.glass.any(), shown))
    print(
        f"{frame.name:12}{own:>10}{masks:>10}"
        f"{np.sqrt(np.mean(errors)):9.3f}{np.mean(observed):10.2f}{np.min(iou):7.2f}  "
        f"{'; '.join(sorted(told))}"
    )
