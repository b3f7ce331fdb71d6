"""A GLB or glTF file as bytes and JSON, with the files that it refers to."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.io import limits
from scan2albedo.io.glb import glb_bytes
from scan2albedo.io.scan_folder import ScanFolder

MARK = "_"
"""Before the names of attributes that trimesh would drop; it keeps those of an application's own."""
_COORDINATES = {5121: "u1", 5123: "<u2"}
"""Types of texture coordinates that are parts of the largest number (glTF 2.0, 3.7.2.1)."""
_JSON_START = 20
"""Of a GLB's text: behind the file's header and the first chunk's."""


@dataclass
class GltfFile:
    """A file: its bytes, the JSON `tree` in it, and the bytes `rest` that follow that in a GLB."""

    path: Path
    data: bytes
    tree: dict[str, Any]
    rest: bytes
    binary: bool
    folder: ScanFolder
    bytes_referred: int = 0

    @classmethod
    def read(cls, path: Path, textures: Path | None = None) -> GltfFile:
        """Read a GLB or glTF file."""
        folder = ScanFolder(path.parent, textures)
        data = limits.read_bytes(path, advice="decimate it")
        if data[:4] != b"glTF":
            return cls(path, data, limits.parse_json(path.name, data), b"", False, folder)
        end = _JSON_START + int.from_bytes(data[12:16], "little")
        return cls(path, data, limits.parse_json(path.name, data[_JSON_START:end]), data[end:], True, folder)

    def referred(self, uri: str) -> bytes:
        """Return the content of a file that the scan may refer to; raises FileNotFoundError for any other."""
        name = unquote(uri)
        file = self.folder.find(name)
        if file is None:
            raise FileNotFoundError(f"{name} {self.folder.why_missing(name)}")
        content = limits.read_bytes(file)
        self.bytes_referred += len(content)
        place = f"what {self.path.name} refers to"
        limits.require_at_most(place, "bytes", self.bytes_referred, 4 * limits.FILE_BYTES, "decimate it")
        return content

    def __getitem__(self, uri: str) -> bytes:
        """Return the content of a file, as trimesh asks for it."""
        return self.referred(uri)

    def picture(self, number: int) -> bytes | None:
        """Return the content of a picture, None when it is missing."""
        entry = self.tree["images"][number]
        if "bufferView" in entry:
            view = self.tree["bufferViews"][entry["bufferView"]]
            start = view.get("byteOffset", 0)
            return self._buffer(view["buffer"])[start : start + view["byteLength"]]
        try:
            return self._content(entry["uri"])
        except (KeyError, OSError, ValueError):
            return None

    def with_marked_skins(self) -> bytes:
        """Return the file's bytes with nodes named by number and skin attributes marked for trimesh."""
        tree = json.loads(json.dumps(self.tree))
        for number, node in enumerate(tree.get("nodes", [])):
            node["name"] = str(number)
        for mesh in tree.get("meshes", []):
            for primitive in mesh["primitives"]:
                primitive["attributes"] = {
                    MARK + name if name.startswith(("JOINTS_", "WEIGHTS_")) else name: accessor
                    for name, accessor in primitive["attributes"].items()
                }
        return glb_bytes(tree, self.rest) if self.binary else json.dumps(tree).encode()

    def with_float_coordinates(self) -> GltfFile:
        """Return the file with texture coordinates of 8 or 16 bits as floats: trimesh does not scale them."""
        used = {
            primitive["attributes"].get("TEXCOORD_0")
            for mesh in self.tree.get("meshes", ())
            for primitive in mesh["primitives"]
        }
        accessors = self.tree.get("accessors", ())
        stored = [i for i in used - {None} if "bufferView" in accessors[i]]
        short = [i for i in stored if accessors[i]["componentType"] in _COORDINATES]
        if not short:
            return self
        tree = json.loads(json.dumps(self.tree))
        for number in short:
            data = self._coordinates(self.tree["accessors"][number]).astype("<f4").tobytes()
            uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
            view = {"buffer": len(tree["buffers"]), "byteLength": len(data)}
            tree["buffers"].append({"byteLength": len(data), "uri": uri})
            count = tree["accessors"][number]["count"]
            place = {"bufferView": len(tree["bufferViews"]), "componentType": 5126}
            tree["accessors"][number] = {**place, "count": count, "type": "VEC2"}
            tree["bufferViews"].append(view)
        whole = glb_bytes(tree, self.rest) if self.binary else json.dumps(tree).encode()
        return replace(self, tree=tree, data=whole)

    def _coordinates(self, accessor: dict[str, Any]) -> FloatArray:
        """Return (N, 2) normalised texture coordinates."""
        kind = np.dtype(_COORDINATES[accessor["componentType"]])
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", 2 * kind.itemsize)
        shape, steps = (accessor["count"], 2), (stride, kind.itemsize)
        stored = np.ndarray(shape, kind, self._buffer(view["buffer"]), start, steps)
        return stored / float(np.iinfo(kind).max)

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
        return self._content(uri)

    def _content(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
        return self.referred(uri)
