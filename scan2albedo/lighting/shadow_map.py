"""Which surface points each light reaches: exact rays, and a table of directions for global searches."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import maximum_filter

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
    NDArray,
    dots,
    norms,
)
from scan2albedo.geometry.rays import RayCaster

_OFFSETS = (1.5e-4, 5e-3)
"""Least and largest offset of shadow rays as parts of the caster's size."""
_RIM = 13
"""Points of a rim, at most 33 degrees apart, that show whether a lamp is cut: a 200th lies beyond two."""


@dataclass(frozen=True)
class ShadowMap:
    """Visibility of lights from N surface points; without `caster` only attached shadows are left (n.l <= 0).

    `position` (N, 3) is in mm on the caster's surface, `normal` (N, 3) unit and outward. Rays start
    `offset_mm` along the normal. 0.03 to 0.3 mm serves a face: less lets the surface shadow itself, more
    loses shadow at contacts. It is kept between 0.015 % and 0.5 % of the caster's size, so that a surface in
    another unit than millimetres neither shadows itself nor loses all its shadows. No ray is shot where the
    light's cosine to the normal is above `open_above` (N,): there nothing is known to hide it. Where points
    are samples of a picture, `place` (N, 2) is row and column of each: neighbours then share rays.
    """

    caster: RayCaster | None
    position: FloatArray
    normal: FloatArray
    offset_mm: float = 0.2
    open_above: FloatArray | None = None
    place: IntArray | None = None
    _origin: Float32Array = field(init=False, repr=False)
    _above: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        origin = np.empty((0, 3), np.float32)
        above = 0.0
        if self.caster is not None:
            offset = shadow_offset_mm(self.caster.size, self.offset_mm)
            origin, above = self.caster.to_local(self.position + offset * self.normal), math.inf
        known = np.full(len(self.position), above) if self.open_above is None else self.open_above
        vars(self).update(_origin=origin, _above=known)

    def visible(self, direction: ArrayLike, distance_mm: float = math.inf) -> ByteArray:
        """Return (N,) uint8, 1 where a light reaches the point.

        `direction`, (3,) or one a point, is unit, from the origin toward the light; `distance_mm` is inf for
        a distant one. Rays are shot only where n.l > 0, and go on past a near light: nothing may stand
        behind it.
        """
        ray = self._toward(direction, distance_mm)
        cosine = dots(self.normal, ray)
        facing = cosine > 0
        at = np.flatnonzero(facing & ~(cosine > self._above * norms(ray)))
        result = facing.astype(np.uint8)
        if self.caster is not None and len(at):
            rays = ray if ray.ndim == 1 else ray[at].astype(np.float32)
            result[at] = ~self.caster.occluded(self._origin[at], rays, local=True)
        return result

    def _toward(self, direction: ArrayLike, distance_mm: float) -> FloatArray:
        """Return the ways from the points to a light in its distances: (N, 3), or (3,) where all are one."""
        toward = np.asarray(direction, float)
        return toward if math.isinf(distance_mm) else toward - self.position / distance_mm

    def reached(
        self, direction: ArrayLike, distance_mm: float = math.inf, radius_deg: float = 0.0, points: int = 16
    ) -> NDArray:
        """Return (N,) the part of a lamp that reaches each point: uint8 of a point, else float32 in [0, 1].

        A lamp of an angular radius is a disc of so many `points`, each weighed by its cosine to the surface.
        A shadow's edge has as many steps: pictures need about a hundred.
        """
        if radius_deg == 0:
            return self.visible(direction, distance_mm)
        to_lamp, radius = self._toward(direction, distance_mm), math.radians(radius_deg)
        length = norms(to_lamp)
        cosine = dots(self.normal, to_lamp) / np.maximum(length, 1e-9)
        # The most by which the cosines to points of the disc differ from that to its centre.
        spread = radius / np.maximum(length - radius / 2, 1e-9)
        result = (cosine > self._above + spread).astype(np.float32)
        unsure = np.flatnonzero((result == 0) & (cosine > -spread))
        disc = cone_directions(points, direction, radius)
        # Its rim comes last; where that is hidden or seen as a whole, so is the rest.
        inner = points - min(points // 3, _RIM)
        if self.place is not None:
            shown, hidden = self._some(unsure)._around(disc[inner:], distance_mm)
            result[unsure] = shown
            unsure = unsure[shown & hidden]
        some = self._some(unsure)
        seen, facing = some._seen(disc[inner:], distance_mm)
        partly = np.flatnonzero((seen > 0) & (seen < facing))
        more, most = some._some(partly)._seen(disc[:inner], distance_mm)
        seen[partly] += more
        facing[partly] += most
        result[unsure] = np.divide(seen, facing, out=np.zeros_like(facing), where=facing > 0)
        return result

    def _some(self, index: NDArray[np.intp]) -> ShadowMap:
        surface = self.position[index], self.normal[index]
        place = None if self.place is None else self.place[index]
        return ShadowMap(self.caster, *surface, self.offset_mm, self._above[index], place)

    def _around(self, rim: FloatArray, distance_mm: float) -> tuple[BoolArray, BoolArray]:
        """Return where part of a lamp's rim (K, 3) is seen in a picture, and where part is hidden (N,).

        A sample shoots at one point of the rim alone, but those within two samples of it shoot at every one.
        """
        assert self.place is not None
        row, column = self.place.T
        toward = rim[(5 * row + column) % len(rim)]
        seen = self.visible(toward, distance_mm) > 0
        facing = dots(self.normal, self._toward(toward, distance_mm)) > 0
        found = []
        for here in (seen, facing & ~seen):
            picture = np.zeros(self.place.max(0) + 1, bool)
            picture[row, column] = here
            found.append(maximum_filter(picture, 5)[row, column])
        return found[0], found[1]

    def _seen(self, directions: FloatArray, distance_mm: float) -> tuple[FloatArray, FloatArray]:
        """Return (N,) the sums of the cosines to the points of a lamp that are seen, and to all."""
        seen, facing = np.zeros((2, len(self.position)))
        for toward in directions:
            cosine = np.maximum(dots(self.normal, self._toward(toward, distance_mm)), 0.0)
            facing += cosine
            seen += cosine * self.visible(toward, distance_mm)
        return seen, facing

    def table(self, directions: ArrayLike) -> VisibilityTable:
        """Return the visibility of distant lights from each of `directions` (D, 3)."""
        toward = np.asarray(directions, float)
        return VisibilityTable(toward, np.stack([self.visible(d) for d in toward]))


def shadow_offset_mm(size: float, offset_mm: float) -> float:
    """Return the offset of shadow rays that a caster of `size` mm takes; see `ShadowMap.offset_mm`."""
    low, high = (part * size for part in _OFFSETS)
    return min(max(offset_mm, low), high)


@dataclass(frozen=True)
class VisibilityTable:
    """Visibility (D, N) uint8 of distant lights from `directions` (D, 3)."""

    directions: FloatArray
    visibility: ByteArray

    def highest_hidden(self, normal: FloatArray) -> FloatArray:
        """Return (N,) the largest cosine to `normal` (N, 3) of a hidden direction, 0 where none is."""
        hidden = np.where(self.visibility.T == 0, normal @ self.directions.T, 0.0)
        return hidden.max(1, initial=0.0)

    def nearest(self, direction: ArrayLike) -> ByteArray:
        """Return (N,) the visibility of the tabulated direction closest to `direction`."""
        return self.visibility[int(np.argmax(self.directions @ np.asarray(direction, float)))]


def cone_directions(count: int, axis: ArrayLike, half_angle_rad: float) -> FloatArray:
    """Return (count, 3) unit vectors spread evenly over the cone around `axis` (a Fibonacci spiral [1]_).

    >>> cone_directions(50, (0, 0, 1), 1.0)[:, 2].min() > 0.54
    np.True_

    .. [1] R. Swinbank, R. J. Purser, "Fibonacci grids", Q. J. R. Meteorol. Soc. 132, 2006.
    """
    along = 1 - (1 - math.cos(half_angle_rad)) * (np.arange(count) + 0.5) / count
    turn, across = np.arange(count) * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - along**2)
    e1, e2, e3 = view_frame(axis)
    return along[:, None] * e3 + (across * np.cos(turn))[:, None] * e1 + (across * np.sin(turn))[:, None] * e2


def view_frame(axis: ArrayLike) -> FloatArray:
    """Return (3, 3) rows of a right-handed orthonormal frame, the third along `axis`; for +z the identity."""
    e3 = np.asarray(axis, float)
    e3 = e3 / np.linalg.norm(e3)
    e1 = np.cross(np.array([0.0, 1.0, 0.0]) if abs(e3[1]) < 0.9 else np.array([0.0, 0.0, -1.0]), e3)
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(e3, e1), e3])
