"""A sheet of people as they were scanned, and as they are unlit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scan2albedo.io.color import encode_srgb_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MEAN_SHOWN = 0.3
"""Linear level at which each picture's mean is shown: scales of albedos are not known."""


def people_figure(rows: Mapping[str, Sequence[NDArray[np.floating]]], columns: Sequence[str]) -> Figure:
    """Return a figure of linear pictures (H, W, 3), 0 outside the face: a row a name, a column a title.

    Raises
    ------
    ValueError
        When there is no row, or one has not a picture for each column.
    """
    if not rows or any(len(pictures) != len(columns) for pictures in rows.values()):
        raise ValueError(f"expected one row or more of {len(columns)} pictures each")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.7 * len(columns), 1.75 * len(rows) + 0.4), dpi=110, layout="constrained")
    axes = figure.subplots(len(rows), len(columns), squeeze=False)
    for line, (name, pictures) in zip(axes, rows.items(), strict=True):
        for axis, picture in zip(line, pictures, strict=True):
            axis.imshow(encode_srgb_bytes(_shown(np.asarray(picture, np.float64))))
            axis.set_xticks([])
            axis.set_yticks([])
        line[0].set_ylabel(name, fontsize=8)
    for axis, title in zip(axes[0], columns, strict=True):
        axis.set_title(title, fontsize=8)
    return figure


def _shown(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    lit = picture.max(-1) > 0
    return picture * (_MEAN_SHOWN / picture[lit].mean()) if lit.any() else picture
