"""Forces from the scan on samples of the model's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scan2albedo.fitting.kernels import pulled, springs
from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.scan_surface import ScanSurface

FloatArray = NDArray[np.float64]

MUTUAL_SLOPE = 0.5
MUTUAL_SPACING = 0.1
RIM_ROBUST_MM = 0.25


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
            between(options.min_robust_mm, progress),
        )


@dataclass(frozen=True)
class ScanForces:
    """Springs per unit area between N surface samples and the scan.

    Parameters
    ----------
    weight : (N,) float64
        Robust weight times gate, 0 ... 1.
    tangential : float
        Stiffness along the surface relative to 1 across it.
    offset : (N, 3) float64
        Closest scan point minus sample.
    normal : (N, 3) float64
        Unit scan normal at the closest point.
    near_mm : (N,) float64
        Distance cut off at the gate; NaN where the closest point is on the scan's border.
    vertex : (N,) int64
        Scan vertices to start the next search from.
    """

    weight: FloatArray
    tangential: float
    offset: FloatArray
    normal: FloatArray
    near_mm: FloatArray
    vertex: NDArray[np.int64]

    def springs(self, area: FloatArray, mutual: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return force (N, 3) and stiffness (N, 6) of samples that stand for `area` (N,), where `mutual`."""
        weight = np.where(mutual, area * self.weight, 0.0)
        force, stiffness = springs(
            self.offset, self.normal, (1 - self.tangential) * weight, self.tangential * weight
        )
        return force, stiffness

    def mutual(self, samples: FloatArray, area: FloatArray) -> NDArray[np.bool_]:
        """Return (N,) which closest points y have a sample near x as their own nearest.

        Where the model hides behind itself (inner lips, nostrils) and the scan does not show it, x lies
        behind a part of the model that y belongs to, about as far as y is: such pairs must not pull. Kept are
        those whose return ends within MUTUAL_SLOPE |y - x| of x, and a part of the spacing of samples.

        Parameters
        ----------
        samples : (N, 3) float64
        area : (N,) float64
        """
        used = np.flatnonzero(self.weight > 0)
        _, back = cKDTree(samples, balanced_tree=False).query(samples[used] + self.offset[used])
        gap = np.linalg.norm(samples[back] - samples[used], axis=1)
        reach = MUTUAL_SLOPE * np.linalg.norm(self.offset[used], axis=1)
        kept = np.zeros(len(samples), bool)
        kept[used] = gap <= reach + MUTUAL_SPACING * np.sqrt(area[used])
        return kept

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
    start: ScanForces | None = None,
    *,
    rim: FloatArray | None = None,
) -> ScanForces:
    """Return the springs w (n n^T + t (I - n n^T)) (y - x) that pull samples x to their closest points y.

    n is the scan's normal at y, t the tangential part, w the product of the gates (distance, angle of
    normals, border of the scan) and of Geman and McClure's robust weight.

    Parameters
    ----------
    scan : ScanSurface
    samples, sample_normals : (N, 3) float64
        Points of the model's surface and their unit normals.
    gates : ForceGates
    start : ScanForces, optional
        Of the last call, when the samples are the same ones moved a little.
    rim : (N,) float64, optional
        `SurfaceSamples.rim`; there, scan that stands before the model is likely hair or cloth.
    """
    vertex = scan.nearest.nearest_vertices(samples) if start is None else start.vertex.copy()
    offset, normal, distance, border = pulled(
        samples, vertex, *scan.nearest.arrays, scan.normals, scan.boundary
    )
    agreement = np.einsum("ij,ij->i", normal, sample_normals)
    open_gate = ~border & (distance < gates.distance_mm) & (agreement > gates.min_normal_cosine)
    across = np.einsum("ij,ij->i", normal, offset)
    weight = np.where(open_gate, robust_weights(across, open_gate, gates, rim), 0.0)
    near = np.where(border, np.nan, np.minimum(distance, gates.distance_mm))
    return ScanForces(weight, gates.tangential, offset, normal, near, vertex)


def robust_weights(
    residual: FloatArray, used: NDArray[np.bool_], gates: ForceGates, rim: FloatArray | None = None
) -> FloatArray:
    """Return (N,) Geman-McClure weights 1 / (1 + (r / c)^2)^2, c from the median of the used residuals.

    At the `rim` a scan in front of the model (positive residual) has a c with RIM_ROBUST_MM as its floor: a
    wide one would draw the rim onto hair and collars, a little further with every stage.
    """
    if not used.any():
        return np.zeros(len(residual))
    spread = 1.4826 * float(np.median(np.abs(residual[used])))
    weight = _geman_mcclure(residual, gates.robust_scale * max(spread, gates.min_robust_mm))
    if rim is None or gates.min_robust_mm <= RIM_ROBUST_MM:
        return weight
    tight = _geman_mcclure(residual, gates.robust_scale * max(spread, RIM_ROBUST_MM))
    return np.where(residual > 0, (1 - rim) * weight + rim * tight, weight)


def _geman_mcclure(residual: FloatArray, cutoff: float) -> FloatArray:
    return 1.0 / (1.0 + (residual / cutoff) ** 2) ** 2
