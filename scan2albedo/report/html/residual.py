"""The distance of a fitted face to its scan, measured again from the input file: no result file holds it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.processed_face import FaceMesh
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.result_json import RegistrationRecord, ResultRecord, read_record

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Residual:
    """(V,) mm, NaN where there is no scan, or None; and where it comes from or why it is not there."""

    distance_mm: FloatArray | None
    source: str


def residual_of_result(folder: Path, record: ResultRecord, mesh: FaceMesh) -> Residual:
    """Return each vertex's distance to the scan that a result was made of, when that still lies there.

    As the fit measures it: none on the scan's border, beyond the gate, or where the scan faces away.
    """
    if mesh.from_chart:
        return Residual(None, "nothing was fitted")
    if record.input.file is None:
        return Residual(None, "the scan came from memory and no file holds it")
    from scan2albedo.io.input_hash import input_sha256

    file = Path(record.input.file)
    try:
        if not file.is_file():
            return Residual(None, f"{file} is no longer there to be measured")
        if input_sha256(file) != record.input.sha256:
            return Residual(None, f"{file} is no longer the scan that was processed")
        pose = read_record(folder / "registration.json", RegistrationRecord).fitted_from_scan
        if pose is None:
            return Residual(None, "registration.json tells no pose of the fit")
        distance = _distances(file, str(record.options.get("unit", "auto")), np.array(pose), mesh)
    except Scan2AlbedoError as error:
        return Residual(None, " ".join(str(error).split()))
    mean = float(np.nanmean(distance)) if np.isfinite(distance).any() else float("nan")
    return Residual(distance, f"measured again against {file.name}: {mean:.3f} mm in the mean")


def _distances(file: Path, unit: str, model_from_scan: FloatArray, mesh: FaceMesh) -> FloatArray:
    from scan2albedo.fitting.options import FitOptions
    from scan2albedo.fitting.outcome import residuals_mm
    from scan2albedo.fitting.scan_surface import scan_near_model
    from scan2albedo.io import load_scan

    scan, gate = load_scan(file, unit=unit), FitOptions().residual_gate_mm
    low, high = mesh.vertices.min(0) - gate, mesh.vertices.max(0) + gate
    surface = scan_near_model(scan.vertices, scan.faces, model_from_scan, low, high)
    if surface is None:
        return np.full(len(mesh.vertices), np.nan)
    surface = surface.turned_outward(mesh.vertices, mesh.normals, gate)
    return residuals_mm(surface, mesh.vertices, mesh.faces, gate)
