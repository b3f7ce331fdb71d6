"""`overview.png` of eyeglasses: canonicalised frames, frames registered on a face, and lenses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, binary_dilation

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import Camera, LensPicture, RegisteredEyeglasses
from scan2albedo.eyeglasses.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.mean_keypoints import align_key_points, in_own_axes
from scan2albedo.eyeglasses.on_face.outline import cover, covered_points, hidden_by
from scan2albedo.geometry.pinhole import normalized_cameras, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.rendering.views import View, heat_colors, render_mesh
from scan2albedo.report.overview import Panel

Mesh = tuple[FloatArray, IntArray]

CANONICAL_COLUMNS, LENS_COLUMNS = 4, 2
MOST_FRAMES, MOST_VIEWS = 24, 12
"""Frames and views beyond these are not drawn: nobody would find them."""
_CANONICAL_SIZE, _SIZE = 420, 560
"""Side of a panel in pixels, of canonical frames and of frames on a face."""
_MARGIN = 0.04
"""Left free around what a picture shows, as a part of its width."""
_OUTSIDE, _BACKDROP, _MASK = 235, 40, 150
_SEEN_COLOR, _HIDDEN_COLOR = (255, 150, 40), (90, 150, 255)
_INLIER_COLOR, _OUTLIER_COLOR = (0.2, 0.95, 0.2), (1.0, 0.1, 0.3)
_SKIN_COLOR, _FRAME_COLOR = (0.87, 0.78, 0.72), (0.15, 0.25, 0.55)
_TURN_DEG, _ABOVE_DEG = 35.0, -90.0


@dataclass(frozen=True)
class DrawnFrame:
    """A frame's name, its vertices (V, 3) and key points (20, 3) as given, and what became of them."""

    name: str
    vertices: FloatArray
    keypoints: FloatArray
    canonical: CanonicalEyeglasses


def glasses_panels(frames: Sequence[DrawnFrame]) -> list[Panel]:
    """Return four panels a frame: before, coloured by weights, and after, coloured by how far it moved.

    Before is the frame brought rigidly to its canonical place. Dots are the canonical key points: its own,
    unbent, or the mean's, the same in all panels then.
    """
    drawn = frames[:MOST_FRAMES]
    before = [
        transform_points(one.canonical.canonical_from_frame, one.canonical.scale * one.vertices)
        for one in drawn
    ]
    moved = [
        np.linalg.norm(frame.canonical.vertices - placed, axis=1)
        for frame, placed in zip(drawn, before, strict=True)
    ]
    most = max(float(m.max()) for m in moved)
    views = [View.around(np.concatenate(before), pitch_deg=pitch) for pitch in (0.0, _ABOVE_DEG)]
    panels = []
    for frame, placed, distance in zip(drawn, before, moved, strict=True):
        rms = float(np.sqrt(np.mean(distance**2)))
        dots = frame.canonical.keypoints[np.isfinite(frame.canonical.keypoints).all(1)]
        how = "unbent, own shape" if frame.canonical.unbent else "to the mean"
        colors = (
            weight_colors(frame.canonical.weights),
            heat_colors(distance, 0, max(most, 1e-9), "viridis"),
        )
        states = (
            (f"{frame.name}\nas given", placed, colors[0]),
            (f"{how}\nmoved by {rms:.2f} mm rms (0 to {most:.2g} mm)", frame.canonical.vertices, colors[1]),
        )
        for view, side in zip(views, ("front", "above"), strict=True):
            for title, vertices, color in states:
                picture = render_mesh(
                    vertices, frame.canonical.faces, vertex_color_srgb=color, view=view, size=_CANONICAL_SIZE
                )
                panels.append(Panel(f"{title}; {side}", picture, view.pixels(dots, _CANONICAL_SIZE)))
    return panels


def weight_colors(weights: FloatArray) -> FloatArray:
    """Return (V, 3) sRGB colours: each of the (V, K) weights' columns has a hue, mixed by weight."""
    from matplotlib import colormaps

    palette = colormaps["tab20"](np.arange(weights.shape[1]) % 20)[:, :3]
    return np.asarray(weights @ palette)


@dataclass(frozen=True)
class SeenView:
    """One camera's mask, None where there is none, and labels (20, 2) in pixels, NaN for missing ones."""

    camera: Camera
    mask: BoolArray | None
    labels: FloatArray


def registration_panels(
    frame: RegisteredEyeglasses, views: Sequence[SeenView], head: Mesh | None = None
) -> list[Panel]:
    """Return a panel for each view, two of the frame's standard deviation, and one on the head if any.

    Orange is the registered frame's outline, blue where the head hides it; green labels fit, red ones are
    outliers. Vertices that are not observed are red.
    """
    caster = None if head is None else RayCaster(*head)
    panels = [_view_panel(frame, number, view, caster) for number, view in enumerate(views[:MOST_VIEWS])]
    upright = align_key_points(frame.keypoints, in_own_axes(frame.keypoints))
    vertices = transform_points(upright, frame.vertices)
    shown = frame.deviation[frame.observed]
    most = max(float(shown.max(initial=0.0)), 1e-9)
    heat = heat_colors(frame.deviation, 0, most, "viridis")
    colors = np.where(frame.observed[:, None], heat, _OUTLIER_COLOR)
    title = f"standard deviation, 0 to {most:.2g} mm" if len(shown) else "nothing is observed"
    lost = 1 - frame.observed.mean()
    more = f"\n(red: {lost:.0%} not observed)" if lost > 0 else ""
    for pitch, side in ((0.0, "front"), (_ABOVE_DEG, "above")):
        view = View.around(vertices, pitch_deg=pitch)
        picture = render_mesh(vertices, frame.faces, vertex_color_srgb=colors, view=view, size=_SIZE)
        panels.append(Panel(f"{title}; {side}{more}", picture))
    if head is not None:
        skin = transform_points(upright, head[0])
        colors = np.repeat([_FRAME_COLOR, _SKIN_COLOR], [len(vertices), len(skin)], axis=0)
        joined = np.concatenate([vertices, skin]), np.concatenate([frame.faces, head[1] + len(vertices)])
        around = View.around(vertices)
        view = View(around.center_mm, 1.3 * around.half_width_mm, yaw_deg=-_TURN_DEG)
        picture = render_mesh(*joined, vertex_color_srgb=colors, view=view, size=_SIZE)
        panels.append(Panel("on the head", picture))
    return panels


def _view_panel(frame: RegisteredEyeglasses, number: int, view: SeenView, head: RayCaster | None) -> Panel:
    camera = normalized_cameras(view.camera.matrix[None])[0]
    zoom = _zoom(view, project(camera, frame.vertices)[0])
    # The mask light on dark, the outside of the picture lighter.
    mask = np.zeros(view.camera.shape, bool) if view.mask is None else view.mask
    scale, shift = zoom[0, 0], zoom[[1, 0], 2]
    shades = np.where(mask, float(_MASK), _BACKDROP)
    size = (_SIZE, _SIZE)
    gray = affine_transform(
        shades, [1 / scale] * 2, -shift / scale, size, order=1, mode="grid-constant", cval=_OUTSIDE
    )
    picture = np.repeat(np.round(gray).astype(np.uint8)[:, :, None], 3, axis=2)
    # Where the frame is seen, and where the head is in front of it.
    pixels, depth = project(normalized_cameras((zoom @ camera)[None])[0], frame.vertices)
    at, face, share = covered_points(cover(pixels, depth, frame.faces, size), pixels, depth, frame.faces)
    behind = hidden_by(head, camera, np.einsum("nk,nki->ni", share, frame.vertices[frame.faces[face]]))
    seen, hidden = np.zeros((2, *size), bool)
    seen[at[~behind, 1], at[~behind, 0]] = True
    hidden[at[behind, 1], at[behind, 0]] = True
    # The silhouette's own border; what the head cuts off is not a border of the frame.
    picture[hidden & binary_dilation(~(seen | hidden), iterations=2)] = _HIDDEN_COLOR
    picture[seen & binary_dilation(~seen, iterations=2)] = _SEEN_COLOR
    errors, close = frame.label_errors_px[number], frame.inliers[number]
    given = ~np.isnan(errors)
    count, wrong = int(given.sum()), int((given & ~close).sum())
    labels = f"{count} labels" + (f", {wrong} outliers" if wrong else "")
    if close.any():
        labels += f", {np.sqrt(np.mean(errors[close] ** 2)):.1f} px rms"
    rms = frame.outline_rms_px[number]
    outline = "outline not compared" if np.isnan(rms) else f"outline {rms:.1f} px rms"
    title = f"{view.camera.name}: {labels}\n{'no mask' if view.mask is None else outline}"
    dots = view.labels[given] @ zoom[:2, :2].T + zoom[:2, 2]
    colors = np.where(close[given, None], _INLIER_COLOR, _OUTLIER_COLOR)
    return Panel(title, picture, dots, colors)


def _zoom(view: SeenView, pixels: FloatArray) -> FloatArray:
    """Return the (3, 3) map from the picture's pixels to the panel's that shows frame, mask and labels."""
    height, width = view.camera.shape
    shown = [pixels[np.isfinite(pixels).all(1)], view.labels[np.isfinite(view.labels).all(1)]]
    if view.mask is not None:
        shown.append(np.argwhere(view.mask)[:, ::-1].astype(np.float64))
    points = np.concatenate(shown)
    limit = np.array([width, height]) - 0.5
    if len(points) == 0:
        points = np.array([[-0.5, -0.5], limit])
    room = _MARGIN * np.array([width, height])
    points = np.clip(points, -0.5 - room, limit + room)
    low, high = points.min(0), points.max(0)
    half = max(float(np.max(high - low)) / 2 * (1 + 2 * _MARGIN), 4.0)
    corner, scale = (low + high) / 2 - half, _SIZE / (2 * half)
    shift = -scale * corner - 0.5
    return np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])


def lens_panels(pictures: Sequence[tuple[str, LensPicture]], exposure: float) -> list[Panel]:
    """Return two panels a view, named pictures with linear colours times `exposure`."""
    return [
        Panel(f"{name}, {how} lenses", preview(linear, exposure))
        for name, one in pictures[:MOST_VIEWS]
        for how, linear in (("without", one.without_lenses_linear), ("with", one.image_linear))
    ]


def preview(linear: FloatArray, exposure: float) -> NDArray[np.uint8]:
    """Return sRGB bytes (H, W, 3)."""
    return encode_srgb_bytes(exposure * linear)
