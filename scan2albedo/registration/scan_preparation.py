"""The scan prepared once for the whole search: checked, in its principal frame, sampled, on a voxel grid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.alignment import NearestGrid
from scan2albedo.geometry.mesh import far_faces, turned_against_neighbours
from scan2albedo.geometry.oriented_points import OrientedPoints, anchors, oriented_points
from scan2albedo.geometry.rigid import in_principal_frame
from scan2albedo.geometry.surface_noise import SurfaceNoise
from scan2albedo.registration.options import RegistrationOptions

_FEWEST_VERTICES, _FEWEST_SAMPLES = 50, 150
_FACE_MM, _LARGEST_MM = 200.0, 6000.0
_ANCHOR_LIMIT = 600
"""Greatest number of anchors: a scan of a whole room is searched more coarsely."""
SPACING_MM, _CELL_MM, _MARGIN_MM = 4.0, 6.0, 40.0
"""Of the samples, and of the grid over them."""


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

    @cached_property
    def turned_faces(self) -> int:
        """How many faces of the scan as read are wound against their neighbours."""
        return int(turned_against_neighbours(self.raw.faces).sum())

    @cached_property
    def grid(self) -> NearestGrid:
        """The voxel grid over the samples."""
        return NearestGrid.of(self.samples, cell=_CELL_MM, margin=_MARGIN_MM)

    @cached_property
    def noise(self) -> SurfaceNoise:
        """What its vertices say of the noise."""
        return SurfaceNoise.of(self.vertices, self.faces)

    def inside_out(self) -> PreparedScan:
        """Return the scan with the normals of its samples turned over."""
        turned = replace(self, samples=self.samples.inside_out(), anchors=self.anchors.inside_out())
        vars(turned)["noise"] = self.noise  # which normals do not change, and which takes long to measure
        return turned


def prepared_scan(scan: RawScan, options: RegistrationOptions) -> PreparedScan:
    """Check a scan's size and prepare it for the search.

    Raises `RegistrationError` when it has too few vertices or too little surface, or is larger than a room.
    """
    if len(scan.vertices) < _FEWEST_VERTICES:
        raise RegistrationError(
            f"{scan.name}: {len(scan.vertices)} vertices cannot show a face, at least "
            f"{_FEWEST_VERTICES} are needed; scan the whole face"
        )
    faces = scan.faces[~far_faces(scan.vertices, scan.faces)]
    corners = scan.vertices[faces].reshape(-1, 3)
    longest = float(np.ptp(corners, axis=0).max())
    power = round(float(np.log10(_FACE_MM / longest))) if longest > 0 else 0
    unit = "Scan the whole face, and check the unit of the file"
    if power:
        unit = (
            "Check the unit of the file: vertices are taken as millimetres "
            f"(multiplied by {10.0**power:g} it would have the size of a face)"
        )
    if longest > _LARGEST_MM:
        raise RegistrationError(
            f"{scan.name}: the scan (box {box_text(corners)}) is too large: a face is about {_FACE_MM:.0f} "
            f"mm, and it is looked for in at most {_LARGEST_MM / 1000:.0f} m. {unit}"
        )
    vertices, prepared_from_scan = in_principal_frame(scan.vertices, faces)
    samples = oriented_points(vertices, faces, SPACING_MM)
    if len(samples) < _FEWEST_SAMPLES:
        raise RegistrationError(
            f"{scan.name}: its surface of {samples.areas.sum():.3g} mm2 (box {box_text(corners)}) is "
            f"too small for a face of about {_FACE_MM:.0f} mm. {unit}"
        )
    spacing_mm = options.anchor_spacing_mm
    far_apart = anchors(samples, spacing=spacing_mm, limit=_ANCHOR_LIMIT, reach=1.5 * spacing_mm)
    return PreparedScan(vertices, faces, samples, far_apart, prepared_from_scan, scan)


def box_text(vertices: FloatArray) -> str:
    """Return the sides of the vertices' box for a message."""
    return " x ".join(f"{side:.3g}" for side in np.ptp(vertices, axis=0)) + " mm"
