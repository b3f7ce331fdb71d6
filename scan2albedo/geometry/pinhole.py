"""Pinhole cameras as (3, 4) projection matrices: pixels (column, row), centres of pixels at integers."""

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, GridShape, all_finite, norms, rms
from scan2albedo.geometry.mesh import normalized


def normalized_cameras(cameras: ArrayLike) -> FloatArray:
    """Return (C, 3, 4) projection matrices of any scale and sign so that depth is the third coordinate.

    The third row's direction becomes a unit vector, and points in front of the camera get positive depth.
    Raises ValueError when the shape is another, numbers are not finite, or a left 3x3 part is singular.
    """
    matrices = np.asarray(cameras, float)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 4):
        raise ValueError(f"cameras must have shape (C, 3, 4), got {matrices.shape}")
    if not all_finite(matrices):
        raise ValueError("cameras must be finite")
    scale = norms(matrices[:, 2, :3]) * np.sign(np.linalg.det(matrices[:, :, :3]))
    if not (scale != 0).all():
        raise ValueError(f"camera {np.argmin(np.abs(scale))} has a singular left 3x3 part")
    return matrices / scale[:, None, None]


def project(camera: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return pixels (N, 2), NaN where depth <= 0, and depths (N,) in a normalised camera (3, 4)."""
    image = points @ camera[:, :3].T + camera[:, 3]
    depth = image[:, 2]
    return image[:, :2] / np.where(depth > 0, depth, np.nan)[:, None], depth


def projected(cameras: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return pixels (N, 2) of points (N, 3), NaN behind a camera, derivatives (N, 2, 3), and which are ahead.

    `cameras` (N, 3, 4) are normalised; one, (1, 3, 4), may be that of all points.
    """
    image = np.einsum("nij,nj->ni", cameras[:, :, :3], points) + cameras[:, :, 3]
    front = image[:, 2] > 0
    depth = np.where(front, image[:, 2], np.nan)
    pixels = image[:, :2] / depth[:, None]
    slopes = (cameras[:, :2, :3] - pixels[:, :, None] * cameras[:, 2:, :3]) / depth[:, None, None]
    return pixels, slopes, front


def camera_centers(cameras: FloatArray) -> FloatArray:
    """Return (..., 3) centres of projection of cameras (..., 3, 4)."""
    return np.asarray(-np.linalg.solve(cameras[..., :3], cameras[..., 3:])[..., 0], float)


def focal_px(camera: FloatArray) -> float:
    """Return by how many pixels a length is seen at a depth as great, in a normalised camera (3, 4)."""
    return float(np.sqrt(abs(np.linalg.det(camera[:, :3]))))


def fit_camera(points: ArrayLike, pixels: ArrayLike) -> FloatArray:
    """Return the (3, 4) camera that projects points (N, 3), six or more, to pixels (N, 2), least squares.

    The homogeneous linear equations of [1]_, section 7.1 (DLT), in coordinates of mean 0 and unit size. Where
    all points lie in a plane, many cameras do so, and one of them is returned.

    .. [1] R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd edition, 2004.
    """
    space, to_space = _centred(np.asarray(points, float))
    plane, to_plane = _centred(np.asarray(pixels, float))
    none = np.zeros_like(space)
    rows = np.block([[space, none, -plane[:, :1] * space], [none, space, -plane[:, 1:2] * space]])
    camera = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 4)
    return np.asarray(np.linalg.solve(to_plane, camera @ to_space), float)


def _centred(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return homogeneous points (N, d + 1) of mean 0 and unit size, and the matrix that made them so."""
    mean, d = points.mean(0), points.shape[1]
    size = rms(points - mean) or 1.0
    matrix = np.eye(d + 1)
    matrix[:d, :d] /= size
    matrix[:d, d] = -mean / size
    return np.column_stack([points, np.ones(len(points))]) @ matrix.T, matrix


def pixel_directions(camera: FloatArray, pixels: ArrayLike) -> FloatArray:
    """Return (N, 3) unit vectors from the camera through pixels (N, 2); the camera normalised."""
    plane = np.asarray(pixels, float)
    homogeneous = np.column_stack([plane, np.ones(len(plane))])
    return normalized(np.asarray(np.linalg.solve(camera[:, :3], homogeneous.T).T, float))


def pixel_grid(shape: GridShape) -> FloatArray:
    """Return (H W, 2) pixels (column, row) of an image (H, W), row by row."""
    row, column = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    return np.stack([column, row], 1).astype(float)


def look_at(
    position: ArrayLike, target: ArrayLike, *, focal_px: float, shape: GridShape, roll_rad: float = 0.0
) -> FloatArray:
    """Return the (3, 4) camera at `position` that sees `target` in the middle of its picture (H, W), +y up.

    The two points are not one above the other; `roll_rad` turns the camera around its line of sight.

    >>> camera = look_at([0, 0, 600], [0, 0, 0], focal_px=1800, shape=(1025, 1025))
    >>> project(camera, np.array([[10.0, 20.0, 0.0]]))
    (array([[542., 452.]]), array([600.]))
    """
    at = np.asarray(position, float)
    forward = normalized(np.asarray(target, float) - at)
    right = normalized(np.cross(forward, [0.0, 1.0, 0.0]))
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    height, width = shape
    intrinsic = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]])
    return intrinsic @ np.column_stack([rotation, -rotation @ at])
