"""How small and how large a geometry image may be."""

from __future__ import annotations

from numbers import Integral

from scan2albedo.errors import GeometryImageError

SMALLEST_SIZE = 8
LARGEST_SIZE = 16384
"""A texel takes some hundred bytes on its way: 16384 texels a side are near 30 GB."""


def check_size(size: int) -> None:
    """Refuse what is no number of texels a side.

    Raises
    ------
    GeometryImageError
        For less than `SMALLEST_SIZE` or more than `LARGEST_SIZE`, or no whole number.
    """
    if isinstance(size, Integral) and SMALLEST_SIZE <= size <= LARGEST_SIZE:
        return
    reason = "too small" if isinstance(size, Integral) and size < SMALLEST_SIZE else "no size"
    raise GeometryImageError(
        f"size {size} is {reason} for a geometry image; give a whole number of texels, {SMALLEST_SIZE} to "
        f"{LARGEST_SIZE}"
    )
