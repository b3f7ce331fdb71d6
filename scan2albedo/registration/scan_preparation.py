"""The scan as the search wants it: checked, without stray vertices, in its principal frame, sampled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import far_vertices
from scan2albedo.geometry.rigid import compose
from scan2albedo.registration.oriented_points import OrientedPoints, oriented_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_VERTICES = 50
_FEWEST_SAMPLES = 150
_FACE_MM = 200.0
_LARGEST_MM = 6000.0
_TRIM_PERCENT = 2.0


@dataclass(frozen=True)
class PreparedScan:
    """A scan in its principal frame.

    Parameters
    ----------
    vertices, faces : (V, 3) float64 mm, (F, 3) int64
        Without the faces that stray.
    samples : OrientedPoints
    prepared_from_scan : (4, 4) float64
        Rigid transform from the scan's own frame.
    raw : RawScan
        As it came, for messages.
    """

    vertices: FloatArray
    faces: IntArray
    samples: OrientedPoints
    prepared_from_scan: FloatArray
    raw: RawScan

    @property
    def stray_faces(self) -> int:
        """How many faces were left out."""
        return len(self.raw.faces) - len(self.faces)

    def inside_out(self) -> PreparedScan:
        """Return the scan with its samples' normals turned over."""
        turned = OrientedPoints(self.samples.points, -self.samples.normals, self.samples.areas)
        return PreparedScan(self.vertices, self.faces, turned, self.prepared_from_scan, self.raw)


def prepared_scan(scan: RawScan, spacing_mm: float) -> PreparedScan:
    """Check a scan's size and prepare it for the search, with a sample about every `spacing_mm`.

    Raises
    ------
    RegistrationError
        When it has too few vertices or too little surface, or is larger than a room.
    """
    _refuse_wrong_size(scan)
    faces = without_stray_faces(scan.vertices, scan.faces)
    vertices, prepared_from_scan = in_principal_frame(scan.vertices, faces)
    samples = oriented_points(vertices, faces, spacing_mm)
    if len(samples) < _FEWEST_SAMPLES:
        raise RegistrationError(
            f"{scan.name}: its surface of {samples.areas.sum():.3g} mm2 (box {box_text(scan.vertices)}) is "
            f"too small for a face of about {_FACE_MM:.0f} mm. "
            + _unit_text(float(np.ptp(scan.vertices, axis=0).max()))
        )
    return PreparedScan(vertices, faces, samples, prepared_from_scan, scan)


def _refuse_wrong_size(scan: RawScan) -> None:
    if len(scan.vertices) < _FEWEST_VERTICES:
        raise RegistrationError(
            f"{scan.name}: {len(scan.vertices)} vertices cannot show a face, at least "
            f"{_FEWEST_VERTICES} are needed; scan the whole face"
        )
    # A few crumbs far away do not make a scan too large.
    low, high = np.percentile(scan.vertices, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    longest = float((high - low).max())
    if longest > _LARGEST_MM:
        raise RegistrationError(
            f"{scan.name}: the scan (box {box_text(scan.vertices)}) is too large: a face is about "
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


def without_stray_faces(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Return the faces (K, 3) without those that reach to `far_vertices`: at most 2 % of the vertices."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    stray = far_vertices(vertices, used)
    return faces[~stray[faces].any(1)] if (stray & used).any() else faces


def in_principal_frame(vertices: FloatArray, faces: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Return the vertices (V, 3) in the surface's principal axes, and the rigid (4, 4) transform there.

    Origin at the surface's centroid, axes along the eigenvectors of its second moments (longest first) and
    toward the heavier tail of the third moments [1]_; so the same mesh in another pose arrives at the same
    coordinates, up to rounding. Where a moment is ambiguous (a ball) any of the frames will do: the search
    covers every rotation from each.

    References
    ----------
    .. [1] M. Elad, A. Tal, S. Ar, "Content based retrieval of VRML objects", 2001 (pose normalisation by
       first, second and third moments).
    """
    # Differences to a vertex of the scan lose no digits however far away the origin is.
    anchor = vertices[faces[0, 0]]
    total, center, second = _first_and_second_moments(vertices, faces, anchor)
    if total <= 0:
        return vertices - anchor, compose(np.eye(3), -anchor)
    origin = anchor + center
    _, vectors = np.linalg.eigh(second)
    axes = np.ascontiguousarray(vectors[:, ::-1])
    axes = axes * np.where(_third_moments(vertices, faces, origin, axes) < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return (vertices - origin) @ axes, compose(axes.T, -axes.T @ origin)


@njit(cache=True, nogil=True)
def _first_and_second_moments(vertices, faces, anchor):  # type: ignore[no-untyped-def]
    """Return area, centroid relative to the anchor, and covariance of the faces' centroids, by area."""
    total, center, second = 0.0, np.zeros(3), np.zeros((3, 3))
    middle = np.empty(3)
    for f in range(faces.shape[0]):
        area = _centroid_and_area(vertices, faces[f], anchor, middle)
        total += area
        for i in range(3):
            center[i] += area * middle[i]
            for j in range(3):
                second[i, j] += area * middle[i] * middle[j]
    if total <= 0:
        return total, center, second
    center /= total
    return total, center, second / total - np.outer(center, center)


@njit(cache=True, nogil=True)
def _third_moments(vertices, faces, origin, axes):  # type: ignore[no-untyped-def]
    """Return (3,) sums of area times the cube of the centroid's coordinate along each axis."""
    third, middle = np.zeros(3), np.empty(3)
    for f in range(faces.shape[0]):
        area = _centroid_and_area(vertices, faces[f], origin, middle)
        for axis in range(3):
            along = middle[0] * axes[0, axis] + middle[1] * axes[1, axis] + middle[2] * axes[2, axis]
            third[axis] += area * along * along * along
    return third


@njit(cache=True, nogil=True)
def _centroid_and_area(vertices, face, origin, middle):  # type: ignore[no-untyped-def]
    """Fill in a face's centroid relative to the origin and return its area."""
    a, b, c = face[0], face[1], face[2]
    ux, uy, uz = (
        vertices[b, 0] - vertices[a, 0],
        vertices[b, 1] - vertices[a, 1],
        vertices[b, 2] - vertices[a, 2],
    )
    vx, vy, vz = (
        vertices[c, 0] - vertices[a, 0],
        vertices[c, 1] - vertices[a, 1],
        vertices[c, 2] - vertices[a, 2],
    )
    for i in range(3):
        at = origin[i]
        middle[i] = ((vertices[a, i] - at) + (vertices[b, i] - at) + (vertices[c, i] - at)) / 3
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return 0.5 * np.sqrt(x * x + y * y + z * z)
