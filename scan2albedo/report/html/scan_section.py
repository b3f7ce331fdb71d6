"""The page's section about one scan."""

import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from scan2albedo.applications.files import load_result
from scan2albedo.core.arrays import Values
from scan2albedo.errors import Scan2AlbedoError, one_line
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.result_records import ResultRecord, flat_figures
from scan2albedo.report.html import texts
from scan2albedo.report.html.encoding import picture_url, viewer_entry
from scan2albedo.report.html.texts import angle_text, label_of, number_text, seconds_text, value_text


def scan_section(
    folder: Path,
    record: ResultRecord,
    page: Path,
    topologies: dict[str, Values],
    *,
    single: bool,
    anchor: str,
    name: str,
) -> Values:
    """Return the section about the result in `folder`, as the template shows it, for the page at `page`.

    Of a `single` scan textures are kept without loss and soft light is shadowed; one of many has small
    pictures. What a missing or damaged file
    would show is left out, and the page names the file and the reason. Raises Scan2AlbedoError when figures
    in the record are of other kinds than those of a run.
    """
    size, quality = (1024, None) if single else (256, 80)
    viewer, viewer_missing = None, ""
    try:
        try:
            face = load_result(folder, need_albedo=False)
            viewer = viewer_entry(face, record, topologies, size=size, quality=quality, soft_shadows=single)
        except Scan2AlbedoError as error:
            viewer_missing = one_line(error)
        # Each file's name, a link to it from the page or "", and its size.
        files = []
        for file in record.files:
            try:
                there = texts.size_text((folder / file).stat().st_size)
                files.append((file, relative_link(folder / file, page), there))
            except OSError:
                files.append((file, "", "missing"))
        total = sum(record.timings_s.values())
        times = []
        start = 0.0
        for stage, seconds in record.timings_s.items():
            share = seconds / total if total > 0 else 0.0
            bar = {"stage": stage.replace("_", " "), "text": seconds_text(seconds)}
            times.append({**bar, "share": share, "start": start})
            start += share
        return {
            **_figures(record),
            "anchor": anchor,
            "name": name,
            "record": record,
            "viewer": viewer,
            "viewer_missing": viewer_missing,
            "overview": picture_url(folder / "overview.png", 1800 if single else 1000),
            "curves": picture_url(folder / "error_vs_time.png", 1800 if single else 1000),
            "times": times,
            "seconds": seconds_text(total),
            "files": files,
            "options": [(label_of(key), _option_text(value)) for key, value in record.options.items()],
        }
    except (TypeError, ValueError, ArithmeticError, AttributeError, LookupError) as error:
        text = f"{folder / 'result.json'}: holds figures that no run wrote ({one_line(error)})"
        raise Scan2AlbedoError(f"{text}; process the scan again") from error


def _figures(record: ResultRecord) -> Values:
    # (label, value, unit) of each stage's figures, without those that are shown elsewhere.
    warnings, groups = [], {}
    for stage, figures in record.metrics.items():
        if isinstance(figures, Mapping):
            title, leaves = stage.replace("_", " "), flat_figures(figures, "")
            groups[title] = {k[1:]: v for k, v in leaves.items() if not k.startswith("_parameters")}
            if figures.get("converged") is False:
                warnings.append(f"{title} did not converge: its budget ended, or it stopped improving")
    plain = {key: value for key, value in record.parameters.items() if not isinstance(value, list | dict)}
    if plain:
        groups["reflectance"] = plain
    rows = {
        title: [(label_of(key), value_text(key, value), texts.unit_of(key)) for key, value in figures.items()]
        for title, figures in groups.items()
    }
    albedo = record.metrics.get("albedo")
    found = albedo.get("uncertainty") if isinstance(albedo, Mapping) else None
    uncertainty: Mapping[str, Any] = found if isinstance(found, Mapping) else {}

    # Other lights that explain the image nearly as well: where they are, and the odds against them.
    others, alternatives = uncertainty.get("alternatives"), []
    for other in others if isinstance(others, list) else []:
        if isinstance(other, Mapping):
            where = angles_text(other.get("lights_deg") or ()) or "no directed light"
            odds = math.exp(min(float(other.get("excess") or 0), 100.0))
            alternatives.append((where, number_text(odds, 2)))
    return {
        "headline": _headline(record),
        "warnings": warnings,
        "figures": rows,
        "lights": _lights(record, uncertainty),
        "alternatives": alternatives,
    }


def _headline(record: ResultRecord) -> list[str]:
    flat = flat_figures(record.metrics, "metrics")
    residual, error = flat.get("metrics_fit_residual_mean_mm"), flat.get("metrics_albedo_expected_error")
    headline = [] if residual is None else [f"fit {number_text(residual)} mm mean"]
    if record.lights:
        degrees = (np.degrees((light.azimuth_rad, light.elevation_rad)) for light in record.lights)
        where = angles_text((float(azimuth), float(elevation)) for azimuth, elevation in degrees)
        headline.append(f"{len(record.lights)} light{'s' if len(record.lights) > 1 else ''} at {where}")
    elif record.parameters.get("brdf") == "spherical-harmonics":
        headline.append("light as spherical harmonics")
    elif record.environment is not None:
        headline.append("soft light")
    else:
        headline.append("no directed light" if record.parameters else "no albedo (see the plan)")
    if error is not None:
        headline.append(f"albedo ± {number_text(100 * error, 2)} % a texel")
    headline.append(seconds_text(sum(record.timings_s.values())))
    return headline


def _lights(record: ResultRecord, uncertainty: Mapping[str, Any]) -> list[Values]:
    """Return the lamps' number, cells of the table, and colour."""

    def known(name: str, k: int, factor: float, unit: str) -> str:
        """Return a standard deviation of a list that may be shorter, hold null, or be none."""
        values = uncertainty.get(name)
        value = values[k] if isinstance(values, list) and k < len(values) else None
        return f"± {number_text(factor * value, 2)}{unit}" if isinstance(value, int | float) else "–"

    lights = []
    for k, light in enumerate(record.lights):
        color = ""  # in sRGB, its brightest channel full; empty for white
        if light.color_linear != (1.0, 1.0, 1.0):
            rgb = encode_srgb_bytes(np.array(light.color_linear) / max(light.color_linear))
            color = f"#{rgb.tobytes().hex()}"
        cells = (
            angle_text(math.degrees(light.azimuth_rad), 1),
            angle_text(math.degrees(light.elevation_rad), 1),
            known("direction_deviation_deg", k, 1, "°"),
            "distant" if light.distance_mm == math.inf else f"{light.distance_mm:.0f} mm",
            number_text(light.intensity),
            known("intensity_deviation", k, 100, " %"),
            f"{number_text(light.radius_deg, 2)}°" if light.radius_deg > 0 else "point",
        )
        lights.append({"number": k + 1, "cells": cells, "color": color})
    return lights


def _option_text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_option_text(part) for part in value) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_option_text(part)}" for key, part in value.items())
    return value_text("", value)


def relative_link(file: Path, page: Path) -> str:
    """Return a link from a page to a file; nothing in a name can make it another kind of link."""
    try:
        relative = os.path.relpath(file.resolve(), page.resolve().parent)
    except ValueError:  # another drive
        return file.resolve().as_uri()
    return quote(Path(relative).as_posix(), safe="/")


def angles_text(angles_deg: Iterable[tuple[float, float]]) -> str:
    """Return directions in degrees.

    >>> angles_text([(-32.1, 16.6), (40, 0)])
    '(−32°, 17°), (40°, 0°)'
    """
    return ", ".join(f"({angle_text(azimuth)}, {angle_text(elevation)})" for azimuth, elevation in angles_deg)
