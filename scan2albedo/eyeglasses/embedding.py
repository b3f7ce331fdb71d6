"""A mesh and its key points in a lattice: every part that can be is connected to a key point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from scan2albedo.core import Plan, PlanStep
from scan2albedo.core.arrays import SMALLEST, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lattice import Lattice, enclosed_cells, join_parts, surface_cells, unique_cells
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_components
from scan2albedo.geometry.rays import RayCaster

MAX_NODES = 10_000
"""Lattice nodes that the automatic spacing may use."""
_REACH = 0.05
"""Gaps up to this part of the size, the diagonal of the key points' box, are bridged, also to key points."""
_THIN_PART = 0.1
"""Part of the surface that may be thinner than the automatic spacing."""
_SKIN = 1e-5
"""Rays start this part of the size off the surface, so that float32 does not find the face itself."""


@dataclass(frozen=True)
class Embedding:
    """The lattice of a mesh; `spacing` is in the mesh's unit, `interpolation` (V, N) goes from the nodes.

    `handle_cells` (H, 3) are cells of the `lattice`, one a handle, `handle` (K,) is that of each key point,
    `shares` (V, K) how its weight is divided among several. Vertices `follower` (n,), out of the lattice's
    reach, take the weights of `leader` (n,).
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


def embed(
    vertices: FloatArray,
    faces: IntArray,
    handles: FloatArray,
    spacing: str | float,
    *,
    max_nodes: int = MAX_NODES,
    names: Sequence[str] | None = None,
) -> Embedding:
    """Return the lattice around a mesh (V, 3), (F, 3) and key points (K, 3); raises as `solve_weights`."""
    called = names or [str(k) for k in range(len(handles))]
    corners = vertices[faces.ravel()]
    # Of the key points: a stray fragment far away does not change how large the glasses are.
    size = float(np.linalg.norm(np.ptp(handles, axis=0)) or np.linalg.norm(np.ptp(corners, axis=0)))
    if not size > 0:
        raise EyeglassesError(f"all {len(corners)} corners of the mesh lie in one point: there is no surface")
    apart = _distances(handles, "chebyshev")
    a, b = _nearest(apart)
    if not apart[a, b] > 0:
        said = f"key points {called[a]} and {called[b]} coincide at {np.round(handles[a], 6).tolist()}"
        raise EyeglassesError(f"{said}; each needs a place of its own: leave one of them out (null)")
    distance = ClosestPointQuery(vertices, faces).query(handles).distance
    far = int(np.argmax(distance))
    if not distance[far] <= _REACH * size:
        said = f"key point {called[far]} at {np.round(handles[far], 4).tolist()} is {distance[far]:.4g} off"
        most = f"at most {_REACH * size:.4g} can be bridged"
        raise EyeglassesError(f"{said} the mesh; {most}: check its place and unit")
    low = np.minimum(corners.min(0), handles.min(0))
    if isinstance(spacing, str):
        if spacing != "auto":
            raise ValueError(f'spacing must be "auto" or a number, got {spacing!r}')
        # Places two spacings apart along one axis lie in cells with another cell between them.
        used, touched, reason = _automatic_spacing(vertices, faces, low, size, apart[a, b] / 2, max_nodes)
    else:
        used, reason = float(spacing), "given"
        if not (used > 0 and np.isfinite(used)):
            raise ValueError(f"spacing must be > 0, got {used}")
        limit = 10 * max_nodes
        found = _cells(vertices, faces, low, used, limit)
        if found is None:
            said = f"a spacing of {used:.4g} makes more than {limit} lattice nodes"
            raise EyeglassesError(f"{said}; give a larger one, or raise max_nodes")
        touched = found
    step = PlanStep("eyeglasses.weights.spacing", reason != "given", reason, f"{used:.6g}")
    origin = _origin(low, used)
    # A handle lies in the middle of its key points; those whose cells touch become one, the nearest first.
    placed, groups = (handles - origin) / used, [[k] for k in range(len(handles))]
    while True:
        middles = np.array([placed[group].mean(0) for group in groups])
        owners = np.floor(middles).astype(int)
        touch = _distances(owners.astype(float), "chebyshev") < 2
        apart = np.where(touch, _distances(middles, "euclidean"), np.inf)
        a, b = _nearest(apart)
        if np.isinf(apart[a, b]):
            break
        groups[a] += groups.pop(b)
    stage = "eyeglasses.weights.shared_handles"
    merged = PlanStep(stage, False, "every key point has cells of its own")
    if shared := [" and ".join(called[k] for k in sorted(group)) for group in groups if len(group) > 1]:
        reason = f"closer together than two spacings, one handle divided by distance: {'; '.join(shared)}"
        merged = PlanStep(stage, True, reason, f"{len(groups)} handles for {len(handles)} key points")
    cells = join_parts(unique_cells(np.concatenate([touched, owners])), _REACH * size / used + 2)
    whole = Lattice.of_cells(cells)
    parts = whole.cell_components
    lattice = Lattice.of_cells(cells[np.isin(parts, parts[whole.find(owners)])])
    local = (vertices - origin) / used
    # Vertices of parts out of reach follow that of their part which is nearest to the lattice.
    corner = np.unique(faces)
    follower = corner[lattice.find(np.floor(local[corner]).astype(int)) < 0]
    leader, stage = follower, "eyeglasses.weights.rigid_parts"
    left_out = PlanStep(stage, False, "every part is in reach of a key point")
    if len(follower):
        distance = cKDTree(lattice.cells + 0.5).query(local[follower])[0]
        part = vertex_components(len(local), faces)[follower]
        by_distance = np.lexsort((distance, part))
        labels, first = np.unique(part[by_distance], return_index=True)
        leader = follower[by_distance[first]][np.searchsorted(labels, part)]
        evidence = f"{len(labels)} parts, {len(follower)} vertices"
        left_out = PlanStep(stage, True, "parts out of reach of every key point", evidence)
    handle, shares = _divided_handles(vertices, handles, groups)
    plan = Plan((step, left_out, merged))
    interpolation = lattice.interpolation(local)
    return Embedding(lattice, owners, handle, shares, interpolation, used, follower, leader, plan)


def _automatic_spacing(
    vertices: FloatArray, faces: IntArray, low: FloatArray, size: float, closest: float, max_nodes: int
) -> tuple[float, IntArray, str]:
    """Return the spacing that thin parts ask for, at least `closest` and within `max_nodes`; cells; why."""
    # The thickness that a tenth of 2,000 places, even in area, stay below; infinite where nothing is met.
    thin, area = math.inf, np.cumsum(face_areas(vertices, faces))
    if area[-1] > 0:
        chosen = np.searchsorted(area, (np.arange(2000) + 0.5) / 2000 * area[-1])
        caster = RayCaster(vertices, faces)
        center, normal = vertices[faces[chosen]].mean(1), face_normals(vertices, faces[chosen])
        skin = _SKIN * caster.size
        sides = [caster.first_hit(center + skin * way, way).distance + skin for way in (normal, -normal)]
        thin = float(np.quantile(np.minimum(*sides), _THIN_PART, method="lower"))
    wanted = np.clip(thin, size / 150, size / 40)
    reason = f"the mesh's thin parts measure {thin:.4g}"
    if closest < wanted:
        wanted, reason = max(closest, size / 150), "two key points are close together"
    count = math.ceil(size / wanted * (1 - 1e-9))
    while (touched := _cells(vertices, faces, low, size / count, max_nodes)) is None:
        if count <= 2:
            raise EyeglassesError(
                f"no lattice of {max_nodes} nodes holds the mesh: it is far larger than the box of its "
                f"key points ({size:.4g}); remove what lies far away, or raise max_nodes"
            )
        # About a twelfth coarser each time.
        count, reason = max(23 * count // 25, 2), f"finer ones have more than {max_nodes} nodes"
    return size / count, touched, reason


def _divided_handles(
    vertices: FloatArray, handles: FloatArray, groups: Sequence[Sequence[int]]
) -> tuple[IntArray, FloatArray]:
    """Return the handle (K,) of each key point, and its share (V, K) in the weight of a handle.

    Shares fall with the square of the distance (Shepard's interpolation): each is 1 at its own key point, and
    far away they are equal.
    """
    handle, shares = np.zeros(len(handles), int), np.empty((len(vertices), len(handles)))
    for number, group in enumerate(map(sorted, groups)):
        handle[group] = number
        square = ((vertices[:, None] - handles[group]) ** 2).sum(2)
        nearness = square.min(1, keepdims=True) / np.maximum(square, SMALLEST)
        nearness[square == 0] = 1.0
        shares[:, group] = nearness / nearness.sum(1, keepdims=True)
    return handle, shares


def _nearest(apart: FloatArray) -> list[int]:
    """Return the two, in order, that are the least `apart` (N, N)."""
    return sorted(int(k) for k in np.unravel_index(np.argmin(apart), apart.shape))


def _distances(places: FloatArray, metric: str) -> FloatArray:
    apart = squareform(pdist(places, metric))
    np.fill_diagonal(apart, np.inf)
    return apart


def _origin(low: FloatArray, spacing: float) -> FloatArray:
    """Return the corner (3,) of the lattice around what begins at `low` (3,)."""
    # 2 - golden ratio cells lie between: on the lattice's planes rounding would decide about flat sides.
    return low - (3 - np.sqrt(5)) / 2 * spacing


def _cells(
    vertices: FloatArray, faces: IntArray, low: FloatArray, spacing: float, limit: int
) -> IntArray | None:
    """Return the cells the mesh touches or encloses, None where they have more than about `limit` nodes."""
    local = (vertices - _origin(low, spacing)) / spacing
    longest = local[faces.ravel()].max()
    # Three such numbers still fit in one integer.
    if longest > 2**20:
        raise EyeglassesError(f"the mesh is {longest:.3g} lattice spacings long: remove what lies far away")
    cells = surface_cells(local[faces], limit)
    if cells is None:
        return None
    parts = Lattice.of_cells(cells).cell_components
    order = np.argsort(parts, kind="stable")
    pieces = np.split(cells[order], np.flatnonzero(np.diff(parts[order])) + 1)
    # Fewer than 26 cells enclose none.
    inside = [enclosed_cells(piece) for piece in pieces if len(piece) >= 26]
    cells = unique_cells(np.concatenate([cells, *inside]))
    return cells if len(Lattice.of_cells(cells).nodes) <= limit else None
