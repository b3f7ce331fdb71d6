"""Light that a surface sends onto itself, and values that are interpolated along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.shadow_map import ShadowMap, shadow_offset_mm

_DIRECTIONS = 128
"""Rays from each patch."""
_CELLS = 24
"""Patches along the longest side of the points, of which they are chosen: some 900 on a face."""
_NEIGHBOURS, SMALLEST_MM = 4, 0.5
"""Points that a value is interpolated from, and the distance below which all weigh the same."""


def surface_keys(position: FloatArray, normal: FloatArray) -> FloatArray:
    """Return (N, 6) what distances along a surface are taken between: position, and normal times 20 mm."""
    return np.column_stack([position, 20 * normal])


def surface_weights(known: FloatArray, wanted: FloatArray) -> sparse.csr_matrix:
    """Return (N, M) weights, rows summing to 1, at N `surface_keys` of values that are known at M of them.

    Values come from along the surface: none leaks to the other side of a fold.
    """
    count = min(_NEIGHBOURS, len(known))
    far, index = cKDTree(known).query(wanted, range(1, count + 1))
    weight = 1 / (far + SMALLEST_MM) ** 2
    weight /= weight.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(wanted)), count)
    return sparse.csr_matrix((weight.ravel(), (rows, index.ravel())), (len(wanted), len(known)))


@dataclass(frozen=True)
class Bounce:
    """One bounce of light from a surface onto itself, as seen from some of its points.

        B(x) = integral of V_hit(x, w) D(y(x, w)) max(0, n.w) / pi dw

    for light D on the surface and albedo 1: M patches exchange it by `factors` (M, M), whose rows sum to the
    hidden part of the hemisphere, and N points take part through `up` (N, M) and `down` (M, N).

    .. [1] C. Goral, K. Torrance, D. Greenberg, B. Battaile, "Modeling the interaction of light between
       diffuse surfaces", SIGGRAPH 1984.
    """

    factors: sparse.csr_matrix
    up: sparse.csr_matrix
    down: sparse.csr_matrix

    def __call__(self, light: FloatArray) -> FloatArray:
        """Return the bounced light (N, ...) of `light` (N, ...)."""
        return np.asarray(self.up @ (self.factors @ (self.down @ light)))


@dataclass(frozen=True)
class Patches:
    """M patches of a surface: their `surface_keys` and the form factors between them."""

    keys: FloatArray
    factors: FloatArray

    @classmethod
    def among(cls, shadows: ShadowMap) -> Patches:
        """Return the patches around some of the points of `shadows`, evenly spread; they have a caster."""
        assert shadows.caster is not None
        position, normal = shadows.position, shadows.normal
        low, high = position.min(0), position.max(0)
        edge = max(float((high - low).max()), 1e-9) / _CELLS
        column, row, layer = ((position - low) / edge).astype(np.int64).T
        some = np.unique((column * (_CELLS + 1) + row) * (_CELLS + 1) + layer, return_index=True)[1]
        return cls.of(shadows.caster, position[some], normal[some], shadows.offset_mm)

    @classmethod
    def of(cls, caster: RayCaster, position: FloatArray, normal: FloatArray, offset_mm: float) -> Patches:
        """Return the patches around points (M, 3): a ray counts for the patch nearest to where it hits."""
        origin = position + shadow_offset_mm(caster.size, offset_mm) * normal
        nearest, factors = cKDTree(position), np.zeros((len(position), len(position)))
        for direction in distant_directions(_DIRECTIONS):
            cosine = normal @ direction
            rows = np.flatnonzero(cosine > 0)
            hits = caster.first_hit(origin[rows], direction)
            hit = hits.face >= 0
            rows, at = rows[hit], origin[rows[hit]] + hits.distance[hit, None] * direction
            column = nearest.query(at)[1]
            # Light leaves the outer side alone: a ray that meets the inner side passed a hole.
            outer = normal[column] @ direction < 0
            np.add.at(factors, (rows[outer], column[outer]), cosine[rows[outer]] * 4 / _DIRECTIONS)
        return cls(surface_keys(position, normal), factors)

    def seen_from(self, position: FloatArray, normal: FloatArray) -> Bounce:
        """Return the bounce onto and from N points."""
        up = surface_weights(self.keys, surface_keys(position, normal))
        # What averages values at the points around each patch.
        total = np.maximum(np.asarray(up.sum(0)).ravel(), 1e-9)
        return Bounce(sparse.csr_matrix(self.factors), up, sparse.diags(1 / total) @ up.T)
