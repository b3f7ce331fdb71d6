"""`load_scan`: any supported scan file as a checked `RawScan` in mm and linear colour."""

import os
from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from scan2albedo.core import RawScan
from scan2albedo.core.arguments import linear_doubt, require_type
from scan2albedo.core.arrays import IntArray
from scan2albedo.core.landmarks import AUTO, PlacedLandmarks, landmarks_option
from scan2albedo.core.raw_scan import scan_name
from scan2albedo.errors import ScanError, memory_errors_of, one_line
from scan2albedo.io import limits
from scan2albedo.io.parsed_mesh import ParsedMesh, ScanFolder

Reader = Callable[[Path, ScanFolder], ParsedMesh]
READERS: dict[str, Reader | str] = {
    ".obj": "scan2albedo.io.obj:read_obj",
    ".ply": "scan2albedo.io.ply:read_ply",
    ".glb": "scan2albedo.io.gltf:read_gltf",
    ".gltf": "scan2albedo.io.gltf:read_gltf",
    ".stl": "scan2albedo.io.ply:read_stl",
    ".off": "scan2albedo.io.ply:read_off",
}
"""By extension in lower case: functions, or places of functions that are imported when such a file is read.

What is added here is read by every function and command.
"""
REFERENCES = {
    ".obj": "scan2albedo.io.obj:files_of_obj",
    ".ply": "scan2albedo.io.ply:files_of_ply",
    ".glb": "scan2albedo.io.gltf:files_of_gltf",
    ".gltf": "scan2albedo.io.gltf:files_of_gltf",
}
"""Places of functions that return the names of files to which a scan refers: its reader finds no others."""
SUPPORTED_SCANS = READERS.keys()


def load_scan(
    path: str | Path,
    unit: str = "auto",
    *,
    name: str | None = None,
    textures: str | Path | None = None,
    landmarks: Any = None,
) -> RawScan:
    """Return a scan from a file: harmless damage repaired, in millimetres and linear colour.

    Its `notes` name the unit, every repair, missing textures and the number of loose components.

    Raises ScanError when the file is missing, of an unsupported kind, damaged, without faces, of a size that
    is not a head in any unit, or so far from the origin that rounding destroys its shape; TooLargeError when
    it declares or holds more than `io/limits.py` allows; MissingDependencyError when it is compressed and the
    library that decodes it is missing. The message names the file, what is wrong and what to do. Raises
    ValueError for an unknown unit.

    Parameters
    ----------
    path : str or Path
        An OBJ (with MTL and textures beside it), PLY, GLB, glTF, STL or OFF file; extensions in any case.
    unit : {"auto", "mm", "cm", "m"}
        What one unit of the file is; "auto" decides from the size of a head.
    name : str, optional
        Name of the scan in messages and output folders; the file's stem when omitted.
    textures : path, optional
        Folder from which materials and textures may be read beside the scan's own; files elsewhere are not,
        whatever the scan names and wherever links lead.
    landmarks : path, mapping or (68, 3) array_like, optional
        Points that someone placed on the scan, any of the 68, in its file's frame and unit: a file
        (`read_landmarks`), a folder that may hold one named after the scan, ``{number: (x, y, z)}``, or an
        array with NaN.
    """
    from scan2albedo.io.units import millimetres_per_unit

    def decide(mesh: ParsedMesh, components: IntArray) -> tuple[float, str]:
        return millimetres_per_unit(mesh.vertices, components, unit, Path(path).name)

    scan = load_scan_with(path, decide, name=name, textures=textures)
    return scan if landmarks is None else with_landmarks(scan, landmarks, path)


def with_landmarks(scan: RawScan, landmarks: Any, path: str | Path | None = None) -> RawScan:
    """Return a scan, of the file `path`, with landmarks as `load_scan` takes them; may raise ScanError."""
    from scan2albedo.io.landmark_files import landmarks_file, read_landmarks

    if not isinstance(landmarks, str | Path):
        placed = PlacedLandmarks.of(landmarks, scan.mm_per_unit)
    elif landmarks_option(landmarks) == AUTO:
        raise ScanError(f"landmarks is {landmarks!r}, an option of `process`: here, give a file or points")
    elif (file := landmarks_file(landmarks, path)) is not None:
        placed = read_landmarks(file, scan.mm_per_unit)
    else:
        return replace(scan, notes=(*scan.notes, f"no landmarks of this scan in the folder {landmarks}"))
    return replace(scan, landmarks=placed, notes=(*scan.notes, f"{int(placed.placed.sum())} landmarks given"))


def load_scan_with(
    path: str | Path,
    decide_unit: Callable[[ParsedMesh, IntArray], tuple[float, str]],
    *,
    name: str | None = None,
    textures: str | Path | None = None,
) -> RawScan:
    """Load a scan as `load_scan` does, of something whose size is not a head's.

    `decide_unit` maps repaired mesh and component labels (V,) to (factor to millimetres, note).
    """
    require_type(path, (str, PathLike), "load_scan: path", "give the path of a scan's file")
    file = Path(path)
    with memory_errors_of(file.name):
        parsed = read_mesh_file(file, None if textures is None else Path(textures))
        from scan2albedo.geometry.mesh import vertex_components
        from scan2albedo.io.repair import repair, require_usable
        from scan2albedo.io.texture_atlas import pack_texture, seen_colors
        from scan2albedo.io.units import largest_extent, rounding_note

        require_usable(parsed, file.name)
        mesh = repair(parsed)
        if len(mesh.faces) == 0:
            raise ScanError(f"{file.name}: every face has zero area; it holds no surface: export it again")
        components = vertex_components(len(mesh.vertices), mesh.faces)
        factor, unit_note = decide_unit(mesh, components)
        rounding = rounding_note(mesh.vertices, largest_extent(mesh.vertices, components), factor, file.name)
        packed = pack_texture(mesh)
        notes = [unit_note, rounding, *mesh.notes, *packed.notes]
        if (count := int(components.max()) + 1) > 1:
            notes.append(f"{count} loose components, all kept")
        texture, vertex_color, seen = packed.texture_linear, mesh.vertex_color_linear, None
        if vertex_color is not None:
            vertex_color, seen = seen_colors(vertex_color, mesh.faces)
        if texture is not None:
            texture, seen = seen_colors(texture, mesh.faces, packed.uv)
        if seen is not None and not seen.any():
            notes.append("its colours are alike everywhere, or transparent: they say nothing, geometry only")
        colors = {"texture": texture, "vertex colours": vertex_color}
        notes += [linear_doubt(what, values) for what, values in colors.items() if values is not None]
        if texture is None and vertex_color is None:
            notes.append("no texture or vertex colours: geometry only")
        return RawScan(
            vertices=mesh.vertices * factor,
            faces=mesh.faces,
            uv=packed.uv,
            texture_linear=texture,
            vertex_color_linear=vertex_color,
            color_seen=seen,
            name=name or scan_name(file),
            notes=tuple(note for note in notes if note),
            mm_per_unit=factor,
            texture_tiles=packed.tiles,
        )


def read_mesh_file(file: Path, textures: Path | None = None) -> ParsedMesh:
    """Return the mesh of a file as it is, with materials from its folder and `textures` (`ScanFolder`).

    Raises ScanError when the file is missing, of an unsupported kind or damaged.
    """
    if os.path.isdir(file):  # false, where Path.is_dir raises, for names that are too long
        raise ScanError(f"{file}: is a folder; name the scan file in it, or run `scan2albedo batch {file}`")
    extension = file.suffix.lower()
    if extension not in SUPPORTED_SCANS:
        if file.is_file():
            limits.require_own_kind(file)
        said = f"{file.name}: {extension or 'a name without extension'} is not supported"
        raise ScanError(f"{said}; save the scan as one of {', '.join(SUPPORTED_SCANS)}")
    try:
        if limits.require_file(file, advice="decimate it") == 0:
            raise ScanError(f"{file.name}: the file is empty (0 bytes); export the scan again")
        with memory_errors_of(file.name):
            folder = ScanFolder(file.parent, textures, frozenset(files_of_scan(file, textures)))
            reader = READERS[extension]
            mesh: ParsedMesh = (resolve_name(reader) if isinstance(reader, str) else reader)(file, folder)
    except (OSError, ValueError) as error:
        raise ScanError(f"{file}: cannot be read: {one_line(error)}; check the path") from error
    return mesh


def files_of_scan(path: Path, textures: str | Path | None = None) -> tuple[Path, ...]:
    """Return the scan file and the existing files it refers to: material libraries, textures, buffers.

    Its reader reads no others, see `ScanFolder`, and its hash is that of all of them. Raises TooLargeError.
    """
    folder = ScanFolder(path.parent, None if textures is None else Path(textures))
    names: list[str] = []
    extension = path.suffix.lower()
    if extension in REFERENCES and path.is_file():  # a pipe or a device may never end
        names = resolve_name(REFERENCES[extension])(path, folder)
    found = map(folder.find, names)
    return (path, *dict.fromkeys(file for file in found if file is not None))
