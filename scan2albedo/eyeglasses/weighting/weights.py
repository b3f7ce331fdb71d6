"""Bounded biharmonic weights of key points on any triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from scan2albedo.core import Budget, Meter, Plan, ProgressCallback, Trace
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.checks import checked_mesh, checked_points
from scan2albedo.eyeglasses.weighting.bounded_quadratic import minimize_bounded
from scan2albedo.eyeglasses.weighting.embedding import Embedding, WeightOptions, embed
from scan2albedo.eyeglasses.weighting.lattice import Lattice, biharmonic_energy
from scan2albedo.eyeglasses.weighting.sparse_cholesky import SparseCholesky
from scan2albedo.eyeglasses.weighting.voxelization import unique_cells

_COARSE_NODES = 1500
"""Lattices of more nodes start from the weights of a lattice of twice the spacing."""
_MAX_STEPS = 60
"""Newton steps a handle on one lattice."""
_ROUGH = 1e-4
"""Scaled residual at which a coarser lattice's weights are good enough to start from."""
STAGE, UNIT = "eyeglasses.weights", "scaled KKT residual"
_VANISHED = 1e-6
"""Sum of the weights below which no key point holds a node: dividing by it would amplify rounding."""


@dataclass(frozen=True)
class LatticeWeights:
    """`weights` (N, K) in [0, 1], not normalised; `residual`, `energy`, `steps` (K,) of each handle."""

    weights: FloatArray
    residual: FloatArray
    energy: FloatArray
    steps: IntArray


def solve_lattice(
    lattice: Lattice, handle_cells: IntArray, options: WeightOptions, meter: Meter
) -> LatticeWeights:
    """Return the weights of the handles that hold the cells `handle_cells` (K, 3) of `lattice`.

    The start comes from the lattice of twice the spacing: it carries the set of nodes at 0 or 1, which
    Newton steps from the unbounded solution move by a few nodes at a time only.
    """
    if len(lattice.nodes) > _COARSE_NODES:
        coarse = Lattice.of_cells(unique_cells(lattice.cells // 2))
        if len(coarse.nodes) < len(lattice.nodes):
            rough = replace(options, tolerance=max(options.tolerance, _ROUGH))
            above = meter.sub_meter(meter.stage, meter.unit)
            solved = solve_lattice(coarse, handle_cells // 2, rough, above)
            meter.merge(above)
            return _solve(
                lattice,
                handle_cells,
                coarse.interpolation(lattice.nodes / 2) @ solved.weights,
                options,
                meter,
            )
    return _solve(lattice, handle_cells, None, options, meter)


def _solve(
    lattice: Lattice, handle_cells: IntArray, start: FloatArray | None, options: WeightOptions, meter: Meter
) -> LatticeWeights:
    energy = biharmonic_energy(lattice)
    fixed, values = _fixed_nodes(lattice, handle_cells)
    weights = np.zeros((len(lattice.nodes), len(handle_cells)))
    weights[fixed] = values
    unknown = np.setdiff1d(np.arange(len(lattice.nodes)), fixed)
    if len(unknown) == 0:
        none = np.zeros(len(handle_cells))
        return LatticeWeights(weights, none, _energies(energy, weights), none.astype(np.int64))
    matrix, right = energy[unknown][:, unknown].tocsr(), -(energy[unknown][:, fixed] @ values)
    first = _unbounded(matrix, right) if start is None else start[unknown]
    found = minimize_bounded(
        matrix,
        right,
        np.clip(first, 0.0, 1.0),
        tolerance=options.tolerance,
        max_steps=_MAX_STEPS,
        meter=meter,
    )
    weights[unknown] = found.x
    return LatticeWeights(weights, found.residual, _energies(energy, weights), found.steps)


def _fixed_nodes(lattice: Lattice, handle_cells: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the handles' nodes (B,) and their weights (B, K): shared where coarse cells share nodes."""
    corners = lattice.corners[lattice.find(handle_cells)]
    fixed, place = np.unique(corners, return_inverse=True)
    values = np.zeros((len(fixed), len(handle_cells)))
    values[place.ravel(), np.repeat(np.arange(len(handle_cells)), 8)] = 1.0
    return fixed, values / values.sum(1, keepdims=True)


def _unbounded(matrix: sparse.csr_matrix, right: FloatArray) -> FloatArray:
    """Return A^-1 b for all columns: biharmonic weights without bounds, which sum to 1."""
    system = SparseCholesky(matrix)
    system.refill(np.zeros(matrix.shape[0], bool))
    result = np.empty_like(right)
    for k in range(right.shape[1]):
        result[system.order, k] = system.solve(right[system.order, k])
    return result


def _energies(energy: sparse.csr_matrix, weights: FloatArray) -> FloatArray:
    return 0.5 * np.einsum("nk,nk->k", weights, energy @ weights)


@dataclass(frozen=True)
class BoundedBiharmonicWeights:
    """Weights and how they were found; see `solve_weights`."""

    weights: FloatArray
    """(V, K); rows sum to 1, entries in [0, 1]."""
    converged: bool
    """Whether every handle's residual is at most the tolerance."""
    iterations: IntArray
    """(K,) Newton steps of each key point's handle on the finest lattice."""
    residual: FloatArray
    """(K,) scaled residuals of the optimality conditions, in weight (no unit)."""
    energy: FloatArray
    """(K,) x^T A x / 2 of the weights before they are normalised, in units of the spacing."""
    spacing: float
    """Of the lattice, in the mesh's unit."""
    node_count: int
    """Nodes of the lattice."""
    plan: Plan
    """The spacing, key points that share a handle, and the parts left out, with the reasons."""
    trace: Trace
    """Largest scaled residual of all handles after each Newton step, lattices in order."""


def bounded_biharmonic_weights(
    vertices: ArrayLike,
    faces: ArrayLike,
    handles: ArrayLike,
    spacing: str | float = "auto",
    budget: Budget | float | None = None,
    *,
    options: WeightOptions = WeightOptions(),
) -> FloatArray:
    """Return the weights (V, K) of `solve_weights` alone.

    Parameters
    ----------
    vertices, faces, handles, spacing, budget, options
        As in `solve_weights`, with its errors.

    Examples
    --------
    >>> bar = np.array([[x, y, z] for x in (0.0, 40.0) for y in (0.0, 3.0) for z in (0.0, 3.0)])
    >>> sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    ...          [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    >>> weights = bounded_biharmonic_weights(bar, sides, [[1.0, 1.5, 1.5], [39.0, 1.5, 1.5]])
    >>> weights.shape, bool((weights[:4, 0] > 0.9).all()), bool((weights[4:, 1] > 0.9).all())
    ((8, 2), True, True)
    """
    return solve_weights(vertices, faces, handles, spacing, budget, options=options).weights


def solve_weights(
    vertices: ArrayLike,
    faces: ArrayLike,
    handles: ArrayLike,
    spacing: str | float = "auto",
    budget: Budget | float | None = None,
    *,
    options: WeightOptions = WeightOptions(),
    on_progress: ProgressCallback | None = None,
) -> BoundedBiharmonicWeights:
    """Return smooth weights of key points over a mesh of any kind.

    Each handle's weight minimises the biharmonic energy alone (Jacobson, Baran, Popovic, Sorkine, "Bounded
    biharmonic weights for real-time deformation", SIGGRAPH 2011, section 3),

        min over w of  w^T L M^-1 L w / 2,  w = 1 at its key point, 0 at the others', 0 <= w <= 1,

    on the nodes of a lattice around (and inside) the surface, by projected Newton steps from coarse to
    fine; then the weights are divided by their sum and interpolated trilinearly at the vertices. The
    mesh may have many parts, holes, flipped, repeated and zero-area faces, and vertices without faces.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Any unit; the result does not depend on it.
    faces : (F, 3) array_like of int
    handles : (K, 3) array_like of float
        Key points, on the mesh or near it.
    spacing : "auto" or float
        Of the lattice, in the mesh's unit; parts closer together than that become one.
    budget : Budget or float, optional
        Seconds, or evaluations: Newton steps. When it ends the weights so far are returned, smooth and
        within their bounds, with `converged` False.
    options : WeightOptions
    on_progress : callable, optional
        Called with each row of the trace.

    Raises
    ------
    EyeglassesError
        When the mesh is empty or not finite, a key point lies far off the mesh, two of them coincide, or a
        given spacing makes too large a lattice.
    ValueError
        When an array has the wrong shape, or `spacing` is not positive.

    Notes
    -----
    The key points do not lie on nodes. Trilinear interpolation is a convex combination of a cell's
    corners, so with weights of at most 1 it is 1 at the key point only if all (of positive share) are 1: the
    handle is the cell, its eight nodes hold 1 for its own key point and 0 for the others'.

    Key points closer together than two spacings, such as the top and the bottom of a wire, share one handle
    in their middle; its weight is divided among them by the inverse squares of their distances.

    A part farther than 5 % of the size from all parts with a key point moves as one piece, with the
    weights of the lattice's point nearest to it.

    Cost: a factorisation of the lattice's matrix a step, 5 to 10 steps a handle.
    """
    meter = Meter(STAGE, UNIT, Budget.of(budget), on_progress)
    return metered_weights(vertices, faces, handles, spacing, options=options, meter=meter)


def metered_weights(
    vertices: ArrayLike,
    faces: ArrayLike,
    handles: ArrayLike,
    spacing: str | float = "auto",
    *,
    options: WeightOptions,
    meter: Meter,
    names: Sequence[str] | None = None,
) -> BoundedBiharmonicWeights:
    """Return what `solve_weights` does, on a meter that runs already; messages call key points by `names`."""
    xyz, index = checked_mesh(vertices, faces)
    points = checked_points("handles", handles)
    embedding = embed(xyz, index, points, spacing, options, names)
    solution = solve_lattice(embedding.lattice, embedding.handle_cells, options, meter)
    total = solution.weights.sum(1)
    if not total.min() > _VANISHED:
        raise EyeglassesError(
            f"no key point holds {int((total <= _VANISHED).sum())} of {len(total)} lattice nodes"
        )
    weights = np.clip(embedding.interpolation @ (solution.weights / total[:, None]), 0.0, 1.0)
    weights = embedding.shares * weights[:, embedding.handle]
    return BoundedBiharmonicWeights(
        weights=_with_followers(weights, embedding),
        converged=bool((solution.residual <= options.tolerance).all()),
        iterations=solution.steps[embedding.handle],
        residual=solution.residual[embedding.handle],
        energy=solution.energy[embedding.handle],
        spacing=embedding.spacing,
        node_count=len(embedding.lattice.nodes),
        plan=embedding.plan,
        trace=meter.trace,
    )


def _with_followers(weights: FloatArray, embedding: Embedding) -> FloatArray:
    """Return the weights with each part left out of the lattice given those of its vertex nearest to it."""
    weights = weights / weights.sum(1, keepdims=True)
    weights[embedding.follower] = weights[embedding.leader]
    return weights
