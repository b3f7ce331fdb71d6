"""Millimetres, centimetres or metres: decided from the size of a head, or of a pair of glasses."""

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, finite_rows, norms
from scan2albedo.errors import ScanError, UnitError
from scan2albedo.geometry.mesh import far_vertices

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0}

PLAUSIBLE_EXTENT_MM = (80.0, 800.0)
"""From the inner face alone (about 100 mm) to a head with shoulders (about 550 mm): one decade, so that
at most one of mm and cm fits; metres are two decades off."""

PLAUSIBLE_GLASSES_MM = (50.0, 400.0)
"""Greatest distance between two key points, from a front without temples (about 100 mm for a child) or half
of one to whole goggles (about 250 mm); less than a decade again."""

_MOST_ROUNDED = 0.01
"""Rounding beyond this part of a scan's extent is an error, beyond a hundredth of it a note."""


def check_unit(unit: str) -> None:
    """Raise ValueError unless it is auto, mm, cm or m."""
    if unit != "auto" and unit not in MM_PER_UNIT:
        raise ValueError(f"unit is {unit!r}, expected 'auto', 'mm', 'cm' or 'm'")


def largest_extent(vertices: FloatArray, components: IntArray) -> float:
    """Return how long the scan is along its longest principal axis, in file units.

    `components` (V,) labels the loose components. Far vertices do not count, whatever they hang on, and of
    the others only the largest components that together hold at least half of them, without the outermost
    0.5 % of their vertices at either end: neither spikes nor stray patches change the unit.
    """
    near = ~far_vertices(vertices, np.ones(len(vertices), bool))
    sizes = np.bincount(components[near])
    order = np.argsort(-sizes, kind="stable")
    enough = int(np.searchsorted(np.cumsum(sizes[order]), near.sum() / 2)) + 1
    kept = vertices[near & np.isin(components, order[:enough])]
    centered = kept - kept.mean(axis=0)
    scale = np.abs(centered).max() or 1.0
    _, axes = np.linalg.eigh((centered / scale).T @ (centered / scale))
    low, high = np.percentile(centered @ axes, [0.5, 99.5], axis=0)
    return float((high - low).max())


def millimetres_per_unit(
    vertices: FloatArray, components: IntArray, unit: str, name: str
) -> tuple[float, str]:
    """Return (factor to millimetres, note on unit and size).

    Raises ScanError when `unit` is "auto" and no unit makes it a head; ValueError for an unknown unit.
    """
    return _decided(largest_extent(vertices, components), unit, name, "scan", "head", PLAUSIBLE_EXTENT_MM)


def rounding_note(vertices: FloatArray, extent: float, mm_per_unit: float, name: str) -> str:
    """Return a note on how single precision rounds a scan far from the origin, "" when it hardly does.

    Raises ScanError when positions are rounded to more than a hundredth of the scan's `extent` (file units).
    """
    if not (vertices == vertices.astype(np.float32)).all():
        return ""
    distance = float(np.median(np.abs(vertices).max(axis=1)))
    step = float(np.spacing(np.float32(distance)))
    if 100 * step <= _MOST_ROUNDED * extent:
        return ""
    note = (
        f"positions are rounded to {step * mm_per_unit:.2g} mm, since the file holds single precision at "
        f"{distance * mm_per_unit:.2g} mm from the origin: move the scan to the origin before it is exported"
    )
    if step > _MOST_ROUNDED * extent:
        raise ScanError(f"{name}: {note}")
    return note


def glasses_millimetres_per_unit(
    keypoints: FloatArray, unit: str, name: str, sizes_mm: tuple[float, float] = PLAUSIBLE_GLASSES_MM
) -> tuple[float, str]:
    """Return (factor to millimetres, note on unit and size) of a pair of glasses with key points (K, 3).

    Key points, NaN for missing ones, give the size: a screw may hold most of a mesh's vertices. ScanError
    for the size of no glasses in the unit given, or for "auto" in mm, cm or m; ValueError for another unit.
    """
    known = keypoints[finite_rows(keypoints)]
    extent = float(norms(known[:, None] - known).max(initial=0.0))
    low, high = sizes_mm
    if unit in MM_PER_UNIT and not low <= extent * MM_PER_UNIT[unit] < high:
        raise ScanError(
            f"{name}: the glasses are {extent:.4g} {unit} long, but glasses measure {low:.3g} to "
            f"{high:.3g} mm; correct the unit (that of the key-point file, or unit='mm', 'cm' or 'm', "
            "in the shell --unit); `scan2albedo glasses canonicalize` takes the front's --frame-width in mm, "
            "and admits other sizes with --widths"
        )
    return _decided(extent, unit, name, "glasses", "pair of glasses", sizes_mm)


def _decided(
    extent: float, unit: str, name: str, thing: str, kind: str, plausible_mm: tuple[float, float]
) -> tuple[float, str]:
    """Return the factor and the note of a `thing` of `extent` file units that should be a `kind`."""
    low, high = plausible_mm
    fitting = [u for u, factor in MM_PER_UNIT.items() if low <= extent * factor < high]
    if unit == "auto":
        more = " (--unit), or `glasses canonicalize` the front's --frame-width in mm or other --widths"
        verb, more = ("are", more) if thing == "glasses" else ("is", "")
        if len(fitting) != 1:
            which = f"not a {kind} in mm, cm or m (expected {low:.3g} to {high:.3g} mm)"
            which = f"a {kind} in {' or '.join(fitting)}" if fitting else which
            said = f"{name}: the {thing} {verb} {extent:.4g} units long, which is {which}"
            raise UnitError(f"{said}; say what a unit is with unit='mm', 'cm' or 'm'{more}")
        unit, how = fitting[0], "decided from the size"
    else:
        check_unit(unit)
        doubt = "" if unit in fitting else f", though a {kind} measures {low:g} to {high:g} mm"
        how = f"as given{doubt}"
    factor = MM_PER_UNIT[unit]
    return factor, f"unit: {unit} (largest extent {extent * factor:.4g} mm), {how}"
