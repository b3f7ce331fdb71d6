"""`engine_maps`: what a renderer's skin material asks for, on any texture coordinates of a processed face."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.template_baking import (
    REACH_MM,
    Appearance,
    Fields,
    TemplateTexture,
    TemplateTile,
    baked_tiles,
)
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry import mesh
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import face_areas, thinned, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.lighting.environment_light import shadowed_transfer
from scan2albedo.lighting.shadow_map import ShadowMap

CARRIERS = ("chart", "scan", "template")
"""Whose texture coordinates the maps lie on."""
SKIN_F0, PLASTIC_F0 = 0.028, 0.04
"""Reflectance at normal incidence of skin (index of refraction 1.4), and of what glTF takes a surface for.

.. [1] T. Weyrich et al., "Analysis of human faces using a measurement-based skin reflectance model", SIGGRAPH
   2006.
"""
MATTE_EXPONENT = 6.0
"""Phong's, of skin whose highlights were not seen: roughness 0.53."""
_PORE_MM = 0.05
"""Depth that is guessed for a spot that is darker by a factor of e."""
_RELIEF_MM, _AROUND_MM = 0.1, 1.0
"""Height above the mean around, of this standard deviation, that makes a cavity map white."""


def engine_maps(
    scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, on: str = "chart", size: int = 1024
) -> TemplateTexture:
    """Return albedo, normals and the maps of a skin material on one of a face's texture coordinates.

    `maps` of each tile are: `occlusion`, the part of an even sky that reaches the surface (1 is all);
    `roughness`, glTF's, of the highlights; `specular`, glTF's factor of the reflectance at normal incidence;
    `displacement_mm`, how far the scan lies outside of the mesh, on other meshes than the scan; and `cavity`,
    small relief beside its surroundings, 0.5 where it is flat. Dark spots of the albedo count there as pores,
    which is a guess. Raises `ApplicationError` when the scan has no colour or no such coordinates, ValueError
    for another name or size.

    Parameters
    ----------
    scan : RawScan
        Without its light (`unlit_scan`).
    fitted, estimate
        Of the scan.
    on : {"chart", "scan", "template"}
        The model's chart on the fitted face, the scan's own coordinates, or those of the model's template.
    size : int
        Texels of a side, 8 to 8192.

    Notes
    -----
    Phong's exponent m of the highlights becomes the roughness (2 m + 1)^(-1/4) of a GGX lobe of the same
    width [1]_. Their strength is that of skin [2]_ times the model's relative one by region, since the
    albedo's scale, and so that of measured highlights, is not known.

    .. [1] B. Walter, S. Marschner, H. Li, K. Torrance, "Microfacet models for refraction through rough
       surfaces", EGSR 2007.
    .. [2] See `SKIN_F0`.
    """
    vertices, faces, uv = _carrier(scan, fitted, on)
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours to make maps of")
    appearance, face = Appearance(fitted, scan), surface_query(fitted.vertices, fitted.faces)
    image, gloss = estimate.image, estimate.reflectance
    relative = np.ones(image.shape) if image.specular_scale is None else image.specular_scale
    strength = filled_from_nearest(relative, image.mask)[..., None] * (SKIN_F0 / PLASTIC_F0)
    exponent = gloss.exponent if gloss.specular_strength > 0 else MATTE_EXPONENT
    occluder = thinned(vertices, faces, _AROUND_MM)
    shadows = ShadowMap(
        RayCaster(occluder.vertices, occluder.faces),
        occluder.vertices,
        vertex_normals(occluder.vertices, occluder.faces),
    )
    open_sky, around = shadowed_transfer(shadows)[:, 0], surface_query(occluder.vertices, occluder.faces)
    raw = transform_points(fitted.model_from_scan, scan.vertices)
    raw_surface, raw_normals = surface_query(raw, scan.faces), vertex_normals(raw, scan.faces)
    relief = _relief(raw, scan.faces, raw_normals)

    def look(place: FloatArray, outward: FloatArray, tangents: FloatArray, steps: FloatArray) -> Fields:
        found = appearance(place, outward, tangents, steps)
        near = around.query(place)
        sky = np.einsum("nk,nk->n", near.barycentric, open_sky[occluder.faces[near.face]])
        on_face = face.query(place)
        chart = np.einsum("nk,nkc->nc", on_face.barycentric, fitted.uv[fitted.faces[on_face.face]])
        close = on_face.distance <= REACH_MM
        everywhere = np.ones(len(place), bool)
        found |= {
            "occlusion": (np.clip(sky, 0, 1)[:, None], everywhere),
            "specular": (bilinear(strength, pixels_from_uv(chart, image.shape)), close),
            "roughness": (np.full((len(place), 1), (2 * exponent + 1) ** -0.25), everywhere),
        }
        hits = raw_surface.query(place)
        corners = scan.faces[hits.face]
        facing = np.einsum("nk,nkc,nc->n", hits.barycentric, raw_normals[corners], outward)
        known = (hits.distance <= REACH_MM) & (facing > 0)
        found["cavity"] = (np.einsum("nk,nk->n", hits.barycentric, relief[corners])[:, None], known)
        if on != "scan":
            # Phong tessellation, the mean of the point on the corners' tangent planes: no edges of faces.
            off = np.einsum("nkc,nkc->nk", raw[corners] - hits.points[:, None], raw_normals[corners])
            lift = np.einsum("nk,nk,nkc->nc", hits.barycentric, off, raw_normals[corners])
            high = np.einsum("nc,nc->n", hits.points + lift - place, outward)
            found["displacement_mm"] = (high[:, None], known)
        return found

    texels = float(size) ** 2 * _uv_area(uv)
    per_mm = np.sqrt(texels / max(float(face_areas(vertices, faces).sum()), 1e-12))
    tiles = baked_tiles(vertices, faces, uv, size, look)
    made = tuple(replace(tile, maps={**tile.maps, "cavity": _cavity(tile, per_mm)}) for tile in tiles)
    return TemplateTexture(vertices, faces, uv, made)


def _carrier(scan: RawScan, fitted: FittedFace, on: str) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the mesh (V, 3), (F, 3) in the model's frame and its coordinates (F, 3, 2)."""
    if on not in CARRIERS:
        raise ValueError(f"maps is {on!r}, expected one of {', '.join(CARRIERS)}")
    if on == "chart":
        return fitted.vertices, fitted.faces, fitted.uv[fitted.faces]
    if on == "scan":
        if scan.uv is None or scan.texture_linear is None:
            raise ApplicationError(
                f"{scan.name}: the scan has no texture coordinates; make maps on the chart"
            )
        own = in_first_period(scan.uv, scan.texture_linear.shape)
        return transform_points(fitted.model_from_scan, scan.vertices), scan.faces, own
    vertices, faces, uv = fitted.template_vertices, fitted.model.template_faces, fitted.model.template_uv
    if vertices is None or faces is None or uv is None:
        raise ApplicationError(f"{fitted.model.name}: the model has no template with texture coordinates")
    return vertices, faces, uv


def _uv_area(uv: FloatArray) -> float:
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return float(np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2)


def _relief(vertices: FloatArray, faces: IntArray, normals: FloatArray) -> FloatArray:
    """Return (V,) how far the vertices of a scan, freed from noise, stand out of their surroundings in mm.

    Of a scan whose edges are longer than those it is their curvature, over the same surroundings.
    """
    around = mesh.adjacency(len(vertices), faces) + sparse.identity(len(vertices), format="csr")
    mean = sparse.diags(1 / np.asarray(around.sum(1)).ravel()) @ around
    # A mean over neighbours has a variance of half a squared edge.
    step_mm2 = max(mesh.usual_edge(vertices, faces), 1e-9) ** 2 / 2
    passes = int(np.clip(round(_AROUND_MM**2 / step_mm2), 1, 100))
    fine = smooth = mean @ (mean @ vertices)
    for _ in range(passes):
        smooth = mean @ smooth
    high = np.einsum("nc,nc->n", fine - smooth, normals)
    return high * (_AROUND_MM**2 / (passes * step_mm2))


def _cavity(tile: TemplateTile, texels_per_mm: float) -> FloatArray:
    """Return (S, S) how far a tile's texels stand out from their surroundings, 0 to 1; 0.5 is flat."""
    value = np.asarray(tile.color_linear, np.float32).max(-1)
    pores = _PORE_MM * np.log(np.maximum(value, 1e-3 * max(float(value.max()), 1e-6)))
    relief = tile.maps["cavity"] + pores - gaussian_filter(pores, _AROUND_MM * texels_per_mm)
    return np.clip(0.5 + relief / (2 * _RELIEF_MM), 0, 1)
