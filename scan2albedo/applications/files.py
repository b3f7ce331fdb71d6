"""Processed faces from files and to files: `load_result` and `write_face`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from scan2albedo.applications.relighting import relight
from scan2albedo.core import PointLight
from scan2albedo.core.arguments import described
from scan2albedo.core.arrays import Values, attributes
from scan2albedo.core.lights import LAMP_RADIUS_DEG
from scan2albedo.errors import ApplicationError, OutputError, Scan2AlbedoError
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.io import geometry_image_files
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.geometry_image_files import read_geometry_image, write_geometry_image
from scan2albedo.io.glb import METRES_PER_MM, write_glb
from scan2albedo.io.gltf import GltfFile
from scan2albedo.io.images import read_image_linear, write_exr, write_png
from scan2albedo.io.landmark_files import LANDMARKS_FILE, LandmarksRecord
from scan2albedo.io.limits import DAMAGE
from scan2albedo.io.parsed_mesh import ScanFolder
from scan2albedo.io.records import plain_json, read_record
from scan2albedo.io.result_records import APPLICATION_FILE, RESULT_FILE, ApplicationRecord, ResultRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.lighting.shading import DIFFUSE_MODELS, Reflectance
from scan2albedo.rendering.pictures import auto_exposure
from scan2albedo.unlit.processed_face import NO_MODEL, OF_LIGHT, SAME_PLACE_MM, FaceMesh, ProcessedFace

if TYPE_CHECKING:
    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core import GeometryImage, RawScan
    from scan2albedo.fitting import FittedFace

FACE_FILES = OwnFiles(
    APPLICATION_FILE,
    ApplicationRecord,
    ("geometry_image.npz", "albedo.exr", "albedo.png", "fitted.glb", "picture.png"),
    command="scan2albedo swap, blend or transfer-expression",
)
"""Of a face that an application made."""
PORTRAIT_LIGHT = PointLight(np.deg2rad(35), np.deg2rad(25), intensity=3.0, radius_deg=LAMP_RADIUS_DEG)
"""Of `picture.png`, which is to show shape and skin whatever light the scan was taken in."""


class ProcessedScan(Protocol):
    """What `load_result` takes of a result in memory, such as `scan2albedo.ProcessResult`."""

    scan: RawScan
    fitted: FittedFace | None
    geometry_image: GeometryImage
    albedo: AlbedoEstimate | None


def load_result(source: str | Path | ProcessedScan, *, need_albedo: bool = True) -> ProcessedFace:
    """Return the processed face of a folder ``OUT/<scan name>`` or an application's, or of a `ProcessResult`.

    A folder as `source` needs result.json (or application.json), geometry_image.npz and albedo.exr, and
    fitted.glb unless it was processed without a model. Where `need_albedo` is False, a result without an
    albedo is taken too, as a shape in grey: its `has_albedo` is False. Raises `ApplicationError` when a file
    is missing, cannot be read, or belongs to another result, or has no albedo and one is needed; the message
    names it; `TypeError` for anything else than a path and a result.
    """
    if isinstance(source, str | Path):
        folder = Path(source)
        try:
            return _from_folder(folder, need_albedo)
        except ApplicationError:
            raise
        except Scan2AlbedoError as error:
            text = str(error) if str(folder) in str(error) else f"{folder}: {error}"
            raise ApplicationError(text) from error
    if not hasattr(source, "albedo"):
        raise TypeError(f"load_result: source is {described(source)}, expected str or Path or ProcessResult")
    name = source.scan.name
    if source.albedo is None and need_albedo:
        raise _no_albedo(name)
    return ProcessedFace.of_stages(name, source.geometry_image, source.fitted, source.albedo)


def _no_albedo(where: str | Path) -> ApplicationError:
    return ApplicationError(
        f"{where}: holds no albedo, for the scan has no colour or the stage was skipped; process a "
        "coloured scan with the stage albedo"
    )


def _from_folder(folder: Path, need_albedo: bool) -> ProcessedFace:
    if not folder.is_dir():
        raise ApplicationError(f"{folder}: no such folder; give that of one processed scan, OUT/<scan name>")
    if (folder / RESULT_FILE).is_file() or not (folder / APPLICATION_FILE).is_file():
        file = _present(folder, RESULT_FILE)
        scan = read_record(file, ResultRecord)
        found: Values = attributes(scan, "name", "lights", "environment")
        found["model_name"] = str(scan.options.get("model", NO_MODEL))
        found["casts_shadows"] = all(step.ran for step in scan.plan if step.stage == "albedo.shadows")
        parameters, chart_mesh = scan.parameters, found["model_name"] == NO_MODEL
    else:
        file = folder / APPLICATION_FILE
        made = read_record(file, ApplicationRecord)
        found = attributes(made, "name", *OF_LIGHT) | {"model_name": made.model}
        parameters, chart_mesh = made.reflectance, made.chart_mesh
        found["landmarks"] = None if made.landmarks is None else np.array(made.landmarks)
    if parameters:
        image, albedo = geometry_image_files.read_image_and_albedo(folder)
        brdf, skin = parameters.get("brdf"), Reflectance("lambert")
        try:
            if brdf != "spherical-harmonics":
                names = DIFFUSE_MODELS[str(brdf)].roughness_name, "specular_strength", "specular_exponent"
                numbers = map(parameters.get, names)
                skin = Reflectance(str(brdf), *map(float, numbers))  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError) as error:
            raise ApplicationError(f"{file}: is no reflectance ({error}); process the scan again") from error
        found |= {"albedo_linear": albedo, "reflectance": skin}
        if (stored := folder / "expected_error.exr").is_file():
            found["expected_error"] = read_image_linear(stored)[..., 0]
    else:
        image = read_geometry_image(_present(folder, "geometry_image.npz"))
        if need_albedo:
            raise _no_albedo(folder)
        found |= ProcessedFace.grey(image)
    if (stored := folder / LANDMARKS_FILE).is_file():
        placed = read_record(stored, LandmarksRecord).landmarks
        found["landmarks"] = np.array([landmark.model_mm for landmark in placed])
    if chart_mesh:
        return ProcessedFace(image=image, mesh=FaceMesh.of_chart(image), **found)
    return ProcessedFace(image=image, mesh=_fitted_surface(folder, image), **found)


def _fitted_surface(folder: Path, image: GeometryImage) -> FaceMesh:
    """Return triangles and chart of the GLB, with the vertices of the image where it has them."""
    file = _present(folder, "fitted.glb")
    try:
        glb = GltfFile.read(file, ScanFolder(folder))
        glb.require_readable()
        skin = glb.tree["meshes"][0]["primitives"][0]
        vertices = glb.array(skin["attributes"]["POSITION"]).astype(float) / METRES_PER_MM
        uv = glb.array(skin["attributes"]["TEXCOORD_0"]) * (1.0, -1.0) + (0.0, 1.0)
        faces = glb.array(skin["indices"]).reshape(-1, 3).astype(int)
    except DAMAGE as error:
        raise ApplicationError(f"{file}: is no textured GLB ({error}); process the scan again") from error
    exact = vertices if image.occluder is None else image.occluder[0]
    if exact.shape != vertices.shape or np.abs(exact - vertices).max(initial=0.0) > SAME_PLACE_MM:
        raise ApplicationError(
            f"{file}: it and geometry_image.npz are of different runs; process the scan again"
        )
    return FaceMesh(exact, faces, uv)


def _present(folder: Path, name: str) -> Path:
    file = folder / name
    if not file.is_file():
        raise ApplicationError(
            f"{file}: is missing; {folder} is not the folder of one processed scan (OUT/<scan name>), or its "
            "run was cut short: process the scan again"
        )
    return file


def check_face_folder(folder: Path) -> None:
    """Raise OutputError for a folder with files that a new face would overwrite and no application wrote."""
    if (folder / RESULT_FILE).exists():
        raise OutputError(f"{folder}: is the folder of a processed scan; choose another for the new face")
    RunFolder(folder, FACE_FILES).check()


def write_face(
    face: ProcessedFace,
    folder: str | Path,
    *,
    application: str,
    inputs: Sequence[ProcessedFace],
    options: Mapping[str, Any] | None = None,
) -> Path:
    """Return the folder into which the face that an application made was written, whole or not at all.

    Files: geometry_image.npz, albedo.exr, albedo.png, fitted.glb with the albedo, picture.png under a
    portrait light, and application.json. A shape alone has no file of an albedo. Raises `OutputError` when
    the folder cannot be written, is that of a processed scan, or holds a user's own files of these names.

    Parameters
    ----------
    face, folder : ProcessedFace, str or Path
    application : str
        "swap", "blend" or "transfer-expression".
    inputs : sequence of ProcessedFace
        What the face was made of; the record keeps their names.
    options : mapping, optional
        Of the application, for the record.
    """
    target, mesh, preview = Path(folder), face.mesh, None
    check_face_folder(target)
    with RunFolder(target, FACE_FILES).publishing() as staging:
        write_geometry_image(staging.folder / "geometry_image.npz", face.image)
        parameters: dict[str, object] = {}
        if face.has_albedo:
            write_exr(staging.folder / "albedo.exr", face.albedo_linear)
            exposed = auto_exposure(face.albedo_linear[face.mask]) * face.albedo_linear
            preview = encode_srgb_bytes(np.clip(filled_from_nearest(exposed, face.mask), 0, 1))
            alpha = np.where(face.image.seen, np.uint8(255), np.uint8(0))
            write_png(staging.folder / "albedo.png", np.dstack([preview, alpha]))
            parameters = face.reflectance.parameters()
        write_glb(staging.folder / "fitted.glb", mesh.vertices, mesh.faces, mesh.uv, preview)
        write_png(staging.folder / "picture.png", relight(face, [PORTRAIT_LIGHT]).picture().srgb())
        staging.write_record(
            **attributes(face, "name", *OF_LIGHT),
            application=application,
            inputs=tuple(source.name for source in inputs),
            options=plain_json(options or {}),
            model=face.model_name,
            chart_mesh=mesh.from_chart,
            landmarks=None if face.landmarks is None else face.landmarks.tolist(),
            reflectance=parameters,
            notes=face.notes,
        )
    return target
