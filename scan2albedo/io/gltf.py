"""GLB and glTF files as bytes and JSON, read through trimesh; skinned meshes as their joints hold them."""

from __future__ import annotations

import base64
import io
import json
import logging
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import require_valid_indices
from scan2albedo.errors import MissingDependencyError, ScanError, one_line
from scan2albedo.io import limits
from scan2albedo.io.color import decode_picture
from scan2albedo.io.glb import glb_bytes
from scan2albedo.io.images import picture_pixels
from scan2albedo.io.parsed_mesh import Material, ParsedMesh, ScanFolder

if TYPE_CHECKING:
    import trimesh

MARK = "_"
"""Before the names of attributes that trimesh would drop; it keeps those of an application's own."""
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5124: "<i4", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DRACO, _OF_ARRAYS = "KHR_draco_mesh_compression", "bytes of arrays"
_NOT_DECODED = ("EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclass
class GltfFile:
    """A file: the JSON `tree` in it, and the bytes `rest` that follow that in a GLB."""

    path: Path
    folder: ScanFolder
    tree: dict[str, Any]
    rest: bytes = b""
    binary: bool = False
    bytes_referred: int = 0

    @classmethod
    def read(cls, path: Path, folder: ScanFolder) -> GltfFile:
        """Read a GLB or glTF file."""
        data = limits.read_bytes(path, advice="decimate it")
        start, end = 0, len(data)
        if binary := data[:4] == b"glTF":
            start = 20  # behind the headers of the file and of its first chunk
            end = start + int.from_bytes(data[12:16], "little")
        tree = limits.parse_json(path.name, data[start:end])
        for material in tree.get("materials", ()):
            base = material.setdefault("pbrMetallicRoughness", {})
            if "emissiveTexture" in material and "baseColorTexture" not in base:
                # Shadeless exports have the colour in the slot of what glows.
                base["baseColorTexture"] = material["emissiveTexture"]
                base["baseColorFactor"] = [*material.get("emissiveFactor", (0, 0, 0)), 1]
        return cls(path, folder, tree, data[end:], binary)

    def __getitem__(self, uri: str) -> bytes:
        """Return the content of a file that the scan may refer to; FileNotFoundError for any other."""
        name = unquote(uri)
        file = self.folder.find(name)
        if file is None:
            raise FileNotFoundError(f"{name} {self.folder.why_missing(name)}")
        content = limits.read_bytes(file)
        self.bytes_referred += len(content)
        place = f"what {self.path.name} refers to"
        limits.require_at_most(place, "bytes", self.bytes_referred, 4 * limits.FILE_BYTES, "decimate it")
        return content

    def require_readable(self) -> None:
        """Raise TooLargeError for a file that declares more than is read, ScanError for unknown compression.

        Arrays, pictures and the scene are judged before they are made. Raises MissingDependencyError when the
        library that decodes the file's compression is missing; LookupError, TypeError, ValueError for damage.
        """
        tree, name = self.tree, self.path.name
        used, required = tree.get("extensionsUsed", ()), tree.get("extensionsRequired", ())
        advice = "export it again without compression"
        for extension in _NOT_DECODED:
            if extension in required:
                said = f"{name}: is compressed with {extension}, which is not decoded here"
                raise ScanError(f"{said}; {advice} (gltfpack without -c)")
        if _DRACO in (*used, *required) and find_spec("DracoPy") is None:
            said = f"{name}: is compressed with Draco; install what reads it with"
            raise MissingDependencyError(f"{said}: pip install 'scan2albedo[draco]', or {advice}")
        for view in tree.get("bufferViews", ()):
            if view["buffer"] < 0 or view.get("byteStride", 4) < 4:
                raise ValueError(f"a view of buffer {view['buffer']}, of stride {view.get('byteStride', 4)}")
        total = 0
        for accessor in tree.get("accessors", ()):
            if accessor["count"] < 0:
                raise ValueError(f"an accessor has {accessor['count']} elements")
            dtype = np.dtype(_DTYPES[accessor["componentType"]])
            total += dtype.itemsize * _COMPONENTS[accessor["type"]] * accessor["count"]
        limits.require_at_most(name, _OF_ARRAYS, total, limits.FILE_BYTES, "decimate it")
        # Vertices, triangles and primitives of all meshes, in the file and as often as its scene shows them.
        meshes = []
        for mesh in tree.get("meshes", ()):
            vertices = triangles = 0
            for primitive in mesh["primitives"]:
                corners = count = tree["accessors"][primitive["attributes"]["POSITION"]]["count"]
                if "indices" in primitive:
                    corners = tree["accessors"][primitive["indices"]]["count"]
                vertices += count
                triangles += corners if primitive.get("mode") == 5 else corners // 3  # 5 is a strip
            meshes.append((vertices, triangles, len(mesh["primitives"])))
        most = {"vertices": limits.VERTICES, "triangles": limits.TRIANGLES, "primitives": limits.NODES}
        # Nodes of the scene, each as often as it is reached; a circle has too many.
        shown, nodes, scenes, reached = [], tree.get("nodes", []), tree.get("scenes"), 0
        left = list(range(len(nodes)) if scenes is None else scenes[tree.get("scene", 0)].get("nodes", []))
        advice = "export the scan alone, without its scene"
        limits.require_at_most(name, "nodes", len(nodes), limits.NODES, advice)
        while left:
            limits.require_at_most(name, "nodes in its scene", reached + len(left), limits.NODES, advice)
            node = nodes[left.pop()]
            reached += 1
            shown += [meshes[node["mesh"]]] if "mesh" in node else []
            left += node.get("children", ())
        for sizes in (meshes, shown):
            totals = [sum(column) for column in zip(*sizes, strict=True)] or [0, 0, 0]
            for (what, limit), count in zip(most.items(), totals, strict=True):
                limits.require_at_most(name, f"{what} of its meshes", count, limit, "decimate or join them")
        # Every picture by its header, and all base colours together.
        colors = set()
        for material in tree.get("materials", ()):
            texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}).get("index")
            entry = {} if texture is None else tree["textures"][texture]
            webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
            colors.add(webp.get("source", entry.get("source")))
        # Pictures of this extension are converted in floats of 64 bits, several at a time.
        copies, total = 8 if "KHR_materials_pbrSpecularGlossiness" in used else 1, 0
        for number, entry in enumerate(tree.get("images", ())):
            try:
                if "bufferView" in entry:
                    view = tree["bufferViews"][entry["bufferView"]]
                    start = view.get("byteOffset", 0)
                    data = self._buffer(view["buffer"])[start : start + view["byteLength"]]
                else:
                    data = self._content(entry["uri"])
            except (KeyError, OSError, ValueError):
                if "bufferView" in entry:
                    raise
                continue  # it is missing
            pixels = picture_pixels(data, f"{number} of {name}")
            if pixels is not None and (number in colors or copies > 1):
                total += copies * pixels
        what, advice = f"the textures of {name}", "save its textures with fewer pixels"
        limits.require_at_most(what, "pixels", total, limits.PIXELS, advice)

    def for_trimesh(self) -> bytes:
        """Return the file's bytes with what trimesh leaves out or misreads changed.

        Positions and coordinates, whole numbers or sparse, become floats, as the base colour's `texCoord` and
        KHR_texture_transform choose and move them. For skins nodes are numbered, attributes marked.
        """
        tree, made, size = json.loads(json.dumps(self.tree)), dict[str, int](), 0
        for primitive in (primitive for mesh in tree.get("meshes", ()) for primitive in mesh["primitives"]):
            attributes = dict(primitive["attributes"])
            material = tree["materials"][primitive["material"]] if "material" in primitive else {}
            picture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
            moved = picture.get("extensions", {}).get("KHR_texture_transform", {})
            chosen = f"TEXCOORD_{moved.get('texCoord', picture.get('texCoord', 0))}"
            changes: dict[str, Any] = {"POSITION": {}, chosen: moved}
            for source in changes.keys() & attributes.keys():
                number, change = attributes[source], changes[source]
                entry, key = self.tree["accessors"][number], json.dumps([number, change])
                whole = "bufferView" in entry and entry["componentType"] != 5126
                if key not in made and ("sparse" in entry or whole or change):
                    values = self._numbers(entry) * change.get("scale", 1)
                    cos, sin = np.cos(turn := change.get("rotation", 0)), np.sin(turn)
                    turned = values @ np.array([[cos, -sin], [sin, cos]]) if turn else values  # v points down
                    data = (turned + change.get("offset", 0)).astype("<f4").tobytes()
                    size += len(data)
                    limits.require_at_most(self.path.name, _OF_ARRAYS, size, limits.FILE_BYTES, "decimate it")
                    made[key] = len(tree["accessors"])
                    views, buffers = (tree.setdefault(name, []) for name in ("bufferViews", "buffers"))
                    plain = {"bufferView": len(views), "componentType": 5126, "count": len(values)}
                    tree["accessors"].append({**plain, "type": entry["type"]})
                    views.append({"buffer": len(buffers), "byteLength": len(data)})
                    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
                    buffers.append({"byteLength": len(data), "uri": uri})
                attributes["TEXCOORD_0" if source == chosen else source] = made.get(key, number)
            marked = ("JOINTS_", "WEIGHTS_") if tree.get("skins") else ()
            primitive["attributes"] = {MARK * n.startswith(marked) + n: k for n, k in attributes.items()}
        for number, node in enumerate(tree.get("nodes", []) if tree.get("skins") else ()):
            node["name"] = str(number)
        return glb_bytes(tree, self.rest) if self.binary else json.dumps(tree).encode()

    def _numbers(self, accessor: dict[str, Any]) -> FloatArray:
        """Return (count, components) of an accessor, whole numbers as parts of their range (glTF 3.6.2)."""
        if "bufferView" not in accessor and "sparse" not in accessor:
            raise ValueError("compressed coordinates are moved (KHR_texture_transform)")
        shape = accessor["count"], _COMPONENTS[accessor["type"]]
        stored = np.zeros(shape, _DTYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            stored[:] = self.array(accessor)
        if "sparse" in accessor:
            few = accessor["sparse"]
            at = self.array({"type": "SCALAR", "count": few["count"], **few["indices"]})[:, 0]
            stored[at] = self.array({**accessor, "byteOffset": 0, "count": few["count"], **few["values"]})
        quantized = "KHR_mesh_quantization" in self.tree.get("extensionsUsed", ())
        if stored.dtype.kind == "f" or not accessor.get("normalized", not quantized):
            return stored.astype(np.float64)
        return np.maximum(stored / np.iinfo(stored.dtype).max, -1)

    def array(self, accessor: dict[str, Any]) -> NDArray[Any]:
        """Return (count, components) what an accessor of a buffer view holds."""
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        steps = (view.get("byteStride", width * dtype.itemsize), dtype.itemsize)
        return np.ndarray((accessor["count"], width), dtype, self._buffer(view["buffer"]), start, steps)

    def _buffer(self, number: int) -> bytes:
        uri = self.tree["buffers"][number].get("uri")
        return self.rest[8:] if uri is None else self._content(uri)  # behind the second chunk's header

    def _content(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
        return self[uri]


def read_gltf(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read a GLB or glTF file: scene transforms applied, all meshes joined, base colours as materials.

    Skinned meshes come as their joints hold them, without animation. Base colour textures are sRGB, factors
    and vertex colours linear (glTF 2.0, 3.7.2 and 3.9.2). Raises ScanError when the file is damaged.
    """
    try:
        return _read_parts(GltfFile.read(path, folder))
    except limits.DAMAGE as error:
        kind, cause = path.suffix[1:].upper(), one_line(error)
        cause = f"there is no {cause}" if isinstance(error, KeyError) else cause
        said = f"{path.name}: cannot be read as {kind} ({cause})"
        advice = "the file is damaged, truncated or refers to a missing file: export it again"
        raise ScanError(f"{said}; {advice}") from error


def files_of_gltf(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the buffers and pictures of a glTF file."""
    try:
        tree = GltfFile.read(path, folder).tree
        uris = [entry.get("uri", "") for entry in (*tree.get("buffers", ()), *tree.get("images", ()))]
    except (ValueError, AttributeError, TypeError, RecursionError):
        return []  # load_scan says what is wrong with the file
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]


def _read_parts(file: GltfFile) -> ParsedMesh:
    import trimesh

    file.require_readable()
    # trimesh only warns of a compression that it cannot decode, and goes on with zeros.
    warned: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            warned.append(record.getMessage())
        return True

    logging.getLogger("trimesh").addFilter(collect)
    try:
        stream, kind = io.BytesIO(file.for_trimesh()), "glb" if file.binary else "gltf"
        scene = trimesh.load_scene(stream, file_type=kind, resolver=file, process=False)  # type: ignore[arg-type]
    finally:
        logging.getLogger("trimesh").removeFilter(collect)
    if warned:
        raise ScanError(f"{file.path.name}: {warned[0]}; export it again without compression")
    # trimesh drops base colour textures that it cannot read without a word.
    reasons = {}
    for declared in file.tree.get("materials", []):
        if (wanted := declared.get("pbrMetallicRoughness", {}).get("baseColorTexture")) is not None:
            texture = file.tree["textures"][wanted["index"]]
            basis = "KHR_texture_basisu" in texture.get("extensions", {}) and "source" not in texture
            reasons[declared.get("name", "material")] = (
                "is KTX2 (KHR_texture_basisu), which is not read; export the scan again with PNG or JPEG"
                if basis
                else "is missing, damaged or of an unknown kind"
            )
    materials: dict[int, Material] = {}
    pictures: dict[int, NDArray[np.float32]] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh):
            by_joints = _skinning_transforms(file, scene, node, mesh) if file.tree.get("skins") else None
            moved = np.asarray(transform, np.float64) if by_joints is None else by_joints
            parts.append(_part(mesh, moved, materials, pictures, file.path.name))
    lost = [m.name for m in materials.values() if m.texture_linear is None and m.name in reasons]
    without = {name: f"the texture of {name} {reasons[name]}: went on without it" for name in lost}
    notes = tuple(without.values())
    if not parts:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), notes=notes)
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    names = ("vertices", "uv", "material", "vertex_color_linear")
    vertices, uv, material, colors = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
    # Colours and coordinates that no part has are left out.
    return ParsedMesh(
        vertices=vertices,
        faces=np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=False)]),
        uv=uv if np.isfinite(uv).any() else None,
        material=material,
        materials=tuple(materials.values()),
        vertex_color_linear=colors if colors[:, 3].any() else None,
        notes=notes,
    )


def _part(
    mesh: trimesh.Trimesh,
    transform: FloatArray,
    materials: dict[int, Material],
    pictures: dict[int, NDArray[np.float32]],
    name: str,
) -> ParsedMesh:
    """Return a mesh moved by (4, 4) or (V, 4, 4); its material and pictures are added to those known."""
    visual: Any = mesh.visual
    source = getattr(visual, "material", None)
    if id(source) not in materials:
        limits.require_at_most(name, "materials", 1 + len(materials), limits.MATERIALS, "join its materials")
        factor = getattr(source, "baseColorFactor", None)
        color = np.ones(3, np.float32) if factor is None else _scaled(np.asarray(factor)[None])[0, :3]
        image, texture = getattr(source, "baseColorTexture", None), None
        if image is not None and id(image) not in pictures:
            pixels, advice = image.size[0] * image.size[1], "save it with fewer pixels"
            limits.require_at_most(f"a texture of {name}", "pixels", pixels, limits.PIXELS, advice)
            with suppress(OSError, SyntaxError, ValueError):
                pictures[id(image)] = decode_picture(np.asarray(image.convert("RGBA"), np.uint8))
        if image is not None and id(image) in pictures:
            texture = pictures[id(image)]
            if (color < 1).any():
                texture = texture * np.append(color, 1)[: texture.shape[2]].astype(np.float32)
        base = (float(color[0]), float(color[1]), float(color[2]))
        materials[id(source)] = Material(str(getattr(source, "name", None) or "material"), texture, base)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    # Joined with other meshes, a wrong index would point at a vertex of the next one.
    require_valid_indices(faces, len(vertices), name)
    linear, shift = transform[..., :3, :3], transform[..., :3, 3]
    if np.median(np.linalg.det(linear)) < 0:
        faces = faces[:, ::-1]
    uv = getattr(visual, "uv", None)
    # A mesh without material and colours has no attributes either.
    others = getattr(visual, "vertex_attributes", {})
    given = visual.vertex_colors if visual.kind == "vertex" else others.get("color")
    number = list(materials).index(id(source))
    if given is None:  # of alpha 0, for no picture showed it
        colors = np.tile([*materials[id(source)].base_color_linear, 0], (len(vertices), 1)).astype(np.float32)
    else:
        colors = _scaled(np.asarray(given))
        colors = np.pad(colors, ((0, 0), (0, 4 - colors.shape[1])), constant_values=1)
    if uv is None or len(uv) != len(vertices):
        uv = np.full((len(vertices), 2), np.nan)
    return ParsedMesh(
        vertices=(linear @ vertices[:, :, None])[:, :, 0] + shift,
        faces=faces,
        uv=np.asarray(uv, np.float64)[faces],
        material=np.full(len(faces), number),
        vertex_color_linear=colors,
    )


def _scaled(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return (N, 3), or with alpha (N, 4), in [0, 1] from whole integers or floats, not decoded."""
    return (colors / (np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0)).astype(np.float32)


def _skinning_transforms(
    file: GltfFile, scene: trimesh.Scene, frame: str, mesh: trimesh.Trimesh
) -> FloatArray | None:
    """Return the transforms (V, 4, 4) of a mesh's vertices by their joints; None for a mesh without a skin.

    v' = sum over k of w_k J_k B_k v, and the transform of the mesh's own node `frame` is ignored (glTF 2.0,
    3.7.3.2 and 3.7.3.3). The scene is that of `GltfFile.for_trimesh`.
    """
    attributes = {name: np.asarray(values) for name, values in mesh.vertex_attributes.items()}
    skin = file.tree["nodes"][int(frame.partition("_")[0])].get("skin")
    sets = sum(name.startswith(f"{MARK}JOINTS_") for name in attributes)
    if skin is None or sets == 0:
        return None
    joints = np.concatenate([attributes[f"{MARK}JOINTS_{n}"] for n in range(sets)], 1).astype(np.int64)
    weights = np.concatenate([attributes[f"{MARK}WEIGHTS_{n}"] for n in range(sets)], 1).astype(np.float64)
    total = weights.sum(1, keepdims=True)
    if not (total > 0).all():
        raise ValueError("a vertex of a skinned mesh has no weights")
    entry = file.tree["skins"][skin]
    transforms = np.array([scene.graph[str(joint)][0] for joint in entry["joints"]])
    if "inverseBindMatrices" in entry:  # else they are identities
        accessor = file.tree["accessors"][entry["inverseBindMatrices"]]
        if accessor["componentType"] != 5126 or accessor["type"] != "MAT4" or "bufferView" not in accessor:
            raise ValueError("inverse bind matrices are not stored as plain 4x4 floats")
        columns = file.array(accessor)[: len(transforms)].reshape(len(transforms), 4, 4)
        transforms = transforms @ columns.transpose(0, 2, 1).astype(np.float64)
    blended, block = np.empty((len(joints), 4, 4)), 1 << 16  # to spare memory
    for start in range(0, len(joints), block):
        rows = slice(start, start + block)
        blended[rows] = np.einsum("vj,vjab->vab", weights[rows] / total[rows], transforms[joints[rows]])
    return blended
