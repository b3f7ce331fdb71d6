"""Colour of a raw scan at given surface points, with what was badly seen known as such."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_vertex_mask, face_areas, face_cross_products, face_normals
from scan2albedo.io.raw_scan import RawScan

FloatArray = NDArray[np.float64]

SIDEWAYS_MM = 0.5
"""A point farther sideways of the scan's edge than this lies in a hole, not above the edge."""


@dataclass(frozen=True)
class LookupOptions:
    """When a texel's texture counts as seen, and how it is filtered."""

    max_distance_mm: float = 4.0
    """Farther from the raw surface than this, a texel has no texture (hole, hair, ear)."""
    min_normal_cosine: float = 0.5
    """The raw surface must face the way the fitted one does; 0.5 is 60 degrees."""
    min_density: float = 0.1
    """Photograph pixels per mm^2 relative to the scan's median: below, the surface was seen at grazing."""
    taps: int = 3
    """Bilinear samples along each side of a texel's footprint in the photograph."""


class TextureLookup:
    """Looks up a scan's texture (or vertex colour) at the closest points of its surface."""

    def __init__(self, scan: RawScan, options: LookupOptions = LookupOptions()) -> None:
        self._scan, self._options = scan, options
        self._query = ClosestPointQuery(scan.vertices, scan.faces)
        self._normals = face_normals(scan.vertices, scan.faces)

    def sample(
        self, points: FloatArray, normals: FloatArray, steps: FloatArray
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return linear colour (N, 3) and whether it was well seen (N,).

        Parameters
        ----------
        points, normals : (N, 3) float64
            Where to look, scan frame, mm; unit normals.
        steps : (N, 3, 2) float64
            Displacement (mm) on the surface of one texel to the right and one down: the footprint that
            the photograph is averaged over.
        """
        hits = self._query.query(points)
        valid = hits.distance <= self._options.max_distance_mm
        valid &= np.einsum("ij,ij->i", normals, self._normals[hits.face]) >= self._options.min_normal_cosine
        valid &= ~self._past_boundary(hits.face, hits.barycentric, points - hits.points, normals)
        if self._scan.uv is not None and self._scan.texture_linear is not None:
            color = self._photograph(hits.face, hits.barycentric, steps)
            valid &= self._dense_enough()[hits.face]
        else:
            assert self._scan.vertex_color_linear is not None
            corners = self._scan.vertex_color_linear[self._scan.faces[hits.face]]
            color = np.einsum("nk,nkc->nc", hits.barycentric, corners).astype(np.float32)
        return color, valid

    def _past_boundary(
        self, face: NDArray[np.int64], barycentric: FloatArray, offset: FloatArray, normals: FloatArray
    ) -> NDArray[np.bool_]:
        """Points whose closest point lies on the scan's edge while they lie sideways of it: in a hole."""
        faces = self._scan.faces
        on_edge = boundary_vertex_mask(len(self._scan.vertices), faces)[faces[face]]
        at_boundary = (np.where(on_edge, 0.0, barycentric).sum(1) < 1e-6) & (on_edge.sum(1) >= 1)
        sideways = offset - np.einsum("ij,ij->i", offset, normals)[:, None] * normals
        return at_boundary & (np.linalg.norm(sideways, axis=1) > SIDEWAYS_MM)

    def _dense_enough(self) -> NDArray[np.bool_]:
        """(F,) whether a face has enough photograph pixels for its area."""
        assert self._scan.uv is not None
        uv = self._scan.uv
        e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        texture_area = 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
        area = face_areas(self._scan.vertices, self._scan.faces)
        density = texture_area / np.maximum(area, 1e-12)
        used = density[texture_area > 0]
        return density > (self._options.min_density * np.median(used) if len(used) else np.inf)

    def _photograph(
        self, face: NDArray[np.int64], barycentric: FloatArray, steps: FloatArray
    ) -> NDArray[np.float32]:
        """Average bilinear samples over each texel's footprint in the photograph."""
        import cv2

        scan, taps = self._scan, self._options.taps
        assert scan.uv is not None
        assert scan.texture_linear is not None
        height, width = scan.texture_linear.shape[:2]
        to_pixels = np.array([width, -height])
        center = np.einsum("nk,nkc->nc", barycentric, scan.uv[face]) * to_pixels + [-0.5, height - 0.5]
        footprint = np.einsum("nck,nkd->ncd", self._uv_gradients()[face], steps) * to_pixels[:, None]
        offsets = (np.arange(taps) + 0.5) / taps - 0.5
        total = np.zeros((len(face), 3), np.float32)
        for right in offsets:
            for down in offsets:
                pixel = (center + footprint @ [right, down]).astype(np.float32)
                # remap takes 2D maps with sides below 32768, so the list of points is folded.
                columns = min(len(face), 16384)
                rows = -(-len(face) // columns)
                padded = np.resize(pixel, (rows * columns, 2)).reshape(rows, columns, 2)
                sampled = cv2.remap(
                    scan.texture_linear,
                    padded[..., 0],
                    padded[..., 1],
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                total += sampled.reshape(-1, 3)[: len(face)]
        return total / np.float32(taps * taps)

    def _uv_gradients(self) -> FloatArray:
        """(F, 2, 3) gradient of u and v over each face, per mm; zero on degenerate faces."""
        scan = self._scan
        assert scan.uv is not None
        corners = scan.vertices[scan.faces]
        cross = face_cross_products(scan.vertices, scan.faces)
        squared = np.maximum(np.einsum("ij,ij->i", cross, cross), 1e-24)
        gradient = np.zeros((len(scan.faces), 2, 3))
        for k in range(3):
            opposite = corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]
            hat = np.cross(cross, opposite) / squared[:, None]
            gradient += scan.uv[:, k, :, None] * hat[:, None, :]
        return gradient


def texel_steps(
    vertices: FloatArray, uv: FloatArray, faces: NDArray[np.int64], shape: tuple[int, int]
) -> FloatArray:
    """Return (F, 3, 2): displacement in mm of one texel to the right and one texel down on each face."""
    corners, chart = vertices[faces], uv[faces]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], 2)
    chart_edges = np.stack([chart[:, 1] - chart[:, 0], chart[:, 2] - chart[:, 0]], 2)
    determinant = np.linalg.det(chart_edges)
    usable = np.abs(determinant) > 1e-15
    inverse = np.zeros_like(chart_edges)
    inverse[usable] = np.linalg.inv(chart_edges[usable])
    height, width = shape
    return edges @ inverse @ np.array([[1 / width, 0.0], [0.0, -1 / height]])
