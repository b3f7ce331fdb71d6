"""The part of Wavefront MTL files that carries colour."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ScanError, TooLargeError
from scan2albedo.io import limits
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.image_headers import require_small_picture
from scan2albedo.io.images import SUPPORTED_IMAGES, read_image_linear
from scan2albedo.io.parsed_mesh import Material
from scan2albedo.io.scan_folder import ScanFolder

_OPTION = re.compile(
    r"-(?:(?:blendu|blendv|cc|clamp|texres|bm|boost|imfchan|type)\s+\S+"
    r"|mm\s+\S+\s+\S+|[ost](?:\s+[-+]?[\d.]+(?:[eE][-+]?\d+)?){1,3})\s+"
)


@dataclass(frozen=True)
class MaterialText:
    """Name, diffuse colour (sRGB as written) and texture file name of one `newmtl` block."""

    name: str
    diffuse_srgb: tuple[float, float, float] = (0.5, 0.5, 0.5)
    texture_file: str | None = None


def decoded(data: bytes) -> str:
    """Return text of an OBJ or MTL file; bytes that are no UTF-8 are kept as surrogates."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    return data.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")


def parse_mtl(text: str) -> dict[str, MaterialText]:
    """Return the materials of an MTL text by name; `map_Kd` options are skipped, spaces in names kept.

    >>> parse_mtl("newmtl skin\\nKd 1 0 0\\nmap_Kd -s 1 1 1 -clamp on my face.png")["skin"].texture_file
    'my face.png'
    """
    materials: dict[str, MaterialText] = {}
    name = None
    for raw in text.splitlines():
        if len(raw) > limits.NAME_BYTES:
            continue
        keyword, _, rest = raw.strip().partition(" ") if "\t" not in raw else raw.strip().partition("\t")
        keyword, rest = keyword.lower(), rest.strip()
        if keyword == "newmtl":
            name = rest
            materials[name] = MaterialText(name)
        elif name is not None and keyword == "kd":
            materials[name] = MaterialText(name, _color(rest), materials[name].texture_file)
        elif name is not None and keyword == "map_kd" and rest:
            materials[name] = MaterialText(name, materials[name].diffuse_srgb, _file_name(rest))
    return materials


def _color(text: str) -> tuple[float, float, float]:
    try:
        values = [min(max(float(token), 0.0), 1.0) for token in text.split()[:3]]
    except ValueError:
        return MaterialText.diffuse_srgb
    if len(values) == 1:
        values *= 3
    return (values[0], values[1], values[2]) if len(values) == 3 else MaterialText.diffuse_srgb


def _file_name(text: str) -> str:
    while match := _OPTION.match(text):
        text = text[match.end() :]
    return text.strip().strip('"')


@dataclass
class ScanPictures:
    """The pictures beside a scan: each is read once, and together they have at most `limits.PIXELS`."""

    folder: ScanFolder
    pixels: int = 0
    read: dict[Path, NDArray[np.float32] | ScanError] = field(default_factory=dict)

    def material(self, text: MaterialText) -> tuple[Material, str | None]:
        """Return a material with its texture read, and a note when the texture is missing or damaged.

        Raises TooLargeError when the picture, or all pictures together, have too many pixels.
        """
        red, green, blue = (float(c) for c in srgb_to_linear(text.diffuse_srgb))
        plain = Material(text.name, None, (red, green, blue))
        if text.texture_file is None:
            return plain, None
        file = self.folder.find(text.texture_file)
        if file is None:
            missing = self.folder.why_missing(text.texture_file)
            return plain, f"texture {text.texture_file} {missing}: went on without it"
        file = file.resolve()
        if file not in self.read:
            try:
                size = require_small_picture(limits.read_bytes(file), file)
                self._count(0 if size is None else size.pixels)
                self.read[file] = pixels = read_image_linear(file)
                if size is None:
                    self._count(pixels.shape[0] * pixels.shape[1])
            except TooLargeError:
                raise
            except OSError as error:
                self.read[file] = ScanError(f"image {file.name} cannot be read: {error.strerror or error}")
            except ScanError as error:
                self.read[file] = error
        picture = self.read[file]
        if isinstance(picture, ScanError):
            return plain, f"{picture}: went on without it"
        return Material(plain.name, picture, plain.base_color_linear), None

    def named_like(self, scan: Path) -> Material | None:
        """Return a material with the image that has the scan's own name, if there is one."""
        for extension in SUPPORTED_IMAGES:
            file = self.folder.find(scan.stem + extension)
            if file is not None:
                material, _ = self.material(MaterialText(file.name, texture_file=file.name))
                return material if material.texture_linear is not None else None
        return None

    def _count(self, pixels: int) -> None:
        self.pixels += pixels
        advice = "save its textures with fewer pixels"
        place = f"the textures of the scan in {self.folder.path}"
        limits.require_at_most(place, "pixels", self.pixels, limits.PIXELS, advice)
