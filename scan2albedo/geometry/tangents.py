"""Meshes with texture coordinates: split at seams, and the frames in which normal maps are written."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, dots, triangle_sides
from scan2albedo.geometry.mesh import lengths, normalized


@dataclass(frozen=True)
class SplitMesh:
    """A mesh with one place for each of its N vertices.

    `vertex` (N,) are the vertices that they were, `uv` (N, 2) the places, `faces` (F, 3) refer to the N.
    """

    vertex: IntArray
    uv: FloatArray
    faces: IntArray


def split_at_seams(faces: IntArray, uv: FloatArray, side: IntArray | None = None) -> SplitMesh:
    """Return a mesh with faces (F, 3) and places of their corners `uv` (F, 3, 2), split where places differ.

    Faces with another number in `side` (F,) come apart as well.

    >>> faces, uv = np.array([[0, 1, 2], [2, 1, 3]]), np.zeros((2, 3, 2))
    >>> uv[1, 0] = 1.0
    >>> split_at_seams(faces, uv).vertex.tolist()
    [0, 1, 2, 2, 3]
    """
    # One number for a vertex and its place in the texture; that two such numbers agree is next to impossible.
    place = np.round(uv * 2**20).astype(int)
    across, up = place[..., 0] * 0xC2B2AE3D27D4EB5, place[..., 1] * 0x165667B19E3779F
    key = faces * 0x9E3779B97F4A7C1 + across + up
    if side is not None:
        key += side[:, None] * 0x27D4EB2F165667C5
    _, first, corner = np.unique(key, return_index=True, return_inverse=True)
    order = np.lexsort((first, faces.ravel()[first]))
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    kept = first[order]
    vertex = faces.ravel()[kept].astype(int)
    return SplitMesh(vertex, uv.reshape(-1, 2)[kept], rank[corner.reshape(faces.shape)])


@dataclass(frozen=True)
class TangentMesh:
    """A mesh split at seams and mirror lines of its chart, with a frame at each of its N vertices.

    `normals` (N, 3) and `tangents` (N, 4) are of unit length; a tangent's last number is the handedness w,
    which is -1 where the chart is mirrored. The third axis is w (normal x tangent).
    """

    split: SplitMesh
    normals: FloatArray
    tangents: FloatArray


def tangent_mesh(vertices: FloatArray, faces: IntArray, uv: FloatArray, normals: FloatArray) -> TangentMesh:
    """Return faces (F, 3) of a mesh (V, 3) with frames; `normals` (V, 3) are its vertices'.

    `uv` (F, 3, 2) are the places of corners. A vertex's tangent is the mean of the directions in which u
    grows on its faces, each turned into its plane, weighted by its corner's angle as by MikkTSpace [1]_.

    .. [1] M. Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", 2008, and glTF 2.0, section 3.7.2.1.
    """
    along, up = triangle_sides(uv)
    turn = along[:, 0] * up[:, 1] - along[:, 1] * up[:, 0]
    split = split_at_seams(faces, uv, (turn < 0).astype(int))
    normal = normals[split.vertex]
    normal = np.where(lengths(normal)[:, None] > 0, normal, (0.0, 0.0, 1.0))
    corners = vertices[faces]
    first, second = triangle_sides(corners)
    right = np.sign(turn)[:, None] * normalized(up[:, 1, None] * first - along[:, 1, None] * second)
    sums = np.zeros((len(normal), 3))
    for corner in range(3):
        at = split.faces[:, corner]
        plane = normal[at]
        ahead = _in_plane(corners[:, (corner + 1) % 3] - corners[:, corner], plane)
        behind = _in_plane(corners[:, (corner + 2) % 3] - corners[:, corner], plane)
        angle = np.arccos(np.clip(dots(ahead, behind), -1, 1))
        np.add.at(sums, at, angle[:, None] * _in_plane(right, plane))
    # Where no face has a place of its own on the texture, any direction in the plane will do.
    spare = np.eye(3)[np.abs(normal).argmin(1)]
    tangent = _in_plane(np.where((lengths(sums) > 1e-9)[:, None], sums, spare), normal)
    hand = np.ones(len(normal))
    hand[split.faces[turn < 0]] = -1.0
    return TangentMesh(split, normal, np.column_stack([tangent, hand]))


def in_tangent_space(directions: FloatArray, normals: FloatArray, tangents: FloatArray) -> FloatArray:
    """Return unit directions (N, 3) as normal maps have them: their parts along the axes of frames.

    Frames have normals (N, 3) and tangents (N, 4), of any length when they come from interpolation.

    >>> one = np.array([[0.0, 0, 1]]), np.array([[0.0, 1, 0, -1]])
    >>> in_tangent_space(np.array([[0.6, 0, 0.8]]), *one).tolist()
    [[0.0, 0.6, 0.8]]
    """
    normal, tangent = normalized(normals), normalized(tangents[:, :3])
    third = np.sign(tangents[:, 3]) * dots(directions, np.cross(normal, tangent))
    ahead, up = dots(directions, tangent), dots(directions, normal)
    # Interpolated frames are a little oblique: the parts are those that add up, not projections.
    slant = dots(normal, tangent)
    square = np.maximum(1 - slant**2, 1e-9)
    parts = [(ahead - slant * up) / square, third / square, (up - slant * ahead) / square]
    return normalized(np.stack(parts, axis=1))


def _in_plane(vectors: FloatArray, normals: FloatArray) -> FloatArray:
    """Return unit vectors (N, 3): the vectors without what they have along unit normals (N, 3)."""
    return normalized(vectors - dots(vectors, normals)[:, None] * normals)
