"""Pictures of eyeglasses: canonicalised frames, frames registered on a face, and where key points go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from PIL.ImageColor import getrgb
from scipy.ndimage import affine_transform, binary_dilation

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, all_finite, finite_rows, norms, rms
from scan2albedo.eyeglasses import Camera, RegisteredEyeglasses
from scan2albedo.eyeglasses.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, KEY_POINT_PLACES
from scan2albedo.eyeglasses.mean_keypoints import align_key_points, in_own_axes
from scan2albedo.eyeglasses.on_face.outline import hidden_by
from scan2albedo.geometry.pinhole import normalized_cameras, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.rendering.pictures import View, heat_colors, render_mesh, seen_samples
from scan2albedo.report.overview import Panel
from scan2albedo.synthetic import GlassesShape, eyeglasses

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Mesh = tuple[FloatArray, IntArray]
SeenView = tuple[Camera, BoolArray | None, FloatArray]

MOST_SHOWN = 12
"""Frames or views beyond these are not drawn: nobody would find them."""
_SIZE = 512
"""Side of a panel in pixels."""
_MARGIN = 0.04
"""Left free around what a picture shows, as a part of its width."""
_ABOVE_DEG = -90.0
_OUTLIER_COLOR = "crimson"


def glasses_panels(frames: Sequence[tuple[str, FloatArray, CanonicalEyeglasses]]) -> list[Panel]:
    """Return four panels a frame: before, coloured by weights, and after, coloured by how far it moved.

    `frames` are names, vertices (V, 3) as given, and what became of them. Dots are the canonical key points.
    """
    from matplotlib import colormaps

    drawn = frames[:MOST_SHOWN]
    before = [transform_points(c.canonical_from_frame, c.scale * original) for _, original, c in drawn]
    pairs = zip(drawn, before, strict=True)
    moved = [norms(canonical.vertices - placed) for (_, _, canonical), placed in pairs]
    most = max(float(m.max()) for m in moved)
    views = [View.around(np.concatenate(before), pitch_deg=pitch) for pitch in (0.0, _ABOVE_DEG)]
    panels = []
    for (name, _, canonical), placed, distance in zip(drawn, before, moved, strict=True):
        dots = canonical.keypoints[finite_rows(canonical.keypoints)]
        # Each column of the weights has a hue, mixed by weight.
        hues = colormaps["tab20"](np.arange(canonical.weights.shape[1]) % 20)[:, :3]
        heat = heat_colors(distance, 0, max(most, 1e-9))
        how = "unbent, own shape" if canonical.unbent else "to the mean"
        how += f"\nmoved by {rms(distance):.2f} mm rms (0 to {most:.2g} mm)"
        states = ((f"{name}\nas given", placed, canonical.weights @ hues), (how, canonical.vertices, heat))
        for view, side in zip(views, ("front", "above"), strict=True):
            for title, vertices, color in states:
                mesh = vertices, canonical.faces
                picture = render_mesh(*mesh, vertex_color_srgb=color, view=view, size=_SIZE)
                panels.append(Panel(f"{title}; {side}", picture, view.pixels(dots, _SIZE)))
    return panels


def registration_panels(
    frame: RegisteredEyeglasses, views: Sequence[SeenView], head: Mesh | None = None
) -> list[Panel]:
    """Return a panel for each view, two of the frame's standard deviation, and one on the head if any.

    Orange is the frame's outline, blue where the head hides it; red are outliers and what is not observed.
    """
    caster = None if head is None else RayCaster(*head)
    panels = [_view_panel(frame, number, view, caster) for number, view in enumerate(views[:MOST_SHOWN])]
    upright = align_key_points(frame.keypoints, in_own_axes(frame.keypoints))
    vertices = transform_points(upright, frame.vertices)
    shown = frame.deviation[frame.observed]
    most = max(float(shown.max(initial=0.0)), 1e-9)
    heat = heat_colors(frame.deviation, 0, most)
    colors = np.where(frame.observed[:, None], heat, np.divide(getrgb(_OUTLIER_COLOR), 255))
    title = f"standard deviation, 0 to {most:.2g} mm" if len(shown) else "nothing is observed"
    lost = 1 - frame.observed.mean()
    more = f"\n(red: {lost:.0%} not observed)" if lost > 0 else ""
    for pitch, side in ((0.0, "front"), (_ABOVE_DEG, "above")):
        view = View.around(vertices, pitch_deg=pitch)
        picture = render_mesh(vertices, frame.faces, vertex_color_srgb=colors, view=view, size=_SIZE)
        panels.append(Panel(f"{title}; {side}{more}", picture))
    if head is not None:
        skin = transform_points(upright, head[0])
        parts = getrgb("midnightblue"), getrgb("bisque")
        colors = np.repeat(parts, [len(vertices), len(skin)], axis=0) / 255
        joined = np.concatenate([vertices, skin]), np.concatenate([frame.faces, head[1] + len(vertices)])
        around = View.around(vertices)
        view = View(around.center_mm, 1.5 * around.half_width_mm, yaw_deg=-35.0)
        picture = render_mesh(*joined, vertex_color_srgb=colors, view=view, size=_SIZE)
        panels.append(Panel("on the head", picture))
    return panels


def _view_panel(frame: RegisteredEyeglasses, number: int, view: SeenView, head: RayCaster | None) -> Panel:
    view_camera, view_mask, view_labels = view
    camera = normalized_cameras(view_camera.matrix[None])[0]
    # The (3, 3) map from the picture's pixels to the panel's that shows frame, mask and labels.
    height, width = view_camera.shape
    outlined = [project(camera, frame.vertices)[0], view_labels]
    if view_mask is not None:
        outlined.append(np.argwhere(view_mask)[:, ::-1].astype(float))
    points, limit = np.concatenate(outlined), np.array([width, height]) - 0.5
    points = points[finite_rows(points)]
    if len(points) == 0:
        points = np.array([[-0.5, -0.5], limit])
    room = _MARGIN * np.array([width, height])
    points = np.clip(points, -0.5 - room, limit + room)
    low, high = points.min(0), points.max(0)
    half = max(float(np.max(high - low)) / 2 * (1 + 2 * _MARGIN), 4.0)
    scale = _SIZE / (2 * half)
    zoom = np.diag([scale, scale, 1.0])
    zoom[:2, 2] = -scale * ((low + high) / 2 - half) - 0.5
    # The mask grey on black, the outside of the picture white.
    mask = np.zeros(view_camera.shape, bool) if view_mask is None else view_mask
    shift, size = zoom[[1, 0], 2], (_SIZE, _SIZE)
    map_back = [1 / scale] * 2, -shift / scale, size
    gray = affine_transform(mask / 2, *map_back, order=1, mode="grid-constant", cval=1.0)
    picture = np.repeat(np.round(255 * gray).astype(np.uint8)[:, :, None], 3, axis=2)
    # Where the frame is seen, and where the head is in front of it.
    shown = seen_samples(frame.vertices, frame.faces, normalized_cameras((zoom @ camera)[None])[0], size)
    behind = hidden_by(head, camera, shown.interpolated(frame.vertices))
    seen, hidden = np.zeros((2, *size), bool)
    seen.flat[shown.index[~behind]] = True
    hidden.flat[shown.index[behind]] = True
    # The silhouette's own border; what the head cuts off is not a border of the frame.
    for part, rest, color in ((hidden, ~(seen | hidden), "cornflowerblue"), (seen, ~seen, "darkorange")):
        picture[part & binary_dilation(rest, iterations=2)] = getrgb(color)
    errors, close = frame.label_errors_px[number], frame.inliers[number]
    labelled = ~np.isnan(errors)
    count, wrong = int(labelled.sum()), int((labelled & ~close).sum())
    labels = f"{count} labels" + (f", {wrong} outliers" if wrong else "")
    if close.any():
        labels += f", {rms(errors[close]):.1f} px rms"
    off = frame.outline_rms_px[number]
    outline = "outline not compared" if np.isnan(off) else f"outline {off:.1f} px rms"
    title = f"{view_camera.name}: {labels}\n{'no mask' if view_mask is None else outline}"
    dots = view_labels[labelled] @ zoom[:2, :2].T + zoom[:2, 2]
    return Panel(title, picture, dots, ["lime" if near else _OUTLIER_COLOR for near in close[labelled]])


def key_point_chart(
    mesh: RawScan | None = None, keypoints: FloatArray | None = None, deviations_mm: Mapping[str, float] = {}
) -> Figure:
    """Return a matplotlib figure of a frame in mm with the names of its key points (20, 3).

    Of a synthetic frame when there is none; deviations stand beside the names.
    """
    from matplotlib.figure import Figure

    if mesh is None or keypoints is None:
        glasses = eyeglasses(shape=GlassesShape(bridge_width=19, bridge_height=5), nose_pads=False)
        vertices, faces, marks = glasses.vertices, glasses.faces, glasses.keypoints
    else:
        upright = align_key_points(keypoints, in_own_axes(keypoints))
        vertices, marks = transform_points(upright, mesh.vertices), transform_points(upright, keypoints)
        faces = mesh.faces
    points = {name: p for name, p in zip(KEY_POINT_NAMES, marks, strict=True) if all_finite(p)}
    x, _, z = map(float, (vertices.min(0) + vertices.max(0)) / 2)
    half = float(np.ptp(vertices, axis=0).max()) * 3 / 4
    temple = [name for name in points if name.startswith(("left_temple", "left_ear"))]
    front = [name for name in points if "temple" not in name and "ear" not in name]
    pictures = (
        ("from the front (left is the wearer's left)", View((x, 0, 0), half), front),
        (
            "from the wearer's left; the right temple likewise",
            View((x, 0, z), half, yaw_deg=-90),
            [name for name in ("left_hinge", "left_rim_top", "left_rim_bottom", *temple) if name in points],
        ),
    )
    figure = Figure(figsize=(12, 10), dpi=100, layout="constrained")
    size = 1400
    line = {"arrowstyle": "-", "color": "gray", "shrinkB": 0}
    for axes, (title, view, names) in zip(figure.subplots(2, 1), pictures, strict=True):
        axes.imshow(render_mesh(vertices, faces, view=view, size=size))
        axes.set_title(title, fontsize=12)
        axes.set_axis_off()
        places = dict(zip(names, view.pixels([points[name] for name in names], size), strict=True))
        middle = np.median([row for _, row in places.values()])
        # Names of the upper points in a row above the frame, of the lower ones in one below.
        ordered = sorted(names, key=lambda name: places[name][0])
        upper = [name for name in ordered if places[name][1] < middle]
        for row, level in ((upper, -270), ([name for name in ordered if name not in upper], 270)):
            for number, name in enumerate(row):
                at, label_at = tuple(places[name]), ((number + 0.5) * size / len(row), middle + level)
                said = f"{name}\n+- {deviations_mm[name]:.1f} mm" if name in deviations_mm else name
                axes.annotate(said, at, label_at, arrowprops=line, fontsize=10, ha="center", va="center")
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
