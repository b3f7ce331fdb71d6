"""Bounded biharmonic weights of key points on any triangle mesh."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from scan2albedo.core import BudgetLike, Meter, OnProgress, Plan, Trace
from scan2albedo.core.arrays import EPSILON, ArrayLike, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.embedding import MAX_NODES, embed
from scan2albedo.eyeglasses.keypoints import checked_mesh, checked_points
from scan2albedo.eyeglasses.lattice import Lattice, biharmonic_energy

TOLERANCE = 1e-7
"""Scaled residual of the optimality conditions at which a handle's weights are done."""


@dataclass(frozen=True)
class BoundedMinimum:
    """Minima `x` (N, K) of K columns, `optimality_residual` (K,) and Newton steps (K,)."""

    x: FloatArray
    residual: FloatArray
    steps: IntArray


@dataclass(frozen=True)
class BoundedBiharmonicWeights:
    """Weights and how they were found; see `solve_weights`."""

    weights: FloatArray
    """(V, K); rows sum to 1, entries in [0, 1]."""
    converged: bool
    iterations: IntArray
    residual: FloatArray
    """(K,) scaled residuals of the optimality conditions after Newton `iterations` (K,); they have
    `converged` where each is at most the tolerance."""
    spacing: float
    node_count: int
    """Of the lattice; its `spacing` is in the mesh's unit."""
    plan: Plan
    trace: Trace
    """Largest scaled residual after each Newton step; `plan` says what shares a handle or was left out."""


def bounded_biharmonic_weights(
    vertices: ArrayLike,
    faces: ArrayLike,
    handles: ArrayLike,
    spacing: str | float = "auto",
    budget: BudgetLike = None,
) -> FloatArray:
    """Return the weights (V, K) of `solve_weights` alone.

    Parameters
    ----------
    vertices, faces, handles, spacing, budget
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
    return solve_weights(vertices, faces, handles, spacing, budget).weights


def solve_weights(
    vertices: ArrayLike,
    faces: ArrayLike,
    handles: ArrayLike,
    spacing: str | float = "auto",
    budget: BudgetLike = None,
    *,
    max_nodes: int = MAX_NODES,
    tolerance: float = TOLERANCE,
    names: Sequence[str] | None = None,
    meter: Meter | None = None,
    on_progress: OnProgress = None,
) -> BoundedBiharmonicWeights:
    """Return smooth weights of key points over a mesh of any kind.

    Each handle's weight minimises the biharmonic energy alone (Jacobson, Baran, Popovic, Sorkine, "Bounded
    biharmonic weights for real-time deformation", SIGGRAPH 2011, section 3),

        min over w of  w^T L M^-1 L w / 2,  w = 1 at its key point, 0 at the others', 0 <= w <= 1,

    on the nodes of a lattice around (and inside) the surface; then the weights are divided by their sum and
    interpolated trilinearly at the vertices. The mesh may have parts, holes and bad faces of any kind. Raises
    EyeglassesError when the mesh is empty or not finite, a key point lies far off it, two of them coincide,
    or a given spacing makes too large a lattice; ValueError for wrong shapes, or `spacing` not above 0.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
    faces : (F, 3) array_like of int
    handles : (K, 3) array_like of float
        Key points, on the mesh or near it.
    spacing : "auto" or float
        Of the lattice, in the mesh's unit; parts closer together than that become one.
    budget, on_progress : optional
        Seconds, or evaluations: Newton steps. When it ends the weights so far are returned; called with rows.
    max_nodes : int
        Lattice nodes that the automatic spacing may use; a given spacing may use ten times as many.
    tolerance : float
        Scaled residual of the optimality conditions at which a handle's weights are done.
    names : sequence of K str, optional
        What messages call the key points; their numbers when omitted.
    meter : Meter, optional
        One that runs already, instead of `budget` and `on_progress`.

    Notes
    -----
    The handle of a key point is its cell, whose eight nodes hold 1 for it and 0 for the others: otherwise
    trilinear interpolation would stay below 1 there. Key points closer together than two spacings share one
    handle in their middle; its weight is divided among them by the inverse squares of their distances. A part
    farther than 5 % of the size from all parts with a key point moves as one piece. Cost: a factorisation of
    the lattice's matrix a step, 5 to 10 steps a handle.
    """
    if meter is None:
        meter = Meter("eyeglasses.weights", "scaled KKT residual", budget, on_progress)
    xyz, index = checked_mesh(vertices, faces)
    marks = checked_points("handles", handles)
    embedding = embed(xyz, index, marks, spacing, max_nodes=max_nodes, names=names)
    solution = solve_lattice(embedding.lattice, embedding.handle_cells, tolerance=tolerance, meter=meter)
    total = solution.x.sum(1)
    # Dividing by less would amplify rounding.
    if not total.min() > TOLERANCE:
        lost = (total <= TOLERANCE).sum()
        raise EyeglassesError(f"no key point holds {lost} of {len(total)} lattice nodes")
    weights = np.clip(embedding.interpolation @ (solution.x / total[:, None]), 0.0, 1.0)
    weights = embedding.shares * weights[:, embedding.handle]
    weights /= weights.sum(1, keepdims=True)
    weights[embedding.follower] = weights[embedding.leader]
    return BoundedBiharmonicWeights(
        weights=weights,
        converged=bool((solution.residual <= tolerance).all()),
        iterations=solution.steps[embedding.handle],
        residual=solution.residual[embedding.handle],
        spacing=embedding.spacing,
        node_count=len(embedding.lattice.nodes),
        plan=embedding.plan,
        trace=meter.trace,
    )


def solve_lattice(
    lattice: Lattice, handle_cells: IntArray, *, tolerance: float = TOLERANCE, meter: Meter
) -> BoundedMinimum:
    """Return the weights (N, K) of the handles that hold the cells `handle_cells` (K, 3) of `lattice`.

    They are not normalised.
    """
    count, nodes = len(handle_cells), len(lattice.nodes)
    # The handles' nodes hold 1 and 0.
    fixed = lattice.corners[lattice.find(handle_cells)].ravel()
    values = np.repeat(np.eye(count), 8, axis=0)
    weights = np.zeros((nodes, count))
    weights[fixed] = values
    free = np.setdiff1d(np.arange(nodes), fixed)
    if len(free) == 0:
        return BoundedMinimum(weights, np.zeros(count), np.zeros(count, int))
    energy = biharmonic_energy(lattice)
    matrix, right = energy[free][:, free].tocsr(), -(energy[free][:, fixed] @ values)
    found = minimize_bounded(matrix, right, tolerance=tolerance, meter=meter)
    weights[free] = found.x
    return BoundedMinimum(weights, found.residual, found.steps)


def minimize_bounded(
    matrix: sparse.csr_matrix, right: FloatArray, *, tolerance: float, max_steps: int = 60, meter: Meter
) -> BoundedMinimum:
    """Minimise x^T A x / 2 - b^T x over 0 <= x <= 1 for each column b (N,) of `right`, A positive definite.

    Projected Newton [1]_: entries at a bound that are pushed outward stay, the others take the Newton step
    A_FF d = -g_F and are clipped back into the bounds; the step is halved until the energy falls. Columns are
    done at scaled residuals of `tolerance`, or after `max_steps`. The start is A^-1 b, clipped. Raises
    numpy.linalg.LinAlgError when A is not positive definite.

    .. [1] D. P. Bertsekas, "Projected Newton methods for optimization problems with simple constraints",
       SIAM J. Control and Optimization 20(2), 1982, section 2.
    """
    whole = _factor(matrix, "MMD_AT_PLUS_A")
    if not whole.U.diagonal().min() > 0:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    # In the order that keeps the factor of all rows sparse, those of the free rows need no other.
    order = np.argsort(whole.perm_c)
    ordered, diagonal = sparse.csc_matrix(matrix[order][:, order]), matrix.diagonal()[order]
    # Columns one after another in memory: the loop below takes them one by one.
    x = np.asfortranarray(np.clip(whole.solve(right), 0.0, 1.0)[order])
    b = np.asfortranarray(right[order])
    product = np.asfortranarray(ordered @ x)
    residual = optimality_residual(x, product - b, diagonal)
    steps = np.zeros(b.shape[1], int)
    for k in range(b.shape[1]):
        held = (x[:, k] <= 0) | (x[:, k] >= 1)
        while not meter.exhausted and residual[k] > tolerance and steps[k] < max_steps:
            gradient, free = product[:, k] - b[:, k], np.flatnonzero(~held)
            direction, lowered = np.zeros(len(held)), False
            direction[free] = _factor(ordered[:, free][free], "NATURAL").solve(-gradient[free])
            # A step still shorter is stopped by rounding, not by its direction.
            for halvings in range(34):
                trial = np.clip(x[:, k] + 0.5**halvings * direction, 0.0, 1.0)
                change, after = trial - x[:, k], ordered @ trial
                # Armijo's condition; differences of the energy itself would drown in rounding.
                predicted = gradient @ change
                if predicted + change @ (after - product[:, k]) / 2 <= 1e-4 * predicted < 0:
                    x[:, k], product[:, k], lowered = trial, after, True
                    break
            meter.count()
            steps[k] += 1
            if not lowered and steps[k] > 1:
                break
            # Below rounding a gradient has no sign.
            gradient, least = product[:, k] - b[:, k], 400 * EPSILON * diagonal
            held = ((x[:, k] <= 0) & (gradient > least)) | ((x[:, k] >= 1) & (gradient < -least))
            residual[k] = optimality_residual(x[:, k], gradient, diagonal)
            meter.record(residual.max())
    result = np.empty_like(right)
    result[order] = x
    return BoundedMinimum(result, residual, steps)


def _factor(matrix: sparse.csr_matrix, order: str) -> SuperLU:
    """Return L D L^T = A of a positive definite A, as L U without pivoting."""
    # Panels of one column are the fastest on lattices.
    return splu(matrix.tocsc(), order, 0.0, panel_size=1, options={"SymmetricMode": True})


def optimality_residual(x: FloatArray, gradient: FloatArray, diagonal: FloatArray) -> Any:
    """Return each column's max |x - clip(x - g / diag(A), 0, 1)|, a length in x; 0 only at the minimum."""
    scaled = gradient / (diagonal if x.ndim == 1 else diagonal[:, None])
    return np.abs(x - np.clip(x - scaled, 0.0, 1.0)).max(0, initial=0.0)
