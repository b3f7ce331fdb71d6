"""A mesh that joints move, as one GLB file that any viewer opens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.io.glb import METRES_PER_MM, GlbFile, plain_material

_MATERIAL = plain_material("frame", (0.25, 0.25, 0.28, 1.0), 0.6)


@dataclass(frozen=True)
class SkinWritten:
    """What stands in a file that `write_skinned_glb` wrote."""

    weights: FloatArray
    """(V, K) after the cut to the largest ones and rounding to 32 bits; rows sum to 1."""
    cut: float
    """Greatest part of a vertex's weight that was cut off."""


def write_skinned_glb(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    keypoints: ArrayLike,
    weights: ArrayLike,
    names: Sequence[str],
    *,
    parents: Sequence[int],
    influences: int | None = 4,
) -> SkinWritten:
    """Write a mesh with a node at each key point and the weights that tie it to them, as binary glTF 2.0.

    A viewer that moves the nodes moves the mesh: v' = sum over k of w_k J_k B_k v, J_k the joint's transform
    to the world and B_k its inverse when the file was written ("glTF 2.0 Specification", section 3.7.3).

    `vertices` and `faces` as in `write_glb`; `keypoints` (K, 3) in mm, NaN for a missing one, which gets no
    node; `weights` (V, K) not negative, rows sum to 1, 0 for missing key points; `parents` (K,) the joint
    that carries each along, -1 for none (children of a missing joint are attached to its parent). Each vertex
    keeps its `influences` largest weights, divided by their sum, as most viewers read only a file's first
    four; None keeps all that are not 0 in 32 bits. The cut moves a vertex by at most `SkinWritten.cut` times
    the greatest distance between any two of the places to which its joints, each by itself, would take it.

    Raises OutputError when the folder cannot be written; ValueError for wrong shapes, numbers that are not
    finite, negative weights, weights of missing joints or parents that form a cycle.
    """
    xyz, joints, shares = (np.asarray(given, np.float64) for given in (vertices, keypoints, weights))
    index, parent = np.asarray(faces, np.int64), np.asarray(parents, np.int64)
    count, joint_count = len(xyz), len(names)
    for name, (array, shape) in {
        "vertices": (xyz, (count, 3)),
        "faces": (index, (len(index), 3)),
        "keypoints": (joints, (joint_count, 3)),
        "weights": (shares, (count, joint_count)),
        "parents": (parent, (joint_count,)),
    }.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not (np.isfinite(xyz).all() and np.isfinite(shares).all() and len(index)):
        raise ValueError("vertices and weights must be finite, and there must be faces")
    if index.min() < 0 or index.max() >= count:
        raise ValueError(f"faces must hold 0 to {count - 1}, got {index.min()} to {index.max()}")
    if influences is not None and influences < 1:
        raise ValueError(f"influences must be 1 or more, or None, got {influences}")
    there = np.isfinite(joints).all(1)
    if shares.min() < 0 or shares[:, ~there].any() or np.abs(shares.sum(1) - 1).max() > 1e-6:
        raise ValueError("weights must not be negative, sum to 1, and be 0 for missing key points")
    known = np.flatnonzero(there)
    above: dict[int, int] = {}  # the nearest joint above each that is known too
    for joint in known.tolist():
        above[joint], climb = -1, int(parent[joint])
        for _ in parent:
            if above[joint] < 0 and climb in known:
                above[joint] = climb
            climb = int(parent[climb]) if climb >= 0 else -1
        if climb >= 0:
            raise ValueError(f"parents go round in a circle from joint {joint}")
    # Joints (V, 4 n) of each vertex, heaviest first, and their weights.
    present = shares[:, known]
    some = present > np.finfo(np.float32).epsneg  # others vanish beside 1 in 32 bits
    width = int(some.sum(1).max())
    if influences is not None:
        width = min(influences, width)
    order = np.argsort(-present, axis=1, kind="stable")[:, :width]
    kept = np.take_along_axis(np.where(some, present, 0.0), order, 1)
    total = kept.sum(1, keepdims=True)
    cut = max(float((present.sum(1) - total[:, 0]).max()), 0.0)
    filling = ((0, 0), (0, -width % 4))
    kept = np.pad((kept / total).astype(np.float32), filling)
    order = np.where(kept > 0, np.pad(order, filling), 0)  # the standard wants joint 0 where a weight is 0
    file = GlbFile()
    kind, attributes = "u1" if order.max() < 256 else "u2", dict[str, tuple[NDArray[Any], str]]()
    for n, start in enumerate(range(0, order.shape[1], 4)):
        attributes[f"JOINTS_{n}"] = (order[:, start : start + 4].astype(kind), "VEC4")
        attributes[f"WEIGHTS_{n}"] = (kept[:, start : start + 4].astype("f4"), "VEC4")
    # A skinned mesh stands beside its skeleton: transforms of its own node do not count.
    number = {int(joint): i + 2 for i, joint in enumerate(known)}
    nodes: list[dict[str, Any]] = [
        {"name": "frame", "mesh": file.add_mesh("frame", xyz, index, attributes=attributes), "skin": 0},
        {"name": "skeleton", "children": [number[joint] for joint in number if above[joint] < 0]},
    ]
    places = joints * METRES_PER_MM
    for joint in number:
        origin = places[above[joint]] if above[joint] >= 0 else np.zeros(3)
        node: dict[str, Any] = {"name": names[joint], "translation": (places[joint] - origin).tolist()}
        if children := [number[j] for j in number if above[j] == joint]:
            node["children"] = children
        nodes.append(node)
    inverse = np.tile(np.eye(4), (len(known), 1, 1))
    inverse[:, :3, 3] = -places[known]
    matrices = file.add_array(inverse.transpose(0, 2, 1).astype("f4"), "MAT4")  # column by column
    skin = {"skeleton": 1, "joints": list(number.values()), "inverseBindMatrices": matrices}
    file.write(path, nodes, [0, 1], skins=[skin], materials=[_MATERIAL])
    written = np.zeros(shares.shape)
    np.add.at(written, (np.arange(len(shares))[:, None], known[order]), kept)
    return SkinWritten(written / written.sum(1, keepdims=True), cut)
