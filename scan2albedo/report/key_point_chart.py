"""Where the key points of glasses go: one labelled picture, from the front and from the side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, KEY_POINT_PLACES
from scan2albedo.rendering.views import View, render_mesh
from scan2albedo.synthetic import GlassesShape, eyeglasses

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE = 1400
_LABELS: dict[str, tuple[float, float]] = {
    "bridge_top": (0, 34),
    "bridge_bottom": (0, -36),
    "left_rim_top": (6, 16),
    "left_rim_bridge": (25, 3),
    "left_rim_inner": (25, 5),
    "left_rim_bottom": (6, -16),
    "left_rim_outer": (23, -10),
    "left_hinge": (18, 13),
}
"""Shifts in mm, to the wearer's left and up, of the labels of the front."""
_SIDE_LABELS: dict[str, tuple[float, float]] = {
    "left_hinge": (0, 22),
    "left_temple_middle": (0, 22),
    "left_ear_bend": (0, 22),
    "left_temple_tip": (14, -14),
    "left_rim_top": (14, 14),
    "left_rim_bottom": (14, -14),
}
"""Shifts in mm, forward and up, of the labels of the side."""


def key_point_chart() -> Figure:
    """Return a matplotlib figure of a synthetic frame with the names of its key points."""
    from matplotlib.figure import Figure

    glasses = eyeglasses(shape=GlassesShape(bridge_width=19, bridge_height=5), nose_pads=False)
    points = dict(zip(KEY_POINT_NAMES, glasses.keypoints, strict=True))
    figure = Figure(figsize=(12, 10.4), dpi=100, layout="constrained")
    front, side = figure.subplots(2, 1, height_ratios=(1, 0.72))
    view = View((0.0, 0.0, 0.0), 112.0)
    _draw(front, glasses.vertices, glasses.faces, view, "from the front (left is the wearer's left)")
    for name, shift in _LABELS.items():
        for sign, shown in ((1, name), (-1, name.replace("left", "right"))):
            if sign > 0 or shown != name:
                _label(front, view, points[shown], np.array([sign * shift[0], shift[1], 0.0]), shown)
    middle = (glasses.vertices.min(0) + glasses.vertices.max(0)) / 2
    view = View((float(middle[0]), 0.0, float(middle[2])), 112.0, yaw_deg=-90.0)
    _draw(side, glasses.vertices, glasses.faces, view, "from the wearer's left; the right temple likewise")
    for name, (forward, up) in _SIDE_LABELS.items():
        _label(side, view, points[name], np.array([0.0, up, forward]), name)
    for axes, half in ((front, 62), (side, 48)):
        center, scale = _SIZE / 2, _SIZE / 2 / 112.0
        axes.set_ylim(center + half * scale, center - half * scale)
    return figure


def _draw(axes: Axes, vertices: FloatArray, faces: IntArray, view: View, title: str) -> None:
    axes.imshow(render_mesh(vertices, faces, view=view, size=_SIZE))
    axes.set_title(title, fontsize=12)
    axes.set_axis_off()


def _label(axes: Axes, view: View, point: FloatArray, shift: FloatArray, text: str) -> None:
    ends = view.pixels(np.array([point, point + shift]), _SIZE)
    axes.annotate(
        text,
        xy=tuple(ends[0]),
        xytext=tuple(ends[1]),
        fontsize=10,
        ha="center",
        va="center",
        arrowprops={"arrowstyle": "-", "color": "0.45", "linewidth": 0.8, "shrinkB": 0},
    )
    axes.plot(*ends[0], "o", color="crimson", markersize=5)


def key_point_table() -> str:
    """Return the table of key points as text."""
    lines = ["left and right are the wearer's; <side> is left or right"]
    for number, place in enumerate(KEY_POINT_PLACES):
        name = place.name if number < 2 else f"<side>_{place.name}"
        lines.append(f"{name:<22}{place.where}")
        lines.append(f"{'':<22}on: {place.spot}; if the frame has none: {place.absent}")
    return "\n".join(lines)
