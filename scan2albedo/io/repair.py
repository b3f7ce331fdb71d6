"""Harmless repairs of raw meshes, each with a note, and errors for what cannot be repaired."""

from dataclasses import replace

import numpy as np

from scan2albedo.core.arrays import BoolArray, IntArray, NDArray, dots, norms, triangle_sides
from scan2albedo.core.raw_scan import LARGEST_COORDINATE, require_valid_indices
from scan2albedo.errors import ScanError
from scan2albedo.geometry.mesh import turned_against_neighbours, vertex_mask
from scan2albedo.io.parsed_mesh import ParsedMesh

_AREA_FLOOR = 1e-12
"""A face whose doubled area is below this share of its squared longest edge has no usable normal."""


_BLOCK = 1 << 20


def require_usable(mesh: ParsedMesh, name: str) -> None:
    """Raise `ScanError` for a mesh without faces, with wrong indices, or with non-finite vertices in use."""
    count = len(mesh.vertices)
    if len(mesh.faces) == 0:
        what = f"a point cloud of {count} vertices" if count else "no vertices and no faces"
        said = f"{name}: holds {what}; a surface is needed"
        raise ScanError(f"{said}: mesh the points first, or export the scan again if the file was cut short")
    require_valid_indices(mesh.faces, count, name)
    bad = ~(np.abs(mesh.vertices) <= LARGEST_COORDINATE).all(axis=1)
    if bad.any():
        broken = np.flatnonzero(bad & vertex_mask(count, mesh.faces))
        if len(broken):
            raise ScanError(
                f"{name}: {len(broken)} vertices used by faces are NaN or infinite (or beyond "
                f"{LARGEST_COORDINATE:g}), the first is vertex {broken[0]} (counting from 0); "
                "repair the scan or export it again"
            )


def first_equal_row(rows: NDArray) -> IntArray:
    """Return (N,) the index of the first row equal to each row of (N, K) numbers.

    >>> first_equal_row(np.array([[1.0, 2], [3, 4], [1, 2]])).tolist()
    [0, 1, 0]
    """
    first, hashes = np.arange(len(rows)), np.zeros(len(rows), np.uint64)
    for column in range(rows.shape[1]):
        plain = np.ascontiguousarray(rows[:, column]) + rows.dtype.type(0)  # -0.0 becomes 0.0
        hashes = (hashes ^ plain.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio
        hashes ^= hashes >> np.uint64(29)
    ordered = np.sort(hashes)
    if (ordered[1:] != ordered[:-1]).all():  # the rest takes four times as long
        return first
    # Rows that share a hash by chance count as different.
    _, place, group = np.unique(hashes, return_index=True, return_inverse=True)
    return np.where((rows[place[group]] == rows).all(1), place[group], first)


def _flat_faces(mesh: ParsedMesh) -> BoolArray:
    """Return (F,) which faces have no usable normal; in blocks to spare memory."""
    flat = np.empty(len(mesh.faces), bool)
    for start in range(0, len(flat), _BLOCK):
        corner = mesh.vertices[mesh.faces[start : start + _BLOCK]]
        one, two = triangle_sides(corner)
        longest = np.max([dots(edge, edge) for edge in (one, two, two - one)], axis=0)
        doubled = norms(np.cross(one, two))
        flat[start : start + len(corner)] = doubled <= _AREA_FLOOR * longest
    return flat


def repair(mesh: ParsedMesh) -> ParsedMesh:
    """Return the mesh with equal positions merged and useless faces and vertices dropped.

    In this order: vertices at exactly equal positions are merged (texture coordinates stay per corner);
    zero-area faces and repeats of the same three vertices are dropped; faces that are wound against their
    neighbours are reversed; unreferenced vertices are dropped. Each step that changed something adds a note.
    """
    used = vertex_mask(len(mesh.vertices), mesh.faces)
    first = first_equal_row(mesh.vertices)
    merged = int((used & (first != np.arange(len(first)))).sum())
    notes = (f"vertices merged at equal positions (seams): {merged}",) if merged else ()
    mesh = replace(mesh, faces=first[mesh.faces], notes=mesh.notes + notes)
    flat = _flat_faces(mesh)
    keep = ~flat
    repeats = first_equal_row(np.sort(mesh.faces[keep], axis=1)) != np.arange(int(keep.sum()))
    keep[np.flatnonzero(keep)[repeats]] = False
    if not keep.all():
        dropped = (("zero-area", int(flat.sum())), ("duplicate", int(repeats.sum())))
        mesh = replace(
            mesh,
            faces=mesh.faces[keep],
            uv=None if mesh.uv is None else mesh.uv[keep],
            material=None if mesh.material is None else mesh.material[keep],
            notes=mesh.notes + tuple(f"{kind} faces dropped: {count}" for kind, count in dropped if count),
        )
    turned = turned_against_neighbours(mesh.faces)
    if turned.any():
        note = f"faces reversed that were wound against their neighbours: {int(turned.sum())}"
        mesh = replace(
            mesh,
            faces=np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces),
            uv=None if mesh.uv is None else np.where(turned[:, None, None], mesh.uv[:, ::-1], mesh.uv),
            notes=(*mesh.notes, note),
        )
    used = vertex_mask(len(mesh.vertices), mesh.faces)
    if used.all():
        return mesh
    color, unused = mesh.vertex_color_linear, int((~used).sum()) - merged
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=(np.cumsum(used) - 1)[mesh.faces],
        vertex_color_linear=None if color is None else color[used],
        notes=mesh.notes + ((f"unreferenced vertices dropped: {unused}",) if unused > 0 else ()),
    )
