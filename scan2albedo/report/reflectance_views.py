"""Pictures of reflectances: albedo, weights of the lobes, which of them is identified, and faces relit."""

import numpy as np

from scan2albedo.core.arrays import BoolArray, ByteArray, FloatArray, GridShape, IntArray, dots, finite_rows
from scan2albedo.geometry.fields import filled_over_mesh
from scan2albedo.geometry.mesh import face_cross_products, normalized
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes, linear_to_srgb
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance import MeshReflectance, ReflectanceFit, VertexReflectance
from scan2albedo.reflectance.point_light_lobes import point_light_lobes
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM
from scan2albedo.rendering.pictures import View, heat_colors, render_mesh, seen_samples
from scan2albedo.report.overview import Panel

_MOST_ERROR = 0.2
"""Difference that is shown in the brightest colour, white = 1."""


def reflectance_panels(mesh: MeshReflectance, fit: ReflectanceFit | None = None) -> list[Panel]:
    """Return panels of albedo, weights and a fit's certainty; the mesh from +z, unknown vertices grey.

    In the albedo's panel they, and those whose albedo the fit does not identify, are filled from around them.
    """
    one = mesh.reflectance

    def heat(title: str, values: FloatArray, most: float) -> Panel:
        return Panel(title, face_picture(mesh, heat_colors(values, 0.0, most)))

    weights = one.weights[one.known]
    most = max(float(np.percentile(weights, 95)) if weights.size else 0.0, 1e-9)
    drawn = one.known if fit is None else fit.drawn
    title = "albedo" if drawn.all() else "albedo, unknown vertices filled"
    panels = [Panel(title, face_picture(mesh, albedo_colors(filled_albedo(mesh, drawn))))]
    lobes = {"broad lobe": 1, "middle lobe": 8, "narrow lobe": 64}
    for k, (name, exponent) in enumerate(lobes.items()):
        panels.append(heat(f"weight of the {name} ({exponent}), 0 to {most:.2g}", one.weights[:, k], most))
    if fit is None:
        return panels
    ratios = fit.identifiability
    panels.append(heat("std over prior: albedo, 0 to 1", ratios[:, :3].max(1), 1.0))
    for k, name in enumerate(lobes):
        panels.append(heat(f"std over prior: {name}, 0 to 1", ratios[:, 3 + k], 1.0))
    pairs = fit.pair_count.astype(float)
    panels.append(heat(f"pictures, 0 to {pairs.max():.0f}", pairs, max(pairs.max(), 1.0)))
    misfit = np.where(np.isfinite(fit.misfit), fit.misfit, np.nan)
    panels.append(heat("misfit over noise, 0 to 3", misfit, 3.0))
    return panels


def face_picture(mesh: MeshReflectance, color: FloatArray) -> ByteArray:
    """Return the mesh seen from +z in sRGB colours (V, 3), without shading."""
    view = View.around(mesh.vertices)
    return render_mesh(mesh.vertices, mesh.faces, vertex_color_srgb=color, view=view, size=360, shaded=False)


def filled_albedo(mesh: MeshReflectance, drawn: BoolArray | None = None) -> FloatArray:
    """Return albedos (V, 3), those not `drawn` (V,) or not known from around them; NaN if there are none."""
    one = mesh.reflectance
    kept = one.known if drawn is None else one.known & drawn
    return filled_over_mesh(one.diffuse_linear, kept, mesh.faces) if kept.any() else one.diffuse_linear


def albedo_colors(diffuse_linear: FloatArray, *, white: float | None = None) -> FloatArray:
    """Return (V, 3) sRGB colours of albedos (V, 3), brightened so that `white` is 0.8; NaN is grey."""
    # The scale of an albedo is not known: its 99th percentile is shown.
    level = albedo_white(diffuse_linear) if white is None else white
    shown = linear_to_srgb(np.clip(np.nan_to_num(diffuse_linear) * (0.8 / max(level, 1e-12)), 0, 1))
    return np.where(np.isfinite(diffuse_linear), shown, 0.6)


def albedo_white(diffuse_linear: FloatArray) -> float:
    """Return the 99th percentile of known albedos (V, 3); 1 where none is known."""
    finite = diffuse_linear[np.isfinite(diffuse_linear)]
    return float(np.percentile(finite, 99)) if finite.size else 1.0


def relit_panels(
    name: str, photograph: FloatArray, relit: FloatArray, shown: BoolArray, valid: BoolArray
) -> list[Panel]:
    """Return panels of a photograph, of a face relit as it was, both (H, W, 3) linear, and the difference.

    `shown` (H, W) marks the part of the face that is known, `valid` (H, W, 3) what the photograph did not
    clip: only there is there a difference.
    """
    # The part of the pictures that holds the shown face.
    window = []
    for axis in (1, 0):
        there, last = np.flatnonzero(shown.any(axis)), shown.shape[1 - axis]
        low, high = (there[0], there[-1] + 1) if len(there) else (0, last)
        window.append(slice(max(low - 8, 0), min(high + 8, last)))
    rows, columns = window
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
            np.round(255 * heat_colors(off, 0, _MOST_ERROR, "inferno")).astype(np.uint8),
        ),
    ]


def draw_in_camera(
    camera: FloatArray, shape: GridShape, vertices: FloatArray, faces: IntArray, color: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return colours (V, 3) as a camera (3, 4) sees them (H, W, 3), and where they are all known (H, W)."""
    seen = seen_samples(vertices, faces, camera, shape)
    known = seen.interpolated(finite_rows(color).astype(float)) > 1 - 1e-9
    colors = np.where(known[:, None], seen.interpolated(np.nan_to_num(color)), 0.0)
    made = seen.picture(np.column_stack([colors, known]))
    return made[..., :3], made[..., 3] > 0


def relit_picture(
    vertices: FloatArray,
    faces: IntArray,
    normals: FloatArray,
    reflectance: VertexReflectance,
    *,
    camera: FloatArray,
    shape: GridShape,
    light: FloatArray,
    reference_distance_mm: float | None = None,
) -> tuple[FloatArray, BoolArray]:
    """Return radiance (H, W, 3) under a light of strength 1 at (3,), and where all of it is known (H, W).

    The mesh's vertices (V, 3), mm, have unit `normals`, 0 where there is none; those whose reflectance is not
    known are filled from those around them. Each pixel of `camera` (3, 4) is the mean of nine rays, shaded
    and shadowed one by one. The back of the mesh is not seen.
    """
    center, across = camera_centers(camera[None]), face_cross_products(vertices, faces)
    front = dots(across, center - vertices[faces[:, 0]]) > 0
    seen = seen_samples(vertices, faces[front], camera, shape, 3)
    if len(seen.index) == 0 or not reflectance.known.any():
        return np.zeros((*shape, 3)), np.zeros(shape, bool)
    numbers = np.concatenate([reflectance.diffuse_linear, reflectance.weights], axis=1)
    numbers = filled_over_mesh(numbers, reflectance.known, faces)
    albedo, gloss = np.split(seen.interpolated(numbers), [3], axis=1)
    point, normal = seen.interpolated(vertices), normalized(seen.interpolated(normals))
    view = point, normal, center, light[None]
    lobes = point_light_lobes(*view, reference_distance_mm=reference_distance_mm)[0]
    # Lamps have their place around the origin, which is to lie inside the mesh.
    middle = (vertices.min(0) + vertices.max(0)) / 2
    curved, distance = seen.raised(vertices, normals, outward=True), float(np.linalg.norm(light - middle))
    shadows = ShadowMap(RayCaster(vertices - middle, faces), curved - middle, normal, RAY_OFFSET_MM)
    reached = (lobes[:, 0] > 0) & (shadows.visible((light - middle) / distance, distance) > 0)
    radiance = lobes[:, :1] * albedo + (lobes[:, 1:] * gloss).sum(1)[:, None]
    certain = seen.interpolated(reflectance.known.astype(float)) > 1 - 1e-9
    made = seen.picture(np.column_stack([radiance * reached[:, None], certain]))
    return made[..., :3], made[..., 3] == 1
