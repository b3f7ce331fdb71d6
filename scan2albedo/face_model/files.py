"""A face model on disk: `afm.json` with the annotation, an .npz beside it with the arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.errors import ModelError
from scan2albedo.face_model.annotation import AnnotatedSurface, Region
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.io.npz import Arrays, read_npz, write_npz
from scan2albedo.io.records import read_record, write_record


class RegionEntry(BaseModel):
    """One region, as in `annotation.Region`."""

    model_config = ConfigDict(extra="forbid")

    index: int = Field(ge=0, le=254, description="value of the `region` array")
    stiffness: float = Field(gt=0, description="relative stiffness in the fit, 1 = average")
    specular_scale: float = Field(ge=0, description="relative strength of highlights, 1 = average skin")
    inpaint: bool = Field(description="whether saturated texels may be filled there")


class FaceModelFile(BaseModel):
    """Annotated Face Model: its annotation, and which arrays its .npz file holds.

    These are control_vertices (C, 3) mm, control_faces (F, 3), uv (C, 2), region (F,), and where the counts
    below are not 0 landmark_face (68,) with landmark_barycentric (68, 3), template_face (T,),
    template_barycentric (T, 3), template_offset (T, 3), template_faces (T_F, 3), template_uv (T_F, 3, 2),
    template_from_model (4, 4).
    """

    model_config = ConfigDict(extra="forbid", title="scan2albedo annotated face model")

    format: Literal["scan2albedo-afm-1"] = Field(description="name and version of this format")
    name: str
    unit: Literal["mm"] = "mm"
    frame: Literal["+x subject's left, +y up, +z out of the face"] = (
        "+x subject's left, +y up, +z out of the face"
    )
    arrays: str = Field(description="file name of the .npz, in the same folder", pattern=r"^[^/\\]+\.npz$")
    control_vertices: int = Field(ge=3, description="C")
    control_faces: int = Field(ge=1, description="F")
    landmarks: Literal[0, 68] = Field(description="0, or 68 in iBUG order")
    template_vertices: int = Field(ge=0, description="T, 0 when the model carries no dense template")
    template_faces: int = Field(ge=0, description="T_F")
    notes: list[str] = Field(default=[], description="what was decided and mended when the model was made")
    regions: dict[str, RegionEntry] = Field(description="by name, for example left_cheek")


def save_model(model: AnnotatedSurface, path: str | Path) -> None:
    """Write `path` (.json) and, beside it, the arrays in `<stem>.npz`; same model, same bytes."""
    target = Path(path)
    arrays = _arrays_of(model)
    entry = FaceModelFile(
        format="scan2albedo-afm-1",
        name=model.name,
        arrays=target.with_suffix(".npz").name,
        control_vertices=len(model.control_vertices),
        control_faces=len(model.control_faces),
        landmarks=68 if model.landmark_points is not None else 0,
        template_vertices=len(arrays.get("template_face", ())),
        template_faces=len(arrays.get("template_faces", ())),
        notes=list(model.notes),
        regions={name: RegionEntry(**_but_name(region)) for name, region in model.regions.items()},
    )
    write_npz(target.with_suffix(".npz"), arrays, what="face model", compression=6)
    write_record(target, entry)


def _but_name(region: Region) -> dict[str, Any]:
    return {field: value for field, value in vars(region).items() if field != "name"}


def _arrays_of(model: AnnotatedSurface) -> Arrays:
    arrays: Arrays = {
        "control_vertices": model.control_vertices.astype(np.float64),
        "control_faces": model.control_faces.astype(np.int32),
        "uv": model.uv.astype(np.float64),
        "region": model.region.astype(np.uint8),
    }
    for prefix, points in (("landmark", model.landmark_points), ("template", model.template_points)):
        if points is not None:
            arrays[f"{prefix}_face"] = points.face.astype(np.int32)
            arrays[f"{prefix}_barycentric"] = points.barycentric.astype(np.float64)
    if model.template_offset is not None:
        arrays["template_offset"] = model.template_offset.astype(np.float64)
    if model.template_from_model is not None:
        arrays["template_from_model"] = model.template_from_model.astype(np.float64)
    if model.template_faces is not None:
        arrays["template_faces"] = model.template_faces.astype(np.int32)
    if model.template_uv is not None:
        arrays["template_uv"] = model.template_uv.astype(np.float64)
    return arrays


def load_model(path: str | Path) -> AnnotatedSurface:
    """Read a model that `save_model` wrote; raises `ModelError` when files are damaged or do not match."""
    entry = read_record(
        path,
        FaceModelFile,
        what="face model",
        advice="give the .json file of a model (data_schemas/annotated_face_model.schema.json)",
        error=ModelError,
    )
    arrays_path = Path(path).with_name(entry.arrays)
    advice = "copy it beside its .json file again"
    arrays = read_npz(arrays_path, what="face model", advice=advice, error=ModelError)
    _check_shapes(entry, arrays, arrays_path)
    template_faces = arrays.get("template_faces")
    return AnnotatedSurface(
        arrays["control_vertices"].astype(np.float64),
        arrays["control_faces"].astype(np.int64),
        arrays["uv"].astype(np.float64),
        arrays["region"].astype(np.uint8),
        {name: Region(name, **region.model_dump()) for name, region in entry.regions.items()},
        landmark_points=_points(arrays, "landmark"),
        template_points=_points(arrays, "template"),
        template_offset=arrays.get("template_offset"),
        template_faces=None if template_faces is None else template_faces.astype(np.int64),
        template_uv=arrays.get("template_uv"),
        template_from_model=arrays.get("template_from_model"),
        notes=tuple(entry.notes),
        name=entry.name,
    )


def _check_shapes(entry: FaceModelFile, arrays: Arrays, path: Path) -> None:
    expected: dict[str, tuple[int, ...]] = {
        "control_vertices": (entry.control_vertices, 3),
        "control_faces": (entry.control_faces, 3),
        "uv": (entry.control_vertices, 2),
        "region": (entry.control_faces,),
    }
    if entry.landmarks:
        expected |= {"landmark_face": (68,), "landmark_barycentric": (68, 3)}
    if entry.template_vertices:
        expected |= {
            "template_face": (entry.template_vertices,),
            "template_barycentric": (entry.template_vertices, 3),
        }
    if "template_offset" in arrays:
        expected["template_offset"] = (entry.template_vertices, 3)
    if "template_from_model" in arrays:
        expected["template_from_model"] = (4, 4)
    if entry.template_faces:
        expected["template_faces"] = (entry.template_faces, 3)
    if "template_uv" in arrays:
        expected["template_uv"] = (entry.template_faces, 3, 2)
    for name, shape in expected.items():
        got = arrays[name].shape if name in arrays else None
        if got != shape:
            found = "missing" if got is None else f"of shape {got}"
            raise ModelError(
                f"face model: {name} in {path} is {found}, the .json file says {shape}; "
                "the two files do not belong together"
            )
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not np.all(np.isfinite(values)):
            raise ModelError(f"face model: {name} in {path} holds NaN or infinite values")
    limits = {
        "control_faces": entry.control_vertices,
        "landmark_face": entry.control_faces,
        "template_face": entry.control_faces,
        "template_faces": entry.template_vertices,
    }
    for name, limit in limits.items():
        if name in arrays and (arrays[name].min() < 0 or arrays[name].max() >= limit):
            raise ModelError(f"face model: {name} in {path} points outside 0 ... {limit - 1}")


def _points(arrays: Arrays, prefix: str) -> SurfacePoints | None:
    if f"{prefix}_face" not in arrays:
        return None
    return SurfacePoints(
        arrays[f"{prefix}_face"].astype(np.int64), arrays[f"{prefix}_barycentric"].astype(np.float64)
    )
