"""`overview.png` of canonicalised eyeglasses: each frame before and after, from the front and from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalEyeglasses
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.report.overview import Panel
from scan2albedo.report.rendering import View, heat_colors, render_mesh

FloatArray = NDArray[np.float64]

COLUMNS = 4
MOST_FRAMES = 24
"""Frames beyond these are not drawn: nobody would find them."""
_ABOVE_DEG = -90.0
_SIZE = 420


@dataclass(frozen=True)
class DrawnFrame:
    """A frame's name, its vertices (V, 3) and key points (20, 3) as given, and what became of them."""

    name: str
    vertices: FloatArray
    keypoints: FloatArray
    canonical: CanonicalEyeglasses


def glasses_panels(frames: Sequence[DrawnFrame], mean_keypoints: FloatArray) -> list[Panel]:
    """Return four panels a frame: before, coloured by weights, and after, coloured by how far it moved.

    Before is the frame brought rigidly to the mean. Dots are the mean's key points, the same in all panels.
    """
    drawn = frames[:MOST_FRAMES]
    before = [_aligned(frame, frame.vertices) for frame in drawn]
    moved = [
        np.linalg.norm(frame.canonical.vertices - placed, axis=1)
        for frame, placed in zip(drawn, before, strict=True)
    ]
    most = max(float(m.max()) for m in moved)
    views = [View.around(np.concatenate(before), pitch_deg=pitch) for pitch in (0.0, _ABOVE_DEG)]
    panels = []
    for frame, placed, distance in zip(drawn, before, moved, strict=True):
        rms = float(np.sqrt(np.mean(distance**2)))
        colors = (
            weight_colors(frame.canonical.weights),
            heat_colors(distance, 0, max(most, 1e-9), "viridis"),
        )
        states = (
            (f"{frame.name}, brought to the mean", placed, colors[0]),
            (f"moved by {rms:.2f} mm rms (0 to {most:.2g} mm)", frame.canonical.vertices, colors[1]),
        )
        for view, side in zip(views, ("front", "above"), strict=True):
            for title, vertices, color in states:
                picture = render_mesh(
                    vertices, frame.canonical.faces, vertex_color_srgb=color, view=view, size=_SIZE
                )
                panels.append(Panel(f"{title}; {side}", picture, _dots(mean_keypoints, view)))
    return panels


def weight_colors(weights: FloatArray) -> FloatArray:
    """Return (V, 3) sRGB colours: each of the (V, K) weights' columns has a hue, mixed by weight."""
    from matplotlib import colormaps

    palette = colormaps["tab20"](np.arange(weights.shape[1]) % 20)[:, :3]
    return np.asarray(weights @ palette)


def _aligned(frame: DrawnFrame, points: FloatArray) -> FloatArray:
    return transform_points(frame.canonical.canonical_from_frame, frame.canonical.scale * points)


def _dots(points: FloatArray, view: View) -> FloatArray:
    seen = view.project(points[np.isfinite(points).all(1)])
    scale = (_SIZE - 1) / (2 * view.half_width_mm)
    return np.stack([(seen[:, 0] + view.half_width_mm) * scale, (view.half_width_mm - seen[:, 1]) * scale], 1)
