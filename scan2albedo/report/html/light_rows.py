"""The lights that a result tells of, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from scan2albedo.io.result_json import ResultRecord
from scan2albedo.report.html.texts import angle_text, number_text

UNKNOWN = "–"


@dataclass(frozen=True)
class LightRow:
    """One light in words; deviations are one standard deviation."""

    number: int
    azimuth: str
    elevation: str
    direction_deviation: str
    distance: str
    intensity: str
    intensity_deviation: str


def light_rows(record: ResultRecord) -> tuple[LightRow, ...]:
    """Return a row for each light of a result, the strongest first as it has them."""
    sure = _uncertainty(record)
    directions = _numbers(sure.get("direction_deviation_deg"), len(record.lights))
    intensities = _numbers(sure.get("intensity_deviation"), len(record.lights))
    return tuple(
        LightRow(
            k + 1,
            angle_text(light.azimuth_deg, 1),
            angle_text(light.elevation_deg, 1),
            UNKNOWN if direction is None else f"± {number_text(direction, 2)}°",
            "distant" if light.distance_mm is None else f"{light.distance_mm:.0f} mm",
            number_text(light.intensity),
            UNKNOWN if intensity is None else f"± {number_text(100 * intensity, 2)} %",
        )
        for k, (light, direction, intensity) in enumerate(
            zip(record.lights, directions, intensities, strict=True)
        )
    )


def alternative_lights(record: ResultRecord) -> tuple[tuple[str, str], ...]:
    """Return other lights that explain the image nearly as well: where they are, and their excess cost."""
    others = _uncertainty(record).get("alternatives")
    rows = []
    for other in others if isinstance(others, list) else []:
        if isinstance(other, Mapping):
            where = angles_text(other.get("lights_deg") or ()) or "no directed light"
            rows.append((where, f"{number_text(100 * float(other.get('excess') or 0), 2)} %"))
    return tuple(rows)


def angles_text(angles_deg: Iterable[tuple[float, float]]) -> str:
    """Return directions in degrees.

    >>> angles_text([(-32.1, 16.6), (40, 0)])
    '(−32°, 17°), (40°, 0°)'
    """
    return ", ".join(f"({angle_text(azimuth)}, {angle_text(elevation)})" for azimuth, elevation in angles_deg)


def _uncertainty(record: ResultRecord) -> Mapping[str, Any]:
    albedo = record.metrics.get("albedo")
    sure = albedo.get("uncertainty") if isinstance(albedo, Mapping) else None
    return sure if isinstance(sure, Mapping) else {}


def _numbers(values: Any, count: int) -> list[float | None]:
    """Return `count` numbers of a list that may be shorter, hold null, or be none."""
    given = values if isinstance(values, list) else []
    known = [float(value) if isinstance(value, int | float) else None for value in given[:count]]
    return known + [None] * (count - len(known))
