"""The scan prepared once for the whole search: checked, in its principal frame, sampled, on a voxel grid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import far_faces, turned_against_neighbours
from scan2albedo.geometry.oriented_points import OrientedPoints, anchors, oriented_points
from scan2albedo.geometry.rigid import in_principal_frame
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.scan_noise import SurfaceNoise

_FEWEST_VERTICES = 50
_FEWEST_SAMPLES = 150
_FACE_MM = 200.0
_LARGEST_MM = 6000.0
_ANCHOR_LIMIT = 600
"""Greatest number of anchors: a scan of a whole room is searched more coarsely."""
_NORMAL_SMOOTHING_MM = 45.0
_CELL_MM = 6.0
_MARGIN_MM = 40.0
_MAX_CELLS = 1_500_000


@dataclass(frozen=True)
class NearestGrid:
    """A voxel grid over a point cloud (mm).

    `nearest` (X, Y, Z) holds the index of (nearly) the nearest sample to each cell's centre, `origin` (3,) is
    the corner of cell (0, 0, 0), `cell_mm` the side of a cell.
    """

    samples: OrientedPoints
    nearest: NDArray[np.int32]
    origin: FloatArray
    cell_mm: float

    @classmethod
    def of(cls, samples: OrientedPoints, *, cell_mm: float, margin_mm: float) -> NearestGrid:
        """Build the grid over the samples' box widened by `margin_mm`; huge boxes get larger cells."""
        low, high = samples.points.min(0) - margin_mm, samples.points.max(0) + margin_mm
        cell = max(cell_mm, float(np.cbrt(np.prod(high - low) / _MAX_CELLS)))
        shape = np.ceil((high - low) / cell).astype(np.int64) + 1
        nearest = _nearest_by_sweeps(samples.points, low, cell, shape[0], shape[1], shape[2])
        return cls(samples, nearest, low, cell)

    def nearest_samples(self, points: FloatArray) -> IntArray:
        """Return the index of (nearly) the nearest sample of each (N, 3) point, -1 outside the grid."""
        cell = np.floor((points - self.origin) / self.cell_mm).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < np.array(self.nearest.shape)), axis=1)
        x, y, z = np.where(inside[:, None], cell, 0).T
        return np.where(inside, self.nearest[x, y, z], -1)


@dataclass(frozen=True)
class PreparedScan:
    """A scan in its principal frame, mm, without stray faces; `raw` is the scan as read, for messages.

    `samples` are spread over its whole surface, `anchors` are few of them far apart, with averaged normals.
    `prepared_from_scan` (4, 4) is the rigid transform from the scan's own frame.
    """

    vertices: FloatArray
    faces: IntArray
    samples: OrientedPoints
    anchors: OrientedPoints
    prepared_from_scan: FloatArray
    raw: RawScan

    @property
    def stray_faces(self) -> int:
        """How many faces were left out."""
        return len(self.raw.faces) - len(self.faces)

    @cached_property
    def turned_faces(self) -> int:
        """How many faces of the scan as read are wound against their neighbours."""
        return int(turned_against_neighbours(self.raw.faces).sum())

    @cached_property
    def grid(self) -> NearestGrid:
        """The voxel grid over the samples."""
        return NearestGrid.of(self.samples, cell_mm=_CELL_MM, margin_mm=_MARGIN_MM)

    @cached_property
    def noise(self) -> SurfaceNoise:
        """What its vertices say of the noise."""
        return SurfaceNoise.of(self.vertices, self.faces)

    def inside_out(self) -> PreparedScan:
        """Return the scan with the normals of its samples turned over."""
        return replace(self, samples=self.samples.inside_out(), anchors=self.anchors.inside_out())


def prepared_scan(scan: RawScan, options: RegistrationOptions) -> PreparedScan:
    """Check a scan's size and prepare it for the search.

    Raises `RegistrationError` when it has too few vertices or too little surface, or is larger than a room.
    """
    faces = scan.faces[~far_faces(scan.vertices, scan.faces)]
    corners = scan.vertices[faces].reshape(-1, 3)
    _refuse_wrong_size(scan, corners)
    vertices, prepared_from_scan = in_principal_frame(scan.vertices, faces)
    samples = oriented_points(vertices, faces, options.scan_spacing_mm)
    far_apart = anchors(
        samples, spacing=options.anchor_spacing_mm, limit=_ANCHOR_LIMIT, reach=_NORMAL_SMOOTHING_MM
    )
    if len(samples) < _FEWEST_SAMPLES:
        raise RegistrationError(
            f"{scan.name}: its surface of {samples.areas.sum():.3g} mm2 (box {box_text(corners)}) is "
            f"too small for a face of about {_FACE_MM:.0f} mm. "
            + _unit_text(float(np.ptp(corners, axis=0).max()))
        )
    return PreparedScan(vertices, faces, samples, far_apart, prepared_from_scan, scan)


def _refuse_wrong_size(scan: RawScan, corners: FloatArray) -> None:
    """Refuse too few vertices, or faces that are too far apart: `corners` (N, 3) of those not stray."""
    if len(scan.vertices) < _FEWEST_VERTICES:
        raise RegistrationError(
            f"{scan.name}: {len(scan.vertices)} vertices cannot show a face, at least "
            f"{_FEWEST_VERTICES} are needed; scan the whole face"
        )
    longest = float(np.ptp(corners, axis=0).max())
    if longest > _LARGEST_MM:
        raise RegistrationError(
            f"{scan.name}: the scan (box {box_text(corners)}) is too large: a face is about "
            f"{_FACE_MM:.0f} mm, and it is looked for in at most {_LARGEST_MM / 1000:.0f} m. "
            + _unit_text(longest)
        )


def _unit_text(longest_mm: float) -> str:
    """Name the power of ten that brings a length nearest to a face's."""
    power = round(float(np.log10(_FACE_MM / longest_mm))) if longest_mm > 0 else 0
    if power == 0:
        return "Scan the whole face, and check the unit of the file"
    return (
        "Check the unit of the file: vertices are taken as millimetres "
        f"(multiplied by {10.0**power:g} it would have the size of a face)"
    )


def box_text(vertices: FloatArray) -> str:
    """Return the sides of the vertices' box for a message."""
    return " x ".join(f"{side:.3g}" for side in np.ptp(vertices, axis=0)) + " mm"


@njit(cache=True, nogil=True)
def _nearest_by_sweeps(points, origin, cell, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Vector distance transform: nearest points spread to neighbours in eight ordered sweeps."""
    nearest = np.full((nx, ny, nz), -1, np.int32)
    squared = np.full((nx, ny, nz), np.inf)
    for p in range(points.shape[0]):
        i = int((points[p, 0] - origin[0]) / cell)
        j = int((points[p, 1] - origin[1]) / cell)
        k = int((points[p, 2] - origin[2]) / cell)
        dx = points[p, 0] - origin[0] - (i + 0.5) * cell
        dy = points[p, 1] - origin[1] - (j + 0.5) * cell
        dz = points[p, 2] - origin[2] - (k + 0.5) * cell
        d = dx * dx + dy * dy + dz * dz
        if d < squared[i, j, k]:
            squared[i, j, k] = d
            nearest[i, j, k] = p
    for sweep in range(8):
        si = 1 if sweep & 1 else -1
        sj = 1 if sweep & 2 else -1
        sk = 1 if sweep & 4 else -1
        for a in range(nx):
            i = a if si > 0 else nx - 1 - a
            for b in range(ny):
                j = b if sj > 0 else ny - 1 - b
                for c in range(nz):
                    k = c if sk > 0 else nz - 1 - c
                    for axis in range(3):
                        u = i - si if axis == 0 else i
                        v = j - sj if axis == 1 else j
                        w = k - sk if axis == 2 else k
                        if u < 0 or v < 0 or w < 0 or u >= nx or v >= ny or w >= nz:
                            continue
                        p = nearest[u, v, w]
                        if p < 0 or p == nearest[i, j, k]:
                            continue
                        dx = points[p, 0] - origin[0] - (i + 0.5) * cell
                        dy = points[p, 1] - origin[1] - (j + 0.5) * cell
                        dz = points[p, 2] - origin[2] - (k + 0.5) * cell
                        d = dx * dx + dy * dy + dz * dz
                        if d < squared[i, j, k]:
                            squared[i, j, k] = d
                            nearest[i, j, k] = p
    return nearest
