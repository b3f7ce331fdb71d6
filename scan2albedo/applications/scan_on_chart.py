"""Where on the face's chart each vertex of a raw scan lies, and how much it belongs to the face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rigid import transform_points

_NEAR_MM, _FAR_MM = 2.5, 5.0
"""Up to this distance from the fitted surface a vertex belongs to the face; from that on not at all."""
_FACING = (0.0, 0.3)
"""The same of the cosine between its normal and the surface's."""
_RIM_MM = 10.0
"""Over this width at the model's rim the face ends gradually."""


@dataclass(frozen=True)
class ScanOnChart:
    """`uv` (V, 2), the chart's place nearest to each vertex, and its `weight` (V,) in [0, 1]."""

    uv: FloatArray
    weight: FloatArray


def scan_on_chart(scan: RawScan, fitted: FittedFace, image: GeometryImage) -> ScanOnChart:
    """Return where the vertices of a scan lie on the chart of the geometry image of its fitted face.

    Weight falls to 0 at the model's rim, and where the scan is far from the fitted surface, looks another
    way, or was left out of the fit (`FittedFace.covered_faces`).
    """
    vertices = transform_points(fitted.model_from_scan, scan.vertices)
    low, high = fitted.vertices.min(0) - _FAR_MM, fitted.vertices.max(0) + _FAR_MM
    near = np.flatnonzero(((vertices > low) & (vertices < high)).all(1))
    uv, weight = np.full((len(vertices), 2), 0.5), np.zeros(len(vertices))
    if len(near) == 0:
        return ScanOnChart(uv, weight)
    hits = surface_query(fitted.vertices, fitted.faces).query(vertices[near])
    corners = fitted.faces[hits.face]
    uv[near] = np.einsum("nk,nkc->nc", hits.barycentric, fitted.uv[corners])
    across = np.einsum("nk,nkc->nc", hits.barycentric, vertex_normals(fitted.vertices, fitted.faces)[corners])
    cosine = np.einsum("nc,nc->n", across, vertex_normals(vertices, scan.faces)[near])
    weight[near] = _smooth((_FAR_MM - hits.distance) / (_FAR_MM - _NEAR_MM))
    weight[near] *= _smooth((cosine - _FACING[0]) / (_FACING[1] - _FACING[0]))
    weight[near] *= _smooth(_from_rim_mm(image, uv[near]) / _RIM_MM)
    if fitted.covered_faces is not None and len(fitted.covered_faces) == len(scan.faces):
        weight[scan.faces[fitted.covered_faces]] = 0.0
    return ScanOnChart(uv, weight)


def _from_rim_mm(image: GeometryImage, uv: FloatArray) -> FloatArray:
    """Return (N,) about how far places of the chart are from its rim."""
    areas = image.texel_areas_mm2()
    texel_mm = float(np.sqrt(np.median(areas))) if len(areas) else 0.0
    inside = distance_transform_edt(np.pad(image.mask, 1))[1:-1, 1:-1]
    return texel_mm * bilinear(inside[..., None], pixels_from_uv(uv, image.shape))[:, 0]


def _smooth(progress: FloatArray) -> FloatArray:
    """Return 0 up to 0, 1 from 1 on, and a smooth step between."""
    step = np.clip(progress, 0.0, 1.0)
    return np.asarray(step * step * (3 - 2 * step))
