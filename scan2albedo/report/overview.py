"""`overview.png`: input, fit, geometry image, lighting and albedo side by side."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.core.arrays import BoolArray, ByteArray, FloatArray, RealArray, Values
from scan2albedo.geometry.mesh import far_faces
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes, label_colors, linear_to_srgb
from scan2albedo.rendering.pictures import View, heat_colors, render_mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core.geometry_image import GeometryImage
    from scan2albedo.core.raw_scan import RawScan
    from scan2albedo.fitting import FittedFace

Picture = ByteArray

RESIDUAL_SCALE_MM = 2.0
"""Residual shown in the brightest colour of the heat map."""


@dataclass(frozen=True)
class Panel:
    """One titled picture of the overview."""

    title: str
    picture: Picture
    dots: FloatArray | None = None
    """(N, 2) pixel positions (column, row) to mark, such as landmarks."""
    dot_colors: FloatArray | None = None
    """(N, 3) sRGB; lime when omitted."""


def overview_figure(title: str, panels: list[Panel], columns: int = 5) -> Figure:
    """Return a matplotlib figure with the panels in rows of `columns`."""
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    # A line that is wider than the figure would be cut off on both sides. An empty one keeps panels apart.
    lines = [line for part in f"{title}\n".split("\n") for line in textwrap.wrap(part, 36 * columns) or [""]]
    below_in = 4 * rows
    height_in = below_in + 0.25 * len(lines)
    figure = Figure(figsize=(3.6 * columns, height_in))
    figure.suptitle("\n".join(lines))
    # Places in inches: matplotlib's own layout engines take as long as the drawing.
    figure.subplots_adjust(0, 0, 1, (below_in - 0.25) / height_in, 0.03, 0.08)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        axis.imshow(panel.picture, interpolation="nearest")
        axis.set_title(panel.title, fontsize=9, y=1.0)  # a given place saves measuring the axes for one
        if panel.dots is not None:
            colors, area = ("lime", 4) if panel.dot_colors is None else (panel.dot_colors, 12)
            axis.scatter(panel.dots[:, 0], panel.dots[:, 1], s=area, c=colors, linewidths=0)
            axis.axis((0, panel.picture.shape[1], panel.picture.shape[0], 0))
    return figure


def result_panels(
    scan: RawScan,
    fitted: FittedFace | None,
    image: GeometryImage,
    estimate: AlbedoEstimate | None,
    albedo_srgb: Picture | None,
    unlit: RawScan | None = None,
) -> list[Panel]:
    """Return the panels of a scan; `albedo_srgb` previews its albedo, `unlit` is it without light."""
    view, panels = None, list[Panel]()
    if fitted is not None:
        view = View.around(fitted.vertices)
        # Pictures of the scan show more around the face than those of the fit.
        wide = View(view.center_mm, 1.5 * view.half_width_mm)
        panels.append(_scan_panel("registered input, found landmarks", scan, fitted, wide))
        if fitted.landmarks is not None:
            panels[0] = replace(panels[0], dots=wide.pixels(fitted.landmarks, len(panels[0].picture)))
        mesh = fitted.vertices, fitted.faces
        panels.append(Panel("fitted surface", render_mesh(*mesh, view=view)))
        colors = heat_colors(fitted.residual_mm, 0, RESIDUAL_SCALE_MM, "inferno")
        residual = render_mesh(*mesh, vertex_color_srgb=colors, view=view, shaded=False)
        known = fitted.residual_mm[np.isfinite(fitted.residual_mm)]
        mean = np.mean(known) if len(known) else np.nan
        heat = f"distance to the scan, 0 to {RESIDUAL_SCALE_MM:g} mm (mean {mean:.2f}, grey: no scan)"
        panels.append(Panel(heat, residual))
    panels += _chart_panels(image, estimate, albedo_srgb)
    texture_linear, mask = image.texture_linear, image.mask
    if fitted is not None and view is not None:
        if texture_linear is not None and albedo_srgb is not None:
            uv = fitted.uv[fitted.faces]
            textures = {"texture": preview_srgb(texture_linear, mask), "albedo": albedo_srgb}
            for name, texture in textures.items():
                picture = render_mesh(*mesh, texture_srgb=(uv, texture), view=view, shaded=False)
                panels.append(Panel(f"face with its {name}", picture))
        if unlit is not None:
            panels.append(_scan_panel("scan without its light", unlit, fitted, wide))
    return panels


def _chart_panels(
    image: GeometryImage, estimate: AlbedoEstimate | None, albedo_srgb: Picture | None
) -> list[Panel]:
    """Return texture, skin, light, albedo and normals on the chart."""
    panels = list[Panel]()
    texture_linear, mask = image.texture_linear, image.mask
    if texture_linear is not None:
        dimmed = np.where(image.seen[..., None], texture_linear, 0.35 * texture_linear)
        panels.append(Panel("texture (dark: badly seen)", preview_srgb(dimmed, mask)))
    if image.skin is not None:
        panels.append(Panel("skin (white): the light is found there", _chart(image.skin, mask)))
    if image.labels is not None:
        panels.append(Panel("skin, brows, eyes, lips ... (docs/files.md)", label_colors()[image.labels]))
    if estimate is not None and albedo_srgb is not None:
        lights = {"diffuse light + ambient": estimate.shading, "highlights": estimate.specular}
        for title, light in lights.items():
            panels.append(Panel(title, _chart(linear_to_srgb(light / white_level(light, mask)), mask)))
        panels.append(Panel("albedo", albedo_srgb))
    return [*panels, Panel("normals", _chart((image.normal + 1) / 2, mask))]


def preview_srgb(linear: RealArray, mask: BoolArray) -> Picture:
    """Return (H, W, 3) sRGB bytes of a linear image times its `preview_factor`, white outside the mask."""
    return _chart(linear_to_srgb(np.clip(linear * preview_factor(linear, mask), 0, 1)), mask)


def preview_factor(linear: RealArray, mask: BoolArray) -> float:
    """Return the factor that puts the 90th percentile of the brightest channel at 0.55."""
    return 0.55 / white_level(linear, mask, 90)


def white_level(values: RealArray, mask: BoolArray, percentile: float = 99.9) -> float:
    """Return a percentile of an image's brightest channel (H, W) or (H, W, C) in its mask; 1 for black."""
    inside = values[mask]
    bright = np.percentile(inside if values.ndim == 2 else inside.max(-1), percentile) if len(inside) else 0
    return float(bright) if bright > 0 else 1.0


def _chart(srgb: RealArray, mask: BoolArray) -> Picture:
    """Return (H, W, 3) bytes of an image (H, W) or (H, W, 3) in [0, 1], clipped, white outside the mask."""
    colors = srgb if srgb.ndim == 3 else np.repeat(srgb[..., None], 3, axis=2)
    return np.round(np.where(mask[..., None], np.clip(colors, 0, 1), 1.0) * 255).astype(np.uint8)


def _scan_panel(title: str, scan: RawScan, fitted: FittedFace, view: View) -> Panel:
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    near = ~far_faces(scan.vertices, scan.faces)  # stray faces in front would hide the face
    colors: Values = {"shaded": not scan.has_color}
    if scan.uv is not None and scan.texture_linear is not None:
        colors["texture_srgb"] = scan.uv[near], encode_srgb_bytes(scan.texture_linear)
    elif scan.vertex_color_linear is not None:
        colors["vertex_color_srgb"] = linear_to_srgb(np.clip(scan.vertex_color_linear, 0, 1))
    return Panel(title, render_mesh(placed, scan.faces[near], view=view, **colors))


def figure_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    png = BytesIO()
    figure.savefig(png, format="png", pil_kwargs={"compress_level": 3})
    return png.getvalue()
