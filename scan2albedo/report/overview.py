"""`overview.png`: input, fit, geometry image, lighting and albedo side by side."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import far_faces
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes, linear_to_srgb
from scan2albedo.rendering.views import View, heat_colors, render_mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core.geometry_image import GeometryImage
    from scan2albedo.core.raw_scan import RawScan
    from scan2albedo.fitting import FittedFace

Picture = NDArray[np.uint8]

RESIDUAL_SCALE_MM = 2.0
"""Residual shown in the brightest colour of the heat map."""
_PNG_LEVEL = 3
_WIDER = 1.35
"""Pictures of the scan show more around the face than those of the fit."""


@dataclass(frozen=True)
class Panel:
    """One titled picture of the overview."""

    title: str
    picture: Picture
    dots: NDArray[np.float64] | None = None
    """(N, 2) pixel positions (column, row) to mark, such as landmarks."""
    dot_colors: NDArray[np.float64] | None = None
    """(N, 3) sRGB; lime when omitted."""


def overview_figure(title: str, panels: list[Panel], columns: int = 5) -> Figure:
    """Return a matplotlib figure with the panels in rows of `columns`."""
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.9 * rows + 0.4), dpi=100, layout="constrained")
    # A line that is wider than the figure would be cut off on both sides.
    lines = [line for part in title.split("\n") for line in textwrap.wrap(part, 36 * columns) or [""]]
    figure.suptitle("\n".join(lines), fontsize=12)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, panel in zip(axes, panels, strict=False):
        axis.imshow(panel.picture, interpolation="nearest")
        axis.set_title(panel.title, fontsize=9, y=1.0)  # a given place saves measuring the axes for one
        if panel.dots is not None:
            colors, area = ("lime", 4) if panel.dot_colors is None else (panel.dot_colors, 12)
            axis.scatter(panel.dots[:, 0], panel.dots[:, 1], s=area, c=colors, linewidths=0)
            axis.set_xlim(0, panel.picture.shape[1])
            axis.set_ylim(panel.picture.shape[0], 0)
    return figure


def result_panels(
    scan: RawScan,
    fitted: FittedFace | None,
    image: GeometryImage,
    estimate: AlbedoEstimate | None,
    albedo_srgb: Picture | None,
    unlit: RawScan | None = None,
) -> list[Panel]:
    """Return the panels of a processed scan, from the input to the albedo, whose preview is `albedo_srgb`.

    `unlit` is the scan itself without its light, where that was asked for.
    """
    charts = _chart_panels(image, estimate, albedo_srgb)
    if fitted is None:
        return charts
    around = View.around(fitted.vertices)
    view = View(around.center_mm, around.half_width_mm * 1.15)
    surface = render_mesh(fitted.vertices, fitted.faces, view=view)
    colors = heat_colors(fitted.residual_mm, 0, RESIDUAL_SCALE_MM, "inferno")
    residual = render_mesh(fitted.vertices, fitted.faces, vertex_color_srgb=colors, view=view, shaded=False)
    mean = float(np.nanmean(fitted.residual_mm)) if np.isfinite(fitted.residual_mm).any() else float("nan")
    heat = f"distance to the scan, 0 to {RESIDUAL_SCALE_MM:g} mm (mean {mean:.2f}, grey: no scan)"
    panels = [_input_panel(scan, fitted, view), Panel("fitted surface", surface), Panel(heat, residual)]
    panels += charts
    if image.texture_linear is not None and albedo_srgb is not None:
        texture_srgb = preview_srgb(image.texture_linear, image.mask)
        uv = fitted.uv[fitted.faces]
        for name, texture in (("texture", texture_srgb), ("albedo", albedo_srgb)):
            picture = render_mesh(
                fitted.vertices, fitted.faces, texture_srgb=(uv, texture), view=view, shaded=False
            )
            panels.append(Panel(f"face with its {name}", picture))
    if unlit is not None:
        panels.append(_scan_panel("scan without its light", unlit, fitted, view))
    return panels


def _chart_panels(
    image: GeometryImage, estimate: AlbedoEstimate | None, albedo_srgb: Picture | None
) -> list[Panel]:
    """Return the panels that live on the chart: texture, lighting, albedo, normals."""
    panels = []
    if image.texture_linear is not None:
        dimmed = np.where(image.seen[..., None], image.texture_linear, 0.35 * image.texture_linear)
        panels.append(Panel("texture (dark: badly seen)", preview_srgb(dimmed, image.mask)))
    if image.skin is not None:
        skin = np.where(image.mask, image.skin, 1.0)
        panels.append(
            Panel("skin (white): the light is found there", _bytes(np.repeat(skin[..., None], 3, axis=2)))
        )
    if estimate is not None and albedo_srgb is not None:
        panels.append(Panel("diffuse light + ambient", _light(estimate.shading, image.mask)))
        panels.append(
            Panel("highlights", _light(np.repeat(estimate.specular[..., None], 3, axis=2), image.mask))
        )
        panels.append(Panel("albedo", albedo_srgb))
    normal = np.where(image.mask[..., None], (image.normal + 1) / 2, 1.0)
    panels.append(Panel("normals", _bytes(normal)))
    return panels


def preview_srgb(linear: NDArray[np.floating], mask: NDArray[np.bool_]) -> Picture:
    """Return (H, W, 3) sRGB bytes of a linear image times its `preview_factor`, white outside the mask."""
    scaled = np.clip(linear * preview_factor(linear, mask), 0, 1)
    return _bytes(np.where(mask[..., None], linear_to_srgb(scaled), 1.0))


def preview_factor(linear: NDArray[np.floating], mask: NDArray[np.bool_]) -> float:
    """Return the factor that puts the 90th percentile of the brightest channel at 0.55; 1 for black images.

    The albedo's global scale is unknown, and a percentile keeps a few wild texels from darkening the rest.
    """
    inside = linear[mask]
    bright = float(np.percentile(inside.max(-1), 90)) if len(inside) else 0.0
    return 0.55 / bright if bright > 0 else 1.0


def _input_panel(scan: RawScan, fitted: FittedFace, view: View) -> Panel:
    panel = _scan_panel("registered input, found landmarks", scan, fitted, view)
    if fitted.landmarks is None:
        return panel
    wide = View(view.center_mm, view.half_width_mm * _WIDER)
    return replace(panel, dots=wide.pixels(fitted.landmarks, len(panel.picture)))


def _scan_panel(title: str, scan: RawScan, fitted: FittedFace, view: View) -> Panel:
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    near = ~far_faces(scan.vertices, scan.faces)  # stray faces in front would hide the face
    texture, color = None, None
    if scan.uv is not None and scan.texture_linear is not None:
        texture = scan.uv[near], encode_srgb_bytes(scan.texture_linear)
    elif scan.vertex_color_linear is not None:
        color = linear_to_srgb(np.clip(scan.vertex_color_linear, 0, 1))
    picture = render_mesh(
        placed,
        scan.faces[near],
        vertex_color_srgb=color,
        texture_srgb=texture,
        view=View(view.center_mm, view.half_width_mm * _WIDER),
        shaded=not scan.has_color,
    )
    return Panel(title, picture)


def _light(values: NDArray[np.floating], mask: NDArray[np.bool_]) -> Picture:
    """Return (H, W, 3) sRGB bytes in which nearly the brightest texel is white."""
    inside = values[mask]
    bright = float(np.percentile(inside.max(-1), 99.5)) if len(inside) else 0.0
    shown = linear_to_srgb(np.clip(values / bright, 0, 1)) if bright > 0 else np.zeros_like(values)
    return _bytes(np.where(mask[..., None], shown, 1.0))


def _bytes(picture: NDArray[np.floating]) -> Picture:
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def figure_png(figure: Figure, dpi: float | None = None) -> bytes:
    """Return a figure as a PNG file, its panels laid out once, where matplotlib would do so twice."""
    if dpi is not None:
        figure.set_dpi(dpi)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    png = BytesIO()
    figure.savefig(png, format="png", dpi="figure", pil_kwargs={"compress_level": _PNG_LEVEL})
    return png.getvalue()
