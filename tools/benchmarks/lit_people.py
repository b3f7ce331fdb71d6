"""Similarities of sixteen MIT-licensed heads (`worlds.lit_heads`), for the calibration of recognition."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from worlds.files import face_data
from worlds.lit_heads import SCAN_LIGHTS, VIEW_LIGHTS, VIEWED, head, photographed, scanned

from benchmarks.people_in_lights import Judged
from scan2albedo import estimate_albedo
from scan2albedo.core.arrays import FloatArray
from scan2albedo.recognition import albedo_templates, certainty, shape_templates, similarity_matrix
from scan2albedo.recognition.templates import Kind


def make_heads(folder: Path) -> None:
    """Write what `estimate_albedo` makes of all heads: HEAD_SITTING_LIGHT.npz; those there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    files = face_data("heads/White_M_1.obj").parent.glob("*.obj")
    for name in sorted(file.stem for file in files):
        sitting, view = head(name)
        for k, lights in (("0", SCAN_LIGHTS[0]), ("1", SCAN_LIGHTS[1]), (VIEWED, VIEW_LIGHTS)):
            left = [light for light in lights if not (folder / f"{name}_{k}_{light}.npz").is_file()]
            if not left:
                continue
            if k == VIEWED:
                image, surface, places, albedo = view()
            else:
                scan, surface, surface_from_scan = sitting(int(k))
                image, places = scanned(scan, surface, surface_from_scan)
                assert image.texture_linear is not None
                albedo = image.texture_linear[image.seen].astype(float)
            seen = image.mask if k == VIEWED else image.seen
            for light in left:
                colours = photographed(surface, *places, albedo, light, list(name.encode()))
                texture = np.zeros((*image.shape, 3), np.float32)
                texture[seen] = colours.mean(1, keepdims=True) if k == VIEWED else colours
                made = estimate_albedo(replace(image, texture_linear=texture), seed=0)
                np.savez_compressed(
                    folder / f"{name}_{k}_{light}.npz",
                    albedo=made.albedo_linear.astype(np.float16),
                    texture=texture.astype(np.float16),
                    expected_error=np.asarray(made.expected_error, np.float16),
                    seen=made.image.seen,
                    normal=image.normal.astype(np.float16),
                )


def head_similarities(folder: Path, viewed: bool, left_out: Collection[str] = ()) -> Judged:
    """Return the pairs of the heads' scans, or of their views, in a folder of `make_heads`."""
    made: dict[Kind, list[FloatArray]] = {"albedo": [], "texture": [], "shading": [], "shape": []}
    known, seen, labels = [], [], []
    for file in sorted(folder.glob("*.npz")):
        name, sitting, light = file.stem.rsplit("_", 2)
        if (sitting == VIEWED) != viewed or name in left_out:
            continue
        with np.load(file) as stored:
            albedo, texture, error, normal = (
                stored[key].astype(float) for key in ("albedo", "texture", "expected_error", "normal")
            )
            seen.append(stored["seen"])
        texture[~seen[-1]] = 0
        shading = np.divide(texture, albedo, out=np.zeros(albedo.shape), where=albedo > 0)
        for kind, values in zip(made, (albedo, texture, shading, normal), strict=True):
            made[kind].append(values)
        known.append(certainty(albedo, error, seen[-1]))
        labels.append((name, f"{name}_{light if viewed else sitting}", light))
    names, sittings, lights = (list(column) for column in zip(*labels, strict=True))
    found: dict[Kind, FloatArray] = {}
    for kind, images in made.items():
        if kind == "shape":
            templates = shape_templates(images, names, masks=seen)
        else:
            templates = albedo_templates(images, names, masks=known)
        if kind != "shape" or not viewed:  # photographs of one surface have one shape
            found[kind] = similarity_matrix(templates, templates)
    return Judged(found, names, sittings, lights)
