"""A GLB or glTF file as bytes and JSON, with the files that it refers to."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import MissingDependencyError, ScanError
from scan2albedo.io import limits
from scan2albedo.io.glb import glb_bytes
from scan2albedo.io.images import picture_pixels
from scan2albedo.io.scan_folder import ScanFolder

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
                raise ScanError(
                    f"{name}: is compressed with {extension}, which is not decoded here; {advice} "
                    "(gltfpack without -c)"
                )
        if _DRACO in (*used, *required) and find_spec("DracoPy") is None:
            raise MissingDependencyError(
                f"{name}: is compressed with Draco; install what reads it with: "
                f"pip install 'scan2albedo[draco]', or {advice}"
            )
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

    def inverse_binds(self, skin: int) -> FloatArray:
        """Return (J, 4, 4) inverse bind matrices of a skin; identities where it has none."""
        entry = self.tree["skins"][skin]
        count = len(entry["joints"])
        if "inverseBindMatrices" not in entry:
            return np.tile(np.eye(4), (count, 1, 1))
        accessor = self.tree["accessors"][entry["inverseBindMatrices"]]
        if accessor["componentType"] != 5126 or accessor["type"] != "MAT4" or "bufferView" not in accessor:
            raise ValueError("inverse bind matrices are not stored as plain 4x4 floats")
        return self._array(accessor)[:count].reshape(count, 4, 4).transpose(0, 2, 1).astype(np.float64)

    def _numbers(self, accessor: dict[str, Any]) -> FloatArray:
        """Return (count, components) of an accessor, whole numbers as parts of their range (glTF 3.6.2)."""
        if "bufferView" not in accessor and "sparse" not in accessor:
            raise ValueError("compressed coordinates are moved (KHR_texture_transform)")
        shape = accessor["count"], _COMPONENTS[accessor["type"]]
        stored = np.zeros(shape, _DTYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            stored[:] = self._array(accessor)
        if "sparse" in accessor:
            few = accessor["sparse"]
            at = self._array({"type": "SCALAR", "count": few["count"], **few["indices"]})[:, 0]
            stored[at] = self._array({**accessor, "byteOffset": 0, "count": few["count"], **few["values"]})
        quantized = "KHR_mesh_quantization" in self.tree.get("extensionsUsed", ())
        if stored.dtype.kind == "f" or not accessor.get("normalized", not quantized):
            return stored.astype(np.float64)
        return np.maximum(stored / np.iinfo(stored.dtype).max, -1)

    def _array(self, accessor: dict[str, Any]) -> NDArray[Any]:
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
