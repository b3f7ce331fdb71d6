"""`load_result`: a processed face from the files of its scan, or from a result in memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.applications.processed_face import NO_MODEL, FaceMesh, ProcessedFace
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.point_light import PointLight
from scan2albedo.errors import ApplicationError, Scan2AlbedoError
from scan2albedo.io.geometry_image_files import read_geometry_image
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import APPLICATION_FILE, ApplicationRecord, LightRecord, ResultRecord
from scan2albedo.lighting.asrm import Reflectance

if TYPE_CHECKING:
    from scan2albedo.pipeline.result import ProcessResult

RESULT_FILE = "result.json"
_SAME_PLACE_MM = 0.01
"""GLB files hold metres with 24 bits: a vertex of a face is off by far less."""


def load_result(source: str | Path | ProcessResult) -> ProcessedFace:
    """Return the processed face of a scan's folder ``OUT/<scan name>``, of what an application wrote, or of a
    `ProcessResult`.

    Parameters
    ----------
    source : path or ProcessResult
        A folder needs result.json (or application.json), geometry_image.npz and albedo.exr, and fitted.glb
        unless it was processed without a model.

    Raises
    ------
    ApplicationError
        When a file is missing, cannot be read, or belongs to another result; the message names it. When the
        result has no albedo.
    """
    if isinstance(source, str | Path):
        return _from_folder(Path(source))
    if source.albedo is None:
        raise ApplicationError(
            f"{source.scan.name}: has no albedo, for the scan has no colour or the stage was skipped; "
            "process a coloured scan with the stage albedo"
        )
    estimate, fitted, image = source.albedo, source.fitted, source.geometry_image
    mesh = FaceMesh.of_chart(image) if fitted is None else FaceMesh(fitted.vertices, fitted.faces, fitted.uv)
    return ProcessedFace(
        source.scan.name,
        image,
        estimate.albedo_linear,
        estimate.reflectance,
        estimate.lights,
        mesh,
        NO_MODEL if fitted is None else fitted.model.name,
        estimate.casts_shadows,
        estimate.view_direction,
        estimate.shadow_offset_mm,
    )


def _from_folder(folder: Path) -> ProcessedFace:
    if not folder.is_dir():
        raise ApplicationError(
            f"{folder}: no such folder; give the folder of one processed scan, OUT/<scan name>"
        )
    try:
        if (folder / RESULT_FILE).is_file() or not (folder / APPLICATION_FILE).is_file():
            return _of_scan(folder, read_record(_present(folder, RESULT_FILE), ResultRecord))
        return _of_application(folder, read_record(folder / APPLICATION_FILE, ApplicationRecord))
    except ApplicationError:
        raise
    except Scan2AlbedoError as error:
        text = str(error) if str(folder) in str(error) else f"{folder}: {error}"
        raise ApplicationError(text) from error


def _of_scan(folder: Path, record: ResultRecord) -> ProcessedFace:
    if not record.parameters:
        raise ApplicationError(
            f"{folder / RESULT_FILE}: tells of no albedo, for the scan has no colour or the stage was "
            "skipped; process a coloured scan with the stage albedo"
        )
    model = str(record.options.get("model", NO_MODEL))
    image, albedo = _images(folder)
    mesh = FaceMesh.of_chart(image) if model == NO_MODEL else fitted_mesh(folder, image)
    shadows = [step.ran for step in record.plan if step.stage == "albedo.shadows"]
    return ProcessedFace(
        record.name,
        image,
        albedo,
        reflectance_of(record.parameters, folder / RESULT_FILE),
        lights_of(record.lights),
        mesh,
        model,
        all(shadows),
        shadow_offset_mm=EstimateOptions().shadow_offset_mm,
    )


def _of_application(folder: Path, record: ApplicationRecord) -> ProcessedFace:
    image, albedo = _images(folder)
    mesh = FaceMesh.of_chart(image) if record.chart_mesh else fitted_mesh(folder, image)
    return ProcessedFace(
        record.name,
        image,
        albedo,
        reflectance_of(record.reflectance, folder / APPLICATION_FILE),
        lights_of(record.lights),
        mesh,
        record.model,
        record.casts_shadows,
        record.view_direction,
        record.shadow_offset_mm,
    )


def reflectance_of(parameters: Mapping[str, Any], file: Path) -> Reflectance:
    """Return the reflectance that the parameters of a result's `file` tell."""
    brdf = parameters.get("brdf")
    if brdf == "spherical-harmonics":
        return Reflectance("lambert")
    rough = parameters.get("minnaert_exponent" if brdf == "minnaert" else "sigma_rad")
    strength, exponent = parameters.get("specular_strength"), parameters.get("specular_exponent")
    try:
        return Reflectance(str(brdf), float(rough), float(strength), float(exponent))  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise ApplicationError(
            f"{file}: its parameters tell no reflectance ({error}); process the scan again"
        ) from error


def lights_of(records: Sequence[LightRecord]) -> tuple[PointLight, ...]:
    """Return the lights of a result."""
    return tuple(
        PointLight(
            math.radians(r.azimuth_deg),
            math.radians(r.elevation_deg),
            math.inf if r.distance_mm is None else r.distance_mm,
            r.intensity,
        )
        for r in records
    )


def _present(folder: Path, name: str) -> Path:
    file = folder / name
    if not file.is_file():
        raise ApplicationError(
            f"{file}: is missing; {folder} is not the folder of one processed scan (OUT/<scan name>), or its "
            "run was cut short: process the scan again"
        )
    return file


def _images(folder: Path) -> tuple[GeometryImage, np.ndarray]:
    image = read_geometry_image(_present(folder, "geometry_image.npz"))
    albedo = read_image_linear(_present(folder, "albedo.exr"))
    if albedo.shape[:2] != image.shape:
        raise ApplicationError(
            f"{folder / 'albedo.exr'}: has {albedo.shape[:2]} texels and geometry_image.npz {image.shape}; "
            "they come from different runs: process the scan again"
        )
    return image, albedo


def fitted_mesh(folder: Path, image: GeometryImage) -> FaceMesh:
    """Return the fitted surface: triangles and chart from the GLB, vertices as exact as they are known.

    Raises
    ------
    ApplicationError
        When fitted.glb is missing, damaged, or of another result; the message names it.
    """
    import trimesh

    from scan2albedo.io.glb import METRES_PER_MM

    file = _present(folder, "fitted.glb")
    try:
        mesh: Any = trimesh.load(file, process=False, force="mesh")
        vertices = np.asarray(mesh.vertices, np.float64) / METRES_PER_MM
        faces, uv = np.asarray(mesh.faces, np.int64), np.asarray(mesh.visual.uv, np.float64)
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, OSError) as error:
        raise ApplicationError(
            f"{file}: cannot be read as a textured GLB ({error}); process the scan again"
        ) from error
    exact = None if image.occluder is None else image.occluder[0]
    if exact is not None and (
        exact.shape != vertices.shape or np.abs(exact - vertices).max() > _SAME_PLACE_MM
    ):
        raise ApplicationError(
            f"{file}: is not the surface of geometry_image.npz beside it; they come from different runs: "
            "process the scan again"
        )
    return FaceMesh(vertices if exact is None else exact, faces, uv)
