"""Forces from the scan on samples of the model's surface."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, dots, norms
from scan2albedo.core.compiled import compiled, triple
from scan2albedo.fitting.options import GATE_MM, FitOptions, between
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.closest_points import mixed, nearest_around, walk_downhill
from scan2albedo.geometry.rigid import dot
from scan2albedo.statistics.robust import geman_mcclure_weights, normal_deviation

MIN_NORMAL_COSINE = 0.6
"""Least cosine between the normals of model and scan where a force acts."""
ROBUST_SCALE = 3.0
"""Residuals beyond that many robust standard deviations lose their weight."""
MIN_ROBUST_MM = (3.0, 1.0)
"""Least robust standard deviation, in the first and last stage."""
RIM_ROBUST_MM = 0.25
"""The same at the rim."""
MUTUAL_SPACING = 0.1


@dataclass(frozen=True)
class ForceGates:
    """Which closest points pull, and how strongly: GATE_MM, `FitOptions.tangential`, MIN_ROBUST_MM."""

    distance_mm: float
    tangential: float
    min_robust_mm: float

    @classmethod
    def at(cls, options: FitOptions, progress: float) -> Self:
        """Return the gates at `progress` 0 (first stage) ... 1 (last)."""
        return cls(between(GATE_MM, progress), options.tangential, between(MIN_ROBUST_MM, progress))


@dataclass(frozen=True)
class ScanForces:
    """Springs per unit area between N surface samples and the scan.

    `weight` (N,) is the robust weight times the gate, `tangential` the stiffness along the surface relative
    to that across it; `offset` (N, 3) the closest scan point minus the sample; `normal` (N, 3) the scan's
    there; `near_mm` (N,) the distance cut off at the gate, NaN on the scan's border; `vertex` (N,) the scan's
    nearest.
    """

    weight: FloatArray
    tangential: float
    offset: FloatArray
    normal: FloatArray
    near_mm: FloatArray
    vertex: IntArray

    def springs(self, area: FloatArray, mutual: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return force (N, 3) and stiffness (N, 6) of samples that stand for `area` (N,), where `mutual`."""
        weight, along = np.where(mutual, area * self.weight, 0.0), self.tangential
        found: tuple[FloatArray, FloatArray] = springs(
            self.offset, self.normal, (1 - along) * weight, along * weight
        )
        return found

    def mutual(self, samples: FloatArray, area: FloatArray) -> BoolArray:
        """Return (N,) True where the sample nearest to the closest point y of a sample x is near x.

        Where the model hides behind itself (inner lips, nostrils) and the scan does not show it, pairs must
        not pull. Kept are those with the sample nearest to y within |y - x| / 2 of x, plus a part of the
        samples' spacing.
        """
        used = np.flatnonzero(self.weight > 0)
        _, back = cKDTree(samples, balanced_tree=False).query(samples[used] + self.offset[used])
        gap = norms(samples[back] - samples[used])
        reach = norms(self.offset[used]) / 2
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

    n is the scan's normal at y, t the tangential part, w the gates times Geman and McClure's robust weight.
    `start` are the forces of the last call for the same samples; at the `rim` (N,) of `SurfaceSamples`, scan
    in front of the model is likely hair or cloth.
    """
    vertex = scan.nearest.nearest_vertices(samples) if start is None else start.vertex.copy()
    offset, normal, distance, border = pulled(
        samples, vertex, *scan.nearest.arrays, scan.normals, scan.boundary
    )
    agreement = dots(normal, sample_normals)
    open_gate = ~border & (distance < gates.distance_mm) & (agreement > MIN_NORMAL_COSINE)
    across = dots(normal, offset)
    weight = np.where(open_gate, robust_weights(across, open_gate, gates, rim), 0.0)
    near = np.where(border, np.nan, np.minimum(distance, gates.distance_mm))
    return ScanForces(weight, gates.tangential, offset, normal, near, vertex)


def robust_weights(
    residual: FloatArray, used: BoolArray, gates: ForceGates, rim: FloatArray | None = None
) -> FloatArray:
    """Return (N,) Geman-McClure weights 1 / (1 + (r / c)^2)^2, c from the median of the used residuals.

    For scan in front of the model at the `rim`, c has the lower floor RIM_ROBUST_MM.
    """
    if not used.any():
        return np.zeros(len(residual))
    spread = float(normal_deviation(residual[used]))
    weight = geman_mcclure_weights(residual, ROBUST_SCALE * max(spread, gates.min_robust_mm))
    if rim is None or gates.min_robust_mm <= RIM_ROBUST_MM:
        return weight
    strict = geman_mcclure_weights(residual, ROBUST_SCALE * max(spread, RIM_ROBUST_MM))
    return np.where(residual > 0, (1 - rim) * weight + rim * strict, weight)


@compiled
def pulled(points, vertex, xyz, faces, ring, ring_start, near, near_start, normals, boundary):  # type: ignore[no-untyped-def]
    """Find the point of the scan's surface closest to each point (N, 3).

    The search starts at `vertex` (N,), updated in place. Returned are the offset (N, 3) there, the unit
    normal (N, 3), the distance (N,), and whether the point lies on the border (N,).
    """
    count = len(points)
    offset, normal = np.empty((count, 3)), np.empty((count, 3))
    distance, border = np.empty(count), np.empty(count, np.bool_)
    for i in range(count):
        point = triple(points, i)
        vertex[i] = walk_downhill(point, vertex[i], xyz, near, near_start)
        best, nearest, weights, offset[i] = nearest_around(point, vertex[i], xyz, faces, ring, ring_start)
        distance[i] = np.sqrt(best)
        a, b, c = triple(faces, nearest)
        n = mixed(weights, triple(normals, a), triple(normals, b), triple(normals, c))
        size = max(np.sqrt(dot(n, n)), 1e-300)
        normal[i] = n[0] / size, n[1] / size, n[2] / size
        border[i] = dot(weights, (boundary[a], boundary[b], boundary[c])) > 0.999
    return offset, normal, distance, border


@compiled
def springs(offset, normal, across, along):  # type: ignore[no-untyped-def]
    """Return the forces (N, 3) H offset and the stiffness H = across n n^T + along I of N springs.

    H is given as (N, 6): xx, yy, zz, xy, xz, yz.
    """
    force, stiffness = np.empty((len(offset), 3)), np.empty((len(offset), 6))
    for i in range(len(offset)):
        n = triple(normal, i)
        pull = across[i] * dot(n, triple(offset, i))
        for k in range(3):
            force[i, k] = pull * n[k] + along[i] * offset[i, k]
            stiffness[i, k] = across[i] * n[k] * n[k] + along[i]
        stiffness[i, 3] = across[i] * n[0] * n[1]
        stiffness[i, 4] = across[i] * n[0] * n[2]
        stiffness[i, 5] = across[i] * n[1] * n[2]
    return force, stiffness
