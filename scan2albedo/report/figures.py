"""Figures to files, with no more drawing than it takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PNG_LEVEL = 3


def save_figure(figure: Figure, path: str | Path, dpi: float | None = None) -> None:
    """Write a figure as PNG, its panels laid out once, where matplotlib would do so twice."""
    if dpi is not None:
        figure.set_dpi(dpi)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(path, format="png", dpi="figure", pil_kwargs={"compress_level": _PNG_LEVEL})
