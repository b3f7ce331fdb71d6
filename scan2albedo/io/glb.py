"""Meshes, also those that joints move, as binary glTF 2.0 files that any viewer opens."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
    NDArray,
    Values,
    all_finite,
    checked_array,
    checked_mesh,
    finite_rows,
    identities,
)
from scan2albedo.geometry.mesh import vertex_normals, without_unreferenced
from scan2albedo.io.atomic import write_bytes
from scan2albedo.io.images import encode_image

METRES_PER_MM = 1e-3
_INFLUENCES = 4
"""Weights of a vertex in a set of attributes (glTF 2.0, 3.7.3.3)."""
OF_VERTICES = 34962
"""Target of a buffer view that holds an attribute of vertices (glTF 2.0, 5.11.5: ARRAY_BUFFER)."""
OF_INDICES = 34963
"""Target of a buffer view that holds the corners of faces (glTF 2.0, 5.11.5: ELEMENT_ARRAY_BUFFER)."""

_COMPONENT = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_KIND = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class GlbFile:
    """A file as it grows: the binary chunk, and the JSON lists that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[Values] = []
        self.meshes: list[Values] = []
        self.materials: list[Values] = []
        self.images: list[Values] = []

    def add_bytes(self, data: bytes, target: int | None = None) -> int:
        """Append bytes and return the number of their buffer view."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def add_picture(self, png: bytes, **entries: str) -> dict[str, int]:
        """Append a picture with further entries, such as a name, and return a material's reference to it."""
        self.images.append({**entries, "bufferView": self.add_bytes(png), "mimeType": "image/png"})
        return {"index": len(self.images) - 1}

    def add_array(self, array: NDArray, target: int | None = None, *, bounds: bool = False) -> int:
        """Append an array, one element a row, floats in 32 bits, and return the number of its accessor."""
        stored = array.astype("<f4") if array.dtype.kind == "f" else array
        little = np.ascontiguousarray(stored, stored.dtype.newbyteorder("<"))
        accessor: Values = {
            "bufferView": self.add_bytes(little.tobytes(), target),
            "componentType": _COMPONENT[stored.dtype.str[1:]],
            "count": len(array),
            "type": _KIND[array.shape[1:]],
        }
        if bounds:
            rows = stored.reshape(len(stored), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_mesh(
        self,
        material: Values,
        vertices_mm: FloatArray,
        faces: IntArray,
        attributes: Mapping[str, NDArray] | None = None,
        *,
        uv: FloatArray | None = None,
        normals: FloatArray | None = None,
    ) -> int:
        """Append a mesh of one material, whose name it takes, and return its number.

        `uv` (V, 2) has v = 0 at the bottom, `normals` (V, 3) are those of a mesh that was split.
        """
        places = vertices_mm * METRES_PER_MM
        normals = vertex_normals(places, faces) if normals is None else normals.copy()
        normals[~normals.any(1)] = (0.0, 0.0, 1.0)
        stored = {
            "POSITION": self.add_array(places, OF_VERTICES, bounds=True),
            "NORMAL": self.add_array(normals, OF_VERTICES),
        }
        further = dict(attributes or {})
        if uv is not None:  # glTF counts v from the top
            further["TEXCOORD_0"] = uv * (1, -1) + (0, 1)
        for key, array in further.items():
            stored[key] = self.add_array(array, OF_VERTICES)
        indices = self.add_array(faces.astype("u4").ravel(), OF_INDICES)
        self.materials.append(material)
        primitive = {"attributes": stored, "indices": indices, "material": len(self.materials) - 1}
        self.meshes.append({"name": material["name"], "primitives": [primitive]})
        return len(self.meshes) - 1

    def add_targets(
        self,
        mesh: int,
        surface: tuple[FloatArray, IntArray],
        targets: FloatArray,
        weights: FloatArray,
        kept: IntArray | slice = slice(None),
        names: Sequence[str] = (),
    ) -> None:
        """Append morph targets (K, V, 3) mm, with weights (K,), of the vertices that a mesh `kept` of another
        one (V, 3), (F, 3) when it was split."""
        (vertices_mm, faces), entry = surface, self.meshes[mesh]
        normals, stored = vertex_normals(vertices_mm, faces), list[dict[str, int]]()
        for move in targets:
            turned = (vertex_normals(vertices_mm + move, faces) - normals)[kept]
            place = self.add_array(METRES_PER_MM * move[kept], OF_VERTICES, bounds=True)
            stored.append({"POSITION": place, "NORMAL": self.add_array(turned, OF_VERTICES)})
        entry["primitives"][0]["targets"] = stored
        entry["weights"] = weights.tolist()
        if names:
            entry["extras"] = {"targetNames": [*names]}

    def add_take(
        self, mesh: int, surface: tuple[FloatArray, IntArray], take: Mapping[str, FloatArray]
    ) -> Values:
        """Append how a mesh moves, see `write_glb`; return the file's animations, of its first node."""
        pose = take["pose"]
        curves = {"rotation": Rotation.from_matrix(pose[:, :3, :3]).as_quat()}
        curves["translation"] = METRES_PER_MM * pose[:, :3, 3]
        if len(take["targets"]):
            curves["weights"] = take["weights"].ravel()
            self.add_targets(mesh, surface, take["targets"], take["weights"][0])
        times = self.add_array(take["time_s"], bounds=True)
        samplers = [{"input": times, "output": self.add_array(values)} for values in curves.values()]
        channels = [{"sampler": k, "target": {"node": 0, "path": p}} for k, p in enumerate(curves)]
        return {"animations": [{"samplers": samplers, "channels": channels}]}

    def write(
        self,
        path: str | Path,
        nodes: list[Values] | None = None,
        roots: Sequence[int] = (),
        **entries: list[Any],
    ) -> None:
        """Write the file atomically, with further lists, and `nodes`, of which `roots` stand in the scene.

        Without nodes each mesh has one, of its name.
        """
        if nodes is None:
            nodes = [{"name": mesh["name"], "mesh": number} for number, mesh in enumerate(self.meshes)]
            roots = range(len(nodes))
        tree = {
            "asset": {"version": "2.0", "generator": "scan2albedo"},
            "scene": 0,
            "scenes": [{"nodes": [*roots]}],
            "nodes": nodes,
            "meshes": self.meshes,
            **entries,
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        if self.images:
            textures = [{"source": number} for number in range(len(self.images))]
            tree |= {"images": self.images, "textures": textures}
        if used := {name for material in self.materials for name in material.get("extensions", ())}:
            tree["extensionsUsed"] = sorted(used)
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text
        body += struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def write_glb(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike | None = None,
    texture_srgb: ByteArray | None = None,
    *,
    emissive: bool = False,
    parts: Sequence["GlbPart"] = (),
    take: Mapping[str, FloatArray] | None = None,
) -> None:
    """Write a mesh with its base colour, atomically.

    `vertices` (V, 3) in mm are stored as metres, glTF's unit. In `uv` (V, 2), v = 0 is the bottom row of
    `texture_srgb` (H, W, 3), or (H, W, 4) with alpha 0 where it is cut away; glTF counts from the top, and v
    is flipped here. Without a texture the mesh is grey. An `emissive` texture, and then `parts` beside the
    mesh, already contain their light, and viewers add none. Raises OutputError when the folder cannot be
    written; ValueError for a texture without `uv`, or wrong shapes.

    The mesh of a `take` moves: at `time_s` (T,) the vertices V are R_t (V + sum_k w_tk D_k) + t_t, linear in
    between, with `targets` D (K, V, 3), `weights` (T, K) and `pose` (T, 4, 4), mm.
    """
    points, triangles = checked_mesh(vertices, faces, str(path))
    if texture_srgb is not None and uv is None:
        raise ValueError("a texture needs uv coordinates")
    if uv is not None and np.shape(uv) != (len(points), 2):
        raise ValueError(f"uv has shape {np.shape(uv)}, expected ({len(points)}, 2)")
    file = GlbFile()
    grey = 200 / 255 if texture_srgb is None else 1.0
    material = plain_material("face", (grey, grey, grey, 1.0), double_sided=False)
    coordinates = None if uv is None else np.asarray(uv, float)
    mesh = file.add_mesh(material, points, triangles, uv=coordinates)
    material["name"] = "albedo"
    if texture_srgb is not None:
        picture = file.add_picture(encode_image(np.asarray(texture_srgb, np.uint8), ".png"))
        if emissive:
            material["pbrMetallicRoughness"]["baseColorFactor"] = [0.0, 0.0, 0.0, 1.0]
            material |= {"emissiveTexture": picture, "emissiveFactor": [1.0, 1.0, 1.0]}
        else:
            material["pbrMetallicRoughness"]["baseColorTexture"] = picture
        if texture_srgb.shape[2] == 4:
            material |= {"alphaMode": "MASK", "doubleSided": True}
            material["pbrMetallicRoughness"]["baseColorTexture"] = picture
    for part in parts:
        part.add_to(file)
        if emissive:
            file.materials[-1]["extensions"] = {"KHR_materials_unlit": {}}
    animations: Values = {} if take is None else file.add_take(mesh, (points, triangles), take)
    file.write(path, **animations)


@dataclass(frozen=True)
class GlbPart:
    """A mesh of one colour (3,), or of a colour a vertex (V, 3): vertices (V, 3) in mm, faces (F, 3)."""

    name: str
    vertices: FloatArray
    faces: IntArray
    color_linear: ArrayLike
    opacity: float = 1.0
    roughness: float = 0.6
    follows: FloatArray | None = None
    """(V, 68): how far vertices move with each landmark of a face; None where they stay."""

    def add_to(self, file: "GlbFile") -> int:
        """Append the part and return the number of its mesh."""
        vertices, faces = np.asarray(self.vertices, float), np.asarray(self.faces, int)
        if len(faces) == 0 or not all_finite(vertices):
            raise ValueError(f"{self.name!r} needs faces and finite vertices")
        color = np.clip(np.asarray(self.color_linear, float), 0, 1)
        attributes = {"COLOR_0": color} if color.ndim > 1 else {}
        base = (*((1.0, 1.0, 1.0) if color.ndim > 1 else color.tolist()), min(max(self.opacity, 0.0), 1.0))
        material = plain_material(self.name, base, self.roughness)
        if self.opacity < 1:
            material["alphaMode"] = "BLEND"
        return file.add_mesh(material, vertices, faces, attributes)


def write_parts_glb(path: str | Path, parts: Sequence[GlbPart]) -> None:
    """Write meshes of one colour each, opaque or not, atomically; lengths as metres, glTF's unit.

    Raises OutputError when it cannot be written; ValueError for no part, no faces or numbers not finite.
    """
    if not parts:
        raise ValueError("a GLB file needs a mesh")
    file = GlbFile()
    for part in parts:
        kept, renumbered = without_unreferenced(np.asarray(part.vertices), np.asarray(part.faces))
        replace(part, vertices=np.asarray(part.vertices)[kept], faces=renumbered).add_to(file)
    file.write(path)


def plain_material(
    name: str, color: Sequence[float], roughness: float = 0.9, *, double_sided: bool = True
) -> Values:
    """Return the entry of a material of one colour (red, green, blue, opacity), which is not a metal."""
    surface = {"baseColorFactor": list(color), "metallicFactor": 0.0, "roughnessFactor": roughness}
    return {"name": name, "doubleSided": double_sided, "pbrMetallicRoughness": surface}


def write_skinned_glb(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    keypoints: ArrayLike,
    weights: ArrayLike,
    names: Sequence[str],
    *,
    parents: Sequence[int],
) -> tuple[FloatArray, float]:
    """Write a mesh with a node at each key point and the weights that tie it to them, as binary glTF 2.0.

    A viewer that moves the nodes moves the mesh: v' = sum over k of w_k J_k B_k v, J_k the joint's transform
    to the world and B_k its inverse when the file was written ("glTF 2.0 Specification", section 3.7.3).

    `vertices` and `faces` as in `write_glb`; `keypoints` (K, 3) in mm, NaN for a missing one, which gets no
    node; `weights` (V, K) not negative, rows sum to 1, 0 for missing key points; `parents` (K,) the joint
    that carries each along, -1 for none (children of a missing joint are attached to its parent). Each vertex
    keeps its four largest weights, divided by their sum: most viewers read no more. Returns the weights
    (V, K) as written, rounded to 32 bits, rows sum to 1, and the greatest part of a vertex's weight that was
    cut off: that times the greatest distance between any two of the places to which its joints, each by
    itself, would take it, it moves at most.

    Raises OutputError when the folder cannot be written; ValueError for wrong shapes, numbers that are not
    finite, negative weights, weights of missing joints or parents that form a cycle.
    """
    xyz, index = checked_mesh(vertices, faces, "the skinned mesh")
    joints = checked_array(keypoints, (len(names), 3), "keypoints")
    shares = checked_array(weights, (len(xyz), len(names)), "weights", finite=ValueError)
    parent = checked_array(parents, (len(names),), "parents", kind=int)
    if not len(index):
        raise ValueError("there must be faces")
    there = finite_rows(joints)
    if shares.min() < 0 or shares[:, ~there].any() or np.abs(shares.sum(1) - 1).max() > 1e-6:
        raise ValueError("weights must not be negative, sum to 1, and be 0 for missing key points")
    known = np.flatnonzero(there)
    joint, weight = _largest_weights(shares[:, known])
    file = GlbFile()
    attributes = {"JOINTS_0": joint.astype("u1" if len(known) <= 256 else "u2"), "WEIGHTS_0": weight}
    frame = plain_material("frame", (0.25, 0.25, 0.28, 1.0), 0.6)
    mesh = file.add_mesh(frame, xyz, index, attributes)
    # A skinned mesh stands beside its skeleton: transforms of its own node do not count.
    number = {int(k): i + 2 for i, k in enumerate(known)}
    skeleton: Values = {"name": "skeleton"}
    nodes: list[Values] = [{"name": "frame", "mesh": mesh, "skin": 0}, skeleton]
    places = joints * METRES_PER_MM
    nodes += [{"name": names[k]} for k in number]
    above = _known_parents(parent, there)
    for k, node in number.items():
        origin, holder = np.zeros(3), skeleton
        if (carrier := int(above[k])) >= 0:
            origin, holder = places[carrier], nodes[number[carrier]]
        nodes[node]["translation"] = (places[k] - origin).tolist()
        holder.setdefault("children", []).append(node)
    inverse = identities(len(known), 4)
    inverse[:, :3, 3] = -places[known]
    matrices = file.add_array(inverse.transpose(0, 2, 1))  # column by column
    skin = {"skeleton": 1, "joints": list(number.values()), "inverseBindMatrices": matrices}
    file.write(path, nodes, [0, 1], skins=[skin])
    written = np.zeros(shares.shape)
    np.add.at(written, (np.arange(len(shares))[:, None], known[joint]), weight)
    cut = max(float((shares * (written == 0)).sum(1).max()), 0.0)
    return written / written.sum(1, keepdims=True), cut


def _known_parents(parents: IntArray, known: BoolArray) -> IntArray:
    """Return the nearest known joint (K,) above each one, -1 for none; ValueError for a circle."""
    above = parents
    climbed = parents
    for _ in parents:
        above = np.where((above >= 0) & ~known[above], parents[above], above)
        climbed = np.where(climbed >= 0, parents[climbed], -1)
    if (climbed[known] >= 0).any():
        raise ValueError("parents go round in a circle")
    return above


def _largest_weights(shares: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the joints (V, 4) of each vertex's largest weights, of sum 1, heaviest first, and these."""
    # Of weights that do not vanish beside 1 in 32 bits; the standard wants joint 0 with none.
    some = np.where(shares > np.finfo(np.float32).epsneg, shares, 0.0)
    order = np.argsort(-some, axis=1, kind="stable")[:, :_INFLUENCES]
    kept = np.take_along_axis(some, order, 1)
    filling = ((0, 0), (0, _INFLUENCES - order.shape[1]))
    weight = np.pad((kept / kept.sum(1, keepdims=True)).astype(np.float32), filling)
    return np.where(weight > 0, np.pad(order, filling), 0), weight
