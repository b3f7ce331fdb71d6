"""The page's section about one scan."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from scan2albedo.applications.files import load_result
from scan2albedo.errors import Scan2AlbedoError, one_line
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.result_records import ResultRecord, flat_figures
from scan2albedo.report.html.charts import read_trace, stage_charts
from scan2albedo.report.html.encoding import TextureStyle, Topologies, picture_url
from scan2albedo.report.html.texts import (
    angle_text,
    label_of,
    number_text,
    seconds_text,
    size_text,
    unit_of,
    value_text,
)
from scan2albedo.report.html.viewer_data import Residual, residual_of_result, viewer_entry

_UNKNOWN = "–"
UNCERTAIN_ALBEDO = 0.1
"""Relative deviation of the albedo from which the page warns."""
_DEVIATION = "metrics_albedo_uncertainty_albedo_deviation"


@dataclass(frozen=True)
class SectionStyle:
    """How much of a scan goes into the page."""

    texture: TextureStyle
    overview_width: int
    overview_quality: int
    """Of a JPEG."""
    residual: bool
    """Whether the distance to the scan is measured again and soft light shadowed, which takes seconds."""


SINGLE = SectionStyle(TextureStyle(1024, None), 1800, 88, True)
"""Of a page of one scan: textures without loss."""
ONE_OF_MANY = SectionStyle(TextureStyle(256, 88), 1000, 76, False)


def scan_section(
    folder: Path,
    record: ResultRecord,
    page: Path,
    topologies: Topologies,
    style: SectionStyle,
    *,
    anchor: str,
    name: str,
) -> dict[str, Any]:
    """Return the section about the result in `folder`, as the template shows it, for the page at `page`.

    What a missing or damaged file would show is left out, and the page names the file and the reason. Raises
    Scan2AlbedoError when figures in the record are of other kinds than those of a run.
    """
    viewer, viewer_missing, residual = None, "", Residual(None, "")
    charts: list[dict[str, Any]] = []
    trace_missing = "no iterative stage ran"
    try:
        try:
            face = load_result(folder, need_albedo=False)
            if style.residual:
                residual = residual_of_result(folder, record, face.mesh)
            viewer = viewer_entry(
                face, record, topologies, style.texture, residual.distance_mm, soft_shadows=style.residual
            )
        except Scan2AlbedoError as error:
            viewer_missing, residual = one_line(error), Residual(None, "")
        try:
            charts = stage_charts(read_trace(folder / "trace.csv"))
        except Scan2AlbedoError as error:
            trace_missing = one_line(error)
        total = sum(record.timings_s.values())
        times, start = [], 0.0
        for stage, seconds in record.timings_s.items():
            share = seconds / total if total > 0 else 0.0
            bar = {"stage": stage.replace("_", " "), "text": seconds_text(seconds)}
            times.append({**bar, "share": share, "start": start})
            start += share
        return {
            "anchor": anchor,
            "name": name,
            "record": record,
            "headline": (*_headline(record), seconds_text(total)),
            "warnings": _warnings(record),
            "viewer": viewer,
            "viewer_missing": viewer_missing,
            "residual_note": residual.source,
            "overview": picture_url(folder / "overview.png", style.overview_width, style.overview_quality),
            "charts": [chart for chart in charts if len(chart["rows"]) > 1],
            "single_points": [chart for chart in charts if len(chart["rows"]) == 1],
            "trace_missing": "" if charts else trace_missing,
            "times": times,
            "seconds": seconds_text(total),
            "figures": _figures(record),
            "lights": _light_rows(record),
            "alternatives": _alternative_lights(record),
            "files": [_file_link(folder / file, file, page) for file in record.files],
            "options": [(label_of(key), _option_text(value)) for key, value in record.options.items()],
        }
    except (TypeError, ValueError, ArithmeticError, AttributeError, LookupError) as error:
        raise Scan2AlbedoError(
            f"{folder / 'result.json'}: holds figures that no run wrote ({one_line(error)}); process the "
            "scan again"
        ) from error


def _headline(record: ResultRecord) -> list[str]:
    parts = []
    figures = flat_figures(record.metrics, "metrics")
    residual, deviation = figures.get("metrics_fit_residual_mean_mm"), figures.get(_DEVIATION)
    if residual is not None:
        parts.append(f"fit {number_text(residual)} mm mean")
    if record.lights:
        degrees = (np.degrees((light.azimuth_rad, light.elevation_rad)) for light in record.lights)
        where = angles_text((float(azimuth), float(elevation)) for azimuth, elevation in degrees)
        parts.append(f"{len(record.lights)} light{'s' if len(record.lights) > 1 else ''} at {where}")
    elif record.parameters.get("brdf") == "spherical-harmonics":
        parts.append("light as spherical harmonics")
    elif record.environment is not None:
        parts.append("soft light")
    else:
        parts.append("no directed light" if record.parameters else "no albedo (see the plan)")
    if deviation is not None:
        parts.append(f"albedo ± {number_text(100 * deviation, 2)} %")
    return parts


def _warnings(record: ResultRecord) -> list[str]:
    """Return the warnings that a person should read before using the result."""
    found = [
        f"{stage.replace('_', ' ')} did not converge: its budget ended, or it stopped improving"
        for stage, figures in record.metrics.items()
        if isinstance(figures, Mapping) and figures.get("converged") is False
    ]
    deviation = flat_figures(record.metrics, "metrics").get(_DEVIATION)
    if deviation is not None and deviation > UNCERTAIN_ALBEDO:
        found.append(
            f"the light is poorly determined: that alone makes the albedo uncertain by "
            f"{number_text(100 * deviation, 2)} %"
        )
    return found


def _figures(record: ResultRecord) -> dict[str, list[tuple[str, str, str]]]:
    """Return (label, value, unit) of each stage's figures; those shown elsewhere are left out."""

    def texts(figures: Mapping[str, Any]) -> list[tuple[str, str, str]]:
        return [(label_of(key), value_text(key, value), unit_of(key)) for key, value in figures.items()]

    groups = {}
    for stage, figures in record.metrics.items():
        if isinstance(figures, Mapping):
            leaves = flat_figures(figures, "")
            shown = {k[1:]: v for k, v in leaves.items() if not k.startswith("_parameters")}
            groups[stage.replace("_", " ")] = texts(shown)
    plain = {key: value for key, value in record.parameters.items() if not isinstance(value, list | dict)}
    if plain:
        groups["reflectance"] = texts(plain)
    return groups


def _option_text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_option_text(part) for part in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_option_text(part)}" for key, part in value.items())
    return value_text("", value)


def _file_link(file: Path, name: str, page: Path) -> tuple[str, str, str]:
    """Return a file's name, a link to it from the page or "", and its size."""
    try:
        size = size_text(file.stat().st_size)
    except OSError:
        return name, "", "missing"
    return name, relative_link(file, page), size


def relative_link(file: Path, page: Path) -> str:
    """Return a link from a page to a file; nothing in a name can make it another kind of link."""
    try:
        relative = os.path.relpath(file.resolve(), page.resolve().parent)
    except ValueError:  # another drive
        return file.resolve().as_uri()
    return quote(Path(relative).as_posix(), safe="/")


def _light_rows(record: ResultRecord) -> list[dict[str, Any]]:
    """Return the lights of a result in words, the strongest first as it has them.

    Deviations are one standard deviation; the colour is in sRGB, its brightest channel full, empty for white.
    """
    uncertainty, rows = _uncertainty(record), []

    def known(name: str, k: int) -> float | None:
        """Return a number of a list that may be shorter, hold null, or be none."""
        values = uncertainty.get(name)
        value = values[k] if isinstance(values, list) and k < len(values) else None
        return float(value) if isinstance(value, int | float) else None

    for k, light in enumerate(record.lights):
        direction, intensity = known("direction_deviation_deg", k), known("intensity_deviation", k)
        color = ""
        if light.color_linear != (1.0, 1.0, 1.0):
            rgb = encode_srgb_bytes(np.array(light.color_linear) / max(light.color_linear))
            color = f"#{rgb.tobytes().hex()}"
        rows.append(
            {
                "number": k + 1,
                "azimuth": angle_text(math.degrees(light.azimuth_rad), 1),
                "elevation": angle_text(math.degrees(light.elevation_rad), 1),
                "direction_deviation": (_UNKNOWN if direction is None else f"± {number_text(direction, 2)}°"),
                "distance": "distant" if light.distance_mm == math.inf else f"{light.distance_mm:.0f} mm",
                "intensity": number_text(light.intensity),
                "intensity_deviation": (
                    _UNKNOWN if intensity is None else f"± {number_text(100 * intensity, 2)} %"
                ),
                "color": color,
                "radius": f"{number_text(light.radius_deg, 2)}°" if light.radius_deg > 0 else "point",
            }
        )
    return rows


def _alternative_lights(record: ResultRecord) -> list[tuple[str, str]]:
    """Return other lights that explain the image nearly as well: where they are, and their excess cost."""
    others = _uncertainty(record).get("alternatives")
    rows = []
    for other in others if isinstance(others, list) else []:
        if isinstance(other, Mapping):
            where = angles_text(other.get("lights_deg") or ()) or "no directed light"
            rows.append((where, f"{number_text(100 * float(other.get('excess') or 0), 2)} %"))
    return rows


def angles_text(angles_deg: Iterable[tuple[float, float]]) -> str:
    """Return directions in degrees.

    >>> angles_text([(-32.1, 16.6), (40, 0)])
    '(−32°, 17°), (40°, 0°)'
    """
    return ", ".join(f"({angle_text(azimuth)}, {angle_text(elevation)})" for azimuth, elevation in angles_deg)


def _uncertainty(record: ResultRecord) -> Mapping[str, Any]:
    albedo = record.metrics.get("albedo")
    uncertainty = albedo.get("uncertainty") if isinstance(albedo, Mapping) else None
    return uncertainty if isinstance(uncertainty, Mapping) else {}
