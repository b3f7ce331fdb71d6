"""Skinned meshes in glTF files: the joints' transforms of their vertices, which replace their node's."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import trimesh

FloatArray = NDArray[np.float64]

_JSON_START = 20
"""Of a GLB's text: behind the file's header and the first chunk's."""
_MARK = "_"
"""Before the names of attributes that trimesh would drop; it keeps those of an application's own."""


@dataclass(frozen=True)
class GltfFile:
    """`tree` is the JSON of a file, `rest` what follows it in a GLB."""

    path: Path
    tree: dict[str, Any]
    rest: bytes
    binary: bool

    @classmethod
    def read(cls, path: Path) -> GltfFile:
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
        text = json.dumps(tree).encode()
        if not self.binary:
            return text
        text += b" " * (-len(text) % 4)
        size = (_JSON_START + len(text) + len(self.rest)).to_bytes(4, "little")
        header = b"glTF" + (2).to_bytes(4, "little") + size
        return header + len(text).to_bytes(4, "little") + b"JSON" + text + self.rest

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


def skinning_transforms(
    file: GltfFile, scene: trimesh.Scene, frame: str, mesh: trimesh.Trimesh
) -> FloatArray | None:
    """Return (V, 4, 4) where the joints, as they stand in the file, take each vertex of a mesh.

    By the standard v' = sum over k of w_k J_k B_k v, and the transform of the mesh's own node is ignored
    [1]_. None for a mesh without a skin.

    Parameters
    ----------
    file : GltfFile
    scene : trimesh.Scene
        Of `GltfFile.with_marked_skins`.
    frame : str
        Name of the mesh's node in the scene.
    mesh : trimesh.Trimesh

    References
    ----------
    .. [1] Khronos Group, "glTF 2.0 Specification", sections 3.7.3.2 and 3.7.3.3.
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
