"""Landmarks of a fitted face as files: `landmarks.json` and `landmarks.csv`."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

from pydantic import Field

from scan2albedo.core.arrays import FloatArray
from scan2albedo.io.records import Number, Record

PARTS = {
    "jaw": range(17),
    "right brow": range(17, 22),
    "left brow": range(22, 27),
    "nose": range(27, 36),
    "right eye": range(36, 42),
    "left eye": range(42, 48),
    "lips": range(48, 68),
}
"""iBUG-68 numbers, from 0; right and left are the subject's."""
_COLUMNS = ("number", "part", "model_x_mm", "model_y_mm", "model_z_mm", "scan_x", "scan_y", "scan_z")

Point = tuple[Number, Number, Number]


class LandmarkRecord(Record):
    """One landmark."""

    number: int = Field(ge=0, le=67, description="iBUG-68, from 0.")
    part: str = Field(description="Of the face; right and left are the subject's.")
    model_mm: Point = Field(description="In the frame of fitted.glb.")
    scan: Point = Field(description="In the frame and unit of the scan's file.")
    deviation_mm: Number = Field(ge=0, description="Standard deviation along each axis.")


class LandmarksRecord(Record):
    """The content of `landmarks.json`."""

    format_version: Literal[1] = 1
    mm_per_unit: Number = Field(gt=0, description="Of the scan's file.")
    landmarks: tuple[LandmarkRecord, ...] = Field(min_length=68, max_length=68)

    @classmethod
    def of(
        cls, model_mm: FloatArray, scan: FloatArray, deviation_mm: FloatArray, mm_per_unit: float
    ) -> LandmarksRecord:
        """Return the record of landmarks (68, 3) in both frames with their deviations (68,)."""
        part_of = {number: part for part, numbers in PARTS.items() for number in numbers}
        rows = zip(model_mm.tolist(), scan.tolist(), deviation_mm.tolist(), strict=True)
        return cls(
            mm_per_unit=mm_per_unit,
            landmarks=tuple(
                LandmarkRecord(
                    number=number, part=part_of[number], model_mm=of_model, scan=of_scan, deviation_mm=sd
                )
                for number, (of_model, of_scan, sd) in enumerate(rows)
            ),
        )


def write_landmarks_csv(file: Path, record: LandmarksRecord) -> None:
    """Write the landmarks as a table, a row each."""
    with file.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow((*_COLUMNS, "deviation_mm"))
        for point in record.landmarks:
            scan = (f"{value:.9g}" for value in point.scan)
            model_mm = (f"{value:.4f}" for value in point.model_mm)
            writer.writerow((point.number, point.part, *model_mm, *scan, f"{point.deviation_mm:.2f}"))
