"""The part of Wavefront MTL files that carries colour."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from scan2albedo.errors import ScanError
from scan2albedo.io.color import srgb_to_linear
from scan2albedo.io.images import SUPPORTED_IMAGES, read_image_linear
from scan2albedo.io.parsed_mesh import Material

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


def parse_mtl(text: str) -> dict[str, MaterialText]:
    """Return the materials of an MTL text by name; `map_Kd` options are skipped, spaces in names kept.

    >>> parse_mtl("newmtl skin\\nKd 1 0 0\\nmap_Kd -s 1 1 1 -clamp on my face.png")["skin"].texture_file
    'my face.png'
    """
    materials: dict[str, MaterialText] = {}
    name = None
    for raw in text.splitlines():
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


def find_beside(folder: Path, name: str) -> Path | None:
    """Find a file that a scan refers to, in any case, by its path as written or by its name beside the scan.

    MTL files often hold absolute or Windows paths of another machine, and names in another case.
    """
    relative = Path(name.replace("\\", "/"))
    for candidate in (folder / relative, folder / relative.name):
        if candidate.is_file():
            return candidate
    for place in {folder / relative.parent: None, folder: None}:
        if place.is_dir():
            wanted = relative.name.casefold()
            found = sorted(p for p in place.iterdir() if p.name.casefold() == wanted and p.is_file())
            if found:
                return found[0]
    return None


def library_names(words: str, folder: Path) -> list[str]:
    """Return the files of one `mtllib` line: one name with spaces when there is such a file, else several."""
    return [words] if not words or find_beside(folder, words) else words.split()


def texture_by_name(scan: Path) -> Material | None:
    """Return a material with the image that lies beside a scan under the scan's own name, if there is one."""
    for extension in SUPPORTED_IMAGES:
        file = find_beside(scan.parent, scan.stem + extension)
        if file is not None:
            material, _ = load_material(MaterialText(file.name, texture_file=file.name), scan.parent)
            return material if material.texture_linear is not None else None
    return None


def load_material(material: MaterialText, folder: Path) -> tuple[Material, str | None]:
    """Return a material with its texture read, and a note when the texture is missing or damaged."""
    red, green, blue = (float(c) for c in srgb_to_linear(material.diffuse_srgb))
    plain = Material(material.name, None, (red, green, blue))
    if material.texture_file is None:
        return plain, None
    file = find_beside(folder, material.texture_file)
    if file is None:
        return plain, f"texture {material.texture_file} is missing beside the scan: went on without it"
    try:
        return Material(material.name, read_image_linear(file), plain.base_color_linear), None
    except ScanError as error:
        return plain, f"{error}: went on without it"
