"""`engine_maps`: what a renderer's skin material asks for, on any texture coordinates of a processed face."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.template_baking import REACH_MM, Appearance, Fields, TemplateTexture, painted
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import face_areas, neighbour_mean, thinned, usual_edge, vertex_normals
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
    raw, around_mm = transform_points(fitted.model_from_scan, scan.vertices), 1.0
    if on == "template":
        blank = TemplateTexture.of(fitted)
    elif on == "chart":
        blank = TemplateTexture(fitted.vertices, fitted.faces, fitted.uv[fitted.faces])
    elif scan.uv is None or scan.texture_linear is None:
        raise ApplicationError(f"{scan.name}: the scan has no texture coordinates; make maps on the chart")
    else:
        blank = TemplateTexture(raw, scan.faces, in_first_period(scan.uv, scan.texture_linear.shape))
    if not scan.has_color:
        raise ApplicationError(f"{scan.name}: the scan has no colours to make maps of")
    appearance, face = Appearance(fitted, scan), surface_query(fitted.vertices, fitted.faces)
    image, gloss = estimate.image, estimate.reflectance
    relative = np.ones(image.shape) if image.specular_scale is None else image.specular_scale
    exponent = gloss.exponent if gloss.specular_strength > 0 else MATTE_EXPONENT
    usual = np.median(estimate.shading.mean(-1)[image.seen if image.seen.any() else image.mask])
    f0 = float(4 * usual * gloss.specular_strength / (2 * exponent + 1)) or SKIN_F0
    strength = filled_from_nearest(relative, image.mask)[..., None] * (f0 / PLASTIC_F0)
    thin = thinned(blank.vertices, blank.faces, around_mm)
    occluder = thin.vertices, thin.faces
    shadows = ShadowMap(RayCaster(*occluder), thin.vertices, vertex_normals(*occluder))
    open_sky, around = shadowed_transfer(shadows)[:, :1], surface_query(*occluder)
    raw_normals, mean = vertex_normals(raw, scan.faces), neighbour_mean(len(raw), scan.faces)
    # How far the scan's vertices, freed from noise, stand out of their surroundings in mm; where edges are
    # longer than those, their curvature, over the same surroundings. A mean over neighbours has a variance of
    # half a squared edge.
    step_mm2 = (usual_edge(raw, scan.faces) or around_mm) ** 2 / 2
    passes = int(np.clip(round(around_mm**2 / step_mm2), 1, 100))
    fine = smooth = mean @ (mean @ raw)
    for _ in range(passes):
        smooth = mean @ smooth
    relief = np.sum((fine - smooth) * raw_normals, axis=1, keepdims=True)
    relief *= around_mm**2 / (passes * step_mm2)
    # Noise is averaged out of what the scan differs by from the face, so that shape the fit follows stays.
    feet = face.query(raw).points
    raw = feet + mean @ (mean @ (raw - feet))
    raw_normals, raw_surface = vertex_normals(raw, scan.faces), surface_query(raw, scan.faces)

    def look(place: FloatArray, outward: FloatArray, tangents: FloatArray, steps: FloatArray) -> Fields:
        on_face, hits, everywhere = face.query(place), raw_surface.query(place), np.ones(len(place), bool)
        pixels = pixels_from_uv(on_face.interpolated(fitted.uv, fitted.faces), image.shape)
        facing = np.einsum("nc,nc->n", hits.interpolated(raw_normals, scan.faces), outward)
        known = (hits.distance <= REACH_MM) & (facing > 0)
        found = {
            **appearance(place, outward, tangents, steps),
            "occlusion": (np.clip(around.query(place).interpolated(open_sky, thin.faces), 0, 1), everywhere),
            "specular": (bilinear(strength, pixels), on_face.distance <= REACH_MM),
            "roughness": (np.full((len(place), 1), (2 * exponent + 1) ** (-1 / 4)), everywhere),
            "cavity": (hits.interpolated(relief, scan.faces), known),
        }
        if on != "scan":
            # Phong tessellation, the mean of the point on the corners' tangent planes: no edges of faces.
            corners = scan.faces[hits.face]
            off = np.einsum("nkc,nkc->nk", raw[corners] - hits.points[:, None], raw_normals[corners])
            lift = np.einsum("nk,nk,nkc->nc", hits.barycentric, off, raw_normals[corners])
            high = np.einsum("nc,nc->n", hits.points + lift - place, outward)
            found["displacement_mm"] = (high[:, None], known)
        return found

    made, tiles = painted(blank, size, look), []
    on_chart = np.abs(np.linalg.det(blank.uv[:, 1:] - blank.uv[:, :1])).sum() / 2
    spread = around_mm * size * np.sqrt(on_chart / (face_areas(blank.vertices, blank.faces).sum() or 1.0))
    for tile in made.tiles:
        # Relief and pores beside their surroundings, 0 to 1; 0.5 is flat.
        value = np.asarray(tile.color_linear, np.float32).max(-1)
        pores = _PORE_MM * np.log(np.maximum(value, value.max() / 1000 or 1.0))
        high = (tile.maps["cavity"] + pores - gaussian_filter(pores, spread)) / (2 * _RELIEF_MM)
        tiles.append(replace(tile, maps={**tile.maps, "cavity": np.clip(0.5 + high, 0, 1)}))
    return replace(made, tiles=tuple(tiles))
