"""`overview.png` of eyeglasses: canonicalised frames, frames registered on a face, and lenses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import Camera, LensPicture, RegisteredEyeglasses
from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.canonical.mean_keypoints import align_key_points, in_own_axes
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
_UNOBSERVED_COLOR = (0.85, 0.1, 0.2)
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


def _aligned(frame: DrawnFrame, points: FloatArray) -> FloatArray:
    return transform_points(frame.canonical.canonical_from_frame, frame.canonical.scale * points)


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
    panels += _deviation_panels(frame, vertices)
    if head is not None:
        panels.append(_head_panel(frame, vertices, (transform_points(upright, head[0]), head[1])))
    return panels


def _view_panel(frame: RegisteredEyeglasses, number: int, view: SeenView, head: RayCaster | None) -> Panel:
    camera = normalized_cameras(view.camera.matrix[None])[0]
    pixels, _ = project(camera, frame.vertices)
    zoom = _zoom(view, pixels)
    picture = _backdrop(view, zoom)
    seen, hidden = _silhouette(frame, normalized_cameras((zoom @ camera)[None])[0], camera, head)
    # The silhouette's own border; what the head cuts off is no border of the frame.
    picture[hidden & _beside(~(seen | hidden))] = _HIDDEN_COLOR
    picture[seen & _beside(~seen)] = _SEEN_COLOR
    errors, close = frame.label_errors_px[number], frame.inliers[number]
    given = ~np.isnan(errors)
    dots = view.labels[given] @ zoom[:2, :2].T + zoom[:2, 2]
    colors = np.where(close[given, None], _INLIER_COLOR, _OUTLIER_COLOR)
    return Panel(_title(frame, number, view), picture, dots, colors)


def _title(frame: RegisteredEyeglasses, number: int, view: SeenView) -> str:
    errors, close = frame.label_errors_px[number], frame.inliers[number]
    count, wrong = int((~np.isnan(errors)).sum()), int((~np.isnan(errors) & ~close).sum())
    labels = f"{count} labels" + (f", {wrong} outliers" if wrong else "")
    if close.any():
        labels += f", {np.sqrt(np.mean(errors[close] ** 2)):.1f} px rms"
    rms = frame.outline_rms_px[number]
    outline = "outline not compared" if np.isnan(rms) else f"outline {rms:.1f} px rms"
    return f"{view.camera.name}: {labels}\n{'no mask' if view.mask is None else outline}"


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


def _backdrop(view: SeenView, zoom: FloatArray) -> NDArray[np.uint8]:
    """Return the picture (S, S, 3): the mask light on dark, the outside of the picture lighter."""
    import cv2

    mask = np.zeros(view.camera.shape, bool) if view.mask is None else view.mask
    shades = np.where(mask, _MASK, _BACKDROP).astype(np.uint8)
    gray = cv2.warpAffine(shades, zoom[:2], (_SIZE, _SIZE), flags=cv2.INTER_LINEAR, borderValue=(_OUTSIDE,))
    return np.repeat(gray[:, :, None], 3, axis=2)


def _silhouette(
    frame: RegisteredEyeglasses, zoomed: FloatArray, camera: FloatArray, head: RayCaster | None
) -> tuple[BoolArray, BoolArray]:
    """Return where (S, S) a zoomed camera sees the frame, and where the head is in front of it."""
    pixels, depth = project(zoomed, frame.vertices)
    covered = cover(pixels, depth, frame.faces, (_SIZE, _SIZE))
    at, face, share = covered_points(covered, pixels, depth, frame.faces)
    place = np.einsum("nk,nki->ni", share, frame.vertices[frame.faces[face]])
    behind = hidden_by(head, camera, place)
    seen, hidden = np.zeros((2, _SIZE, _SIZE), bool)
    seen[at[~behind, 1], at[~behind, 0]] = True
    hidden[at[behind, 1], at[behind, 0]] = True
    return seen, hidden


def _beside(mask: BoolArray) -> BoolArray:
    """Return where (H, W) a neighbour, two pixels away or less, is in the mask."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(mask, iterations=2))


def _deviation_panels(frame: RegisteredEyeglasses, vertices: FloatArray) -> list[Panel]:
    shown = frame.deviation[frame.observed]
    most = max(float(shown.max(initial=0.0)), 1e-9)
    colors = np.where(
        frame.observed[:, None], heat_colors(frame.deviation, 0, most, "viridis"), _UNOBSERVED_COLOR
    )
    title = f"standard deviation, 0 to {most:.2g} mm" if len(shown) else "nothing is observed"
    lost = 1 - frame.observed.mean()
    more = f"\n(red: {lost:.0%} not observed)" if lost > 0 else ""
    panels = []
    for pitch, side in ((0.0, "front"), (_ABOVE_DEG, "above")):
        view = View.around(vertices, pitch_deg=pitch)
        picture = render_mesh(vertices, frame.faces, vertex_color_srgb=colors, view=view, size=_SIZE)
        panels.append(Panel(f"{title}; {side}{more}", picture))
    return panels


def _head_panel(frame: RegisteredEyeglasses, vertices: FloatArray, head: Mesh) -> Panel:
    colors = np.repeat([_FRAME_COLOR, _SKIN_COLOR], [len(vertices), len(head[0])], axis=0)
    joined = np.concatenate([vertices, head[0]]), np.concatenate([frame.faces, head[1] + len(vertices)])
    around = View.around(vertices)
    view = View(around.center_mm, 1.3 * around.half_width_mm, yaw_deg=-_TURN_DEG)
    picture = render_mesh(*joined, vertex_color_srgb=colors, view=view, size=_SIZE)
    return Panel("on the head", picture)


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


def preview(linear: FloatArray, exposure: float) -> NDArray[np.uint8]:
    """Return sRGB bytes (H, W, 3)."""
    return encode_srgb_bytes(exposure * linear)
