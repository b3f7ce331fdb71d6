"""The picture of the README: a synthetic person's raw scan, what is made of it, and the face relit.

    python tools/make_readme_picture.py [-o docs/images/before_after.jpg] [--seed 6] [--size 512]

Everything is made by the package: the person, the scan, the fit, the albedo and the new light. Some twenty
seconds of CPU.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import scan2albedo as s2a
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.report.overview import preview_srgb
from scan2albedo.synthetic import Scanner

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "before_after.jpg"
HEIGHT = 224
"""Of the panels in pixels."""
GAP = 8
"""Between them."""
CAPTION = 30
"""Height of a caption in pixels."""
FONT_SIZE = 18
FINER = 3
"""Samples along a side of a pixel."""
NARROW = 0.72
"""Width over height of panels with a face from the front."""
TILT_DEG = 50.0
FLASH = s2a.PointLight(np.deg2rad(-48), np.deg2rad(22), distance_mm=900.0, intensity=3.5)
LAMPS = (
    s2a.PointLight(np.deg2rad(62), np.deg2rad(12), intensity=4.0),
    s2a.PointLight(np.deg2rad(-25), np.deg2rad(48), intensity=4.0),
)
QUALITY = 86

Pixels = NDArray[np.uint8]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--size", type=int, default=512)
    given = parser.parse_args()
    scanner = Scanner(rotation_max_deg=TILT_DEG)
    scan, _ = s2a.synthetic.raw_scan(given.seed, lights=[FLASH], scanner=scanner)
    result = s2a.process(scan, size=given.size, seed=0)
    print(result.summary())
    given.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(panels(result)).save(given.out, quality=QUALITY, optimize=True)
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")


def panels(result: ProcessResult) -> list[tuple[str, Pixels]]:
    """Return titles and pictures from the raw scan to the relit face."""
    image, estimate = result.geometry_image, result.albedo
    assert estimate is not None
    assert image.texture_linear is not None
    return [
        ("raw scan", raw_panel(result.scan)),
        ("fitted", fitted_panel(result)),
        ("texture as scanned", smaller(preview_srgb(image.texture_linear, image.mask))),
        ("albedo", smaller(preview_srgb(estimate.albedo_linear, image.mask))),
        *((f"relit {where}", pixels) for where, pixels in relit_panels(result)),
    ]


def raw_panel(scan: s2a.RawScan) -> Pixels:
    """Return the scan as it was delivered: its own pose, hair, shoulders, holes and crumbs."""
    low, high = np.percentile(scan.vertices, [0.5, 99.5], axis=0)
    x, y, z = (low + high) / 2
    return scan_picture(scan, scan.vertices, View((x, y, z), 0.54 * float((high - low)[:2].max())))


def scan_picture(scan: s2a.RawScan, vertices: NDArray[np.floating], view: View) -> Pixels:
    """Return a scan's own colours, whose vertices (V, 3) were turned, without any shading."""
    size = FINER * HEIGHT
    if scan.uv is not None and scan.texture_linear is not None:
        texture = (scan.uv, encode_srgb_bytes(scan.texture_linear))
        return smaller(
            render_mesh(vertices, scan.faces, texture_srgb=texture, view=view, size=size, shaded=False)
        )
    assert scan.vertex_color_linear is not None
    colors = encode_srgb_bytes(scan.vertex_color_linear[None])[0] / 255
    return smaller(
        render_mesh(vertices, scan.faces, vertex_color_srgb=colors, view=view, size=size, shaded=False)
    )


def fitted_panel(result: ProcessResult) -> Pixels:
    """Return the fitted surface in grey with its landmarks."""
    fitted = result.fitted
    assert fitted is not None
    assert fitted.landmarks is not None
    around = View.around(fitted.vertices)
    size = FINER * HEIGHT
    picture = Image.fromarray(render_mesh(fitted.vertices, fitted.faces, view=around, size=size))
    scale = (size - 1) / (2 * around.half_width_mm)
    draw = ImageDraw.Draw(picture)
    for right, up, _ in around.project(fitted.landmarks):
        column, row = (right + around.half_width_mm) * scale, (around.half_width_mm - up) * scale
        draw.ellipse((column - 4, row - 4, column + 4, row + 4), fill=(214, 72, 30))
    return narrow(smaller(np.asarray(picture)))


def relit_panels(result: ProcessResult) -> list[tuple[str, Pixels]]:
    """Return the face under two new lamps, on white."""
    face = s2a.applications.load_result(result)
    made = []
    for name, lamp in zip(("sideways", "from above"), LAMPS, strict=True):
        lit = s2a.applications.relight(face, [lamp], ambient=0.35)
        picture = lit.picture(shape=(HEIGHT, HEIGHT), samples=FINER)
        alpha = picture.alpha[..., None]
        on_white = alpha * picture.srgb() + 255 * (1 - alpha)
        made.append((name, narrow(np.round(on_white).astype(np.uint8))))
    return made


def smaller(picture: NDArray[np.generic]) -> Pixels:
    """Return a square picture at a panel's size, averaged."""
    resized = Image.fromarray(np.asarray(picture, np.uint8)).resize((HEIGHT, HEIGHT), Image.Resampling.BOX)
    return np.asarray(resized)


def narrow(picture: Pixels) -> Pixels:
    """Return the middle columns."""
    width = round(NARROW * picture.shape[1])
    first = (picture.shape[1] - width) // 2
    return picture[:, first : first + width]


def sheet(pictures: list[tuple[str, Pixels]]) -> Image.Image:
    """Return the panels side by side on white, each with its caption below."""
    width = GAP + sum(pixels.shape[1] + GAP for _, pixels in pictures)
    page = Image.new("RGB", (width, HEIGHT + CAPTION + 2 * GAP), "white")
    draw = ImageDraw.Draw(page)
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), FONT_SIZE)
    left = GAP
    for title, pixels in pictures:
        page.paste(Image.fromarray(pixels), (left, GAP))
        middle = (left + pixels.shape[1] // 2, GAP + HEIGHT + CAPTION // 2)
        draw.text(middle, title, fill=(60, 60, 60), font=font, anchor="mm")
        left += pixels.shape[1] + GAP
    return page


if __name__ == "__main__":
    main()
