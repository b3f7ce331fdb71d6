"""glTF files by the standard's text: they share no code with our readers and writers."""

import json
import math
import struct

import numpy as np

from scan2albedo.io import load_scan

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
WIDTHS = {name: math.prod(shape) for shape, name in KINDS.items()}


class Gltf:
    """A file as its JSON `tree`, of one mesh and one material, and the bytes of its one buffer."""

    def __init__(self, tree, binary=b""):
        self.tree, self.binary = tree, binary

    @classmethod
    def read(cls, path):
        """Take a GLB apart."""
        data = path.read_bytes()
        assert data[:4] == b"glTF"
        version, length, size = struct.unpack("<3I", data[4:16])
        assert (version, length) == (2, len(data))
        assert data[16:20] == b"JSON"
        assert size % 4 == 0
        start = 28 + size
        assert struct.unpack("<I4s", data[20 + size : start]) == (len(data) - start, b"BIN\0")
        made = cls(json.loads(data[20 : 20 + size]), data[start:])
        assert made.tree["buffers"] == [{"byteLength": len(made.binary)}]
        return made

    @property
    def primitive(self):
        """The first primitive."""
        return self.tree["meshes"][0]["primitives"][0]

    @property
    def attributes(self):
        """Numbers of its accessors by name."""
        return self.primitive["attributes"]

    @property
    def material(self):
        """The first material."""
        return self.tree["materials"][0]

    def array(self, number):
        """Return (count, width) what an accessor holds, whose bounds are right; no strides."""
        entry = self.tree["accessors"][number]
        view = self.tree["bufferViews"][entry["bufferView"]]
        kind, width = COMPONENTS[entry["componentType"]], WIDTHS[entry["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == entry["count"] * width * np.dtype(kind).itemsize
        values = np.frombuffer(self.binary, kind, entry["count"] * width, view["byteOffset"])
        values = values.reshape(-1, width)
        if "min" in entry:
            assert (entry["min"], entry["max"]) == (values.min(0).tolist(), values.max(0).tolist())
        return values

    def view(self, data, **entries):
        """Append bytes and return the number of their view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        views = self.tree.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **entries})
        self.binary += data
        self.tree["buffers"] = [{"byteLength": len(self.binary)}]
        return len(views) - 1

    def add(self, values, **accessor):
        """Append an array, one element a row, and return the number of its accessor."""
        values = np.ascontiguousarray(values)
        kind = next(number for number, name in COMPONENTS.items() if np.dtype(name) == values.dtype)
        place = {"bufferView": self.view(values.tobytes()), "componentType": kind}
        accessors = self.tree.setdefault("accessors", [])
        accessors.append(place | {"count": len(values), "type": KINDS[values.shape[1:]]} | accessor)
        return len(accessors) - 1

    def data(self):
        """Return the bytes of a GLB."""
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = ((text, b"JSON"), (binary, b"BIN\0"))
        body = b"".join(struct.pack("<I4s", len(chunk), name) + chunk for chunk, name in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body

    def write(self, path):
        """Write it as GLB; return the path."""
        path.write_bytes(self.data())
        return path

    def load(self, folder, unit="auto"):
        """Write it as a.glb into a folder, and return the scan that we read."""
        return load_scan(self.write(folder / "a.glb"), unit)
