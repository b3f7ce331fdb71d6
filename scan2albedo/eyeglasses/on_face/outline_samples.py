"""Which points of a frame make its outlines in the pictures, and can be compared with the masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.on_face.interface import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.mask_distance import search_edges
from scan2albedo.eyeglasses.on_face.objective import ObservedView, OutlineSamples
from scan2albedo.eyeglasses.on_face.outline import Outline, cover, covered_points, trace_outline
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rays import RayCaster

_FACING = 0.3
"""Least cosine between where outside is for the frame's outline and for the observed one."""
_ABOVE_SKIN_MM = 1.0
"""The head hides points more than this behind its surface: frames rest on the skin."""
_HEAD_MARGIN_PX = 4.0
"""Pixels of the outline this near to where the head hides the frame are left out."""
_REACH, _NEAR_PX = 3.0, 5.0
"""Standard deviations that a sample reaches, and pixels more for noise and what weights cannot bend."""


@dataclass(frozen=True)
class FrameMesh:
    """A frame at rest; weights (V, K)."""

    points: SkinnedPoints
    faces: IntArray


def hidden_by(head: RayCaster | None, camera: FloatArray, points: FloatArray) -> BoolArray:
    """Return (N,) True for points that the head hides from a camera."""
    if head is None:
        return np.zeros(len(points), bool)
    toward = camera_centers(camera[None])[0] - points
    return head.occluded(points + _ABOVE_SKIN_MM * normalized(toward), toward)


def _no_samples(mesh: FrameMesh) -> OutlineSamples:
    handles = mesh.points.weights.shape[1]
    nowhere = np.zeros((0, 2))
    points = SkinnedPoints(np.zeros((0, 3)), np.zeros((0, handles)))
    return OutlineSamples(np.zeros(0, np.int64), points, nowhere, nowhere)


def _px_per_mm(camera: FloatArray, depth: FloatArray) -> FloatArray:
    """Return (N,) pixels that a millimetre across the line of sight takes at each depth."""
    skew = np.linalg.det(camera[:, :3])
    return np.sqrt(abs(skew)) / depth


class OutlineSampler:
    """Traces the outlines of a moving frame, with the head, if any, in front of it."""

    def __init__(
        self,
        mesh: FrameMesh,
        views: tuple[ObservedView, ...],
        head: RayCaster | None,
        options: FaceRegistrationOptions,
        shown: tuple[IntArray, ...] | None = None,
    ) -> None:
        """`shown` are the faces that each view's mask shows, all of them when omitted."""
        self.mesh, self.views, self.head, self.options = mesh, views, head, options
        self.shown = (mesh.faces,) * len(views) if shown is None else shown

    def sample(self, motion: FrameMotion, deviation_mm: FloatArray) -> OutlineSamples:
        """Return outline points that the head does not hide and whose observed outline is within reach.

        `deviation_mm` (K,) says how well the key points are known so far: an uncertain one reaches far.
        """
        vertices = motion.positions(self.mesh.points)
        parts = [self._of_view(n, vertices, deviation_mm) for n in range(len(self.views))]
        return OutlineSamples(
            np.concatenate([p.view for p in parts]),
            SkinnedPoints(
                np.concatenate([p.points.rest for p in parts]),
                np.concatenate([p.points.weights for p in parts]),
            ),
            np.concatenate([p.edges for p in parts]),
            np.concatenate([p.outward for p in parts]),
        )

    def mask(self, motion: FrameMotion, number: int) -> tuple[BoolArray, IntArray]:
        """Return (H, W) True where a view should show the frame, the head in front, and its `shown` faces."""
        view, faces = self.views[number], self.shown[number]
        assert view.shape is not None
        vertices = motion.positions(self.mesh.points)
        pixels, depth = project(view.camera, vertices)
        covered = cover(pixels, depth, faces, view.shape)
        at, face, share = covered_points(covered, pixels, depth, faces)
        place = np.einsum("nk,nki->ni", share, vertices[faces[face]])
        seen = ~hidden_by(self.head, view.camera, place)
        owner = np.full(view.shape, -1, np.int64)
        owner[at[seen, 1], at[seen, 0]] = face[seen]
        return owner >= 0, owner

    def _of_view(self, number: int, vertices: FloatArray, deviation_mm: FloatArray) -> OutlineSamples:
        view, mesh, faces = self.views[number], self.mesh, self.shown[number]
        if view.distance is None or view.shape is None:
            return _no_samples(mesh)
        pixels, depth = project(view.camera, vertices)
        covered = cover(pixels, depth, faces, view.shape)
        outline = trace_outline(covered, pixels, depth, faces, view.shape)
        outline = outline.thinned(self.options.outline_stride)
        foremost = faces[outline.face, 0]
        reach = (
            _REACH * mesh.points.weights[foremost] @ deviation_mm * _px_per_mm(view.camera, depth[foremost])
        )
        reach = np.minimum(_NEAR_PX + reach, self.options.outline_reach_px)
        edges, kept = self._matched(view, outline, reach)
        corners, share = faces[outline.face[kept]], outline.barycentric[kept]
        place = np.einsum("nk,nki->ni", share, vertices[corners])
        free = ~self._near_head(view, place, outline.pixels[kept].astype(np.float64))
        corners, share, chosen = corners[free], share[free], np.flatnonzero(kept)[free]
        return OutlineSamples(
            np.full(len(chosen), number),
            SkinnedPoints(
                np.einsum("nk,nki->ni", share, mesh.points.rest[corners]),
                np.einsum("nk,nki->ni", share, mesh.points.weights[corners]),
            ),
            edges[chosen],
            outline.outward[chosen],
        )

    def _matched(
        self, view: ObservedView, outline: Outline, reach_px: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return edges (N, 2) found by a search across the outline, and which pixels have a match (N,).

        Where the nearest border of the mask has its outside on the same side, its distance counts; elsewhere,
        such as at the end of a temple that is too short, the search does.
        """
        assert view.distance is not None
        assert view.shape is not None
        pixels = outline.pixels.astype(np.float64)
        distance, slope = view.distance.sample(pixels)
        facing = np.einsum("ni,ni->n", slope, outline.outward)
        # Points nearer to the picture's border than to the observed outline may have it outside.
        border = np.minimum(pixels, [view.shape[1] - 1, view.shape[0] - 1] - pixels).min(1)
        limit = np.minimum(reach_px, border + 0.5)
        with np.errstate(invalid="ignore"):
            near = np.abs(distance) <= limit
            near &= facing >= _FACING * np.linalg.norm(slope, axis=1)
        edges, lost = np.full((len(pixels), 2), np.nan), np.flatnonzero(~near)
        way = search_edges(view.distance, pixels[lost], outline.outward[lost], limit[lost], _FACING)
        edges[lost] = pixels[lost] + way[:, None] * outline.outward[lost]
        return edges, near | np.isfinite(edges[:, 0])

    def _near_head(self, view: ObservedView, place: FloatArray, pixels: FloatArray) -> BoolArray:
        """Return (N,) True where the head hides the point, or a ray some pixels beside it."""
        if self.head is None or not len(place):
            return np.zeros(len(place), bool)
        hidden = hidden_by(self.head, view.camera, place)
        center = camera_centers(view.camera[None])[0]
        far = np.linalg.norm(place - center, axis=1)[:, None]
        for way in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beside = center + far * pixel_directions(view.camera, pixels + _HEAD_MARGIN_PX * np.array(way))
            hidden |= hidden_by(self.head, view.camera, beside)
        return hidden
