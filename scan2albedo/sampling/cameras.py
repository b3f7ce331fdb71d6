"""Which cameras took a scan's texture, and where they stood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.mesh import face_normals, vertex_components
from scan2albedo.geometry.pinhole import camera_centers, fit_camera
from scan2albedo.geometry.tangents import split_at_seams

_LEAST_PART, _LEAST_FACES = 0.02, 100
"""Faces of a piece of the texture from which a camera is fitted: as a part of all, and their number."""
_OFF = 0.003
"""Median distance, as a part of a piece's span in the texture, by which a camera may miss it. Photographs of
a stereo scanner have 0.0005, unwrapped surfaces 0.01 and more."""
_RELIEF = 0.02
"""Least thickness of a piece as a part of its length: nothing shows where the camera of a plane stood."""
_FACING = 0.9
"""Part of a piece's faces that has to face its camera."""
_CAMERAS = 0.8
"""Part of the faces that cameras have to explain: the texture is photographs or it is not."""


@dataclass(frozen=True)
class TextureCameras:
    """`face_camera` (F,) is the number of the camera that took a face, -1 where it is not known.

    `positions` (K, 3) is where the cameras stood, mm in the scan's frame.
    """

    face_camera: IntArray
    positions: FloatArray


def texture_cameras(scan: RawScan) -> TextureCameras | None:
    """Find the cameras whose photographs a scan's texture is made of; None where it is not.

    Of a photograph, texture coordinates are the vertices' projection by a pinhole camera. It is fitted to
    each connected piece of the texture, large ones first; unwrapped surfaces fit none.
    """
    if scan.uv is None or scan.texture_linear is None or len(scan.faces) < _LEAST_FACES:
        return None
    height, width = scan.texture_linear.shape[:2]
    corners, pixels = scan.vertices[scan.faces], scan.uv * np.array([width, height])
    normals = face_normals(scan.vertices, scan.faces)
    # The connected piece of the texture that each face is part of.
    corner = split_at_seams(scan.faces, scan.uv).faces
    pieces = vertex_components(int(corner.max()) + 1, corner)[corner[:, 0]]
    camera, positions = np.full(len(scan.faces), -1), list[FloatArray]()
    sizes = np.bincount(pieces)
    least = max(_LEAST_FACES, _LEAST_PART * len(scan.faces))
    for piece in np.flatnonzero(sizes >= least)[np.argsort(-sizes[sizes >= least], kind="stable")]:
        inside = pieces == piece
        if np.mean(camera[inside] >= 0) > 0.5 or len(positions) == 100:
            continue
        fitted = _fitted(corners[inside], pixels[inside], normals[inside])
        if fitted is None:
            continue
        off = _distances(fitted, corners, pixels).max(1)
        camera[(camera < 0) & (inside | (off < _tolerance(pixels[inside])))] = len(positions)
        positions.append(camera_centers(fitted[None])[0])
    if np.mean(camera >= 0) < _CAMERAS:
        return None
    return TextureCameras(camera, np.array(positions))


def _fitted(corners: FloatArray, pixels: FloatArray, normals: FloatArray) -> FloatArray | None:
    """Return the camera (3, 4) of a piece with corners (F, 3, 3), pixels (F, 3, 2), normals (F, 3)."""
    some = np.linspace(0, len(corners) - 1, min(len(corners), 4000)).astype(np.int64)
    points, places = corners[some].reshape(-1, 3), pixels[some].reshape(-1, 2)
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if extents[2] < _RELIEF * extents[0]:
        return None
    kept: BoolArray = np.ones(len(points), bool)
    for _ in range(4):
        camera = fit_camera(points[kept], places[kept])
        off = _distances(camera, points, places)
        kept = off <= 4 * np.median(off)
    if not np.median(off) < _tolerance(pixels):
        return None
    facing = np.einsum("ij,ij->i", camera_centers(camera[None])[0] - corners[:, 0], normals) > 0
    return camera if facing.mean() >= _FACING else None


def _distances(camera: FloatArray, points: FloatArray, places: FloatArray) -> FloatArray:
    """Return how far from `places` (..., 2) a camera (3, 4) projects points (..., 3)."""
    image = points @ camera[:, :3].T + camera[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(image[..., :2] / image[..., 2:] - places, axis=-1))


def _tolerance(pixels: FloatArray) -> float:
    return _OFF * float(np.ptp(pixels.reshape(-1, 2), axis=0).max())
