"""`overview.png`: input, fit, geometry image, lighting and albedo side by side."""

from functools import partial

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import Values
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.mesh import far_faces
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import label_colors, linear_to_srgb
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.rendering.pictures import View, heat_colors, render_mesh
from scan2albedo.report.overview import Panel, chart_picture, preview_srgb, white_level

RESIDUAL_SCALE_MM = 2.0
"""Residual shown in the brightest colour of the heat map."""


def result_panels(result: ProcessResult) -> list[Panel]:
    """Return the panels of a result."""
    fitted, texture_linear = result.fitted, result.geometry_image.texture_linear
    if fitted is None:
        return _chart_panels(result)
    view = View.around(fitted.vertices)
    # Pictures of the scan show more around the face than those of the fit.
    wide = View(view.center_mm, 1.5 * view.half_width_mm)
    drawn = partial(render_mesh, fitted.vertices, fitted.faces, view=view)
    colors = heat_colors(fitted.residual_mm, 0, RESIDUAL_SCALE_MM, "inferno")
    mean = np.nanmean(fitted.residual_mm)
    heat = f"off the scan: 0 to {RESIDUAL_SCALE_MM:g} mm (mean {mean:.2f}, grey: no scan)"
    panels = [
        scan_panel("registered input, found landmarks", result.scan, fitted, wide, marked=True),
        Panel("fitted surface", drawn()),
        Panel(heat, drawn(vertex_color_srgb=colors, shaded=False)),
        *_chart_panels(result),
    ]
    if texture_linear is not None and result.preview_srgb is not None:
        textures = {
            "texture": preview_srgb(texture_linear, result.geometry_image.mask),
            "albedo": result.preview_srgb,
        }
        for name, texture in textures.items():
            uv = fitted.uv[fitted.faces]
            panels.append(Panel(f"face with its {name}", drawn(texture=(uv, texture), shaded=False)))
    if result.unlit is not None:
        panels.append(scan_panel("scan without its light", result.unlit.scan, fitted, wide))
    return panels


def _chart_panels(result: ProcessResult) -> list[Panel]:
    """Return texture, skin, light, albedo and normals on the chart."""
    panels = list[Panel]()
    image, estimate = result.geometry_image, result.albedo
    mask = image.mask
    if image.texture_linear is not None:
        dimmed = np.where(image.seen[..., None], 1, 0.35) * image.texture_linear
        panels.append(Panel("texture (dark: badly seen)", preview_srgb(dimmed, mask)))
    if image.skin is not None:
        panels.append(Panel("skin (white): the light is found there", chart_picture(image.skin, mask)))
    if image.labels is not None:
        panels.append(Panel("skin, brows, eyes, lips ... (docs/files.md)", label_colors()[image.labels]))
    if estimate is not None and result.preview_srgb is not None:
        lights = {"diffuse light + ambient": estimate.shading, "highlights": estimate.specular}
        for title, light in lights.items():
            shown = linear_to_srgb(light / white_level(light, mask))
            panels.append(Panel(title, chart_picture(shown, mask)))
        panels.append(Panel("albedo", result.preview_srgb))
    return [*panels, Panel("normals", chart_picture((image.normal + 1) / 2, mask))]


def scan_panel(title: str, scan: RawScan, fitted: FittedFace, view: View, *, marked: bool = False) -> Panel:
    """Return a scan where the fit has it, `marked` with its landmarks if it has some."""
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    near = ~far_faces(scan.vertices, scan.faces)  # stray faces in front would hide the face
    colors: Values = {"shaded": not scan.has_color}
    if scan.uv is not None and scan.texture_linear is not None:
        colors["texture"] = scan.uv[near], scan.texture_linear
    elif scan.vertex_color_linear is not None:
        colors["vertex_color_srgb"] = linear_to_srgb(np.clip(scan.vertex_color_linear, 0, 1))
    picture = render_mesh(placed, scan.faces[near], view=view, **colors)
    dots = view.pixels(fitted.landmarks, len(picture)) if marked and fitted.landmarks is not None else ()
    return Panel(title, picture, dots)
