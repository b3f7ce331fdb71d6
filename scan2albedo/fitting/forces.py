"""Forces from the scan on samples of the model's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.nearest_surface import NearestHits

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ForceGates:
    """Which closest points pull, and how strongly; see `FitOptions` for the fields."""

    distance_mm: float
    min_normal_cosine: float
    tangential: float
    robust_scale: float
    min_robust_mm: float

    @classmethod
    def at(cls, options: FitOptions, progress: float) -> ForceGates:
        """Return the gates at `progress` 0 (first stage) ... 1 (last)."""
        return cls(
            between(options.gate_mm, progress),
            options.min_normal_cosine,
            options.tangential,
            options.robust_scale,
            options.min_robust_mm,
        )


@dataclass(frozen=True)
class ScanForces:
    """Forces per unit area on N surface samples.

    Parameters
    ----------
    force : (N, 3) float64
        Millimetres (a spring of unit stiffness per area); zero where a gate is closed.
    weight : (N,) float64
        Robust weight times gate, 0 ... 1.
    offset : (N, 3) float64
        Closest scan point minus sample.
    normal : (N, 3) float64
        Unit scan normal at the closest point.
    near_mm : (N,) float64
        Distance cut off at the gate; NaN where the closest point is on the scan's border.
    hits : NearestHits
        To start the next search from.
    """

    force: FloatArray
    weight: FloatArray
    offset: FloatArray
    normal: FloatArray
    near_mm: FloatArray
    hits: NearestHits

    def mean_distance_mm(self, area: FloatArray) -> float:
        """Mean cut-off distance (weighted by area) of samples with scan opposite; NaN without any."""
        seen = ~np.isnan(self.near_mm)
        total = float(area[seen].sum())
        return float(area[seen] @ self.near_mm[seen]) / total if total > 0 else float("nan")


def scan_forces(
    scan: ScanSurface,
    samples: FloatArray,
    sample_normals: FloatArray,
    gates: ForceGates,
    start: NearestHits | None = None,
) -> ScanForces:
    """Return the forces w (n n^T + t (I - n n^T)) (y - x) that pull samples x to their closest points y.

    n is the scan's normal at y, t the tangential part, w the product of the gates (distance, angle of
    normals, border of the scan) and of Geman and McClure's robust weight.

    Parameters
    ----------
    scan : ScanSurface
    samples, sample_normals : (N, 3) float64
        Points of the model's surface and their unit normals.
    gates : ForceGates
    start : NearestHits, optional
        Of the last call, when the samples are the same ones moved a little.
    """
    hits = scan.nearest.query(samples, None if start is None else start.vertex)
    normal = normalized(scan.normals_at(hits))
    offset = hits.points - samples
    border = scan.on_boundary(hits)
    agreement = np.einsum("ij,ij->i", normal, sample_normals)
    open_gate = ~border & (hits.distance < gates.distance_mm) & (agreement > gates.min_normal_cosine)
    across = np.einsum("ij,ij->i", normal, offset)
    weight = np.where(open_gate, robust_weights(across, open_gate, gates), 0.0)
    force = (1 - gates.tangential) * across[:, None] * normal + gates.tangential * offset
    near = np.where(border, np.nan, np.minimum(hits.distance, gates.distance_mm))
    return ScanForces(weight[:, None] * force, weight, offset, normal, near, hits)


def robust_weights(residual: FloatArray, used: NDArray[np.bool_], gates: ForceGates) -> FloatArray:
    """Return (N,) Geman-McClure weights 1 / (1 + (r / c)^2)^2, c from the median of the used residuals."""
    if not used.any():
        return np.zeros(len(residual))
    spread = 1.4826 * float(np.median(np.abs(residual[used])))
    cutoff = gates.robust_scale * max(spread, gates.min_robust_mm)
    return 1.0 / (1.0 + (residual / cutoff) ** 2) ** 2
