"""The surface of anyone's face template: unit, seams, main part, which side is out; and as a disc."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, Texts, checked_mesh, norms
from scan2albedo.core.compiled import compiled
from scan2albedo.errors import ModelError, errors_of
from scan2albedo.geometry import mesh as meshes
from scan2albedo.geometry.mesh import boundary_loops, edges_with_faces, face_cross_products, face_edges
from scan2albedo.geometry.parametrization import boundary_loop
from scan2albedo.geometry.rigid import compose
from scan2albedo.io.repair import first_equal_row

MIN_VERTICES = 100
"""A template with fewer vertices is refused."""
MENDABLE_SHARE = 0.02
"""A template that is a surface only without more of its faces is refused."""
HEAD_SIZE_MM = (80.0, 600.0)
_BACK_OF_HEAD = 0.35
UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}


@dataclass(frozen=True)
class TemplateSurface:
    """The largest part of a template, welded and oriented; still with its holes, and in any pose.

    `vertices` (T, 3) are all the template's, in mm, origin at the centroid of those in the manifold `faces`
    (F, 3). `template_from_surface` (4, 4) leads back to the input's unit; `notes` say what was mended.
    """

    vertices: FloatArray
    faces: IntArray
    template_from_surface: FloatArray
    notes: Texts = ()

    def turned(self, rotation: FloatArray) -> Self:
        """Return the surface turned by a (3, 3) rotation about its origin."""
        back = self.template_from_surface @ compose(rotation.T, np.zeros(3))
        return replace(self, vertices=self.vertices @ rotation.T, template_from_surface=back)


def template_surface(vertices: FloatArray, faces: IntArray, name: str) -> TemplateSurface:
    """Decide the unit, join seams, keep the largest part and turn its faces outward.

    Raises `ModelError` for vertices (T, 3) that are no head in any unit, are not finite or too few, bad
    indices, or a surface that is not manifold even when a few faces are dropped, or cannot be oriented.
    """
    points, index = checked_mesh(vertices, faces, name, ModelError)
    if len(index) == 0:
        raise ModelError(f"{name}: a template needs faces, a point cloud is not enough; mesh its points")
    used = np.unique(index)
    if len(used) < MIN_VERTICES:
        raise ModelError(f"{name}: only {len(used)} vertices in faces, at least {MIN_VERTICES} needed")
    low, high = np.percentile(points[used], [0.5, 99.5], axis=0)
    size = float(np.max(high - low))
    least, most = HEAD_SIZE_MM
    unit = next((unit for unit, factor in UNITS_MM.items() if least <= size * factor <= most), None)
    if unit is None:
        raise ModelError(
            f"{name}: the template is {size:.4g} units large, which is not a head in mm, cm, m or um "
            f"({least:.0f} to {most:.0f} mm); scale it to millimetres"
        )
    origin = points[used].mean(0)
    xyz = (points - origin) * UNITS_MM[unit]
    # Vertices at equal positions (UV seams) are joined, unless that makes an edge with three faces.
    step = 1e-7 * float(np.max(np.ptp(xyz, axis=0)))
    welded = _proper(xyz, first_equal_row(np.round(xyz / step))[index])
    if len(welded) == 0 or int(edges_with_faces(welded)[1].max()) > 2:
        welded = _proper(xyz, index)
    if len(welded) == 0:
        raise ModelError(f"{name}: every face has zero area; it holds no surface: export it again")
    part = largest_component(len(xyz), welded)
    mesh, dropped = _manifold(part, name)
    far = len(used) - len(np.unique(index[~meshes.far_faces(xyz, index)]))
    found = (
        (far, "vertices far from the rest, which bend the surface: remove them"),
        (len(welded) - len(part), "faces of loose parts, which follow the nearest surface"),
        (dropped, "faces dropped at edges with three faces and at pinched points"),
    )
    corner = xyz[mesh[:, 0]] - xyz[np.unique(mesh)].mean(0)
    if float(np.sum(face_cross_products(xyz, mesh) * corner)) < 0:
        mesh = mesh[:, ::-1].copy()
    notes = (f"unit {unit}", *(f"{text}: {count}" for count, text in found if count))
    return TemplateSurface(xyz, mesh, compose(np.eye(3) / UNITS_MM[unit], origin), notes)


def _proper(xyz: FloatArray, faces: IntArray) -> IntArray:
    """Drop faces with a repeated corner, no area, or the same corners as an earlier face."""
    area = norms(face_cross_products(xyz, faces))
    good = faces[area > 1e-14 * area.max()]
    return good[first_equal_row(np.sort(good, axis=1)) == np.arange(len(good))]


def largest_component(vertex_count: int, faces: IntArray) -> IntArray:
    """Return the faces of the connected part that has the most."""
    label = meshes.vertex_components(vertex_count, faces)[faces[:, 0]]
    return faces[label == np.bincount(label).argmax()]


def _manifold(faces: IntArray, name: str) -> tuple[IntArray, int]:
    """Return consistently oriented faces of a surface, and how many had to be dropped for it."""
    import igl

    kept = faces
    while True:
        edges, uses = edges_with_faces(kept)
        if uses.max() > 2:
            # At an edge of more than two faces those with a free edge go, or all.
            size = int(kept.max()) + 1
            keys = np.sort(face_edges(kept), axis=2) @ [size, 1]
            key = edges @ [size, 1]
            at_knot = np.isin(keys, key[uses > 2]).any(1)
            loose = at_knot & np.isin(keys, key[uses == 1]).any(1)
            spoilt = loose if loose.any() else at_knot
        else:
            # Those around pinched points; vertices without a face count as such, but no face is at them.
            spoilt = np.isin(kept, np.flatnonzero(~igl.is_vertex_manifold(kept))).any(1)
        if not spoilt.any():
            break
        kept = kept[~spoilt]
        if len(faces) - len(kept) > max(MENDABLE_SHARE * len(faces), 1):
            raise ModelError(
                f"{name}: more than {MENDABLE_SHARE:.0%} of the faces lie at edges with more than two "
                "faces, or where surfaces touch at a point; remove inner and doubled faces"
            )
    if len(kept) < len(faces):
        kept = largest_component(int(faces.max()) + 1, kept)
    oriented = np.asarray(igl.bfs_orient(kept)[0], int)
    if meshes.neighbouring_faces(oriented)[2].any():
        raise ModelError(f"{name}: the surface cannot be oriented (it is one-sided); use an orientable mesh")
    return oriented, len(faces) - len(kept)


def clean_template(surface: TemplateSurface, name: str) -> tuple[TemplateSurface, BoolArray]:
    """Cut a closed head in the model's axes open at the back, fill the holes, and check that it is a disc.

    Also return which of its faces (F,) close holes. Raises `ModelError` when the surface has handles, or
    holes too long to fill.
    """
    xyz, mesh = surface.vertices, surface.faces
    if not len(boundary_loops(mesh)):
        depth = xyz[:, 2]
        low, high = depth[mesh].min(), depth[mesh].max()
        mesh = largest_component(len(xyz), mesh[(depth[mesh] > low + _BACK_OF_HEAD * (high - low)).all(1)])
    # Every boundary loop is closed but the one with the greatest length in mm.
    loops = [loop for loop in boundary_loops(mesh) if len(loop) >= 3]
    length = [float(norms(xyz[loop] - xyz[np.roll(loop, 1)]).sum()) for loop in loops]
    rim = int(np.argmax(length)) if loops else -1
    holes = [loop for i, loop in enumerate(loops) if i != rim and len(loop) <= 600]
    closed = np.concatenate([mesh, *(fill_hole(xyz, mesh, loop) for loop in holes)])
    filled = np.arange(len(closed)) >= len(mesh)
    used, index = meshes.without_unreferenced(xyz, closed)
    advice = "close handles or cut the face out of the head"
    with errors_of(f"{name}, its holes filled", ModelError, advice=advice):
        boundary_loop(len(used), index)
    cut = len(surface.faces) - len(mesh)
    done = {"faces cut off the back of a closed surface": cut, "holes filled": len(holes)}
    notes = (*surface.notes, *(f"{text}: {count}" for text, count in done.items() if count))
    return replace(surface, faces=closed, notes=notes), filled


def fill_hole(vertices: FloatArray, faces: IntArray, loop: IntArray) -> IntArray:
    """Return the (n - 2, 3) faces of least total area that close a loop (n,) of `boundary_loops`.

    The new faces run against the loop; the mesh's own edges are no chords. Dynamic programming (Barequet and
    Sharir, "Filling gaps in the boundary of a polyhedron", 1995), O(n^3): 500 vertices take a second.
    """
    ring = np.ascontiguousarray(loop[::-1])
    # Where the mesh has an edge between two vertices of the loop.
    place = np.full(len(vertices), -1)
    place[ring] = np.arange(len(ring))
    ends = place[face_edges(faces).reshape(-1, 2)]
    ends = ends[(ends >= 0).all(1)]
    joined = np.zeros((len(ring), len(ring)), bool)
    joined[ends[:, 0], ends[:, 1]] = joined[ends[:, 1], ends[:, 0]] = True
    split = _least_area_splits(np.ascontiguousarray(vertices[ring]), joined)
    patch, pending = [], [(0, len(ring) - 1)]
    while pending:
        i, k = pending.pop()
        if k - i < 2:
            continue
        j = int(split[i, k])
        patch.append((ring[i], ring[j], ring[k]))
        pending += [(i, j), (j, k)]
    return np.array(patch, int).reshape(-1, 3)


@compiled
def _least_area_splits(points, joined):  # type: ignore[no-untyped-def]
    n = len(points)
    # More than any triangulation's area, so that a chord already in the mesh is the last resort.
    forbidden = n * np.sum((points - points[0]) ** 2)
    cost = np.zeros((n, n))
    split = np.zeros((n, n), np.int64)
    for span in range(2, n):
        for i in range(n - span):
            k = i + span
            best = np.inf
            for j in range(i + 1, k):
                area = 0.5 * np.linalg.norm(np.cross(points[j] - points[i], points[k] - points[i]))
                total = cost[i, j] + cost[j, k] + area
                if total < best:
                    best = total
                    split[i, k] = j
            cost[i, k] = best + (forbidden if joined[i, k] and span < n - 1 else 0.0)
    return split
