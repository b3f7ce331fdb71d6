"""Settings of the weights."""

from __future__ import annotations

from dataclasses import dataclass


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
