"""Overviews, pictures side by side: their panels, and what they show of an image on the chart."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from itertools import repeat

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from scan2albedo.core.arrays import BoolArray, ByteArray, FloatArray, RealArray
from scan2albedo.io.color import linear_to_srgb


@dataclass(frozen=True)
class Panel:
    """One titled picture of the overview."""

    title: str
    picture: ByteArray
    dots: FloatArray | Sequence[FloatArray] = ()
    """(N, 2) pixel positions (column, row) to mark, such as landmarks."""
    dot_colors: Sequence[str] = ()
    """N names of colours; lime when omitted."""

    def fitted(self, side: int) -> Image.Image:
        """Return the picture with its dots, as large as a square of `side` pixels holds."""
        picture = Image.fromarray(self.picture)
        pen = ImageDraw.Draw(picture)
        for place, color in zip(self.dots, self.dot_colors or repeat("lime"), strict=False):
            pen.ellipse([*(place - 2), *(place + 2)], color)
        # Means over what is made smaller; what is made larger keeps its pixels.
        return ImageOps.contain(picture, (side, side), Image.Resampling.BOX)


def overview_picture(title: str, panels: list[Panel], columns: int = 5, width: int = 368) -> Image.Image:
    """Return an image of the panels in rows of `columns`, which are `width` pixels wide with a gap."""
    columns = min(columns, len(panels))
    rows, side = -(-len(panels) // columns), width - 8
    head = _wrapped(title, width * columns // 9)
    names = [_wrapped(panel.title, side // 7) for panel in panels]
    below = 44 + 20 * head.count("\n")
    above = 28 + 16 * max(name.count("\n") for name in names)
    page = Image.new("RGB", (width * columns, below + rows * (above + side)), "white")
    pen, font = ImageDraw.Draw(page), lettering(13)
    pen.text((page.width / 2, 12), head, "black", lettering(17), "ma", align="center")
    for number, (panel, name) in enumerate(zip(panels, names, strict=True)):
        row, column = divmod(number, columns)
        middle, top = width * column + width // 2, below + (above + side) * row + above
        pen.text((middle, top - 6), name, "black", font, "md", align="center")
        shown = panel.fitted(side)
        page.paste(shown, (middle - shown.width // 2, top))
    return page


def lettering(height: int) -> ImageFont.FreeTypeFont:
    """Return the font of matplotlib's figures, of a height in pixels; it has letters of many languages."""
    file = distribution("matplotlib").locate_file("matplotlib/mpl-data/fonts/ttf/DejaVuSans.ttf")
    return ImageFont.truetype(str(file), height)


def _wrapped(text: str, width: int) -> str:
    """Return a text in lines of at most `width` characters."""
    return "\n".join(part for line in text.split("\n") for part in textwrap.wrap(line, width) or [""])


def preview_srgb(linear: RealArray, mask: BoolArray) -> ByteArray:
    """Return (H, W, 3) sRGB bytes of a linear image times its `preview_factor`, white outside the mask."""
    return chart_picture(linear_to_srgb(np.clip(linear * preview_factor(linear, mask), 0, 1)), mask)


def preview_factor(linear: RealArray, mask: BoolArray) -> float:
    """Return the factor that puts the 90th percentile of the brightest channel at 0.55."""
    return 0.55 / white_level(linear, mask, 90)


def white_level(values: RealArray, mask: BoolArray, percentile: float = 99.9) -> float:
    """Return a percentile of an image's brightest channel (H, W) or (H, W, C) in its mask; 1 for black."""
    inside = values[mask]
    bright = np.percentile(inside if values.ndim == 2 else inside.max(-1), percentile) if len(inside) else 0
    return float(bright) if bright > 0 else 1.0


def chart_picture(srgb: RealArray, mask: BoolArray) -> ByteArray:
    """Return (H, W, 3) bytes of an image (H, W) or (H, W, 3) in [0, 1], clipped, white outside the mask."""
    colors = srgb if srgb.ndim == 3 else np.repeat(srgb[..., None], 3, axis=2)
    return np.round(np.where(mask[..., None], np.clip(colors, 0, 1), 1.0) * 255).astype(np.uint8)
