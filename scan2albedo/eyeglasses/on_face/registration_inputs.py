"""What `register_on_face` was given, checked and in the frame's own scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.mean_keypoints import require_posable, usual_size_factor
from scan2albedo.eyeglasses.checks import checked_keypoints, checked_mesh, checked_weights
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT
from scan2albedo.eyeglasses.on_face.mask_distance import MaskDistance
from scan2albedo.eyeglasses.on_face.objective import ObservedView
from scan2albedo.geometry.pinhole import normalized_cameras

Mesh = tuple[FloatArray, IntArray]

_FARTHEST_PX = 1e6
"""No camera has as many pixels a side: such a label is a slip."""


@dataclass(frozen=True)
class RegistrationInputs:
    """Lengths in mm of a frame of usual size, the caller's lengths divided by `unit`."""

    vertices: FloatArray
    faces: IntArray
    keypoints: FloatArray
    """(20, 3), NaN where the frame lacks them."""
    weights: FloatArray | None
    views: tuple[ObservedView, ...]
    masks: tuple[BoolArray | None, ...]
    head: Mesh | None
    start: FloatArray | None
    unit: float
    """Caller's lengths in one of these millimetres."""
    plan: tuple[PlanStep, ...]
    """Masks that do not count."""

    @property
    def known(self) -> BoolArray:
        """(20,) key points that the frame has."""
        return np.asarray(np.isfinite(self.keypoints).all(1))

    @property
    def labelled(self) -> bool:
        """Whether any key point has a label in any view."""
        return any((np.isfinite(view.labels).all(1) & self.known).any() for view in self.views)


def checked_inputs(
    glasses: Any,
    keypoints_2d: ArrayLike,
    masks: Sequence[ArrayLike | None] | ArrayLike | None,
    cameras: ArrayLike,
    head: Any | None,
    start: ArrayLike | None,
    shapes: Sequence[tuple[int, int]] | None = None,
) -> RegistrationInputs:
    """Return the inputs of `register_on_face`, checked; see there for what is raised."""
    vertices, faces, keypoints, weights = _glasses(glasses)
    labels, matrices = np.asarray(keypoints_2d, np.float64), normalized_cameras(cameras)
    if labels.shape != (len(matrices), KEY_POINT_COUNT, 2) or len(matrices) == 0:
        raise ValueError(
            f"keypoints_2d must have shape (C, {KEY_POINT_COUNT}, 2) for C cameras of shape (C, 3, 4), got "
            f"{labels.shape} and {matrices.shape}"
        )
    unit = 1 / usual_size_factor(keypoints)
    given_masks = _masks(masks, len(matrices))
    _require_labels_in_pictures(labels, given_masks)
    sizes = _shapes(shapes, given_masks)
    matrices = matrices * np.array([unit, unit, unit, 1.0])
    matrices = normalized_cameras(matrices)
    views, plan = [], []
    for number, (camera, marks, mask) in enumerate(zip(matrices, labels, given_masks, strict=True)):
        usable = mask is not None and bool(mask.any()) and not bool(mask.all())
        if mask is not None and not usable:
            what = "covers all of its picture" if mask.any() else "is empty"
            plan.append(
                PlanStep("glasses.mask", False, f"the mask of view {number} {what}: it does not count")
            )
        views.append(
            ObservedView(
                camera,
                np.where(np.isfinite(marks).all(1)[:, None], marks, np.nan),
                MaskDistance.of(mask) if usable and mask is not None else None,
                sizes[number],
            )
        )
    skull = None if head is None else _mesh("the head", head)
    return RegistrationInputs(
        vertices=vertices / unit,
        faces=faces,
        keypoints=keypoints / unit,
        weights=weights,
        views=tuple(views),
        masks=given_masks,
        head=None if skull is None else (skull[0] / unit, skull[1]),
        start=None if start is None else _scaled_start(start, unit),
        unit=unit,
        plan=tuple(plan),
    )


def _require_labels_in_pictures(labels: FloatArray, masks: tuple[BoolArray | None, ...]) -> None:
    for number, (marks, mask) in enumerate(zip(labels, masks, strict=True)):
        given = marks[np.isfinite(marks).all(1)]
        if (np.abs(given) > _FARTHEST_PX).any():
            raise EyeglassesError(f"labels of view {number} are no pixels: up to {np.abs(given).max():.3g}")
        if mask is None or not len(given):
            continue
        outside = ((given < -0.5) | (given > np.array(mask.shape[::-1]) - 0.5)).any(1)
        if outside.mean() > 0.5:
            raise EyeglassesError(
                f"{int(outside.sum())} of {len(given)} labels of view {number} lie outside its mask of "
                f"{mask.shape[1]} x {mask.shape[0]} pixels: give masks of the labelled pictures' size"
            )


def _glasses(glasses: Any) -> tuple[FloatArray, IntArray, FloatArray, FloatArray | None]:
    """Return vertices, faces, key points and weights: a tuple of four for the one caller."""
    if hasattr(glasses, "vertices"):
        parts = [glasses.vertices, glasses.faces, glasses.keypoints, getattr(glasses, "weights", None)]
    elif isinstance(glasses, tuple | list) and len(glasses) in (3, 4):
        parts = [*glasses, None][:4]
    else:
        raise ValueError(
            "glasses must have vertices, faces and keypoints, or be a tuple of them and maybe weights, got "
            f"{type(glasses).__name__}"
        )
    vertices, faces = _mesh("the glasses", (parts[0], parts[1]))
    keypoints = checked_keypoints("the glasses' keypoints", parts[2])
    keypoints[~np.isfinite(keypoints).all(1)] = np.nan
    require_posable(keypoints, "the glasses")
    if parts[3] is None:
        return vertices, faces, keypoints, None
    weights = checked_weights("the glasses' weights", parts[3], len(vertices))
    if not np.isfinite(weights).all() or np.abs(weights.sum(1) - 1).max(initial=0.0) > 1e-6:
        raise EyeglassesError("the glasses' weights must be finite, each row of sum 1; solve them again")
    if weights[:, ~np.isfinite(keypoints).all(1)].any():
        raise EyeglassesError("the glasses' weights give a share to key points that the frame lacks")
    return vertices, faces, keypoints, weights


def _mesh(owner: str, mesh: Any) -> Mesh:
    vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "vertices") else mesh
    return checked_mesh(vertices, faces, owner)


def _masks(masks: Sequence[ArrayLike | None] | ArrayLike | None, count: int) -> tuple[BoolArray | None, ...]:
    if masks is None:
        return (None,) * count
    listed: list[Any] = list(masks)  # type: ignore[arg-type]
    if len(listed) != count:
        raise ValueError(f"masks must have one entry for each of {count} cameras, got {len(listed)}")
    result: list[BoolArray | None] = []
    for number, mask in enumerate(listed):
        picture = None if mask is None else np.asarray(mask)
        if picture is not None and (picture.ndim != 2 or min(picture.shape) < 2):
            raise ValueError(f"mask {number} must have shape (H, W) of 2 pixels or more, got {picture.shape}")
        result.append(None if picture is None else picture != 0)
    return tuple(result)


def _shapes(
    shapes: Sequence[tuple[int, int]] | None, masks: tuple[BoolArray | None, ...]
) -> tuple[tuple[int, int] | None, ...]:
    of_masks = tuple(None if mask is None else (mask.shape[0], mask.shape[1]) for mask in masks)
    if shapes is None:
        return of_masks
    if len(shapes) != len(masks):
        raise ValueError(f"shapes must have one entry for each of {len(masks)} cameras, got {len(shapes)}")
    given = tuple((int(height), int(width)) for height, width in shapes)
    for number, (own, said) in enumerate(zip(of_masks, given, strict=True)):
        if own not in (None, said):
            raise ValueError(f"mask {number} has shape {own}, expected its picture's {said}")
    return given


def _scaled_start(start: ArrayLike, unit: float) -> FloatArray:
    pose = np.array(start, np.float64)
    if pose.shape != (4, 4):
        raise ValueError(f"start must have shape (4, 4), got {pose.shape}")
    rotation = pose[:3, :3]
    if not np.isfinite(pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6:
        raise EyeglassesError("start must be a rigid world_from_glasses: a rotation and a translation")
    pose[:3, 3] /= unit
    return pose
