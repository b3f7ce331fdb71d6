"""What the viewer of a scan needs, in few bytes: 16 bits a number, shared triangles, PNG or JPEG textures."""

import base64
import hashlib
import io
import math
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion, label

from scan2albedo.applications.relighting import RelightOptions, prepared_for_light
from scan2albedo.core import EnvironmentLight, GeometryImage, PointLight
from scan2albedo.core.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    NDArray,
    RealArray,
    Values,
    all_finite,
    norms,
)
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.rasterization import area_mean, filled_from_nearest
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.result_records import ResultRecord
from scan2albedo.lighting.environment_light import environment_light_on, open_shading
from scan2albedo.lighting.shadow_map import ShadowMap, shadow_offset_mm
from scan2albedo.rendering.pictures import DISTANCE_MM, PORTRAIT_MARGIN, portrait_frame
from scan2albedo.report.overview import preview_factor, white_level
from scan2albedo.unlit.processed_face import FaceMesh, ProcessedFace

_LEVELS = np.iinfo(np.uint16).max


def encoded(data: bytes) -> str:
    """Return bytes as base64 text."""
    return base64.b64encode(data).decode("ascii")


def quantized(values: FloatArray, low: FloatArray, span: FloatArray) -> NDArray[np.uint16]:
    """Return values between `low` and `low + span` as little-endian 16-bit parts of the span."""
    parts = (values - low) / np.where(span > 0, span, 1.0)
    return np.round(np.clip(parts, 0, 1) * _LEVELS).astype("<u2")


def octahedral(normals: FloatArray) -> NDArray[np.int16]:
    """Return (V, 2) 16-bit octahedral coordinates of unit vectors (Cigolle et al., JCGT 3(2), 2014)."""
    flat = normals / np.maximum(np.abs(normals).sum(1, keepdims=True), 1e-12)
    sign = np.where(flat[:, :2] >= 0, 1.0, -1.0)
    folded = np.where(flat[:, 2:] < 0, (1 - np.abs(flat[:, 1::-1])) * sign, flat[:, :2])
    return np.round(np.clip(folded, -1, 1) * 32767).astype("<i2")


def mesh_entry(mesh: FaceMesh, topologies: dict[str, Values]) -> Values:
    """Return a mesh as the viewer reads it; positions are off by half of a 65535th of the box at most.

    Its triangles and chart coordinates go to `topologies`, {key: {"faces", "uv", "wide"}}, once for all
    scans of a report.
    """
    wide = len(mesh.uv) > _LEVELS
    index = np.ascontiguousarray(mesh.faces, "<u4" if wide else "<u2").tobytes()
    chart = quantized(np.clip(mesh.uv, 0, 1), np.zeros(2), np.ones(2)).tobytes()
    key = hashlib.sha256(index + chart).hexdigest()[:12]
    topologies[key] = {"faces": encoded(index), "uv": encoded(chart), "wide": wide}
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    box = {"low": low.tolist(), "span": (high - low).tolist()}
    positions = encoded(quantized(mesh.vertices, low, high - low).tobytes())
    normals = encoded(octahedral(mesh.normals).tobytes())
    return {"topology": key, "positions": positions, "normals": normals, **box}


def thinned_chart(image: GeometryImage, most: int = 60_000) -> FaceMesh:
    """Return the texel grid as a mesh of about `most` vertices: those of each block of texels are one.

    Vertices on the rim of the mask and at seams stay, so that no gap opens (vertex clustering on the chart,
    Rossignac and Borrel, 1993).
    """
    full = FaceMesh.of_chart(image)
    step = math.ceil(math.sqrt(len(full.vertices) / most))
    row, column = np.nonzero(image.mask)
    height, width = image.shape
    block = (row // step * width + column // step) * height * width + label(image.mask)[0][image.mask]
    own = -1 - np.arange(len(block))
    inside = binary_erosion(image.mask, np.ones((3, 3)))[image.mask]
    _, used, place = np.unique(np.where(inside, block, own), return_index=True, return_inverse=True)
    vertices, faces = full.vertices[used], place[full.faces]
    return FaceMesh(vertices, faces[face_areas(vertices, faces) > 0], full.uv[used])


def texture_entry(
    linear: RealArray,
    mask: BoolArray,
    size: int,
    *,
    quality: int | None = None,
    factor: float | None = None,
) -> Values:
    """Return a linear texture (H, W, 3) as 8-bit sRGB for the viewer, continued beyond the mask (H, W).

    Its longest side has at most `size` texels; a JPEG of a quality, or PNG without loss. The texture is
    multiplied by `factor`, by which the viewer divides; when None, its `white_level` is 1.
    """
    factor = 1 / white_level(linear, mask) if factor is None else factor
    return {"factor": factor, **picture_entry(_pixels(linear, mask, size, factor), quality)}


def patch_entry(linear: RealArray, under: RealArray, mask: BoolArray, size: int, factor: float) -> Values:
    """Return a texture (H, W, 3) as what is to be drawn over that of `under`, clear where the two agree."""
    over, below = (_pixels(texture, mask, size, factor) for texture in (linear, under))
    differs = (over != below).any(-1, keepdims=True)
    return picture_entry(np.concatenate([over, np.full_like(over[..., :1], 255)], -1) * differs, None)


def _pixels(linear: RealArray, mask: BoolArray, size: int, factor: float) -> ByteArray:
    return encode_srgb_bytes(np.clip(factor * _fitted(filled_from_nearest(linear, mask), size), 0, 1))


def gray_entry(values: FloatArray, mask: BoolArray, size: int) -> Values:
    """Return values (H, W) as 8 bits of their greatest, without loss; the viewer multiplies by `scale`."""
    scale = float(values[mask].max()) if mask.any() else 0.0
    parts = _fitted(filled_from_nearest(values[..., None], mask) / (scale or 1.0), size)[..., 0]
    return {"scale": scale, **picture_entry(np.round(255 * np.clip(parts, 0, 1)).astype(np.uint8), None)}


def picture_entry(pixels: ByteArray, quality: int | None) -> Values:
    """Return 8-bit pixels as PNG, or as JPEG of a quality with full colour, in base64."""
    from PIL import Image

    data, kind = io.BytesIO(), "png" if quality is None else "jpeg"
    Image.fromarray(pixels).save(data, kind, quality=quality, subsampling=0, optimize=True)
    return {"type": f"image/{kind}", "data": encoded(data.getvalue())}


def picture_url(file: Path, width: int) -> tuple[str, int, int] | None:
    """Return a picture file as the data URL of a JPEG at most `width` wide, and its size; None if damaged."""
    from PIL import Image

    if not file.is_file():  # a pipe may never end
        return None
    try:
        with Image.open(file) as opened:
            picture = opened.convert("RGB")
    except (OSError, ValueError):
        return None
    picture.thumbnail((width, picture.height), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=80, optimize=True, progressive=True)
    return f"data:image/jpeg;base64,{encoded(data.getvalue())}", picture.width, picture.height


def _fitted(values: FloatArray, size: int) -> FloatArray:
    """Return an image (H, W, C) at most `size` texels wide and high, each the mean of what it covers."""
    height, width = values.shape[:2]
    part = size / max(height, width)
    if part >= 1:
        return values
    return area_mean(values, (max(1, round(height * part)), max(1, round(width * part))))


def viewer_entry(
    face: ProcessedFace,
    record: ResultRecord,
    topologies: dict[str, Values],
    *,
    size: int,
    quality: int | None = None,
    soft_shadows: bool = False,
) -> Values:
    """Return all of a scan's viewer as JSON can hold it; `topologies` gets the triangles.

    Relit pictures show the face as `relight` lights it, without gaps and with skin's usual gloss: "filled" is
    its albedo where that differs, "assumed" what was done. `size` and `quality` are as in `texture_entry`.
    `soft_shadows` computes at each vertex what the face hides from itself of the scan's soft light.
    """
    image = face.image
    mesh = thinned_chart(image) if face.mesh.from_chart else face.mesh
    prepared, assumed = prepared_for_light(face, RelightOptions()) if face.has_albedo else (face, ())
    skin = prepared.reflectance
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
        "lights": [_lamp(light) for light in record.lights],
        "harmonics": _harmonics(record),
        "castsShadows": face.casts_shadows,
        "shadowOffset": shadow_offset_mm(extent, face.shadow_offset_mm),
        "reach": float(norms(face.mesh.vertices).max()),
        "frame": {**frame, "distance": max(DISTANCE_MM, 4 * radius)},
    }
    if image.texture_linear is not None:
        entry["texture"] = texture_entry(image.texture_linear, image.mask, size, quality=quality, factor=1.0)
    if (prepared.albedo_linear != face.albedo_linear).any():
        both = prepared.albedo_linear, face.albedo_linear
        entry["filled"] = patch_entry(*both, image.mask, size, entry["albedo"]["factor"])
    if prepared.image.specular_scale is not None and skin.specular_strength > 0:
        entry["gloss"] = gray_entry(prepared.image.specular_scale.astype(float), image.mask, size)
    if soft_shadows and face.environment is not None and face.environment.occluded:
        entry["soft"] = _soft_light(face, face.environment, mesh)
    return entry


def _lamp(light: PointLight) -> Values:
    place = {"azimuth": math.degrees(light.azimuth_rad), "elevation": math.degrees(light.elevation_rad)}
    distance = light.distance_mm if math.isfinite(light.distance_mm) else None
    return {**place, "distance": distance, "intensity": light.intensity, "color": list(light.color_linear)}


def _harmonics(record: ResultRecord) -> list[float] | None:
    """Return soft light as 9 rows of 3 coefficients of the shading of an open surface; None for none."""
    found = np.zeros(0)
    if record.environment is not None:
        found = open_shading(record.environment)
    elif record.parameters.get("brdf") == "spherical-harmonics":
        found = np.asarray(record.parameters.get("sh_coefficients"), float)
    return found.ravel().tolist() if found.shape == (9, 3) and all_finite(found) else None


def _soft_light(face: ProcessedFace, light: EnvironmentLight, mesh: FaceMesh) -> Values:
    """Return red, green, blue of the soft light on each vertex as 16-bit parts of a scale."""
    caster = RayCaster(*face.image.occluder_mesh()) if face.casts_shadows else None
    shadows = ShadowMap(caster, mesh.vertices, mesh.normals, face.shadow_offset_mm)
    soft = environment_light_on(light, shadows)
    scale = float(soft.max()) or 1.0
    return {"scale": scale, "data": encoded(quantized(soft, np.zeros(3), np.full(3, scale)).tobytes())}
