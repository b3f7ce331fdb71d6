"""Scan points that pull the model, and which closest points are mutual."""
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from scan2albedo.geometry.mesh import vertex_areas, boundary_vertex_mask
from scan2albedo.fitting.kernels import add_springs
from scan2albedo.fitting.forces import robust_weights

@dataclass(frozen=True)
class Pullers:
    points: np.ndarray
    normals: np.ndarray
    area: float
    @classmethod
    def of(cls, scan, options):
        area = vertex_areas(scan.vertices, scan.faces) * ~scan.boundary
        rng = np.random.default_rng(0)
        n = options.reverse_points
        # systematic resampling
        c = np.cumsum(area) / area.sum()
        idx = np.unique(np.searchsorted(c, (np.arange(n) + .5) / n))
        return cls(scan.vertices[idx], scan.normals[idx], float(area.sum() / len(idx)))

@dataclass(frozen=True)
class ReversePulls:
    index: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    area: float
    @classmethod
    def of(cls, pullers, points, normals, samples, tree, gates):
        d, j = tree.query(pullers.points, distance_upper_bound=gates.distance_mm)
        near = np.flatnonzero(np.isfinite(d))
        j = j[near]
        ok = ~samples.border[j] & (np.einsum("ij,ij->i", normals[j], pullers.normals[near]) > gates.min_normal_cosine)
        near, j = near[ok], j[ok]
        return cls(j, pullers.points[near], pullers.normals[near], pullers.area)
    def add(self, force, stiffness, points, normals, gates, share):
        if len(self.index) == 0: return
        offset = self.points - points[self.index]
        n = self.normals
        across = np.einsum("ij,ij->i", n, offset)
        w = robust_weights(across, np.ones(len(across), bool), gates) * self.area * share
        add_springs(force, stiffness, self.index, offset, n, (1 - gates.tangential) * w, gates.tangential * w)

def mutual(forces, points, samples, tree, options):
    if options.mutual_slope >= 100: return np.ones(len(points))
    used = np.flatnonzero(forces.weight > 0)
    out = np.zeros(len(points))
    if len(used) == 0: return out
    y = points[used] + forces.offset[used]
    _, j = tree.query(y)
    gap = np.linalg.norm(points[j] - points[used], axis=1)
    limit = options.mutual_slope * np.linalg.norm(forces.offset[used], axis=1) + options.mutual_floor * np.sqrt(samples.area[used])
    out[used] = gap <= limit
    return out
