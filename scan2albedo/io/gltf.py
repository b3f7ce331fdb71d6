"""GLB and glTF files, read through trimesh; skinned meshes as their joints hold them."""

from __future__ import annotations

import base64
import io
import json
import logging
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import ScanError
from scan2albedo.io.color import decode_srgb_integers
from scan2albedo.io.glb import glb_bytes
from scan2albedo.io.parsed_mesh import Material, ParsedMesh
from scan2albedo.io.repair import require_valid_indices

if TYPE_CHECKING:
    import trimesh


_JSON_START = 20
"""Of a GLB's text: behind the file's header and the first chunk's."""
_MARK = "_"
"""Before the names of attributes that trimesh would drop; it keeps those of an application's own."""
PARSER_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
"""What trimesh's parser was seen to raise, or may raise, on damaged files."""


def read_gltf(path: Path) -> ParsedMesh:
    """Read a GLB or glTF file: scene transforms applied, all meshes joined, base colours as materials.

    Skinned meshes come as their joints hold them in the file, without animation.

    Base colour textures are sRGB; base colour factors and vertex colours are linear (glTF 2.0, 3.7.2 and
    3.9.2). Raises ScanError when the file is damaged; the message names it.
    """
    try:
        return _read_parts(path)
    except PARSER_ERRORS as error:
        kind, cause = path.suffix[1:].upper(), " ".join(f"{type(error).__name__}: {error}".split())
        raise ScanError(
            f"{path.name}: cannot be read as {kind} ({cause}); "
            "the file is damaged, truncated or refers to a missing file: export it again"
        ) from error


def _read_parts(path: Path) -> ParsedMesh:
    import trimesh

    file = _GltfFile.read(path)
    skinned = bool(file.tree.get("skins"))
    scene = _load_scene(path, file.with_marked_skins() if skinned else None)
    # trimesh drops base colour textures that it cannot read without a word.
    textured = {
        declared.get("name", "material")
        for declared in file.tree.get("materials", [])
        if "baseColorTexture" in declared.get("pbrMetallicRoughness", {})
    }
    materials: dict[int, Material] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh):
            part = _part(mesh, materials, path.name)
            by_joints = _skinning_transforms(file, scene, node, mesh) if skinned else None
            parts.append(_placed(part, np.asarray(transform, np.float64) if by_joints is None else by_joints))
    lost = [m.name for m in materials.values() if m.texture_linear is None and m.name in textured]
    notes = (
        f"the texture of {name} is missing, damaged or of an unknown kind: went on without it"
        for name in lost
    )
    return _joined(parts, tuple(materials.values()), tuple(dict.fromkeys(notes)))


def _load_scene(path: Path, data: bytes | None) -> trimesh.Scene:
    """Load a file, or `data` in its place, through trimesh; its warnings become errors.

    It only warns of a compression that it cannot decode, and goes on with zeros.
    """
    import trimesh

    warned = _Warnings()
    logging.getLogger("trimesh").addHandler(warned)
    try:
        if data is None:
            scene = trimesh.load_scene(path, process=False)
        else:
            resolver = trimesh.resolvers.FilePathResolver(str(path))
            scene = trimesh.load_scene(
                io.BytesIO(data), file_type=path.suffix[1:].lower(), resolver=resolver, process=False
            )
    finally:
        logging.getLogger("trimesh").removeHandler(warned)
    if warned.messages:
        raise ScanError(f"{path.name}: {warned.messages[0]}; export it again without compression")
    return scene


class _Warnings(logging.Handler):
    """Collects trimesh's warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


def _part(mesh: trimesh.Trimesh, materials: dict[int, Material], name: str) -> ParsedMesh:
    """Return one mesh with the index of its material, which is added to `materials` when it is new."""
    visual: Any = mesh.visual
    source = getattr(visual, "material", None)
    if id(source) not in materials:
        materials[id(source)] = _material(source)
    faces = np.asarray(mesh.faces, np.int64)
    # Joined with other meshes, a wrong index would point at a vertex of the next one.
    require_valid_indices(faces, len(mesh.vertices), name)
    uv = getattr(visual, "uv", None)
    colors = visual.vertex_colors if visual.kind == "vertex" else visual.vertex_attributes.get("color")
    return ParsedMesh(
        vertices=np.asarray(mesh.vertices, np.float64),
        faces=faces,
        uv=None if uv is None or len(uv) != len(mesh.vertices) else np.asarray(uv, np.float64)[faces],
        material=np.full(len(faces), list(materials).index(id(source))),
        vertex_color_linear=None if colors is None else _scaled(np.asarray(colors)),
    )


def _material(material: Any) -> Material:
    factor = getattr(material, "baseColorFactor", None)
    color = np.ones(3, np.float32) if factor is None else _scaled(np.asarray(factor)[None])[0]
    base = (float(color[0]), float(color[1]), float(color[2]))
    image = getattr(material, "baseColorTexture", None)
    name = str(getattr(material, "name", None) or "material")
    if image is None:
        return Material(name, None, base)
    try:
        pixels = np.asarray(image.convert("RGB"), np.uint8)
    except (OSError, SyntaxError, ValueError):
        return Material(name, None, base)
    texture = decode_srgb_integers(pixels)
    return Material(name, texture if (color == 1).all() else texture * color, base)


def _scaled(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return (N, 3) in [0, 1] from integers of the full range or floats, without decoding."""
    top = np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0
    return (colors[:, :3] / top).astype(np.float32)


def _placed(part: ParsedMesh, transform: FloatArray) -> ParsedMesh:
    """Apply a transform, (4, 4) or one a vertex (V, 4, 4); mirrored faces are turned to face out again."""
    linear, shift = transform[..., :3, :3], transform[..., :3, 3]
    flipped = np.median(np.linalg.det(linear)) < 0
    order = slice(None, None, -1) if flipped else slice(None)
    return ParsedMesh(
        vertices=(linear @ part.vertices[:, :, None])[:, :, 0] + shift,
        faces=part.faces[:, order],
        uv=None if part.uv is None else part.uv[:, order],
        material=part.material,
        vertex_color_linear=part.vertex_color_linear,
    )


def _joined(parts: list[ParsedMesh], materials: tuple[Material, ...], notes: tuple[str, ...]) -> ParsedMesh:
    """Concatenate parts; those without coordinates get NaN, without vertex colours their base colour."""
    if not parts:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), notes=notes)
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    uvs = [np.full((len(p.faces), 3, 2), np.nan) if p.uv is None else p.uv for p in parts]
    material = [p.material for p in parts if p.material is not None]
    return ParsedMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=False)]),
        uv=np.concatenate(uvs) if any(p.uv is not None for p in parts) else None,
        material=np.concatenate(material),
        materials=materials,
        vertex_color_linear=_joined_colors(parts, materials),
        notes=notes,
    )


def _joined_colors(parts: list[ParsedMesh], materials: tuple[Material, ...]) -> NDArray[np.float32] | None:
    if all(p.vertex_color_linear is None for p in parts):
        return None
    colors = []
    for part in parts:
        base = Material("").base_color_linear
        if part.material is not None and len(part.material):
            base = materials[part.material[0]].base_color_linear
        plain = np.tile(np.array(base, np.float32), (len(part.vertices), 1))
        colors.append(plain if part.vertex_color_linear is None else part.vertex_color_linear)
    return np.concatenate(colors)


@dataclass(frozen=True)
class _GltfFile:
    """The JSON `tree` of a file, and the bytes `rest` that follow it in a GLB."""

    path: Path
    tree: dict[str, Any]
    rest: bytes
    binary: bool

    @classmethod
    def read(cls, path: Path) -> _GltfFile:
        """Read a GLB or glTF file."""
        data = path.read_bytes()
        if data[:4] != b"glTF":
            return cls(path, json.loads(data.decode("utf-8", "replace")), b"", False)
        end = _JSON_START + int.from_bytes(data[12:16], "little")
        return cls(path, json.loads(data[_JSON_START:end].decode("utf-8", "replace")), data[end:], True)

    def with_marked_skins(self) -> bytes:
        """Return the file's bytes with nodes named by number and skin attributes marked for trimesh."""
        tree = json.loads(json.dumps(self.tree))
        for number, node in enumerate(tree.get("nodes", [])):
            node["name"] = str(number)
        for mesh in tree.get("meshes", []):
            for primitive in mesh["primitives"]:
                primitive["attributes"] = {
                    _MARK + name if name.startswith(("JOINTS_", "WEIGHTS_")) else name: accessor
                    for name, accessor in primitive["attributes"].items()
                }
        return glb_bytes(tree, self.rest) if self.binary else json.dumps(tree).encode()

    def inverse_binds(self, skin: int) -> FloatArray:
        """Return (J, 4, 4) inverse bind matrices of a skin; identities where it has none."""
        entry = self.tree["skins"][skin]
        count = len(entry["joints"])
        if "inverseBindMatrices" not in entry:
            return np.tile(np.eye(4), (count, 1, 1))
        accessor = self.tree["accessors"][entry["inverseBindMatrices"]]
        if accessor["componentType"] != 5126 or accessor["type"] != "MAT4" or "bufferView" not in accessor:
            raise ValueError("inverse bind matrices are not stored as plain 4x4 floats")
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stored = np.frombuffer(self._buffer(view["buffer"]), "<f4", 16 * count, start)
        return stored.reshape(count, 4, 4).transpose(0, 2, 1).astype(np.float64)

    def _buffer(self, number: int) -> bytes:
        uri = self.tree["buffers"][number].get("uri")
        if uri is None:
            return self.rest[8:]  # behind the second chunk's header
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
        return (self.path.parent / unquote_to_bytes(uri).decode()).read_bytes()


def _skinning_transforms(
    file: _GltfFile, scene: trimesh.Scene, frame: str, mesh: trimesh.Trimesh
) -> FloatArray | None:
    """Return the transforms (V, 4, 4) of a mesh's vertices by their joints; None for a mesh without a skin.

    v' = sum over k of w_k J_k B_k v, and the transform of the mesh's own node `frame` is ignored (glTF 2.0,
    3.7.3.2 and 3.7.3.3). The scene is that of `with_marked_skins`.
    """
    attributes = {name: np.asarray(values) for name, values in mesh.vertex_attributes.items()}
    skin = file.tree["nodes"][int(frame.partition("_")[0])].get("skin")
    sets = sum(name.startswith(f"{_MARK}JOINTS_") for name in attributes)
    if skin is None or sets == 0:
        return None
    joints = np.concatenate([attributes[f"{_MARK}JOINTS_{n}"] for n in range(sets)], 1).astype(np.int64)
    weights = np.concatenate([attributes[f"{_MARK}WEIGHTS_{n}"] for n in range(sets)], 1).astype(np.float64)
    total = weights.sum(1, keepdims=True)
    if not (total > 0).all():
        raise ValueError("a vertex of a skinned mesh has no weights")
    places = np.array([scene.graph[str(joint)][0] for joint in file.tree["skins"][skin]["joints"]])
    transforms = places @ file.inverse_binds(skin)
    return np.einsum("vj,vjab->vab", weights / total, transforms[joints])
