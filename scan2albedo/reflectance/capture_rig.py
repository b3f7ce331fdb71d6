"""`CaptureRig`: from where each picture was taken and lit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.pinhole import camera_centers, normalized_cameras


@dataclass(frozen=True)
class CaptureRig:
    """Cameras and flashes of J pictures, in the frame of the face.

    Raises `ReflectanceError` when shapes disagree, or numbers are not finite.
    """

    cameras: FloatArray
    """(J, 3, 4): projection matrices, pixels (column, row) from points in mm, normalised so that depth is
    third."""
    light_positions: FloatArray
    """(J, 3): of the flash that lit each picture, in mm."""
    light: IntArray
    """(J,): number of that flash, 0, 1, ..."""

    def __post_init__(self) -> None:
        try:
            cameras = normalized_cameras(self.cameras)
        except ValueError as error:
            raise ReflectanceError(f"the cameras of the rig cannot be used: {error}") from error
        positions, light = np.asarray(self.light_positions, np.float64), np.asarray(self.light)
        if positions.shape != (len(cameras), 3) or not np.isfinite(positions).all():
            raise ReflectanceError(
                f"light_positions is {positions.shape}, expected finite numbers ({len(cameras)}, 3)"
            )
        if light.shape != (len(cameras),) or not np.issubdtype(light.dtype, np.integer) or (light < 0).any():
            raise ReflectanceError(
                f"light is {light.dtype} {light.shape}, expected ({len(cameras)},) integers >= 0"
            )
        object.__setattr__(self, "cameras", cameras)
        object.__setattr__(self, "light_positions", positions)
        object.__setattr__(self, "light", light.astype(np.int64))

    @property
    def camera_positions(self) -> FloatArray:
        """(J, 3) centres of projection in mm."""
        return camera_centers(self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)


def rig_of_head_poses(
    rotations: ArrayLike, translations: ArrayLike, intrinsics: ArrayLike, *, view: ArrayLike, flash: ArrayLike
) -> CaptureRig:
    """Return the rig in which each flash is at the place of a camera.

    A head pose maps points of the face into camera c, x_cam = R_c x + t_c; seen from the face, the camera is
    turned by R_c^T and is at -R_c^T t_c. Picture j is taken by camera view[j], lit by the flash at camera
    flash[j] (Han, Wang, Xu, supplement, Eq. 1). Raises `ReflectanceError` when shapes disagree, a matrix is
    no rotation, or a number refers to no camera.

    Parameters
    ----------
    rotations : (C, 3, 3) array_like of float
        R, proper.
    translations : (C, 3) array_like of float
        t in mm.
    intrinsics : (3, 3) or (C, 3, 3) array_like of float
        Pixels from camera coordinates.
    view, flash : (J,) array_like of int
        Numbers of cameras.

    Examples
    --------
    >>> rig = rig_of_head_poses([np.eye(3)], [[0.0, 0, 600]], np.diag([900.0, 900, 1]), view=[0], flash=[0])
    >>> (0 - rig.light_positions).tolist()
    [[0.0, 0.0, 600.0]]
    """
    turn, shift = np.asarray(rotations, np.float64), np.asarray(translations, np.float64)
    if turn.ndim != 3 or turn.shape[1:] != (3, 3) or shift.shape != turn.shape[:2]:
        raise ReflectanceError(
            f"rotations is {turn.shape} and translations {shift.shape}, expected (C, 3, 3) and (C, 3)"
        )
    finite = np.where(np.isfinite(turn).all((1, 2), keepdims=True), turn, 0.0)
    off = np.abs(finite @ finite.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = (off > 1e-4) | (np.linalg.det(finite) <= 0)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise ReflectanceError(
            f"head pose {first} has no proper rotation: R R^T is off by {off[first]:.3g}, det R is "
            f"{np.linalg.det(finite[first]):.3g}"
        )
    numbers = [np.asarray(index) for index in (view, flash)]
    for name, index in zip(("view", "flash"), numbers, strict=True):
        if index.ndim != 1 or not np.issubdtype(index.dtype, np.integer) or len(index) != len(numbers[0]):
            raise ReflectanceError(
                f"{name} is {index.dtype} {index.shape}, expected (J,) integers, one a picture"
            )
        if len(index) and not (index.min() >= 0 and index.max() < len(turn)):
            raise ReflectanceError(
                f"{name} reaches {index.min()} to {index.max()}, but there are {len(turn)} poses"
            )
    inner = np.broadcast_to(np.asarray(intrinsics, np.float64), turn.shape)
    cameras = inner @ np.concatenate([turn, shift[:, :, None]], axis=2)
    centers = -np.einsum("cji,cj->ci", turn, shift)
    return CaptureRig(cameras[numbers[0]], centers[numbers[1]], numbers[1])
