"""PLY, glTF, STL and OFF files, read through trimesh."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ScanError
from scan2albedo.io.color import decode_srgb_integers, srgb_to_linear
from scan2albedo.io.mtl import MaterialText, load_material
from scan2albedo.io.parsed_mesh import Material, ParsedMesh

if TYPE_CHECKING:
    import trimesh

_PARSER_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NameError,
    NotImplementedError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
"""What trimesh's parsers were seen to raise, or may raise, on damaged files."""


def read_ply(path: Path) -> ParsedMesh:
    """Read a PLY file: vertex colours (sRGB), or texture coordinates with the `TextureFile` of its header.

    Raises
    ------
    ScanError
        When the file is damaged; the message names it.
    """
    from trimesh.exchange.ply import load_ply

    with path.open("rb") as file:
        head = file.read(1 << 16).split(b"end_header", maxsplit=1)[0].decode("latin-1")
        file.seek(0)
        parsed = _guarded(path, lambda: load_ply(file))
    if "vertices" not in parsed:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    faces = _triangles(path, parsed.get("faces"))
    colors = parsed.get("vertex_colors")
    uv = getattr(parsed.get("visual"), "uv", None)
    material, note = _ply_texture(head, path.parent)
    return ParsedMesh(
        vertices=np.asarray(parsed["vertices"], np.float64),
        faces=faces,
        uv=None if uv is None else np.asarray(uv, np.float64)[faces],
        materials=(material,) if material is not None else (),
        vertex_color_linear=None if colors is None else _linear_colors(np.asarray(colors)),
        notes=(note,) if note else (),
    )


def _ply_texture(header: str, folder: Path) -> tuple[Material | None, str | None]:
    named = re.search(r"^comment\s+TextureFile\s+(.+?)\s*$", header, re.MULTILINE | re.IGNORECASE)
    if named is None:
        return None, None
    return load_material(MaterialText("texture", texture_file=named[1]), folder)


def read_gltf(path: Path) -> ParsedMesh:
    """Read a GLB or glTF file: scene transforms applied, all meshes joined, base colours as materials.

    Base colour textures are sRGB, base colour factors and vertex colours linear (glTF 2.0, 3.9.2).

    Raises
    ------
    ScanError
        When the file is damaged; the message names it.
    """
    import trimesh

    scene = _guarded(path, lambda: trimesh.load_scene(path, process=False))
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh):
            parts.append(_placed(_gltf_part(mesh), np.asarray(transform, np.float64)))
    return _joined(parts)


def _gltf_part(mesh: trimesh.Trimesh) -> ParsedMesh:
    visual: Any = mesh.visual
    faces = np.asarray(mesh.faces, np.int64)
    uv = getattr(visual, "uv", None)
    colors = visual.vertex_colors if visual.kind == "vertex" else None
    return ParsedMesh(
        vertices=np.asarray(mesh.vertices, np.float64),
        faces=faces,
        uv=None if uv is None or len(uv) != len(mesh.vertices) else np.asarray(uv, np.float64)[faces],
        materials=(_gltf_material(getattr(visual, "material", None)),),
        vertex_color_linear=None if colors is None else _scaled_colors(np.asarray(colors)),
    )


def _gltf_material(material: Any) -> Material:
    factor = getattr(material, "baseColorFactor", None)
    color = np.ones(3) if factor is None else _scaled_colors(np.asarray(factor)[None])[0].astype(float)
    base = (float(color[0]), float(color[1]), float(color[2]))
    image = getattr(material, "baseColorTexture", None)
    name = str(getattr(material, "name", None) or "material")
    if image is None:
        return Material(name, None, base)
    pixels = np.asarray(image.convert("RGB"), np.uint8)
    texture = decode_srgb_integers(pixels)
    return Material(name, texture if (color == 1).all() else texture * color.astype(np.float32), base)


def _placed(part: ParsedMesh, transform: NDArray[np.float64]) -> ParsedMesh:
    """Apply a scene transform; a mirroring one turns the faces over, so that they keep facing out."""
    flipped = np.linalg.det(transform[:3, :3]) < 0
    order = slice(None, None, -1) if flipped else slice(None)
    return ParsedMesh(
        vertices=part.vertices @ transform[:3, :3].T + transform[:3, 3],
        faces=part.faces[:, order],
        uv=None if part.uv is None else part.uv[:, order],
        materials=part.materials,
        vertex_color_linear=part.vertex_color_linear,
    )


def _joined(parts: list[ParsedMesh]) -> ParsedMesh:
    """Concatenate parts; the rest get NaN coordinates, or their base colour, where only some have them."""
    if not parts:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    blank_uv = [np.full((len(p.faces), 3, 2), np.nan) if p.uv is None else p.uv for p in parts]
    colors = [
        np.tile(np.array(p.materials[0].base_color_linear, np.float32), (len(p.vertices), 1))
        if p.vertex_color_linear is None
        else p.vertex_color_linear
        for p in parts
    ]
    return ParsedMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=False)]),
        uv=np.concatenate(blank_uv) if any(p.uv is not None for p in parts) else None,
        material=np.repeat(np.arange(len(parts)), [len(p.faces) for p in parts]),
        materials=tuple(p.materials[0] for p in parts),
        vertex_color_linear=np.concatenate(colors)
        if any(p.vertex_color_linear is not None for p in parts)
        else None,
    )


def read_stl(path: Path) -> ParsedMesh:
    """Read an ASCII or binary STL file.

    Raises
    ------
    ScanError
        When the file is damaged; the message names it.
    """
    import trimesh

    parsed = _guarded(path, lambda: trimesh.load_mesh(path, file_type="stl", process=False))
    return ParsedMesh(np.asarray(parsed.vertices, np.float64), np.asarray(parsed.faces, np.int64))


def read_off(path: Path) -> ParsedMesh:
    """Read an ASCII OFF file.

    Raises
    ------
    ScanError
        When the file is damaged or shorter than its header says; the message names it.
    """
    from trimesh.exchange.off import load_off

    with path.open("rb") as file:
        parsed = _guarded(path, lambda: load_off(file))
    return ParsedMesh(np.asarray(parsed["vertices"], np.float64), _triangles(path, parsed["faces"]))


def _guarded(path: Path, read: Any) -> Any:
    """Run a third-party parser; whatever it trips over becomes one `ScanError` that names the file."""
    try:
        return read()
    except _PARSER_ERRORS as error:
        kind = path.suffix[1:].upper()
        raise ScanError(
            f"{path.name}: cannot be read as {kind} ({type(error).__name__}: {error}); "
            "the file is damaged, truncated or of another format: export it again"
        ) from error


def _triangles(path: Path, faces: Any) -> NDArray[np.int64]:
    from trimesh.geometry import triangulate_quads

    if faces is None or len(faces) == 0:
        return np.zeros((0, 3), np.int64)
    return np.asarray(_guarded(path, lambda: triangulate_quads(faces)), np.int64)


def _linear_colors(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return (V, 3) linear from sRGB integers, or floats in [0, 1]."""
    if colors.dtype in (np.uint8, np.uint16):
        return decode_srgb_integers(colors[:, :3])
    return srgb_to_linear(colors[:, :3]).astype(np.float32)


def _scaled_colors(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return (N, 3) in [0, 1] from integers of the full range or floats, without decoding."""
    top = np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0
    return (colors[:, :3] / top).astype(np.float32)
