"""`ParsedMesh`, what a reader hands to `load_scan`, its materials (MTL, pictures), and polygons cut up.

`ScanFolder` says which files a scan may refer to, and how they are found: one rule for MTL, PLY and glTF.
"""

import codecs
import os
import re
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import Float32Array, FloatArray, IntArray, Texts
from scan2albedo.errors import ScanError, TooLargeError
from scan2albedo.io import limits
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.images import SUPPORTED_IMAGES, picture_pixels, read_image_linear

_CODE_PAGES = ("cp1252", "cp932", "gbk", "cp949", "cp1251", "cp437")
"""Of file names in OBJ and MTL files that are no UTF-8; the file that exists decides which it is."""


@dataclass(frozen=True)
class ScanFolder:
    """The files that a scan may refer to: those in its folder and, where given, in the folder `textures`.

    Links that lead elsewhere lead to none of these files. With `only`, what `load_scan.files_of_scan` names,
    there are no others: a reader reads no file that the scan's hash leaves out. Raises ScanError when
    `textures` is not a folder.
    """

    path: Path
    textures: Path | None = None
    only: frozenset[Path] | None = None

    def __post_init__(self) -> None:
        if self.textures is not None and not os.path.isdir(self.textures):
            raise ScanError(f"{self.textures}: is not a folder; give the folder that holds the textures")

    def find(self, name: str) -> Path | None:
        """Return a file by its path or name, in any case, code page and Unicode form, or None."""
        spellings = [name]
        if any("\udc80" <= letter <= "\udcff" for letter in name):  # not UTF-8
            data = name.encode("utf-8", "surrogateescape")
            spellings += [data.decode(page, "replace") for page in _CODE_PAGES]
        for spelling in spellings:
            relative = Path(spelling.replace("\\", "/"))
            wanted = _folded(relative.name)
            try:
                for home in filter(None, (self.path, self.textures)):
                    folders = dict.fromkeys((home / relative.parent, home))
                    places = [place for place in folders if self._allows(place)]
                    candidates = (place / relative.name for place in places)
                    others = (file for place in places if place.is_dir() for file in sorted(place.iterdir()))
                    for file in chain(candidates, (file for file in others if _folded(file.name) == wanted)):
                        known = self.only is None or file in self.only
                        if known and file.is_file() and self._allows(file):
                            return file
            except (OSError, ValueError):  # a name that no file may have, a folder that may not be read
                continue
        return None

    def library_names(self, words: str) -> list[str]:
        """Return the files of a `mtllib` line: one name with spaces if there is such a file, else several."""
        return [words] if not words or self.find(words) else words.split()

    def with_stem_fallback(self, scan: Path, textures: list[str]) -> list[str]:
        """Return names of textures, where one is missing also those that an image of the scan may have."""
        lost = not textures or any(self.find(name) is None for name in textures)
        return textures + ([scan.stem + extension for extension in SUPPORTED_IMAGES] if lost else [])

    def why_missing(self, name: str) -> str:
        """Return why `find` returns None, as the end of a sentence."""
        if os.path.isfile(self.path / name.replace("\\", "/")):
            return "lies outside the scan's folder, and only --textures (in Python: textures) allows another"
        return "is missing beside the scan (--textures names another folder to look in)"

    def _allows(self, path: Path) -> bool:
        homes = (self.path, self.textures)
        real = path.resolve()
        return any(home is not None and real.is_relative_to(home.resolve()) for home in homes)


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


GREY = (float(srgb_to_linear(0.5)),) * 3
"""Base colour of materials of which OBJ, MTL and PLY files say none."""


@dataclass(frozen=True)
class Material:
    """One surface material; its base colour shows where it has no texture (H, W, 3), or none was found.

    A texture (H, W, 4) has alpha, which is 0 where no picture showed the surface. `uv_placement` is
    the scale (2) and the offset (2) with which coordinates look it up. `texture_file` is the picture that an
    MTL or PLY file names, in which `ScanPictures` finds the texture.
    """

    name: str
    texture_linear: Float32Array | None = None
    base_color_linear: tuple[float, float, float] = (0.5, 0.5, 0.5)
    uv_placement: tuple[float, ...] = (1, 1, 0, 0)
    texture_file: str | None = None


@dataclass(frozen=True)
class ParsedMesh:
    """Geometry and appearance as they stand in a file, in file units.

    `vertices` (V, 3); `faces` (F, 3), not yet checked against them; `uv` (F, 3, 2), NaN at corners without
    texture coordinates, v = 0 the bottom row; `material` (F,) indices into `materials`, -1 for none, all 0
    when omitted and there are materials; `vertex_color_linear` (V, 3), or with alpha (V, 4).
    """

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None = None
    material: IntArray | None = None
    materials: tuple[Material, ...] = ()
    vertex_color_linear: Float32Array | None = None
    notes: Texts = ()


def fan_triangles(counts: IntArray, name: str) -> tuple[IntArray, IntArray]:
    """Cut polygons of `counts` (P,) >= 3 corners, stored one after the other, into fans at their first ones.

    Returns the triangles (T, 3) as indices into the stored corners, and the polygon (T,) of each. Raises
    TooLargeError, which names the file, when they are too many.

    >>> fan_triangles(np.array([3, 4]), "scan.obj")[0].tolist()
    [[0, 1, 2], [3, 4, 5], [3, 5, 6]]
    """
    limits.require_at_most(name, "triangles", int((counts - 2).sum()), limits.TRIANGLES, "decimate it")
    first = np.cumsum(counts) - counts
    if (counts == 3).all():
        return first[:, None] + np.arange(3), np.arange(len(counts))
    triangles = counts - 2
    polygon = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first[polygon]
    return np.stack([start, start + step + 1, start + step + 2], axis=1), polygon


def strip_triangles(items: IntArray) -> IntArray:
    """Return the triangles (T, 3) of strips of corners, each ended by a number below 0; half are turned.

    >>> strip_triangles(np.array([0, 1, 2, 3, -1, 4, 5, 6])).tolist()
    [[0, 1, 2], [2, 1, 3], [4, 5, 6]]
    """
    items = np.append(items, -1)
    place = np.arange(len(items))
    odd = (place - np.maximum.accumulate(np.where(items < 0, place, -1))) % 2 == 0
    rows = np.stack([np.roll(items, -k) for k in range(3)], axis=1)
    rows[odd] = rows[odd][:, [1, 0, 2]]
    return rows[(rows >= 0).all(axis=1)]


def cut_note(counts: IntArray) -> Texts:
    """Return a note on how many polygons were cut, if any."""
    cut = int((counts > 3).sum())
    return (f"polygons cut into triangles: {cut}",) if cut else ()


def damaged(path: Path, what: str) -> ScanError:
    """Return the error for a file that is not a whole one of the kind that its name ends with."""
    kind = path.suffix[1:].upper()
    return ScanError(f"{path.name}: {what}; the file is damaged, truncated or no {kind}: export it again")


_OPTION = re.compile(
    r"-(?:(?:blendu|blendv|cc|clamp|texres|bm|boost|imfchan|type)\s+\S+"
    r"|mm\s+\S+\s+\S+|([ost])((?:\s+[-+]?[\d.]+(?:[eE][-+]?\d+)?){1,3}))\s+"
)


def decoded(data: bytes) -> str:
    """Return text of an OBJ or MTL file; bytes that are no UTF-8 are kept as surrogates."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    return data.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")


def parse_mtl(text: str) -> dict[str, Material]:
    """Return the materials of an MTL text by name, with spaces in names; `ScanPictures` reads their textures.

    Of the options of a picture `-s` and `-o` are read, others skipped. Shadeless exports have the picture in
    `map_Ka` or `map_Ke`; it is taken where `map_Kd` is missing.

    >>> parse_mtl("newmtl skin\\nKd 1 0 0\\nmap_Kd -s 1 1 1 -clamp on my face.png")["skin"].texture_file
    'my face.png'
    """
    materials: dict[str, Material] = {}
    name = None
    for raw in text.splitlines():
        if len(raw) > limits.NAME_BYTES:
            continue
        keyword, rest = [*raw.split(maxsplit=1), "", ""][:2]
        keyword, rest = keyword.lower(), rest.strip()
        if keyword == "newmtl":
            name = rest
            materials[name] = Material(name, base_color_linear=GREY)
        elif name is not None and keyword == "kd":
            with suppress(ValueError, ZeroDivisionError):
                values = [float(token) for token in rest.split()[:3]]
                red, green, blue = srgb_to_linear(np.clip(values * (3 // len(values)), 0, 1)).tolist()
                materials[name] = replace(materials[name], base_color_linear=(red, green, blue))
        elif name is not None and rest and keyword in ("map_kd", "map_ka", "map_ke"):
            if keyword != "map_kd" and materials[name].texture_file is not None:
                continue
            placement = list(Material.uv_placement)
            while match := _OPTION.match(rest):
                rest = rest[match.end() :]
                with suppress(ValueError):
                    if (start := {"s": 0, "o": 2}.get(match[1])) is not None:
                        values = [float(token) for token in match[2].split()[:2]]
                        placement[start : start + len(values)] = values
            file = rest.strip().strip('"')
            materials[name] = replace(materials[name], texture_file=file, uv_placement=tuple(placement))
    return materials


@dataclass
class ScanPictures:
    """The pictures beside a scan: each is read once, and together they have at most `limits.PIXELS`."""

    folder: ScanFolder
    pixels: int = 0
    read: dict[Path, Float32Array | str] = field(default_factory=dict)

    def materials(self, untextured: Iterable[Material]) -> tuple[tuple[Material, ...], Texts]:
        """Return materials with textures, and notes on missing or damaged ones; may raise TooLargeError."""
        materials, notes = [], []
        for one in untextured:
            picture = None if one.texture_file is None else self._picture(one.texture_file)
            if isinstance(picture, str):
                notes.append(f"{picture}: went on without it")
                picture = None
            materials.append(replace(one, texture_linear=picture))
        return tuple(materials), tuple(notes)

    def _picture(self, name: str) -> Float32Array | str:
        file = self.folder.find(name)
        if file is None:
            return f"texture {name} {self.folder.why_missing(name)}"
        file = file.resolve()
        if file not in self.read:
            try:
                pixels = picture_pixels(limits.read_bytes(file), file)
                if pixels is None:  # as of EXR files, which are judged when they are read
                    self.read[file] = found = read_image_linear(file, alpha=True)
                    pixels = found.shape[0] * found.shape[1]
                self.pixels += pixels
                place = f"the textures of the scan in {self.folder.path}"
                advice = "save its textures with fewer pixels"
                limits.require_at_most(place, "pixels", self.pixels, limits.PIXELS, advice)
                if file not in self.read:
                    self.read[file] = read_image_linear(file, alpha=True)
            except TooLargeError:
                raise
            except OSError as error:
                self.read[file] = f"image {file.name} cannot be read: {error.strerror or error}"
            except ScanError as error:
                self.read[file] = str(error)
        return self.read[file]

    def with_stem_fallback(
        self, scan: Path, uv: FloatArray | None, materials: tuple[Material, ...], notes: Texts
    ) -> tuple[tuple[Material, ...], Texts]:
        """Return materials and notes; where all textures are missing, the image with the scan's own name."""
        lost = not materials or any(note.startswith("texture ") for note in notes)
        if uv is None or not lost or any(m.texture_linear is not None for m in materials):
            return materials, notes
        for name in self.folder.with_stem_fallback(scan, []):
            if (file := self.folder.find(name)) is not None:
                found, _ = self.materials([Material(file.name, None, GREY, texture_file=file.name)])
                if found[0].texture_linear is None:
                    break
                lacking = (note.partition(": went on without")[0] for note in notes)
                return found, (*lacking, f"texture {found[0].name} was found by the scan's name")
        return materials, notes
