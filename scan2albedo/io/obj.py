"""Wavefront OBJ files: faces share vertices, texture coordinates belong to corners."""

import codecs
import re
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import Float32Array, FloatArray, IntArray, Texts, all_finite
from scan2albedo.errors import ScanError
from scan2albedo.io import limits, parsed_mesh
from scan2albedo.io.atomic import write_text
from scan2albedo.io.color import linear_of_srgb_numbers
from scan2albedo.io.parsed_mesh import GREY, Material, ParsedMesh, ScanFolder, ScanPictures, decoded
from scan2albedo.io.text_tables import number_table, plain_numbers

_RUN = re.compile(rb"([^ \n]*)[^\n]*\n(?:\1 [^\n]*\n)*")
"""Lines that follow each other and begin with the same word."""


class ObjLines:
    """The lines of an OBJ file by their first words."""

    def __init__(self, data: bytes, name: str) -> None:
        data = _plain_text(data)
        limits.require_at_most(name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
        self.name = name
        # For each word, the first line's number and the text of each run of lines that begin with it.
        self._runs: dict[bytes, list[tuple[int, bytes]]] = {}
        line = 0
        for run in _RUN.finditer(data):
            self._runs.setdefault(run[1], []).append((line, run[0]))
            line += run[0].count(b"\n")

    def numbers_of(self, word: bytes) -> IntArray:
        """Return the numbers, from 0, of the lines that begin with a word."""
        places = [np.arange(text.count(b"\n")) + line for line, text in self._runs.get(word, [])]
        return np.concatenate([np.zeros(0, int), *places])

    def text_of(self, word: bytes) -> bytes:
        """Return what follows the word in all its lines, each with its line feed."""
        whole = b"\n" + b"".join(text for _, text in self._runs.get(word, []))
        return whole.replace(b"\n" + word + b" ", b"\n")[1:]

    def names(self, word: bytes) -> list[str]:
        """Return what follows the word in all its lines, which is a name."""
        text = self.text_of(word)
        limits.require_at_most(
            self.name, "lines of names", text.count(b"\n"), limits.VALUES, "export it again"
        )
        lines = text.split(b"\n")[:-1]
        too_long = np.flatnonzero([len(line) > limits.NAME_BYTES for line in lines])
        self.raise_for(word, too_long, f"expected a name of at most {limits.NAME_BYTES} bytes")
        return [decoded(line).strip() for line in lines]

    def numbers(self, word: bytes, width: int, least: int, most: int) -> tuple[FloatArray, IntArray]:
        """Return (values (N, width), NaN where a line ends before; how many numbers each line has)."""
        text = self.text_of(word)
        limits.require_at_most(self.name, "vertices", text.count(b"\n"), most, "decimate it")
        table = number_table(plain_numbers(text))
        short = np.append(np.flatnonzero(table.counts < least), np.arange(table.bad, table.bad + 1))
        self.raise_for(word, short[short >= 0], f"expected at least {least} number{'s' * (least > 1)}")
        return table.columns(width), table.counts

    def corners(self) -> tuple[IntArray, IntArray]:
        """Return the corners (C, 2), written v, v/vt, v//vn or v/vt/vn, and how many each face has (F,).

        Their indices v and vt are as written, from 1 or negative from the end; 0 is not given.
        """
        text = plain_numbers(b" " + self.text_of(b"f").replace(b"\n", b"\n "))
        for empty, instead in ((b"//", b"/0/"), (b"/ ", b"/0 "), (b"/\n", b"/0\n"), (b" /", b" ?")):
            text = text.replace(empty, instead)
        table = number_table(text.replace(b"/", b" "), int)
        letters = np.frombuffer(b" " + text, np.uint8)
        begins = letters[table.places] != ord("/")
        start = np.flatnonzero(begins)
        parts = np.diff(np.append(start, len(begins)))
        corners = np.zeros((len(start), 2), int)
        corners[:, 0] = table.values[start]
        corners[parts > 1, 1] = table.values[start[parts > 1] + 1]
        counts = np.diff(np.searchsorted(start, np.append(table.first, len(begins))))
        wrong = np.repeat(np.arange(len(counts)), counts)[(corners[:, 0] == 0) | (parts > 3)]
        self.raise_for(
            b"f",
            np.append(wrong, table.bad)[: len(wrong) + (table.bad >= 0)],
            "expected corners like 1, 1/2 or 1/2/3",
        )
        return corners, counts

    def raise_for(self, word: bytes, lines: IntArray, expected: str) -> None:
        """Raise a `ScanError` for the first of the given lines of a word, if there is any."""
        if len(lines):
            beginning = decoded(self.text_of(word).split(b"\n")[lines[0]][:50]).strip()[:40]
            said = f"{self.name}: line {self.numbers_of(word)[lines[0]] + 1} holds '{beginning}', {expected}"
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
    corners, counts = lines.corners()
    lines.raise_for(b"f", np.flatnonzero(counts < 3), "expected at least 3 corners")
    triangles, face_of_triangle = parsed_mesh.fan_triangles(counts, lines.name)
    face_of_corner = np.repeat(np.arange(len(counts)), counts)
    kinds = ((b"v", len(positions), "vertices"), (b"vt", len(coordinates), "texture coordinates"))
    for column, (word, total, name) in enumerate(kinds):
        written = corners[:, column]
        if (from_end := written < 0).any():
            before = np.searchsorted(lines.numbers_of(word), lines.numbers_of(b"f"))[face_of_corner]
            written = np.where(from_end, before + written + 1, written)
            lines.raise_for(b"f", face_of_corner[(written < 1) & from_end], "index before 1")
        lines.raise_for(b"f", face_of_corner[written > total], f"but there are {total} {name}")
        corners[:, column] = written - 1
    uv = None
    if len(coordinates) and (corners[:, 1] >= 0).any():
        corner = corners[triangles, 1]
        uv = np.where((corner >= 0)[..., None], coordinates[corner], np.nan)
    pictures = ScanPictures(folder)
    material, own, notes = _materials(lines, pictures)
    materials, notes = pictures.or_named_like(path, uv, own, notes)
    colors, lost = _vertex_colors(lines, positions, tokens)
    notes += lost
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
    """Return a file's text in UTF-8 without a mark of its order.

    Line feeds alone end lines, the last one too; none goes on in the next or begins with blanks, which are
    spaces.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16", "replace").encode("utf-8", "replace")
    data = data.removeprefix(codecs.BOM_UTF8)
    plain = ((b"\r\n", b"\n"), (b"\r", b"\n"), (b"\t", b" "), (b"\v", b" "), (b"\f", b" "), (b"\\\n", b"  "))
    for special, instead in plain:
        if special[:1] in data:
            data = data.replace(special, instead)
    data = data.lstrip(b" ") + b"\n"
    return re.sub(rb"\n +", b"\n", data) if b"\n " in data else data


def files_of_obj(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the material libraries and textures of an OBJ file."""
    names: list[str] = []
    materials: dict[str, Material] = {}
    text = _plain_text(limits.read_bytes(path))
    for match in re.findall(rb"mtllib +([^\n]+)", text):  # in comments, too: more than is read
        for library in folder.library_names(decoded(match).strip()):
            names.append(library)
            if (file := folder.find(library)) is not None:
                materials |= parsed_mesh.parse_mtl(decoded(limits.read_bytes(file, limits.LIBRARY_BYTES)))
    textures = [m.texture_file for m in materials.values() if m.texture_file is not None]
    return names + folder.or_named_like(path, textures)


def write_obj(path: str | Path, vertices: FloatArray, faces: IntArray) -> None:
    """Write the vertices (V, 3) and faces (F, 3) of a mesh, atomically; raises `OutputError`."""
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}\n" for x, y, z in np.asarray(vertices).tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (np.asarray(faces) + 1).tolist()]
    write_text(path, "".join(lines))


def _vertex_colors(
    lines: ObjLines, positions: FloatArray, counts: IntArray
) -> tuple[Float32Array | None, Texts]:
    """Return linear colours (V, 3 or 4) by numbers (V, 7) of vertices, of which each has `counts` (V,)."""
    # They are the last of six numbers, or of seven with a weight; what is below 0 is a normal's.
    coloured = counts >= 6
    srgb = np.where((counts > 6)[:, None], positions[:, 4:7], positions[:, 3:6])
    if coloured.any() and all_finite(srgb[coloured]) and srgb[coloured].min() >= 0:
        linear = linear_of_srgb_numbers(np.where(coloured[:, None], srgb, 0))
        return np.column_stack([linear, coloured]), ()
    painted = "".join(lines.names(b"#MRGB"))  # of ZBrush: mask, red, green, blue of each vertex
    if not painted:
        return None, ()
    try:
        mask_and_srgb = np.frombuffer(bytes.fromhex(painted), np.uint8).reshape(len(positions), 4)
    except ValueError:
        return None, ("its #MRGB colours are not those of its vertices: went on without them",)
    return linear_of_srgb_numbers(mask_and_srgb[:, 1:]), ()


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
    names, faces = lines.names(b"usemtl"), lines.numbers_of(b"f")
    current = np.searchsorted(lines.numbers_of(b"usemtl"), faces) - 1
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
