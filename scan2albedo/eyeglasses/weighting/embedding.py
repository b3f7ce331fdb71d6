"""A mesh and its key points in a lattice: every part that can be is connected to a key point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from scan2albedo.core import Plan, PlanStep
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.weighting.lattice import Lattice, join_parts
from scan2albedo.eyeglasses.weighting.voxelization import enclosed_cells, surface_cells, unique_cells
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_components
from scan2albedo.geometry.rays import RayCaster

_REACH = 0.05
"""Gaps up to this part of the size are bridged: between parts, and from key points to the mesh."""
_COINCIDENT = 1e-6
"""Part of the size below which two key points are one."""
_THIN_PART, _SAMPLES = 0.1, 2000
"""Part of the surface that may be thinner than the automatic spacing, and places where that is measured."""
_SKIN = 1e-5
"""Rays start this part of the size off the surface, so that float32 does not find the face itself."""
_OFFSET = 0.3819660112501051
"""Cells between the mesh's lowest corner and a lattice plane (2 - golden ratio): flat sides and regular grids
do not lie on the planes, where rounding would decide which cell they touch."""
_COARSER = 0.92
"""Factor on the number of parts when a lattice is too large."""
_FARTHEST = 2.0**20
"""Cells along an axis: three such numbers still fit in one integer."""
_GIVEN = 10
"""A spacing given by the caller may use this many times `max_nodes`."""


@dataclass(frozen=True)
class WeightOptions:
    """Settings of `solve_weights`."""

    max_nodes: int = 10_000
    """Lattice nodes that the automatic spacing may use; time and memory grow a little faster than they do.
    A given spacing may use ten times as many."""
    finest: float = 1 / 150
    """Least automatic spacing as a part of the size (the diagonal of the key points' box, or the mesh's for a
    single one): a finer lattice changes deformations less than a scan's noise. Key points closer together
    than twice that share a handle."""
    coarsest: float = 1 / 40
    """Greatest automatic spacing as a part of the size."""
    tolerance: float = 1e-7
    """Scaled residual of the optimality conditions at which a handle's weights are done."""


@dataclass(frozen=True)
class Embedding:
    """The lattice of a mesh; `spacing` is in the mesh's unit.

    `handle_cells` (H, 3) are cells of the `lattice`, one a handle. Key points too close together for the
    spacing share a handle: `handle` (K,) is that of each key point, `shares` (V, K) how its weight is
    divided among them. `interpolation` (V, N) takes node values to the vertices. Vertices `follower` (n,)
    take the weights of `leader` (n,): their parts are out of the lattice's reach.
    """

    lattice: Lattice
    handle_cells: IntArray
    handle: IntArray
    shares: FloatArray
    interpolation: sparse.csr_matrix
    spacing: float
    follower: IntArray
    leader: IntArray
    plan: Plan


@dataclass(frozen=True)
class _MarkedMesh:
    """A mesh (V, 3), (F, 3) with named key points (K, 3)."""

    vertices: FloatArray
    faces: IntArray
    handles: FloatArray
    names: Sequence[str]

    @cached_property
    def size(self) -> float:
        """The diagonal of the key points' box, or of the mesh's where there is one key point alone.

        The key points say how large the glasses are; a stray fragment far away does not change it.
        """
        corners = self.vertices[self.faces.ravel()]
        for points in (self.handles, corners):
            size = float(np.linalg.norm(np.ptp(points, axis=0)))
            if size > 0:
                return size
        raise EyeglassesError(f"all {len(corners)} corners of the mesh lie in one point: there is no surface")

    def origin(self, spacing: float) -> FloatArray:
        """Return (3,) where the lattice begins."""
        low = np.minimum(self.vertices[self.faces.ravel()].min(0), self.handles.min(0))
        return np.asarray(low - _OFFSET * spacing)

    def pair(self, a: int, b: int) -> str:
        """Return the names of two key points."""
        return f"{self.names[min(a, b)]} and {self.names[max(a, b)]}"


def embed(
    vertices: FloatArray,
    faces: IntArray,
    handles: FloatArray,
    spacing: str | float,
    options: WeightOptions,
    names: Sequence[str] | None = None,
) -> Embedding:
    """Return the lattice around a mesh (V, 3), (F, 3) and key points (K, 3); raises as `solve_weights`."""
    called = names if names is not None else [str(k) for k in range(len(handles))]
    mesh = _MarkedMesh(vertices, faces, handles, called)
    closest = _closest_spacing(mesh)
    _require_near(mesh)
    if isinstance(spacing, str):
        if spacing != "auto":
            raise ValueError(f'spacing must be "auto" or a number, got {spacing!r}')
        cells, used, step = _automatic(mesh, closest, options)
    else:
        cells, used, step = _given(mesh, float(spacing), options)
    owners, handle, merged = _shared_handles(mesh, used)
    cells = join_parts(unique_cells(np.concatenate([cells, owners])), _REACH * mesh.size / used + 2)
    lattice = Lattice.of_cells(_with_handles(cells, owners))
    local = (vertices - mesh.origin(used)) / used
    follower, leader, left_out = _parts_out_of_reach(lattice, local, faces)
    return Embedding(
        lattice=lattice,
        handle_cells=owners,
        handle=handle,
        shares=_shares(vertices, handles, handle),
        interpolation=lattice.interpolation(local),
        spacing=used,
        follower=follower,
        leader=leader,
        plan=Plan((step, left_out, merged)),
    )


def _nearest_pair(places: FloatArray) -> tuple[int, int, float]:
    """Return the two places of (K, 3) that are nearest to each other along the axes, and how far."""
    apart = squareform(pdist(places, "chebyshev")) if len(places) > 1 else np.zeros((1, 1))
    np.fill_diagonal(apart, np.inf)
    a, b = (int(k) for k in np.unravel_index(int(np.argmin(apart)), apart.shape))
    return a, b, float(apart[a, b])


def _closest_spacing(mesh: _MarkedMesh) -> float:
    """Return the greatest spacing at which no two key points share a node; raises when two coincide."""
    a, b, apart = _nearest_pair(mesh.handles)
    if not apart > _COINCIDENT * mesh.size:
        raise EyeglassesError(
            f"key points {mesh.pair(a, b)} coincide at {np.round(mesh.handles[a], 6).tolist()}; each "
            "needs a place of its own: leave one of them out (null)"
        )
    # Places two spacings apart along one axis lie in cells with another cell between them.
    return apart / 2


def _shared_handles(mesh: _MarkedMesh, spacing: float) -> tuple[IntArray, IntArray, PlanStep]:
    """Return the handles' cells (H, 3), that of each key point (K,), and the step of the plan.

    A handle lies in the middle of its key points. Those whose cells touch become one, the nearest first.
    """
    groups = [[k] for k in range(len(mesh.handles))]
    while True:
        middles = np.array([mesh.handles[group].mean(0) for group in groups])
        cells = np.floor((middles - mesh.origin(spacing)) / spacing).astype(np.int64)
        steps = squareform(pdist(cells.astype(float), "chebyshev")) if len(groups) > 1 else np.zeros((1, 1))
        apart = squareform(pdist(middles)) if len(groups) > 1 else np.zeros((1, 1))
        apart[(steps >= 2) | np.eye(len(groups), dtype=bool)] = np.inf
        a, b = sorted(int(k) for k in np.unravel_index(int(np.argmin(apart)), apart.shape))
        if np.isinf(apart[a, b]):
            break
        groups[a] += groups.pop(b)
    handle = np.zeros(len(mesh.handles), np.int64)
    for number, group in enumerate(groups):
        handle[group] = number
    stage = "eyeglasses.weights.shared_handles"
    shared = [" and ".join(mesh.names[k] for k in sorted(group)) for group in groups if len(group) > 1]
    if not shared:
        return cells, handle, PlanStep(stage, False, "every key point has cells of its own")
    reason = f"closer together than two spacings, one handle divided by distance: {'; '.join(shared)}"
    return cells, handle, PlanStep(stage, True, reason, f"{len(groups)} handles for {len(handle)} key points")


def _shares(vertices: FloatArray, points: FloatArray, handle: IntArray) -> FloatArray:
    """Return (V, K) shares of the key points (K, 3) of a handle in its weight at vertices (V, 3).

    They fall with the square of the distance and sum to 1 over the key points of a handle: each is 1 at its
    own key point, and far away they are equal (Shepard's interpolation).
    """
    shares = np.ones((len(vertices), len(points)))
    for number in np.flatnonzero(np.bincount(handle) > 1):
        group = np.flatnonzero(handle == number)
        square = ((vertices[:, None] - points[group]) ** 2).sum(2)
        nearness = square.min(1, keepdims=True) / np.maximum(square, np.finfo(float).tiny)
        nearness[square == 0] = 1.0
        shares[:, group] = nearness / nearness.sum(1, keepdims=True)
    return shares


def _require_near(mesh: _MarkedMesh) -> None:
    distance = ClosestPointQuery(mesh.vertices, mesh.faces).query(mesh.handles).distance
    far, reach = int(np.argmax(distance)), _REACH * mesh.size
    if not distance[far] <= reach:
        raise EyeglassesError(
            f"key point {mesh.names[far]} at {np.round(mesh.handles[far], 4).tolist()} is "
            f"{distance[far]:.4g} off the mesh; at most {reach:.4g} can be bridged: check its place and unit"
        )


def _thickness(vertices: FloatArray, faces: IntArray) -> float:
    """Return the thickness, in the mesh's unit, that a tenth of the surface's area stays below.

    Measured across the faces at places spread evenly over the area, on the side where the mesh is met
    first: winding does not matter, and a narrow gap counts like a thin part. Infinite where nothing is met.
    """
    area = np.cumsum(face_areas(vertices, faces))
    if not area[-1] > 0:
        return math.inf
    chosen = np.searchsorted(area, (np.arange(_SAMPLES) + 0.5) / _SAMPLES * area[-1])
    caster = RayCaster(vertices, faces)
    center, normal = vertices[faces[chosen]].mean(1), face_normals(vertices, faces[chosen])
    skin = _SKIN * caster.size
    sides = [caster.first_hit(center + skin * way, way).distance + skin for way in (normal, -normal)]
    return float(np.quantile(np.minimum(*sides), _THIN_PART, method="lower"))


def _cells(mesh: _MarkedMesh, spacing: float, limit: int) -> IntArray | None:
    """Return the cells the mesh touches or encloses, None where they have more than about `limit` nodes."""
    local = (mesh.vertices - mesh.origin(spacing)) / spacing
    longest = local[mesh.faces.ravel()].max()
    if longest > _FARTHEST:
        raise EyeglassesError(f"the mesh is {longest:.3g} lattice spacings long: remove what lies far away")
    cells = surface_cells(local[mesh.faces], limit)
    if cells is None:
        return None
    parts = Lattice.of_cells(cells).cell_components
    order = np.argsort(parts, kind="stable")
    pieces = np.split(cells[order], np.flatnonzero(np.diff(parts[order])) + 1)
    inside = [enclosed_cells(piece) for piece in pieces if len(piece) >= 26]
    cells = unique_cells(np.concatenate([cells, *inside]))
    return cells if len(Lattice.of_cells(cells).nodes) <= limit else None


def _given(mesh: _MarkedMesh, spacing: float, options: WeightOptions) -> tuple[IntArray, float, PlanStep]:
    if not (spacing > 0 and np.isfinite(spacing)):
        raise ValueError(f"spacing must be > 0, got {spacing}")
    limit = _GIVEN * options.max_nodes
    cells = _cells(mesh, spacing, limit)
    if cells is None:
        raise EyeglassesError(
            f"a spacing of {spacing:.4g} makes more than {limit} lattice nodes; give a larger one, or raise "
            "options.max_nodes"
        )
    return cells, spacing, PlanStep("eyeglasses.weights.spacing", False, "given", f"{spacing:.6g}")


def _automatic(mesh: _MarkedMesh, closest: float, options: WeightOptions) -> tuple[IntArray, float, PlanStep]:
    """Return cells as fine as thin parts and key points ask for, as coarse as the nodes allow.

    The size is divided into a whole number of parts: rounding in another unit does not change the lattice.
    """
    thin = _thickness(mesh.vertices, mesh.faces)
    spacing = float(np.clip(thin, options.finest * mesh.size, options.coarsest * mesh.size))
    reason = f"the mesh's thin parts measure {thin:.4g}"
    if closest < spacing:
        spacing, reason = max(closest, options.finest * mesh.size), "two key points are close together"
    parts = math.ceil(mesh.size / spacing * (1 - 1e-9))
    while (cells := _cells(mesh, mesh.size / parts, options.max_nodes)) is None:
        if parts <= 2:
            raise EyeglassesError(
                f"no lattice of {options.max_nodes} nodes holds the mesh: it is far larger than the box of "
                f"its key points ({mesh.size:.4g}); remove what lies far away, or raise options.max_nodes"
            )
        parts, reason = max(int(_COARSER * parts), 2), f"finer ones have more than {options.max_nodes} nodes"
    spacing = mesh.size / parts
    return cells, spacing, PlanStep("eyeglasses.weights.spacing", True, reason, f"{spacing:.6g}")


def _with_handles(cells: IntArray, owners: IntArray) -> IntArray:
    """Return the cells of the parts that hold a key point."""
    lattice = Lattice.of_cells(cells)
    parts = lattice.cell_components
    return cells[np.isin(parts, parts[lattice.find(owners)])]


def _parts_out_of_reach(
    lattice: Lattice, local: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray, PlanStep]:
    """Return followers, leaders (each part's vertex nearest to the lattice) and the step of the plan."""
    used = np.zeros(len(local), bool)
    used[faces.ravel()] = True
    outside = np.flatnonzero(used & (lattice.find(np.floor(local).astype(np.int64)) < 0))
    stage = "eyeglasses.weights.rigid_parts"
    if len(outside) == 0:
        return outside, outside, PlanStep(stage, False, "every part is in reach of a key point")
    distance = cKDTree(lattice.cells + 0.5).query(local[outside])[0]
    part = vertex_components(len(local), faces)[outside]
    by_distance = np.lexsort((distance, part))
    labels, first = np.unique(part[by_distance], return_index=True)
    leader = outside[by_distance[first]][np.searchsorted(labels, part)]
    evidence = f"{len(labels)} parts, {len(outside)} vertices"
    return outside, leader, PlanStep(stage, True, "parts out of reach of every key point", evidence)
