"""Turn the surface of anyone's face template into a disc: a closed head cut open, holes filled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.errors import ModelError
from scan2albedo.face_model.template_surface import TemplateSurface, largest_component
from scan2albedo.geometry.hole_filling import boundary_loops, fill_hole
from scan2albedo.geometry.mesh import edges_with_faces, without_unreferenced

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_FILLED_LOOP = 600
BACK_OF_HEAD = 0.35


@dataclass(frozen=True)
class CleanTemplate:
    """A template ready for decimation.

    Parameters
    ----------
    vertices : (K, 3) float64
        Millimetres, origin at the centroid of `all_vertices`.
    faces : (F, 3) int64
        One disc, holes filled, counter-clockwise from outside.
    filled : (F,) bool
        True for faces that close a hole the template had.
    source : (K,) int64
        Template vertex each of `vertices` was.
    all_vertices : (T, 3) float64
        Every template vertex in the same frame and unit, the template's order.
    holes : int
        Holes filled.
    """

    vertices: FloatArray
    faces: IntArray
    filled: NDArray[np.bool_]
    source: IntArray
    all_vertices: FloatArray
    holes: int


def clean_template(surface: TemplateSurface, name: str) -> CleanTemplate:
    """Cut a closed head open at the back, fill the holes, and see that a disc remains.

    Parameters
    ----------
    surface : TemplateSurface
        In the model's axes: +x left, +y up, +z out of the face.
    name : str
        Used in messages.

    Raises
    ------
    ModelError
        When the surface has handles or holes too long to fill.
    """
    mesh = _front_of_closed(surface.vertices, surface.faces)
    closed, filled, holes = _holes_filled(surface.vertices, mesh)
    _require_disc(closed, name)
    source, renumbered = without_unreferenced(surface.vertices, closed)
    return CleanTemplate(surface.vertices[source], renumbered, filled, source, surface.vertices, holes)


def _front_of_closed(xyz: FloatArray, faces: IntArray) -> IntArray:
    """Cut the back off a closed head, so that a rim exists; open meshes stay whole."""
    if len(boundary_loops(faces)):
        return faces
    depth = xyz[:, 2]
    low, high = depth[faces].min(), depth[faces].max()
    front = faces[(depth[faces] > low + BACK_OF_HEAD * (high - low)).all(1)]
    return largest_component(len(xyz), front)


def _holes_filled(xyz: FloatArray, faces: IntArray) -> tuple[IntArray, NDArray[np.bool_], int]:
    """Close every boundary loop but the one with the greatest length in mm."""
    loops = [loop for loop in boundary_loops(faces) if len(loop) >= 3]
    length = [float(np.linalg.norm(xyz[loop] - xyz[np.roll(loop, 1)], axis=1).sum()) for loop in loops]
    rim = int(np.argmax(length)) if loops else -1
    patches = [
        fill_hole(xyz, faces, loop)
        for i, loop in enumerate(loops)
        if i != rim and len(loop) <= MAX_FILLED_LOOP
    ]
    extra = np.concatenate(patches) if patches else np.zeros((0, 3), np.int64)
    filled = np.arange(len(faces) + len(extra)) >= len(faces)
    return np.concatenate([faces, extra]), filled, len(patches)


def _require_disc(faces: IntArray, name: str) -> None:
    edges, _ = edges_with_faces(faces)
    euler = len(np.unique(faces)) - len(edges) + len(faces)
    loops = len(boundary_loops(faces))
    if euler == 1 and loops == 1:
        return
    raise ModelError(
        f"{name}: after filling holes the surface has {loops} rims and Euler characteristic {euler}, "
        "expected 1 and 1 (a disc); close handles or cut the face out of the head"
    )
