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
from scan2albedo.report.html.charts import StageChart, read_trace, stage_charts
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
    color: str
    """Of its light in sRGB, #rrggbb, its brightest channel full; empty for white light."""
    radius: str


@dataclass(frozen=True)
class TimeBar:
    """One stage's part of the run time."""

    stage: str
    text: str
    share: float
    start: float


@dataclass(frozen=True)
class ScanSection:
    """One scan as the template shows it."""

    anchor: str
    name: str
    record: ResultRecord
    headline: tuple[str, ...]
    warnings: tuple[str, ...]
    viewer: Mapping[str, Any] | None
    viewer_missing: str
    residual_note: str
    overview: tuple[str, int, int] | None
    charts: tuple[StageChart, ...]
    single_points: tuple[StageChart, ...]
    """Stages of which a single row was recorded: a sentence each."""
    trace_missing: str
    times: tuple[TimeBar, ...]
    seconds: str
    figures: Mapping[str, list[tuple[str, str, str]]]
    lights: tuple[LightRow, ...]
    alternatives: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str, str], ...]
    options: tuple[tuple[str, str], ...]


def scan_section(
    folder: Path,
    record: ResultRecord,
    page: Path,
    topologies: Topologies,
    style: SectionStyle,
    *,
    anchor: str,
    name: str,
) -> ScanSection:
    """Return the section about the result in `folder` for the page at `page`.

    What a missing or damaged file would show is left out, and the page names the file and the reason. Raises
    Scan2AlbedoError when figures in the record are of other kinds than those of a run.
    """
    try:
        return _section(folder, record, page, topologies, style, anchor, name)
    except (TypeError, ValueError, ArithmeticError, AttributeError, LookupError) as error:
        raise Scan2AlbedoError(
            f"{folder / 'result.json'}: holds figures that no run wrote ({one_line(error)}); process the "
            "scan again"
        ) from error


def _section(
    folder: Path,
    record: ResultRecord,
    page: Path,
    topologies: Topologies,
    style: SectionStyle,
    anchor: str,
    name: str,
) -> ScanSection:
    viewer, missing, residual = _viewer(folder, record, topologies, style)
    trace, trace_missing = _trace(folder)
    total = sum(record.timings_s.values())
    return ScanSection(
        anchor=anchor,
        name=name,
        record=record,
        headline=_headline(record, total),
        warnings=_warnings(record),
        viewer=viewer,
        viewer_missing=missing,
        residual_note=residual.source,
        overview=picture_url(folder / "overview.png", style.overview_width, style.overview_quality),
        charts=tuple(chart for chart in trace if chart.drawn),
        single_points=tuple(chart for chart in trace if not chart.drawn),
        trace_missing=trace_missing,
        times=_times(record, total),
        seconds=seconds_text(total),
        figures=_figures(record),
        lights=light_rows(record),
        alternatives=alternative_lights(record),
        files=file_links(folder, record.files, page),
        options=tuple((label_of(key), _option_text(value)) for key, value in record.options.items()),
    )


def _viewer(
    folder: Path, record: ResultRecord, topologies: Topologies, style: SectionStyle
) -> tuple[Mapping[str, Any] | None, str, Residual]:
    unknown = Residual(None, "")
    try:
        face = load_result(folder, need_albedo=False)
        residual = residual_of_result(folder, record, face.mesh) if style.residual else unknown
        entry = viewer_entry(
            face, record, topologies, style.texture, residual.distance_mm, soft_shadows=style.residual
        )
        return entry, "", residual
    except Scan2AlbedoError as error:
        return None, one_line(error), unknown


def _trace(folder: Path) -> tuple[list[StageChart], str]:
    try:
        charts = stage_charts(read_trace(folder / "trace.csv"))
    except Scan2AlbedoError as error:
        return [], one_line(error)
    return charts, "" if charts else "no iterative stage ran"


def _headline(record: ResultRecord, total: float) -> tuple[str, ...]:
    parts = []
    figures = flat_figures(record.metrics, "metrics")
    residual = figures.get("metrics_fit_residual_mean_mm")
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
    deviation = figures.get("metrics_albedo_uncertainty_albedo_deviation")
    if deviation is not None:
        parts.append(f"albedo ± {number_text(100 * deviation, 2)} %")
    return (*parts, seconds_text(total))


def _warnings(record: ResultRecord) -> tuple[str, ...]:
    """Return the warnings that a person should read before using the result."""
    found = [
        f"{stage.replace('_', ' ')} did not converge: its budget ended, or it stopped improving"
        for stage, figures in record.metrics.items()
        if isinstance(figures, Mapping) and figures.get("converged") is False
    ]
    figures = flat_figures(record.metrics, "metrics")
    deviation = figures.get("metrics_albedo_uncertainty_albedo_deviation")
    if deviation is not None and deviation > UNCERTAIN_ALBEDO:
        found.append(
            f"the light is poorly determined: that alone makes the albedo uncertain by "
            f"{number_text(100 * deviation, 2)} %"
        )
    return tuple(found)


def _times(record: ResultRecord, total: float) -> tuple[TimeBar, ...]:
    bars, start = [], 0.0
    for stage, seconds in record.timings_s.items():
        share = seconds / total if total > 0 else 0.0
        bars.append(TimeBar(stage.replace("_", " "), seconds_text(seconds), share, start))
        start += share
    return tuple(bars)


def _figures(record: ResultRecord) -> dict[str, list[tuple[str, str, str]]]:
    """Return (label, value, unit) of each stage's figures; those shown elsewhere are left out."""
    groups: dict[str, list[tuple[str, str, str]]] = {}
    for stage, figures in record.metrics.items():
        if not isinstance(figures, Mapping):
            continue
        leaves = flat_figures(figures, "")
        shown = {k[1:]: v for k, v in leaves.items() if not k.startswith("_parameters")}
        groups[stage.replace("_", " ")] = [
            (label_of(key), value_text(key, value), unit_of(key)) for key, value in shown.items()
        ]
    reflectance = [
        (label_of(key), value_text(key, value), unit_of(key))
        for key, value in record.parameters.items()
        if not isinstance(value, list | dict)
    ]
    if reflectance:
        groups["reflectance"] = reflectance
    return groups


def _option_text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, list | tuple):
        return ", ".join(_option_text(part) for part in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_option_text(part)}" for key, part in value.items())
    return value_text("", value)


def file_links(folder: Path, names: tuple[str, ...], page: Path) -> tuple[tuple[str, str, str], ...]:
    """Return (name, link relative to the page or "", size) of a result's files."""
    links = []
    for name in names:
        file = folder / name
        try:
            size = size_text(file.stat().st_size)
        except OSError:
            links.append((name, "", "missing"))
            continue
        links.append((name, relative_link(file, page), size))
    return tuple(links)


def relative_link(file: Path, page: Path) -> str:
    """Return a link from a page to a file; nothing in a name can make it another kind of link."""
    try:
        relative = os.path.relpath(file.resolve(), page.resolve().parent)
    except ValueError:  # another drive
        return file.resolve().as_uri()
    return quote(Path(relative).as_posix(), safe="/")


def light_rows(record: ResultRecord) -> tuple[LightRow, ...]:
    """Return a row for each light of a result, the strongest first as it has them."""
    uncertainty = _uncertainty(record)
    directions = _numbers(uncertainty.get("direction_deviation_deg"), len(record.lights))
    intensities = _numbers(uncertainty.get("intensity_deviation"), len(record.lights))
    return tuple(
        LightRow(
            k + 1,
            angle_text(math.degrees(light.azimuth_rad), 1),
            angle_text(math.degrees(light.elevation_rad), 1),
            _UNKNOWN if direction is None else f"± {number_text(direction, 2)}°",
            "distant" if light.distance_mm == math.inf else f"{light.distance_mm:.0f} mm",
            number_text(light.intensity),
            _UNKNOWN if intensity is None else f"± {number_text(100 * intensity, 2)} %",
            _hex_color(light.color_linear),
            f"{number_text(light.radius_deg, 2)}°" if light.radius_deg > 0 else "point",
        )
        for k, (light, direction, intensity) in enumerate(
            zip(record.lights, directions, intensities, strict=True)
        )
    )


def _hex_color(color_linear: tuple[float, float, float]) -> str:
    if color_linear == (1.0, 1.0, 1.0):
        return ""
    red, green, blue = encode_srgb_bytes(np.array(color_linear) / max(color_linear)).tolist()
    return f"#{red:02x}{green:02x}{blue:02x}"


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
    uncertainty = albedo.get("uncertainty") if isinstance(albedo, Mapping) else None
    return uncertainty if isinstance(uncertainty, Mapping) else {}


def _numbers(values: Any, count: int) -> list[float | None]:
    """Return `count` numbers of a list that may be shorter, hold null, or be none."""
    given = values if isinstance(values, list) else []
    known = [float(value) if isinstance(value, int | float) else None for value in given[:count]]
    return known + [None] * (count - len(known))
