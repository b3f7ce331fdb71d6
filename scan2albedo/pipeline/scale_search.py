"""The pose of a scan that may be inside out, and whose unit nobody may have given."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.core.arrays import IntArray
from scan2albedo.errors import InsideOutError, NoFaceError, RegistrationError, UnitError
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.io.load_scan import load_scan_with
from scan2albedo.io.parsed_mesh import ParsedMesh
from scan2albedo.io.units import largest_extent, millimetres_per_unit
from scan2albedo.pipeline.result import SURE
from scan2albedo.registration import Registration

_EXTENTS_MM = (300, 200, 440, 140)
"""Lengths that a scan is tried at: of a head, of less of it, of one with shoulders, of a bare face. The sizes
of faces between two of them are found by the registration."""
_HUMAN_SCALE = (0.75, 1.3)
"""Sizes of people's faces, children's too, relative to the model's."""
_SURE = 0.9
"""Least confidence in a face whose size is not given: at one of many sizes much resembles a face."""

Register = Callable[[RawScan], tuple[RawScan, Registration]]
"""Returns the pose of a scan's face, and the scan, turned if need be."""


def load_of_any_size(file: Path, name: str | None, textures: str | Path | None) -> tuple[RawScan, bool]:
    """Load a scan, as long as a head where no unit makes it one; return whether its size fits, too."""
    fits = True

    def decide(mesh: ParsedMesh, components: IntArray) -> tuple[float, str]:
        nonlocal fits
        try:
            return millimetres_per_unit(mesh.vertices, components, "auto", file.name)
        except UnitError:
            extent = largest_extent(mesh.vertices, components)
            if not 0 < extent < np.inf:
                raise
            fits = False
            return _EXTENTS_MM[0] / extent, f"unit: none fits (largest extent {extent:.4g} units)"

    return load_scan_with(file, decide, name=name, textures=textures), fits


def registered_outward(
    scan: RawScan, register: Callable[[RawScan], Registration]
) -> tuple[RawScan, Registration]:
    """Return the scan, its triangles reversed where they face inward, and the pose of its face."""
    try:
        return scan, register(scan)
    except InsideOutError:
        note = (
            f"the scan was inside out: its {len(scan.faces)} triangles were reversed. If the export was "
            "mirrored, left and right of the face are swapped: then mirror the scan and process it again"
        )
        turned = replace(scan.inside_out(), notes=(*scan.notes, note))
        return turned, register(turned)


def registered_at_any_scale(
    scan: RawScan, fits: bool, register: Register, draft: Register | None = None
) -> tuple[RawScan, Registration]:
    """Return the scan, at the scale at which it holds a face, and the face's pose.

    It is taken as it is where its size `fits` and it holds a face of a person's size. Where that is in doubt
    it is tried at the sizes of other heads, with the cheaper search `draft` if given, and brought to the
    scale at which a sure face has the model's size. Raises RegistrationError, that of the scan as it is if
    its size fits, where there is no face; its note lists the sizes tried.
    """
    refusal = NoFaceError(f"{scan.name}: no face beyond doubt at any scale; give unit='mm', 'cm' or 'm'")
    known = None
    if fits:
        try:
            known = register(scan)
        except NoFaceError as error:
            refusal = error
    low, high = _HUMAN_SCALE
    if known is not None and known[1].confidence >= SURE and low <= known[1].face_scale <= high:
        return known
    extent = largest_extent(scan.vertices, vertex_components(len(scan.vertices), scan.faces))
    nearest_mm = min(_EXTENTS_MM, key=lambda mm: abs(np.log(mm / extent)))
    sizes_mm = list(_EXTENTS_MM)
    if fits and known is None and low < nearest_mm / extent < high:
        sizes_mm.remove(nearest_mm)  # a face of that size was looked for in the scan as it is
    for tried_mm in sizes_mm:
        with suppress(RegistrationError):
            _, found = (draft or register)(scan.scaled(tried_mm / extent))
            if found.confidence >= _SURE:
                factor = tried_mm / extent / found.face_scale
                note = (
                    f"unit: 1 unit is {scan.mm_per_unit * factor:.4g} mm (largest extent "
                    f"{extent * factor:.4g} mm), by the size of the face, as if it were an average one; give "
                    "the unit if you know it"
                )
                others = (n for n in scan.notes if not n.startswith("unit: "))
                break
    else:
        if known is None:
            refusal.add_note(f"no sure face where it is {sizes_mm} mm long, either")
            raise refusal
        return known
    return register(replace(scan.scaled(factor), notes=(note, *others)))
