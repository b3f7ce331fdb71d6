"""Pictures of reflectances: albedo, weights of the lobes, which of them is identified, and faces relit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.operators import filled_over_mesh
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.io.color import encode_srgb_bytes, linear_to_srgb
from scan2albedo.report.overview import Panel
from scan2albedo.report.rendering import View, heat_colors, render_mesh

if TYPE_CHECKING:
    from scan2albedo.reflectance import MeshReflectance, ReflectanceFit


_SIZE = 360
_BRIGHT = 0.8
"""Linear level at which the albedo's 99th percentile is shown: its scale is not known."""
_MOST_ERROR = 0.2
"""Difference that is shown in the brightest colour, white = 1."""
_MARGIN_PX = 8


def reflectance_panels(mesh: MeshReflectance, fit: ReflectanceFit | None = None) -> list[Panel]:
    """Return panels of albedo, weights and a fit's certainty; the mesh from +z, unknown vertices grey.

    In the albedo's panel they, and those whose albedo the fit does not identify, are filled from around them.
    """
    view = View.around(mesh.vertices)
    one = mesh.reflectance
    weights = one.weights[one.known]
    most = max(float(np.percentile(weights, 95)) if weights.size else 0.0, 1e-9)
    drawn = one.known if fit is None else fit.drawn
    title = "albedo" if drawn.all() else "albedo, unknown vertices filled"
    panels = [Panel(title, _colored(mesh, albedo_colors(filled_albedo(mesh, drawn)), view))]
    for k, name in enumerate(("broad lobe (1)", "middle lobe (8)", "narrow lobe (64)")):
        title = f"weight of the {name}, 0 to {most:.2g}"
        panels.append(Panel(title, _heat(mesh, one.weights[:, k], most, view)))
    if fit is None:
        return panels
    ratios = fit.identifiability
    panels.append(Panel("std over prior: albedo, 0 to 1", _heat(mesh, ratios[:, :3].max(1), 1.0, view)))
    for k, name in enumerate(("broad lobe", "middle lobe", "narrow lobe")):
        panels.append(Panel(f"std over prior: {name}, 0 to 1", _heat(mesh, ratios[:, 3 + k], 1.0, view)))
    pairs = fit.pair_count.astype(float)
    panels.append(Panel(f"pictures, 0 to {pairs.max():.0f}", _heat(mesh, pairs, max(pairs.max(), 1.0), view)))
    misfit = np.where(np.isfinite(fit.misfit), fit.misfit, np.nan)
    panels.append(Panel("misfit over noise, 0 to 3", _heat(mesh, misfit, 3.0, view)))
    return panels


def filled_albedo(mesh: MeshReflectance, drawn: BoolArray | None = None) -> FloatArray:
    """Return albedos (V, 3), those not `drawn` (V,) or not known from around them; NaN if there are none."""
    one = mesh.reflectance
    kept = one.known if drawn is None else one.known & drawn
    return filled_over_mesh(one.diffuse_linear, kept, mesh.faces) if kept.any() else one.diffuse_linear


def albedo_colors(diffuse_linear: FloatArray, *, white: float | None = None) -> FloatArray:
    """Return (V, 3) sRGB colours of albedos (V, 3), brightened so that `white` is 0.8; NaN is grey."""
    level = albedo_white(diffuse_linear) if white is None else white
    shown = linear_to_srgb(np.clip(np.nan_to_num(diffuse_linear) * (_BRIGHT / max(level, 1e-12)), 0, 1))
    return np.where(np.isfinite(diffuse_linear), shown, 0.6)


def albedo_white(diffuse_linear: FloatArray) -> float:
    """Return the 99th percentile of known albedos (V, 3); 1 where none is known."""
    finite = diffuse_linear[np.isfinite(diffuse_linear)]
    return float(np.percentile(finite, 99)) if finite.size else 1.0


def relit_panels(
    name: str,
    photograph: FloatArray,
    relit: FloatArray,
    shown: BoolArray,
    valid: BoolArray,
) -> list[Panel]:
    """Return panels of a photograph, of a face relit as it was, both (H, W, 3) linear, and the difference.

    `shown` (H, W) marks the part of the face that is known, `valid` (H, W, 3) what the photograph did not
    clip: only there is there a difference.
    """
    rows, columns = _window(shown)
    compared = shown & valid.all(-1)
    level = float(np.percentile(photograph[compared], 99)) if compared.any() else 1.0
    scale = 1 / max(level, 1e-12)
    whole = np.where(valid, photograph, level)
    taken, made = (picture[rows, columns] for picture in (whole, relit))
    off = np.abs(scale * (taken - made)).mean(-1)
    off = np.where(compared[rows, columns], off, np.nan)
    return [
        Panel(f"{name}: photograph", encode_srgb_bytes(np.clip(scale * taken, 0, 1))),
        Panel("relit", encode_srgb_bytes(np.clip(scale * made, 0, 1))),
        Panel(
            f"difference, 0 to {100 * _MOST_ERROR:.0f} % of white",
            np.round(255 * heat_colors(off, 0, _MOST_ERROR, "magma")).astype(np.uint8),
        ),
    ]


def draw_in_camera(
    camera: FloatArray, shape: tuple[int, int], vertices: FloatArray, faces: IntArray, color: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return colours (V, 3) as a camera (3, 4) sees them (H, W, 3), and where they are all known (H, W)."""
    pixels, depth = project(camera, vertices)
    known = np.isfinite(color).all(1)
    ahead = np.asarray(np.isfinite(pixels).all(1))
    kept = faces[np.flatnonzero(np.take(ahead, faces).all(1))]
    raster = rasterize(np.where(ahead[:, None], pixels, 0.0), -depth, kept, shape)
    shown = raster.covered & (interpolate(raster, kept, known.astype(float)) > 1 - 1e-9)
    return np.where(shown[..., None], interpolate(raster, kept, np.nan_to_num(color)), 0.0), shown


def _colored(mesh: MeshReflectance, color: FloatArray, view: View) -> NDArray[np.uint8]:
    return render_mesh(
        mesh.vertices, mesh.faces, vertex_color_srgb=color, view=view, size=_SIZE, shaded=False
    )


def _heat(mesh: MeshReflectance, values: FloatArray, most: float, view: View) -> NDArray[np.uint8]:
    return _colored(mesh, heat_colors(values, 0.0, most), view)


def _window(shown: BoolArray) -> tuple[slice, slice]:
    """Return the part of a picture that holds the shown face."""
    spans = []
    for axis in (1, 0):
        there = np.flatnonzero(shown.any(axis))
        last = shown.shape[1 - axis]
        low, high = (there[0], there[-1] + 1) if len(there) else (0, last)
        spans.append(slice(max(low - _MARGIN_PX, 0), min(high + _MARGIN_PX, last)))
    return spans[0], spans[1]
