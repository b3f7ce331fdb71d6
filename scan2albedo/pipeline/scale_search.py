"""The scale of a scan whose unit nobody gave, from the size of the face in it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import NoFaceError, RegistrationError, UnitError
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.io.load_scan import load_scan_with
from scan2albedo.io.parsed_mesh import ParsedMesh
from scan2albedo.io.units import largest_extent, millimetres_per_unit
from scan2albedo.pipeline.result import SURE
from scan2albedo.registration import Registration
from scan2albedo.registration.register import HUMAN_SCALE

_EXTENTS_MM = (300.0, 200.0, 440.0, 140.0)
"""Lengths that a scan is tried at: of a head, of less of it, of one with shoulders, of a bare face. The sizes
of faces between two of them are found by the registration."""
_SURE = 0.9
"""Least confidence in a face whose size is not given: at one of many sizes much resembles a face."""

Register = Callable[[RawScan], tuple[RawScan, Registration]]
"""Returns the pose of a scan's face, and the scan, turned if need be."""


@dataclass(frozen=True)
class ScaledScan:
    """A scan, and whether its size `fits` a head with what a unit of its file was taken for."""

    scan: RawScan
    fits: bool


def load_of_any_size(file: Path, name: str | None, textures: str | Path | None) -> ScaledScan:
    """Load a scan as `load_scan` does; one of no head's size in any unit becomes as long as a head."""
    fits: list[bool] = []

    def decide(mesh: ParsedMesh, components: NDArray[np.int64]) -> tuple[float, str]:
        try:
            factor, note = millimetres_per_unit(mesh.vertices, components, "auto", file.name)
        except UnitError:
            extent = largest_extent(mesh.vertices, components)
            if not 0 < extent < np.inf:
                raise
            factor, note = _EXTENTS_MM[0] / extent, f"unit: none fits (largest extent {extent:.4g} units)"
            fits.append(False)
        else:
            fits.append(True)
        return factor, note

    scan = load_scan_with(file, decide, name=name, textures=textures)
    return ScaledScan(scan, fits[-1])


def registered_at_any_scale(scaled: ScaledScan, register: Register) -> tuple[RawScan, Registration]:
    """Return the scan, at the scale at which it holds a face, and the face's pose.

    It is taken as it is where its size fits and it holds a face of a person's size. Where that is in doubt it
    is tried at the sizes of heads, and brought to the scale at which a face beyond doubt has the model's.
    Raises RegistrationError, that of the scan as it is if its size fits, where there is no face.
    """
    refusal = NoFaceError(
        f"{scaled.scan.name}: no face found beyond doubt at any scale; give the unit with unit='mm', 'cm' or "
        "'m'"
    )
    known, held_back = None, list[warnings.WarningMessage]()
    if scaled.fits:
        try:
            with warnings.catch_warnings(record=True) as held_back:
                warnings.simplefilter("always")
                known = register(scaled.scan)
        except NoFaceError as error:
            refusal = error
    low, high = HUMAN_SCALE
    if known is None or known[1].confidence < SURE or not low <= known[1].face_scale <= high:
        larger = _as_large_as_heads(scaled, register)
        if larger is not None:
            return register(larger)
    if known is None:
        raise refusal
    for warning in held_back:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return known


def _as_large_as_heads(scaled: ScaledScan, register: Register) -> RawScan | None:
    """Return the scan at the scale of a face that it holds beyond doubt, with a note, or None."""
    scan = scaled.scan
    extent = largest_extent(scan.vertices, vertex_components(len(scan.vertices), scan.faces))
    for tried_mm in _EXTENTS_MM:
        tried = scan.scaled(tried_mm / extent)
        with warnings.catch_warnings(), suppress(RegistrationError):
            warnings.simplefilter("ignore")
            _, found = register(tried)
            if found.confidence >= _SURE:
                factor = tried_mm / extent / found.face_scale
                note = (
                    f"unit: 1 unit is {scan.mm_per_unit * factor:.4g} mm (largest extent "
                    f"{extent * factor:.4g} mm), by the size of the face, as if it were an average one; give "
                    "the unit if you know it"
                )
                others = (n for n in scan.notes if not n.startswith("unit: "))
                return replace(scan.scaled(factor), notes=(note, *others))
    return None
