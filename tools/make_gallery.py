"""The pictures of docs/gallery.md, or the same of a scan of yours.

    python tools/make_gallery.py [-o docs/images/gallery]
    python tools/make_gallery.py --scan SCAN -o FOLDER

Without SCAN everything is made by the package: its synthetic people and the examples; a minute of CPU. With
it: what became of the scan (scan.jpg), the scan beside itself without its light (unlit.jpg), and the maps of
a skin material (maps.jpg).
"""

from __future__ import annotations

import argparse
import runpy
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from make_readme_picture import (
    FINER,
    FLASH,
    HEIGHT,
    QUALITY,
    TILT_DEG,
    Pixels,
    narrow,
    panels,
    scan_picture,
    sheet,
    smaller,
)
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications.template_baking import integers, normal_bytes
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.synthetic import Scanner

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "images" / "gallery"
SIDE_DEG = 40.0
"""Of the second view of a scan."""
SEED = 6
Panels = list[tuple[str, Pixels]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--scan", type=Path)
    given = parser.parse_args()
    if given.scan is not None:
        scan = s2a.load_scan(given.scan)
    else:
        scanner = Scanner(rotation_max_deg=TILT_DEG)
        scan, _ = s2a.synthetic.raw_scan(SEED, lights=[FLASH], scanner=scanner)
    result = s2a.process(scan, unlit="all", maps="chart", texture_size=HEIGHT, seed=0)
    pictures = {"scan": panels(result), "unlit": unlit_panels(result), "maps": maps_panels(result)}
    if given.scan is None:
        del pictures["scan"]  # README's picture
        with tempfile.TemporaryDirectory() as folder:
            pictures |= example_panels(Path(folder))
    given.out.mkdir(parents=True, exist_ok=True)
    for name, made in pictures.items():
        file = given.out / f"{name}.jpg"
        sheet(made).save(file, quality=QUALITY, optimize=True)
        print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def unlit_panels(result: ProcessResult) -> Panels:
    """Return a scan and the same without its light, from the front and from a side, by the same camera."""
    assert result.unlit is not None
    assert result.fitted is not None
    face = View.around(result.fitted.vertices)
    made = []
    for where, yaw_deg in (("from the front", 0.0), ("from the side", SIDE_DEG)):
        view = View(face.center_mm, 1.4 * face.half_width_mm, yaw_deg)
        for what, scan in (("scan", result.scan), ("unlit", result.unlit.scan)):
            upright = transform_points(result.fitted.model_from_scan, scan.vertices)
            made.append((f"{what}, {where}", scan_picture(scan, upright, view)))
    return made


def maps_panels(result: ProcessResult) -> Panels:
    """Return the maps of a skin material on the face's chart."""
    assert result.maps_of_skin is not None
    (tile,) = result.maps_of_skin.tiles
    shown = {"albedo": encode_srgb_bytes(tile.color_linear), "normals": normal_bytes(tile.normal)}
    grey = {**tile.maps, "displacement": 0.5 + tile.maps["displacement_mm"] / 2}  # 1 mm outward is white
    for name in ("displacement", "cavity", "occlusion", "specular"):
        shown[name] = np.repeat(integers(grey[name])[..., None], 3, axis=-1)
    return [(name, smaller(pixels)) for name, pixels in shown.items()]


def example_panels(folder: Path) -> dict[str, Panels]:
    """Run the examples and return what they show."""
    for name in ("relight_sweep", "swap_and_blend", "transfer_expression", "reflectance_from_flashes"):
        arguments = ["-o", str(folder / name)]
        if name != "reflectance_from_flashes":
            arguments += ["--size", str(HEIGHT)]
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"](arguments)
    relit = folder / "relight_sweep"
    frames = [relit / "frames" / f"frame_{k:03d}.png" for k in (0, 4, 7, 11)]
    lamps = sorted((folder / "reflectance_from_flashes").glob("lamp_*.ply"))
    swaps = ["A", "B", "A with B's skin", "B with A's skin"]
    blends = ["A", "a quarter of B", "half of B", "3/4 of B", "B"]
    smiles = ["A", "A smiling", "B", "B with A's smile", "1.5 times that"]
    return {
        "relit": [
            ("two lamps", picture(relit / "portrait.png", whole=True)),
            ("a sky", picture(relit / "sky.png")),
            *(("a lamp moves", picture(frame)) for frame in frames),
        ],
        "swapped": strip(folder / "swap_and_blend" / "swaps.png", swaps),
        "blended": strip(folder / "swap_and_blend" / "blends.png", blends),
        "expressions": strip(folder / "transfer_expression" / "expressions.png", smiles),
        "reflectance": [(f"lamp {k}", lit_mesh(path)) for k, path in enumerate(lamps, 1)],
    }


def picture(path: Path, *, whole: bool = False) -> Pixels:
    with Image.open(path) as opened:
        pixels = np.asarray(opened.convert("RGB"))
    return pixels if whole else narrow(pixels)


def strip(path: Path, titles: list[str]) -> Panels:
    """Return the square pictures that stand side by side in a file, with a title each."""
    with Image.open(path) as opened:
        whole = np.asarray(opened.convert("RGB"))
    parts = np.split(whole, len(titles), axis=1)
    return [(title, narrow(part)) for title, part in zip(titles, parts, strict=True)]


def lit_mesh(path: Path) -> Pixels:
    """Return a mesh with the colours of its vertices, which are those of skin in a lamp's light."""
    mesh = trimesh.load(path, process=False)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    size = FINER * HEIGHT
    return narrow(
        smaller(render_mesh(mesh.vertices, mesh.faces, vertex_color_srgb=colors, size=size, shaded=False))
    )


if __name__ == "__main__":
    main()
