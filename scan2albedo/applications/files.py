"""The files of a face that an application made; `load_result` reads them back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.pictures import auto_exposure, padded
from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.applications.relighting import relight
from scan2albedo.core.point_light import PointLight
from scan2albedo.core.version import VERSION
from scan2albedo.errors import OutputError
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.geometry_image_files import write_geometry_image
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.records import plain_json, write_record
from scan2albedo.io.result_folder import result_folder
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, LightRecord
from scan2albedo.lighting.asrm import Reflectance

PORTRAIT_LIGHT = PointLight(np.deg2rad(35), np.deg2rad(25), intensity=3.0)
"""Of `picture.png`, which is to show shape and skin whatever light the scan was taken in."""


SCAN_FILE = "result.json"
FILES = frozenset(
    {"application.json", "geometry_image.npz", "albedo.exr", "albedo.png", "fitted.glb", "picture.png"}
)
"""Every file of a face that an application made."""


def check_face_folder(folder: Path) -> None:
    """Refuse the folder of a processed scan, which a new face would spoil.

    Raises
    ------
    OutputError
        Naming it.
    """
    if (folder / SCAN_FILE).exists():
        raise OutputError(f"{folder}: is the folder of a processed scan; choose another for the new face")


def write_face(
    face: ProcessedFace,
    folder: str | Path,
    *,
    application: str,
    inputs: Sequence[ProcessedFace],
    options: Mapping[str, Any] | None = None,
) -> Path:
    """Write what came of an application into a folder, whole or not at all; return the folder.

    Files: geometry_image.npz, albedo.exr, albedo.png, fitted.glb with the albedo, picture.png under a
    portrait light, and application.json, which comes last.

    Parameters
    ----------
    face : ProcessedFace
    folder : str or Path
        Made when it is not there.
    application : str
        "swap", "blend" or "transfer-expression"; kept in the record.
    inputs : sequence of ProcessedFace
        What the face was made of; their names are kept.
    options : mapping, optional
        What the application was called with; kept.

    Returns
    -------
    Path

    Raises
    ------
    OutputError
        When the folder cannot be written, or is that of a processed scan.
    """
    target = Path(folder)
    check_face_folder(target)
    with result_folder(target, APPLICATION_FILE) as staging:
        _write_images(face, staging)
        written = sorted(path.name for path in staging.iterdir())
        record = _record(face, application, inputs, options or {}, (*written, APPLICATION_FILE))
        write_record(staging / APPLICATION_FILE, record)
    return target


def albedo_preview(face: ProcessedFace) -> NDArray[np.uint8]:
    """Return (H, W, 3) sRGB bytes of the albedo, bright but not clipped, carried on over the chart's rim."""
    factor = auto_exposure(face.albedo_linear[face.mask])
    return encode_srgb_bytes(np.clip(factor * padded(face.albedo_linear, face.mask), 0, 1))


def _write_images(face: ProcessedFace, folder: Path) -> None:
    write_geometry_image(folder / "geometry_image.npz", face.image)
    write_exr(folder / "albedo.exr", face.albedo_linear)
    preview = albedo_preview(face)
    write_png(folder / "albedo.png", np.where(face.mask[..., None], preview, np.uint8(255)))
    write_glb(folder / "fitted.glb", face.mesh.vertices, face.mesh.faces, face.mesh.uv, preview)
    write_png(folder / "picture.png", relight(face, [PORTRAIT_LIGHT]).picture().srgb())


def _record(
    face: ProcessedFace,
    application: str,
    inputs: Sequence[ProcessedFace],
    options: Mapping[str, Any],
    files: tuple[str, ...],
) -> ApplicationRecord:
    return ApplicationRecord(
        scan2albedo_version=VERSION,
        name=face.name,
        application=application,
        inputs=tuple(given.name for given in inputs),
        options=plain_json(options),
        model=face.model_name,
        chart_mesh=face.mesh.from_chart,
        casts_shadows=face.casts_shadows,
        view_direction=face.view_direction,
        shadow_offset_mm=face.shadow_offset_mm,
        reflectance=_parameters(face.reflectance),
        lights=tuple(LightRecord.of(light) for light in face.lights),
        files=files,
    )


def _parameters(reflectance: Reflectance) -> dict[str, Any]:
    rough = "minnaert_exponent" if reflectance.brdf == "minnaert" else "sigma_rad"
    return {
        "brdf": reflectance.brdf,
        rough: reflectance.roughness,
        "specular_strength": reflectance.specular_strength,
        "specular_exponent": reflectance.exponent,
    }
