"""Frames of eyeglasses from files: a mesh and its key points, brought to millimetres together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.mean_keypoints import WIDTHS_MM
from scan2albedo.eyeglasses.files.keypoint_files import KeyPoints, read_keypoints_with_unit
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.load_scan import load_scan_with
from scan2albedo.io.units import (
    MM_PER_UNIT,
    PLAUSIBLE_GLASSES_MM,
    check_unit,
    glasses_millimetres_per_unit,
)

if TYPE_CHECKING:
    from scan2albedo.core.raw_scan import RawScan
    from scan2albedo.io.parsed_mesh import ParsedMesh


KEY_POINTS_SUFFIX = ".keypoints.json"

_NEAR = 0.1
"""Median distance of key points from the mesh, as a part of their size, up to which they are of that mesh."""


@dataclass(frozen=True)
class GlassesFrame:
    """A frame as read: mesh and key points (20, 3) in mm, NaN for missing ones."""

    scan: RawScan
    keypoints: FloatArray
    mm_per_unit: float
    """Of the mesh's file."""
    mesh_file: Path
    mesh_sha256: str
    """Of the file as read, with those it refers to."""
    keypoints_file: Path
    keypoints_sha256: str

    @property
    def name(self) -> str:
        """The mesh file's stem."""
        return self.scan.name

    @property
    def missing_key_points(self) -> tuple[str, ...]:
        """Names of the key points that the file leaves out."""
        rows = zip(KEY_POINT_NAMES, self.keypoints, strict=True)
        return tuple(name for name, point in rows if not np.isfinite(point).all())

    @property
    def has_temples(self) -> bool:
        """Whether a key point behind the hinges is known."""
        behind = [name for name in KEY_POINT_NAMES if "temple" in name or "ear" in name]
        return not set(behind) <= set(self.missing_key_points)


def keypoints_beside(mesh: Path) -> Path:
    """Return where a mesh's key points are looked for: ``<stem>.keypoints.json`` beside it."""
    return mesh.with_name(mesh.stem + KEY_POINTS_SUFFIX)


def read_frame(
    mesh: Path,
    keypoints: Path | None = None,
    unit: str = "auto",
    widths_mm: tuple[float, float] = WIDTHS_MM,
) -> GlassesFrame:
    """Read a mesh and its key points, ``<stem>.keypoints.json`` beside it when omitted.

    The unit is the mesh's. "auto" is the one in which the key points lie on the mesh, when their file states
    its own unit; otherwise both are in one unit, which the size of glasses decides. Other `widths_mm` of
    fronts admit other sizes in proportion. Raises EyeglassesError or ScanError, naming the file, when one
    cannot be read or the size is that of no glasses; ValueError for an unknown unit.
    """
    check_unit(unit)
    marks_file = keypoints_beside(mesh) if keypoints is None else keypoints
    marks = read_keypoints_with_unit(marks_file)
    low, high = np.array(PLAUSIBLE_GLASSES_MM) * widths_mm / WIDTHS_MM
    sizes_mm = float(low), float(high)
    mm_per_unit = 0.0

    def decide(parsed: ParsedMesh, components: IntArray) -> tuple[float, str]:
        nonlocal mm_per_unit
        mm_per_unit, note = _unit_of(parsed, marks, unit, (mesh.name, marks_file.name), sizes_mm)
        return mm_per_unit, note

    scan = load_scan_with(mesh, decide)
    factor = mm_per_unit if marks.unit == "unknown" else MM_PER_UNIT[marks.unit]
    return GlassesFrame(
        scan=scan,
        keypoints=marks.points * factor,
        mm_per_unit=mm_per_unit,
        mesh_file=mesh,
        mesh_sha256=input_sha256(mesh),
        keypoints_file=marks_file,
        keypoints_sha256=file_sha256(marks_file),
    )


def _unit_of(
    mesh: ParsedMesh, marks: KeyPoints, unit: str, names: tuple[str, str], sizes_mm: tuple[float, float]
) -> tuple[float, str]:
    """Return the factor to millimetres of a mesh, and the note that states its unit.

    `names` are those of the files of mesh and key points.
    """
    mesh_name, marks_name = names
    if marks.unit == "unknown":
        return glasses_millimetres_per_unit(marks.points, unit, mesh_name, sizes_mm)
    _, size = glasses_millimetres_per_unit(marks.points, marks.unit, marks_name, sizes_mm)
    if unit != "auto":
        return MM_PER_UNIT[unit], f"unit: {unit}, as given; of the key points: {size.removeprefix('unit: ')}"
    return _unit_on_which_key_points_lie(mesh, marks, mesh_name)


def _unit_on_which_key_points_lie(mesh: ParsedMesh, marks: KeyPoints, name: str) -> tuple[float, str]:
    """Return the unit in which key points of a known unit lie on the mesh: units are factors of ten apart."""
    known = marks.points[np.isfinite(marks.points).all(1)] * MM_PER_UNIT[marks.unit]
    surface, size = ClosestPointQuery(mesh.vertices, mesh.faces), float(np.ptp(known, axis=0).max())
    off = {
        unit: mm * float(np.median(surface.query(known / mm).distance)) for unit, mm in MM_PER_UNIT.items()
    }
    unit = min(off, key=lambda u: off[u])
    if not off[unit] <= _NEAR * size:
        raise EyeglassesError(
            f"{name}: in no unit do the key points lie on the mesh: at best, in {unit}, they are "
            f"{off[unit]:.3g} mm off; check that they belong to this mesh and that their file says their unit"
        )
    evidence = f"median distance {off[unit]:.2g} mm of the key points, which are in {marks.unit}"
    return MM_PER_UNIT[unit], f"unit: {unit}, decided from where the key points lie ({evidence})"
