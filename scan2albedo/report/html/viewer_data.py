"""What the viewer of one scan needs, from the files of its result."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.applications.processed_face import FaceMesh, ProcessedFace
from scan2albedo.applications.relighting import RelightOptions, as_lit
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import Scan2AlbedoError, one_line
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import RegistrationRecord, ResultRecord
from scan2albedo.lighting.environment_light import environment_light_on, open_shading
from scan2albedo.lighting.shadow_map import ShadowMap, shadow_offset_mm
from scan2albedo.rendering.pictures import DISTANCE_MM, PORTRAIT_MARGIN, portrait_frame
from scan2albedo.report.html.encoding import (
    encoded,
    gray_entry,
    mesh_entry,
    patch_entry,
    quantized,
    texture_entry,
    thinned_chart,
)
from scan2albedo.report.overview import RESIDUAL_SCALE_MM, preview_factor


def residual_of_result(folder: Path, record: ResultRecord, mesh: FaceMesh) -> tuple[FloatArray | None, str]:
    """Return each vertex's distance (V,) to the scan in mm, and from which file it was measured.

    It is measured again from the input, as the fit does, for no file of a result holds it: NaN on the scan's
    border, beyond the gate, and where the scan faces away. None, and why, where it cannot be measured.
    """
    if mesh.from_chart:
        return None, "nothing was fitted"
    if record.input.file is None:
        return None, "the scan came from memory and no file holds it"
    from scan2albedo.fitting.result import RESIDUAL_GATE_MM, residuals_mm
    from scan2albedo.fitting.scan_surface import scan_near_model
    from scan2albedo.io import load_scan
    from scan2albedo.io.input_hash import input_sha256

    file = Path(record.input.file)
    try:
        if not file.is_file():
            return None, f"{file} is no longer there to be measured"
        textures = record.options.get("textures")
        if input_sha256(file, None if textures is None else str(textures)) != record.input.sha256:
            return None, f"{file} is no longer the scan that was processed"
        pose = read_record(folder / "registration.json", RegistrationRecord).fitted_from_scan
        if pose is None:
            return None, "registration.json holds no pose of the fit"
        scan, gate = load_scan(file, unit=str(record.options.get("unit", "auto"))), RESIDUAL_GATE_MM
        low, high = mesh.vertices.min(0) - gate, mesh.vertices.max(0) + gate
        surface = scan_near_model(scan.vertices, scan.faces, np.array(pose), low, high)
        distance = np.full(len(mesh.vertices), np.nan)
        if surface is not None:
            surface = surface.turned_outward(mesh.vertices, mesh.normals, gate)
            distance = residuals_mm(surface, mesh.vertices, mesh.faces, gate)
    except Scan2AlbedoError as error:
        return None, one_line(error)
    mean = float(np.nanmean(distance)) if np.isfinite(distance).any() else float("nan")
    return distance, f"measured again against {file.name}: {mean:.3f} mm in the mean"


def viewer_entry(
    face: ProcessedFace,
    record: ResultRecord,
    topologies: dict[str, dict[str, Any]],
    residual_mm: FloatArray | None = None,
    *,
    size: int,
    quality: int | None = None,
    soft_shadows: bool = False,
) -> dict[str, Any]:
    """Return all of a scan's viewer as JSON can hold it; `topologies` gets the triangles.

    Relit pictures show the face as `relight` lights it, without gaps and with skin's usual gloss: "filled" is
    its albedo where that differs, "assumed" what was done. `residual_mm` (V,) is that of the mesh's vertices,
    NaN where there is no scan; `size` and `quality` are as in `texture_entry`. `soft_shadows` computes at
    each vertex what the face hides from itself of the scan's soft light.
    """
    image = face.image
    mesh = thinned_chart(image) if face.mesh.from_chart else face.mesh
    lit, assumed = as_lit(face, RelightOptions()) if face.has_albedo else (face, ())
    skin = lit.reflectance
    # Soft light as 9 rows of 3 coefficients of the shading of an open surface.
    harmonics = None
    if record.environment is not None:
        harmonics = open_shading(record.environment)
    elif record.parameters.get("brdf") == "spherical-harmonics":
        given = np.asarray(record.parameters.get("sh_coefficients"), np.float64)
        harmonics = given if given.shape == (9, 3) and np.isfinite(given).all() else None
    lights = []
    for light in record.lights:
        place = {"azimuth": math.degrees(light.azimuth_rad), "elevation": math.degrees(light.elevation_rad)}
        distance = light.distance_mm if math.isfinite(light.distance_mm) else None
        shines = {"intensity": light.intensity, "color": list(light.color_linear)}
        lights.append({**place, "distance": distance, **shines})
    # The portrait's camera, as `applications.default_camera` has it.
    middle, radius, depth = portrait_frame(face.mesh.vertices)
    frame = {"middle": middle.tolist(), "radius": radius, "margin": PORTRAIT_MARGIN, "depth": depth}
    highlight = {"strength": skin.specular_strength, "exponent": skin.exponent}
    extent = float(np.ptp(face.mesh.vertices, axis=0).max())
    entry = {
        **mesh_entry(mesh, topologies),
        "hasAlbedo": face.has_albedo,
        "albedo": texture_entry(face.albedo_linear, image.mask, size, quality=quality),
        "albedoExposure": preview_factor(face.albedo_linear, face.mask),
        "albedoLevel": face.level(),
        "reflectance": {"brdf": skin.brdf, "roughness": skin.roughness, **highlight},
        "assumed": list(assumed),
        "assumedGloss": skin.specular_strength > face.reflectance.specular_strength,
        "lights": lights,
        "harmonics": None if harmonics is None else np.ravel(harmonics).tolist(),
        "castsShadows": face.casts_shadows,
        "shadowOffset": shadow_offset_mm(extent, face.shadow_offset_mm),
        "reach": float(np.linalg.norm(face.mesh.vertices, axis=1).max()),
        "frame": {**frame, "distance": max(DISTANCE_MM, 4 * radius)},
    }
    if image.texture_linear is not None:
        entry["texture"] = texture_entry(image.texture_linear, image.mask, size, quality=quality, factor=1.0)
    if (lit.albedo_linear != face.albedo_linear).any():
        both = lit.albedo_linear, face.albedo_linear
        entry["filled"] = patch_entry(*both, image.mask, size, entry["albedo"]["factor"])
    if lit.image.specular_scale is not None and skin.specular_strength > 0:
        entry["gloss"] = gray_entry(lit.image.specular_scale.astype(np.float64), image.mask, size)
    if soft_shadows and face.environment is not None and face.environment.occluded:
        # Red, green, blue of the soft light on each vertex as 16-bit parts of a scale.
        caster = RayCaster(*image.occluder_mesh()) if face.casts_shadows else None
        shadows = ShadowMap(caster, mesh.vertices, mesh.normals, face.shadow_offset_mm)
        soft = environment_light_on(face.environment, shadows)
        scale = float(soft.max()) or 1.0
        parts = quantized(soft, np.zeros(3), np.full(3, scale))
        entry["soft"] = {"scale": scale, "data": encoded(parts.tobytes())}
    if residual_mm is not None:
        # 255 is not measured.
        shown = np.round(254 * np.clip(residual_mm / RESIDUAL_SCALE_MM, 0, 1))
        stored = np.where(np.isnan(residual_mm), 255, shown).astype(np.uint8)
        entry["residual"] = {"scale": RESIDUAL_SCALE_MM, "data": encoded(stored.tobytes())}
    return entry
