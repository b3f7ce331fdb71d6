"""Wavefront OBJ files: faces share vertices, texture coordinates belong to corners."""

import codecs
import re
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, Texts, all_finite
from scan2albedo.errors import ScanError
from scan2albedo.io import limits, parsed_mesh, text_tables as tables
from scan2albedo.io.atomic import write_text
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.parsed_mesh import GREY, Material, ParsedMesh, ScanFolder, ScanPictures, decoded


class ObjLines:
    """The lines of an OBJ file by their first words, with the byte ranges of what follows these."""

    def __init__(self, data: bytes, name: str) -> None:
        data = _plain_text(data)
        limits.require_at_most(name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
        self.name, self.text = name, np.frombuffer(data, np.uint8)
        begins, self.ends = tables.line_ranges(self.text)
        self.words, self.starts = tables.split_keywords(self.text, begins, self.ends)

    def of_kind(self, word: bytes) -> IntArray:
        """Return indices of the lines that begin with a word."""
        return np.flatnonzero(self.words == int.from_bytes(word, "big"))

    def names(self, word: bytes) -> list[str]:
        """Return what follows the word in all its lines, which is a name."""
        lines = self.of_kind(word)
        limits.require_at_most(self.name, "lines of names", len(lines), limits.VALUES, "export it again")
        self.raise_for(
            lines[self.ends[lines] - self.starts[lines] > limits.NAME_BYTES],
            f"expected a name of at most {limits.NAME_BYTES} bytes",
        )
        ranges = zip(self.starts[lines], self.ends[lines], strict=True)
        return [decoded(self.text[start:end].tobytes()).strip() for start, end in ranges]

    def numbers(self, word: bytes, width: int, least: int, most: int) -> tuple[FloatArray, IntArray]:
        """Return (values (N, width), NaN where a line ends before; numbers of each line, at most `width`)."""
        lines = self.of_kind(word)
        limits.require_at_most(self.name, "vertices", len(lines), most, "decimate it")
        starts, ends = self.starts[lines], self.ends[lines]
        counts = tables.count_tokens(self.text, starts, ends)
        table = tables.NumberLines(self.text, starts, ends, counts).table(most=width)
        wrong = counts < least
        wrong[table.bad : table.bad + 1 if table.bad >= 0 else 0] = True
        self.raise_for(lines[wrong], f"expected at least {least} number{'s' * (least > 1)}")
        values = np.full((len(lines), width), np.nan)
        if len(lines) and (table.counts == (same := table.counts[0])).all():  # much faster than by a mask
            values[:, :same] = table.values.reshape(-1, same)
        else:
            values[np.arange(width) < table.counts[:, None]] = table.values
        return values, table.counts

    def raise_for(self, lines: IntArray, expected: str) -> None:
        """Raise a `ScanError` for the first of the given lines, if there is any."""
        if len(lines):
            start, end = int(self.starts[lines[0]]), int(self.ends[lines[0]])
            beginning = decoded(self.text[start : min(end, start + 50)].tobytes()).strip()[:40]
            said = f"{self.name}: line {lines[0] + 1} holds '{beginning}', {expected}"
            raise ScanError(f"{said}; the file is damaged or truncated: export it again")


def read_obj(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read an OBJ file with its materials.

    Polygons are cut into fans, negative indices count from the end, vertex colours (three numbers after the
    position, or ZBrush's `#MRGB`) are sRGB. Of materials `Kd` and the pictures of `parse_mtl` are used; where
    the library, or every texture that it names, is missing, an image of the scan's own name is taken for the
    texture. Raises ScanError, naming file and line, when a line is damaged or an index points outside the
    file; TooLargeError for more than is read.
    """
    lines = ObjLines(limits.read_bytes(path, advice="decimate it"), path.name)
    positions, tokens = lines.numbers(b"v", 7, least=3, most=limits.VERTICES)
    coordinates, _ = lines.numbers(b"vt", 2, least=1, most=limits.TEXT_LINES)
    # Corners as written, then as indices from 0 of vertex and coordinates, -1 for none.
    rows = lines.of_kind(b"f")
    starts, ends = lines.starts[rows], lines.ends[rows]
    counts = tables.count_tokens(lines.text, starts, ends)
    lines.raise_for(rows[counts < 3], "expected at least 3 corners")
    triangles, face_of_triangle = parsed_mesh.fan_triangles(counts, lines.name)
    corners, bad = tables.parse_corners(lines.text, starts, counts)
    lines.raise_for(rows[bad : bad + 1] if bad >= 0 else rows[:0], "expected corners like 1, 1/2 or 1/2/3")
    line_of_corner = np.repeat(rows, counts)
    kinds = ((b"v", len(positions), "vertices"), (b"vt", len(coordinates), "texture coordinates"))
    for column, (word, total, name) in enumerate(kinds):
        written = corners[:, column]
        if (written < 0).any():
            before = np.repeat(np.searchsorted(lines.of_kind(word), rows), counts)
            written = np.where(written < 0, before + written + 1, written)
            lines.raise_for(line_of_corner[(written < 1) & (corners[:, column] < 0)], "index before 1")
        lines.raise_for(line_of_corner[written > total], f"but there are {total} {name}")
        corners[:, column] = written - 1
    uv = None
    if len(coordinates) and (corners[:, 1] >= 0).any():
        corner = corners[triangles, 1]
        uv = np.where((corner >= 0)[..., None], coordinates[corner], np.nan)
    pictures = ScanPictures(folder)
    material, own, notes = _materials(lines, pictures)
    materials, notes = pictures.with_stem_fallback(path, uv, own, notes)
    # Colours are the last of six numbers, or of seven with a weight; what is below 0 is a normal's.
    coloured, colors = tokens >= 6, None
    srgb = np.where((tokens > 6)[:, None], positions[:, 4:7], positions[:, 3:6])
    if coloured.any() and all_finite(srgb[coloured]) and srgb[coloured].min() >= 0:
        colors = np.column_stack([linear_of_srgb_numbers(np.where(coloured[:, None], srgb, 0)), coloured])
    elif painted := "".join(lines.names(b"#MRGB")):  # of ZBrush: mask, red, green, blue of each vertex
        try:
            mask_and_srgb = np.frombuffer(bytes.fromhex(painted), np.uint8).reshape(len(positions), 4)
            colors = linear_of_srgb_numbers(mask_and_srgb[:, 1:])
        except ValueError:
            notes += ("its #MRGB colours are not those of its vertices: went on without them",)
    material = None if material is None or materials is not own else material[face_of_triangle]
    placements = np.array([m.uv_placement for m in materials])
    if uv is not None and material is not None and (placements != Material.uv_placement).any():
        placed = placements[material, None]
        with np.errstate(all="ignore"):  # what is beyond all numbers counts as no coordinates
            uv = uv * placed[..., :2] + placed[..., 2:]
    return ParsedMesh(
        vertices=np.ascontiguousarray(positions[:, :3]),
        faces=corners[triangles, 0],
        uv=uv,
        material=material,
        materials=materials,
        vertex_color_linear=colors,
        notes=parsed_mesh.cut_note(counts) + notes,
    )


def _plain_text(data: bytes) -> bytes:
    """Return a file's text in UTF-8 without a mark of its order; line feeds alone end lines, none goes on."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16", "replace").encode("utf-8", "replace")
    data = data.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data.replace(b"\\\n", b"  ")


def files_of_obj(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the material libraries and textures of an OBJ file."""
    names: list[str] = []
    materials: dict[str, Material] = {}
    text = _plain_text(limits.read_bytes(path))
    for match in re.findall(rb"mtllib[ \t\v\f]+([^\n]+)", text):  # in comments, too: more than is read
        for library in folder.library_names(decoded(match).strip()):
            names.append(library)
            if (file := folder.find(library)) is not None:
                materials |= parsed_mesh.parse_mtl(decoded(limits.read_bytes(file, limits.LIBRARY_BYTES)))
    textures = [m.texture_file for m in materials.values() if m.texture_file is not None]
    return names + folder.with_stem_fallback(path, textures)


def write_obj(path: str | Path, vertices: FloatArray, faces: IntArray) -> None:
    """Write the vertices (V, 3) and faces (F, 3) of a mesh, atomically; raises `OutputError`."""
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in np.asarray(vertices).tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (np.asarray(faces) + 1).tolist()]
    write_text(path, "".join(lines))


def _materials(
    lines: ObjLines, pictures: ScanPictures
) -> tuple[IntArray | None, tuple[Material, ...], Texts]:
    """Return (material index of each polygon or None, materials used, notes)."""
    notes: list[str] = []
    # The materials of all libraries that the file names.
    known: dict[str, Material] = {}
    words = list(dict.fromkeys(lines.names(b"mtllib")))
    limits.require_at_most(lines.name, "material libraries", len(words), limits.MATERIALS, "join them")
    total = 0
    folder = pictures.folder
    for name in (name for line in words for name in folder.library_names(line)):
        file = folder.find(name)
        if file is None:
            notes.append(f"material library {name} {folder.why_missing(name)}: went on without textures")
            continue
        data = limits.read_bytes(file, limits.LIBRARY_BYTES, "export the scan again")
        total += len(data)
        place = f"the material libraries of {lines.name}"
        limits.require_at_most(place, "bytes", total, limits.LIBRARY_BYTES, "export the scan again")
        known |= parsed_mesh.parse_mtl(decoded(data))
    if not known:
        return None, (), tuple(notes)
    names, faces = lines.names(b"usemtl"), lines.of_kind(b"f")
    current = np.searchsorted(lines.of_kind(b"usemtl"), faces) - 1
    if not names:
        names, current = [next(iter(known))], np.zeros(len(faces), int)
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    if len(order) == len(known) == 1 and known.keys() != order.keys():
        (renamed,), (only,) = order, known
        notes.append(f"material {renamed} is not in the material library: took its only one, {only}")
        known[renamed] = known[only]
    limits.require_at_most(lines.name, "materials", len(order), limits.MATERIALS, "join its materials")
    number = np.array([order[name] for name in names], int)
    index = np.where(current < 0, -1, number[np.maximum(current, 0)])
    lost = (name for name in order if name not in known)
    notes += [f"material {name} is not in the material library: went on without it" for name in lost]
    materials, lacking = pictures.materials(known.get(name, Material(name, None, GREY)) for name in order)
    return index, materials, tuple(dict.fromkeys((*notes, *lacking)))
