"""`overview.png` of lenses in a frame: each view without them and with them, and what is a guess."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses import LensPicture
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.report.overview import Panel

COLUMNS = 2
MOST_VIEWS = 12
"""Views beyond these are not drawn."""


def lens_panels(pictures: Sequence[tuple[str, LensPicture]], exposure: float) -> list[Panel]:
    """Return two panels a view, named pictures with linear colours times `exposure`."""
    panels = []
    for name, picture in pictures[:MOST_VIEWS]:
        for title, linear in (
            ("without lenses", picture.without_lenses_linear),
            ("with lenses", picture.image_linear),
        ):
            panels.append(Panel(f"{name}, {title}", preview(linear, exposure)))
    return panels


def preview(linear: NDArray[np.float64], exposure: float) -> NDArray[np.uint8]:
    """Return sRGB bytes (H, W, 3)."""
    return encode_srgb_bytes(exposure * linear)
