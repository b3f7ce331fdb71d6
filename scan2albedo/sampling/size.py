"""How small a geometry image may be."""

from __future__ import annotations

from scan2albedo.errors import GeometryImageError

SMALLEST_SIZE = 8


def check_size(size: int) -> None:
    """Raise `GeometryImageError` for an image of fewer than `SMALLEST_SIZE` texels a side."""
    if size < SMALLEST_SIZE:
        raise GeometryImageError(
            f"size {size} is too small for a geometry image; at least {SMALLEST_SIZE} is needed"
        )
