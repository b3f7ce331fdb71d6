"""Numbers, names and units as a person reads them."""

import math
from typing import Any

_UNITS = {
    "mm": "mm",
    "mm2": "mm²",
    "deg": "°",
    "rad": "rad",
    "mb": "MB",
    "s": "s",
    "seconds": "s",
    "pct": "%",
}
_SHARES = {"coverage", "seen", "confidence", "albedo_deviation", "intensity_deviation"}
"""Last parts of names whose values are parts of 1, shown in per cent."""
_NAMES = {
    "metrics_fit_residual_mean_mm": "fit, mean",
    "metrics_fit_residual_p95_mm": "fit, 95 %",
    "metrics_albedo_lights": "lights",
    "metrics_albedo_uncertainty_albedo_deviation": "albedo uncertainty",
    "uncertainty_albedo_deviation": "albedo uncertainty",
    "seconds": "time",
    "cpu_seconds": "CPU time",
    "peak_memory_mb": "memory",
}


def number_text(value: float | None, digits: int = 3) -> str:
    """Return a number with some significant digits, no exponent where a person does without.

    >>> [number_text(v) for v in (0.11502, 12.0, 1234567.0, 2e12, 0.0, 0.00001234, None)]
    ['0.115', '12', '1,234,567', '2e+12', '0', '1.23e-05', '–']
    """
    if value is None or not math.isfinite(value):
        return "–"
    if value == int(value) and abs(value) < 1e9:
        return f"{int(value):,}"
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:.{digits}g}"


def unit_of(column: str) -> str:
    """Return the unit in a column's name, "%" for shares, or "".

    >>> [unit_of(name) for name in ("metrics_fit_residual_mean_mm", "seconds_fit", "metrics_fit_coverage")]
    ['mm', 's', '%']
    """
    if column.startswith("seconds") or column.endswith("seconds"):
        return "s"
    return "%" if is_share(column) else _UNITS.get(column.rpartition("_")[2], "")


def is_share(column: str) -> bool:
    """Return whether a column holds parts of 1."""
    return any(column == share or column.endswith(f"_{share}") for share in _SHARES)


def label_of(column: str) -> str:
    """Return a column's name for a person, without its unit.

    >>> label_of("metrics_geometry_image_texel_area_mm2"), label_of("seconds_fit"), label_of("cohort_id")
    ('geometry image texel area', 'time of fit', 'cohort id')
    """
    if column in _NAMES:
        return _NAMES[column]
    if column.startswith("seconds_"):
        return f"time of {column.removeprefix('seconds_').replace('_', ' ')}"
    words = column.removeprefix("metrics_").split("_")
    if len(words) > 1 and words[-1] in _UNITS:
        words = words[:-1]
    return " ".join(words)


def value_text(column: str, value: Any) -> str:
    """Return a value of a column as text, without its unit."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return number_text(float(100 * value if is_share(column) and 0 <= value <= 1 else value))
    return str(value)


def angle_text(angle_deg: float, digits: int = 0) -> str:
    """Return an angle in degrees, with a minus sign and no negative zero.

    >>> angle_text(-32.12), angle_text(-0.2), angle_text(16.63, 1)
    ('−32°', '0°', '16.6°')
    """
    rounded = round(angle_deg, digits) + 0.0
    return f"{rounded:.{digits}f}°".replace("-", "−")


def seconds_text(seconds: float | None) -> str:
    """Return a duration.

    >>> [seconds_text(s) for s in (1e-5, 0.25, 37.67, 754.0, 12345.0)]
    ['0 s', '0.25 s', '37.7 s', '12 min 34 s', '3 h 25 min']
    """
    if seconds is None:
        return "–"
    if seconds < 0.005:
        return "0 s"
    if seconds < 120:
        return f"{number_text(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def size_text(count: int) -> str:
    """Return a size in bytes.

    >>> [size_text(n) for n in (900, 251749, 13390747)]
    ['900 B', '252 kB', '13.4 MB']
    """
    for limit, unit in ((1e3, "B"), (1e6, "kB"), (1e9, "MB")):
        if count < limit:
            return f"{number_text(count / (limit / 1e3))} {unit}"
    return f"{number_text(count / 1e9)} GB"
