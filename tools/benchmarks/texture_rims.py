"""How far texels beside the charts of exported textures are from the nearest texel inside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt, maximum_filter

from benchmarks.real_applications import SEAM_PAIRS, real_faces
from scan2albedo.applications import blend_faces, swap_texture, write_face
from scan2albedo.core.arrays import BoolArray
from scan2albedo.geometry.rasterization import rasterize_uv
from scan2albedo.io.geometry_image_files import read_geometry_image

LIMIT = 0.05
"""Of differences in sRGB, 0 to 1: what filtering may mix in at a chart's rim."""
_BESIDE = 8
"""Texels beside a chart that filtering reads: one of a picture (mipmap) an eighth as large."""


def rim_step(picture: NDArray[np.integer], covered: BoolArray) -> float:
    """Return the largest difference (sRGB, 0 to 1) of texels beside the charts from the nearest one inside.

    `picture` (H, W, C), `covered` (H, W).
    """
    beside = maximum_filter(covered, 2 * _BESIDE + 1) & ~covered
    row, column = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    step = np.abs(picture.astype(float) - picture[row, column])[beside]
    return float(step.max(initial=0.0)) / np.iinfo(picture.dtype).max


def exported_textures(folder: Path) -> Iterator[tuple[str, NDArray[np.integer], BoolArray]]:
    """Yield name, picture (H, W, C) and covered texels (H, W) of each texture in the folder of a result."""
    image = read_geometry_image(folder / "geometry_image.npz")
    yield "albedo.png", np.asarray(Image.open(folder / "albedo.png"))[..., :3], image.mask
    for file in sorted(folder.glob("*.glb")):
        parts = getattr(scene := trimesh.load(file, process=False), "geometry", {"": scene})
        for name, mesh in parts.items():
            # Coordinates of a template's tiles beyond the first go on from tile to tile.
            uv, material = np.asarray(mesh.visual.uv), mesh.visual.material
            for kind, picture in (("", material.baseColorTexture), (" normals", material.normalTexture)):
                if picture is not None:
                    values = np.asarray(picture.convert("RGB"))
                    covered = rasterize_uv(uv - np.floor(uv.mean(0)), mesh.faces, values.shape[:2]).covered
                    yield f"{file.name}{' ' + name if len(parts) > 1 else ''}{kind}", values, covered


def bench_rims(results: Path, out: Path, pairs: Sequence[tuple[str, str]] | None) -> None:
    """Print the steps at the rims of what processing, swaps and blends of pairs export.

    A subfolder of the results' folder named `template` may hold some made with `--model` and a template.
    """
    pairs = pairs or SEAM_PAIRS
    faces = real_faces(results, list(dict.fromkeys(name for pair in pairs for name in pair)))
    folders = [results / name for name in faces]
    folders += sorted(file.parent for file in results.glob("template/*/result.json"))
    for first, second in pairs:
        a, b = faces[first], faces[second]
        for what, made in (("swap", swap_texture(a, b)), ("blend", blend_faces(a, b, 0.5))):
            folder = out / f"{what}_{first}_{second}"
            folders.append(write_face(made, folder, application=what, inputs=[a, b]))
    print(f"largest step in sRGB (0 to 1) from the nearest texel of the charts, up to {_BESIDE} beside them")
    worst: dict[str, list[float]] = {}
    for folder in folders:
        for name, picture, covered in exported_textures(folder):
            worst.setdefault(name, []).append(step := rim_step(picture, covered))
            size = f"{picture.shape[1]} x {picture.shape[0]}"
            print(f"{folder.name:36}{name:24}{size:>12}{step:8.3f}", flush=True)
    for name, steps in worst.items():
        above = sum(step > LIMIT for step in steps)
        print(f"{f'worst of {len(steps)}':36}{name:24}{max(steps):20.3f}, above {LIMIT}: {above}")
