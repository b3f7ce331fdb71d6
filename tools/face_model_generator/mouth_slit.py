"""Cut the half mesh open along the mouth line, and close it with a narrow film that a mouth stretches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from face_model_generator.meshing import HalfMesh
from scan2albedo.core.arrays import BoolArray, IntArray

HALF_GAP_MM = 0.4
TAPER = 2
"""The lips' edges lie this far above and below the mouth line, less at this many last vertices."""


@dataclass(frozen=True)
class SlitMesh:
    """The half mesh with its mouth cut open.

    Parameters
    ----------
    mesh : HalfMesh
        Its "mouth_line" is the upper lip's edge; "lower_mouth_line" the lower lip's.
    film : (F,) bool
        Faces between the two edges.
    """

    mesh: HalfMesh
    film: BoolArray


def with_mouth_slit(mesh: HalfMesh) -> SlitMesh:
    """Double the vertices of the mouth line, but for the corner, and put a film between the two lines."""
    line = mesh.curves["mouth_line"]
    opened, corner = line[:-1], line[-1]
    copies = len(mesh.flat) + np.arange(len(opened))
    flat = np.concatenate([mesh.flat, mesh.flat[opened]])
    half_gap = HALF_GAP_MM * np.minimum(np.arange(len(opened), 0, -1) / TAPER, 1)
    flat[opened, 1] += half_gap
    flat[copies, 1] -= half_gap
    renumbered = np.arange(len(flat))
    renumbered[opened] = copies
    below = np.isin(mesh.faces, opened).any(1) & _below(mesh, line)
    faces = np.where(below[:, None], renumbered[mesh.faces], mesh.faces)
    film = _film(opened, copies, int(corner))
    curves = {**mesh.curves, "lower_mouth_line": np.append(copies, corner)}
    for name, index in mesh.curves.items():
        if name != "mouth_line" and (index == opened[0]).any():
            # The midline passes through both edges: top to bottom or bottom to top.
            at = int(np.flatnonzero(index == opened[0])[0])
            pair = [opened[0], copies[0]]
            rising = flat[index[-1], 1] > flat[index[0], 1]
            curves[name] = np.concatenate([index[:at], pair[::-1] if rising else pair, index[at + 1 :]])
    whole = np.concatenate([faces, film])
    return SlitMesh(HalfMesh(flat, whole, curves), np.arange(len(whole)) >= len(faces))


def _below(mesh: HalfMesh, line: IntArray) -> BoolArray:
    """Return (F,) whether a face's centre lies below the line: exact for faces that touch it."""
    centre, points = mesh.flat[mesh.faces].mean(1), mesh.flat[line]
    return np.asarray(centre[:, 1] < np.interp(centre[:, 0], points[:, 0], points[:, 1]))


def _film(upper: IntArray, lower: IntArray, corner: int) -> IntArray:
    """Return the faces between two rows of vertices that run from the midline to the corner."""
    up, low = np.append(upper, corner), np.append(lower, corner)
    first = np.stack([low[:-1], low[1:], up[:-1]], 1)
    second = np.stack([low[1:-1], up[1:-1], up[:-2]], 1)
    return np.concatenate([first, second])
