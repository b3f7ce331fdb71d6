"""A mesh and its key points in a lattice: every part that can be is connected to a key point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from scan2albedo.core import Plan, PlanStep
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.weighting.lattice import Lattice, join_parts
from scan2albedo.eyeglasses.weighting.voxelization import enclosed_cells, surface_cells, unique_cells
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import face_areas, face_normals, vertex_components
from scan2albedo.geometry.rays import RayCaster

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class WeightOptions:
    """Settings of `solve_weights`."""

    max_nodes: int = 10_000
    """Lattice nodes that the automatic spacing may use; time and memory grow a little faster than they do.
    A given spacing may use ten times as many."""
    finest: float = 1 / 150
    """Least automatic spacing as a part of the size (the diagonal of the key points' box, or the mesh's for a
    single one): a finer lattice changes deformations less than a scan's noise."""
    coarsest: float = 1 / 40
    """Greatest automatic spacing as a part of the size."""
    thin_part: float = 0.1
    """Part of the surface that may be thinner than the automatic spacing."""
    reach: float = 0.05
    """Gaps up to this part of the size are bridged: between parts, and from key points to the mesh."""
    tolerance: float = 1e-7
    """Scaled residual of the optimality conditions at which a handle's weights are done."""
    max_steps: int = 60
    """Newton steps a handle on one lattice."""
    coarse_nodes: int = 1500
    """Lattices of more nodes start from the weights of a lattice of twice the spacing."""


_COINCIDENT = 1e-6
"""Part of the size below which two key points are one."""


def closest_spacing(handles: FloatArray, size: float, names: Sequence[str]) -> float:
    """Return the spacing at which no two of the (K, 3) key points, called `names`, share a node.

    Raises EyeglassesError when two coincide.
    """
    if len(handles) < 2:
        return np.inf
    apart = squareform(pdist(handles, "chebyshev"))
    np.fill_diagonal(apart, np.inf)
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    if not apart[a, b] > _COINCIDENT * size:
        raise EyeglassesError(
            f"key points {_pair(names, a, b)} coincide at {np.round(handles[a], 6).tolist()}; each "
            "needs a place of its own: leave one of them out"
        )
    # Places two spacings apart along one axis lie in cells with another cell between them.
    return float(apart[a, b]) / 2


def cells_of_handles(local: FloatArray, spacing: float, names: Sequence[str]) -> IntArray:
    """Return (K, 3) the cells of key points `local` (K, 3), given in units of the spacing.

    Raises EyeglassesError when two share a node.
    """
    cells = np.floor(local).astype(np.int64)
    steps = squareform(pdist(cells.astype(float), "chebyshev")) if len(cells) > 1 else np.full((1, 1), np.inf)
    np.fill_diagonal(steps, np.inf)
    a, b = np.unravel_index(int(np.argmin(steps)), steps.shape)
    if steps[a, b] < 2:
        apart = spacing * float(np.abs(local[a] - local[b]).max())
        raise EyeglassesError(
            f"key points {_pair(names, a, b)} are {apart:.4g} apart along the axes, too close for a lattice "
            f"of spacing {spacing:.4g}; give a spacing of {apart / 2:.4g} or less, or raise max_nodes"
        )
    return cells


def _pair(names: Sequence[str], a: np.intp, b: np.intp) -> str:
    return f"{names[int(min(a, b))]} and {names[int(max(a, b))]}"


_SAMPLES = 2000
_SKIN = 1e-5
"""Rays start this part of the size off the surface, so that float32 does not find the face itself."""


def thickness(vertices: FloatArray, faces: IntArray, part: float) -> float:
    """Return the thickness, in the mesh's unit, that `part` of the surface's area stays below.

    Measured across the faces at 2,000 places spread evenly over the area, on the side where the mesh is met
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
    return float(np.quantile(np.minimum(*sides), part, method="lower"))


def spacing_wanted(
    vertices: FloatArray, faces: IntArray, size: float, closest: float, options: WeightOptions
) -> tuple[int, str]:
    """Return into how many parts the size of the mesh is to be divided, and why.

    `closest` is the greatest spacing at which no two key points share a node, in the mesh's unit. Parts are
    a whole number, so that rounding in another unit does not change the lattice.
    """
    thin = thickness(vertices, faces, options.thin_part)
    spacing = float(np.clip(thin, options.finest * size, options.coarsest * size))
    reason = f"the mesh's thin parts measure {thin:.4g}"
    if closest < spacing:
        spacing, reason = closest, "two key points are close together"
    return math.ceil(size / spacing * (1 - 1e-9)), reason


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
class Embedding:
    """The lattice of a mesh.

    `handle_cells` (K, 3) are cells of the `lattice`; `interpolation` (V, N) takes node values to the
    vertices; `spacing` is in the mesh's unit. Vertices `follower` (n,) are to take the weights of the
    vertices `leader` (n,): their parts are out of reach of the lattice.
    """

    lattice: Lattice
    handle_cells: IntArray
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
    options: WeightOptions,
    names: Sequence[str] | None = None,
) -> Embedding:
    """Return the lattice around a mesh (V, 3), (F, 3) and its key points (K, 3).

    Messages call the key points by their `names` (K,), or by number. Raises what `solve_weights` does.
    """
    called = names if names is not None else [str(k) for k in range(len(handles))]
    size = _size(vertices[faces.ravel()], handles)
    closest = closest_spacing(handles, size, called)
    _require_near(vertices, faces, handles, options.reach * size, called)
    if isinstance(spacing, str):
        if spacing != "auto":
            raise ValueError(f'spacing must be "auto" or a number, got {spacing!r}')
        cells, used, step = _automatic(vertices, faces, handles, size, closest, options)
    else:
        cells, used, step = _given(vertices, faces, handles, float(spacing), options)
    origin = _origin(vertices, faces, handles, used)
    owners = cells_of_handles((handles - origin) / used, used, called)
    cells = unique_cells(np.concatenate([cells, owners]))
    lattice = Lattice.of_cells(_with_handles(join_parts(cells, options.reach * size / used + 2), owners))
    local = (vertices - origin) / used
    follower, leader, left_out = _parts_out_of_reach(lattice, local, faces)
    return Embedding(
        lattice, owners, lattice.interpolation(local), used, follower, leader, Plan((step, left_out))
    )


def _size(points: FloatArray, handles: FloatArray) -> float:
    """Return the diagonal of the key points' box, or of the mesh's where there is one key point alone.

    The key points say how large the glasses are; a stray fragment far away does not change it.
    """
    for candidate in (handles, points):
        size = float(np.linalg.norm(np.ptp(candidate, axis=0)))
        if size > 0:
            return size
    raise EyeglassesError(f"all {len(points)} corners of the mesh lie in one point: there is no surface")


def _require_near(
    vertices: FloatArray, faces: IntArray, handles: FloatArray, reach: float, names: Sequence[str]
) -> None:
    distance = ClosestPointQuery(vertices, faces).query(handles).distance
    far = int(np.argmax(distance))
    if not distance[far] <= reach:
        raise EyeglassesError(
            f"key point {names[far]} at {np.round(handles[far], 4).tolist()} is {distance[far]:.4g} off the "
            f"mesh; at most {reach:.4g} can be bridged: check its place and its unit, or raise options.reach"
        )


def _origin(vertices: FloatArray, faces: IntArray, handles: FloatArray, spacing: float) -> FloatArray:
    low = np.minimum(vertices[faces.ravel()].min(0), handles.min(0))
    origin: FloatArray = low - _OFFSET * spacing
    return origin


def _cells(
    vertices: FloatArray, faces: IntArray, handles: FloatArray, spacing: float, limit: int
) -> IntArray | None:
    """Return the cells the mesh touches or encloses, None where they have more than about `limit` nodes."""
    local = (vertices - _origin(vertices, faces, handles, spacing)) / spacing
    if local[faces.ravel()].max() > _FARTHEST:
        raise EyeglassesError(
            f"the mesh is {local[faces.ravel()].max():.3g} lattice spacings long: remove what lies far away"
        )
    cells = surface_cells(local[faces], limit)
    if cells is None:
        return None
    parts = Lattice.of_cells(cells).cell_components
    order = np.argsort(parts, kind="stable")
    pieces = np.split(cells[order], np.flatnonzero(np.diff(parts[order])) + 1)
    inside = [enclosed_cells(piece) for piece in pieces if len(piece) >= 26]
    cells = unique_cells(np.concatenate([cells, *inside]))
    return cells if len(Lattice.of_cells(cells).nodes) <= limit else None


def _given(
    vertices: FloatArray, faces: IntArray, handles: FloatArray, spacing: float, options: WeightOptions
) -> tuple[IntArray, float, PlanStep]:
    if not (spacing > 0 and np.isfinite(spacing)):
        raise ValueError(f"spacing must be > 0, got {spacing}")
    limit = _GIVEN * options.max_nodes
    cells = _cells(vertices, faces, handles, spacing, limit)
    if cells is None:
        raise EyeglassesError(
            f"a spacing of {spacing:.4g} makes more than {limit} lattice nodes; give a larger one, or raise "
            "options.max_nodes"
        )
    return cells, spacing, PlanStep("eyeglasses.weights.spacing", False, "given", f"{spacing:.6g}")


def _automatic(
    vertices: FloatArray,
    faces: IntArray,
    handles: FloatArray,
    size: float,
    closest: float,
    options: WeightOptions,
) -> tuple[IntArray, float, PlanStep]:
    parts, reason = spacing_wanted(vertices, faces, size, closest, options)
    while True:
        cells = _cells(vertices, faces, handles, size / parts, options.max_nodes)
        if cells is not None:
            break
        if parts <= 2:
            raise EyeglassesError(
                f"no lattice of {options.max_nodes} nodes holds the mesh: it is far larger than the box of "
                f"its key points ({size:.4g}); remove what lies far away, or raise options.max_nodes"
            )
        parts, reason = max(int(_COARSER * parts), 2), f"finer ones have more than {options.max_nodes} nodes"
    spacing = size / parts
    return cells, spacing, PlanStep("eyeglasses.weights.spacing", True, reason, f"{spacing:.6g}")


def _with_handles(cells: IntArray, owners: IntArray) -> IntArray:
    """Return the cells of the parts that hold a key point."""
    lattice = Lattice.of_cells(cells)
    parts = lattice.cell_components
    return cells[np.isin(parts, parts[lattice.find(owners)])]


def _parts_out_of_reach(
    lattice: Lattice, local: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray, PlanStep]:
    """Return the followers, their leaders and the plan's word on them.

    The parts of what is left out are those of the faces: each follows its vertex nearest to the lattice.
    """
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
