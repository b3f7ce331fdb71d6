"""Where the key points of glasses go: one labelled picture, from the front and from the side."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, KEY_POINT_PLACES
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.synthetic import GlassesShape, eyeglasses

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def key_point_chart() -> Figure:
    """Return a matplotlib figure of a synthetic frame with the names of its key points."""
    from matplotlib.figure import Figure

    glasses = eyeglasses(shape=GlassesShape(bridge_width=19, bridge_height=5), nose_pads=False)
    points = dict(zip(KEY_POINT_NAMES, glasses.keypoints, strict=True))
    x, _, z = map(float, (glasses.vertices.min(0) + glasses.vertices.max(0)) / 2)
    temple = [name for name in points if name.startswith(("left_temple", "left_ear"))]
    front = [name for name in points if "temple" not in name and "ear" not in name]
    pictures = (
        ("from the front (left is the wearer's left)", View((0, 0, 0), 112), front),
        (
            "from the wearer's left; the right temple likewise",
            View((x, 0, z), 112, yaw_deg=-90),
            ["left_hinge", "left_rim_top", "left_rim_bottom", *temple],
        ),
    )
    figure = Figure(figsize=(12, 10), dpi=100, layout="constrained")
    size, line = 1400, {"arrowstyle": "-", "color": "gray", "shrinkB": 0}
    for axes, (title, view, names) in zip(figure.subplots(2, 1), pictures, strict=True):
        axes.imshow(render_mesh(glasses.vertices, glasses.faces, view=view, size=size))
        axes.set_title(title, fontsize=12)
        axes.set_axis_off()
        places = dict(zip(names, view.pixels([points[name] for name in names], size), strict=True))
        middle = np.median([row for _, row in places.values()])
        # Names of the upper points in a row above the frame, of the lower ones in one below.
        ordered = sorted(names, key=lambda name: places[name][0])
        upper = [name for name in ordered if places[name][1] < middle]
        for row, level in ((upper, -270), ([name for name in ordered if name not in upper], 270)):
            for number, name in enumerate(row):
                at, beside = tuple(places[name]), ((number + 0.5) * size / len(row), middle + level)
                axes.annotate(name, at, beside, arrowprops=line, fontsize=10, ha="center", va="center")
                axes.plot(*places[name], "o", color="crimson", markersize=5)
        axes.set_ylim(middle + 320, middle - 320)
    return figure


def key_point_table() -> str:
    """Return the table of key points as text."""
    lines = ["left and right are the wearer's; <side> is left or right"]
    for number, place in enumerate(KEY_POINT_PLACES):
        name = place.name if number < 2 else f"<side>_{place.name}"
        lines.append(f"{name:<22}{place.where}")
        lines.append(f"{'':<22}on: {place.spot}; if the frame has none: {place.absent}")
    return "\n".join(lines)
