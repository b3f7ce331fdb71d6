"""Bounded biharmonic weights on the nodes of a lattice, from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.eyeglasses.weighting.biharmonic import biharmonic_energy
from scan2albedo.eyeglasses.weighting.bounded_quadratic import minimize_bounded
from scan2albedo.eyeglasses.weighting.lattice import Lattice
from scan2albedo.eyeglasses.weighting.options import WeightOptions
from scan2albedo.eyeglasses.weighting.sparse_cholesky import SparseCholesky
from scan2albedo.eyeglasses.weighting.voxelization import unique_cells

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ROUGH = 1e-4
"""Scaled residual at which a coarser lattice's weights are good enough to start from."""


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
    if len(lattice.nodes) > options.coarse_nodes:
        coarse = Lattice.of_cells(unique_cells(lattice.cells // 2))
        if len(coarse.nodes) < len(lattice.nodes):
            rough = replace(options, tolerance=max(options.tolerance, _ROUGH))
            above = meter.child(meter.stage, meter.unit)
            solved = solve_lattice(coarse, handle_cells // 2, rough, above)
            meter.adopt(above)
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
        max_steps=options.max_steps,
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
