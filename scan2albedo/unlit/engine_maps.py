"""`engine_maps`: what a renderer's skin material asks for, on any texture coordinates of a processed face."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, IntArray, dots
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import face_areas, median_edge, neighbour_mean, thinned, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, filled_from_nearest, pixels_from_uv
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.lighting.environment_light import shadowed_transfer
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.unlit.light_removal import median_light
from scan2albedo.unlit.template_baking import REACH_MM, Appearance, Fields, TemplateTexture, painted

CARRIERS = ("chart", "scan", "template")
"""Whose texture coordinates the maps lie on."""
SKIN_F0 = 0.028
"""Reflectance of skin at normal incidence (index of refraction 1.4) [1]_.

.. [1] T. Weyrich et al., "Analysis of human faces using a measurement-based skin reflectance model", SIGGRAPH
   2006.
"""
PLASTIC_F0 = 0.04
"""Reflectance at normal incidence of what glTF takes a surface for."""
MATTE_EXPONENT = 6.0
"""Phong's, of skin whose highlights were not seen: roughness 0.53."""
_PORE_MM = 0.05
"""Depth that is guessed for a spot that is darker by a factor of e."""
_AROUND_MM = 1.0
"""What lies farther away is no longer around."""
_RELIEF_MM = 0.1
"""Height above the mean around, of 1 mm standard deviation, that makes a cavity map white."""


def engine_maps(
    scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, on: str = "chart", size: int = 1024
) -> TemplateTexture:
    """Return albedo, normals and the maps of a skin material on one of a face's texture coordinates.

    `maps` of each tile are: `occlusion`, the part of an even sky that reaches the surface (1 is all);
    `roughness`, glTF's, of the highlights; `specular`, glTF's factor of the reflectance at normal incidence;
    `displacement_mm`, how far the scan, its noise averaged out, lies outside of other meshes than itself; and
    `cavity`, small relief beside its surroundings, 0.5 where it is flat; dark spots of the albedo count as
    pores, a guess. `ApplicationError` without colour or such coordinates, ValueError for other names, sizes.

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
    width [1]_, and their strength k_s, beside an albedo as bright as the scan, F0 = 4 k_s / (2 m + 1), which
    has the same peak; that of skin [2]_ where none were seen. The model's relative gloss multiplies it.

    .. [1] B. Walter, S. Marschner, H. Li, K. Torrance, "Microfacet models for refraction through rough
       surfaces", EGSR 2007.
    .. [2] See `SKIN_F0`.
    """
    if on not in CARRIERS:
        raise ValueError(f"maps is {on!r}, expected one of {', '.join(CARRIERS)}")
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours to make maps of")
    blank = _carrier(scan, fitted, on)
    appearance, face = Appearance(fitted, scan), surface_query(fitted.vertices, fitted.faces)
    gloss = estimate.reflectance
    exponent = gloss.exponent if gloss.specular_strength > 0 else MATTE_EXPONENT
    roughness = (2 * exponent + 1) ** (-1 / 4)
    strength = _specular(estimate, exponent)
    thin = thinned(blank.vertices, blank.faces, _AROUND_MM)
    around, open_sky = surface_query(thin.vertices, thin.faces), _open_sky(thin.vertices, thin.faces)
    raw = transform_points(fitted.model_from_scan, scan.vertices)
    relief = _relief_mm(raw, scan.faces)
    # Noise is averaged out of what the scan differs by from the face, so that shape the fit follows stays.
    feet, mean = face.query(raw).points, neighbour_mean(len(raw), scan.faces)
    raw = feet + mean @ (mean @ (raw - feet))
    normals, surface = vertex_normals(raw, scan.faces), surface_query(raw, scan.faces)

    def look(place: FloatArray, outward: FloatArray, tangents: FloatArray, steps: FloatArray) -> Fields:
        on_face, hits, everywhere = face.query(place), surface.query(place), np.ones(len(place), bool)
        pixels = pixels_from_uv(on_face.interpolated(fitted.uv, fitted.faces), estimate.image.shape)
        facing = dots(hits.interpolated(normals, scan.faces), outward)
        known = (hits.distance <= REACH_MM) & (facing > 0)
        found = {
            **appearance(place, outward, tangents, steps),
            "occlusion": (np.clip(around.query(place).interpolated(open_sky, thin.faces), 0, 1), everywhere),
            "specular": (bilinear(strength, pixels), on_face.distance <= REACH_MM),
            "roughness": (np.full((len(place), 1), roughness), everywhere),
            "cavity": (hits.interpolated(relief, scan.faces), known),
        }
        if on != "scan":
            # Phong tessellation, the mean of the point on the corners' tangent planes: no edges of faces.
            corners = scan.faces[hits.face]
            off = dots(raw[corners] - hits.points[:, None], normals[corners])
            lift = np.einsum("nk,nk,nkc->nc", hits.barycentric, off, normals[corners])
            high = dots(hits.points + lift - place, outward)
            found["displacement_mm"] = (high[:, None], known)
        return found

    return _with_pores(painted(blank, size, look), size)


def _with_pores(made: TemplateTexture, size: int) -> TemplateTexture:
    """Return maps whose `cavity`, mm, became relief and pores beside what is around: 0 to 1, 0.5 is flat."""
    on_chart = np.abs(np.linalg.det(made.uv[:, 1:] - made.uv[:, :1])).sum() / 2
    spread = _AROUND_MM * size * np.sqrt(on_chart / (face_areas(made.vertices, made.faces).sum() or 1.0))
    tiles = []
    for tile in made.tiles:
        value = np.asarray(tile.color_linear, np.float32).max(-1)
        pores = _PORE_MM * np.log(np.maximum(value, value.max() / 1000 or 1.0))
        high = (tile.maps["cavity"] + pores - gaussian_filter(pores, spread)) / (2 * _RELIEF_MM)
        tiles.append(replace(tile, maps={**tile.maps, "cavity": np.clip(0.5 + high, 0, 1)}))
    return replace(made, tiles=tuple(tiles))


def _carrier(scan: RawScan, fitted: FittedFace, on: str) -> TemplateTexture:
    """Return the mesh that the maps lie on, without pictures."""
    if on == "template":
        return TemplateTexture.of(fitted)
    if on == "chart":
        return TemplateTexture(fitted.vertices, fitted.faces, fitted.uv[fitted.faces])
    if scan.uv is None or scan.texture_linear is None:
        raise ApplicationError(f"{scan.name}: the scan has no texture coordinates; make maps on the chart")
    vertices = transform_points(fitted.model_from_scan, scan.vertices)
    return TemplateTexture(vertices, scan.faces, in_first_period(scan.uv, scan.texture_linear.shape))


def _specular(estimate: AlbedoEstimate, exponent: float) -> FloatArray:
    """Return (H, W, 1) glTF's factor of the reflectance at normal incidence, on the chart."""
    image, gloss = estimate.image, estimate.reflectance
    relative = np.ones(image.shape) if image.specular_scale is None else image.specular_scale
    f0 = float(4 * median_light(estimate) * gloss.specular_strength / (2 * exponent + 1)) or SKIN_F0
    return filled_from_nearest(relative, image.mask)[..., None] * (f0 / PLASTIC_F0)


def _open_sky(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (V, 1) the part of an even sky that reaches the vertices of a mesh."""
    shadows = ShadowMap(RayCaster(vertices, faces), vertices, vertex_normals(vertices, faces))
    return shadowed_transfer(shadows)[:, :1]


def _relief_mm(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (V, 1) how far a scan's vertices, freed from noise, stand out of their surroundings.

    Where edges are longer than those, it is their curvature, over the same surroundings. A mean over
    neighbours has a variance of half a squared edge.
    """
    mean = neighbour_mean(len(vertices), faces)
    step_mm2 = (median_edge(vertices, faces) or _AROUND_MM) ** 2 / 2
    passes = int(np.clip(round(_AROUND_MM**2 / step_mm2), 1, 100))
    fine = smooth = mean @ (mean @ vertices)
    for _ in range(passes):
        smooth = mean @ smooth
    relief = np.sum((fine - smooth) * vertex_normals(vertices, faces), axis=1, keepdims=True)
    return relief * (_AROUND_MM**2 / (passes * step_mm2))
