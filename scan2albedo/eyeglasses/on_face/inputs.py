"""Settings, checked inputs and result of `register_on_face`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import Any

import numpy as np

from scan2albedo.core import Plan, PlanStep, Trace
from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    GridShape,
    IntArray,
    NDArray,
    Texts,
    all_finite,
    checked_array,
    finite_rows,
)
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, checked_keypoints, checked_mesh, checked_weights
from scan2albedo.eyeglasses.mean_keypoints import require_posable, typical_size_factor
from scan2albedo.eyeglasses.on_face.outline import MaskDistance, ObservedView
from scan2albedo.geometry.pinhole import normalized_cameras
from scan2albedo.geometry.rasterization import within
from scan2albedo.geometry.rigid import is_rigid

OBSERVED_MM = 1.2
"""Deviation up to which a point counts as observed, in mm of a frame of usual size."""


@dataclass(frozen=True)
class FaceRegistrationOptions:
    """Settings of `register_on_face`.

    Lengths in mm are those of a frame of usual size, whose bones' median is 30 mm; they scale with the frame.
    """

    bend: bool = True
    """Whether the frame may bend; otherwise it is moved as it is."""
    label_noise_px: float = 2.0
    """How far labels of key points are usually off; labels many times that hardly pull."""
    outline_noise_px: float = 1.0
    """How far a mask's outline is usually off."""


@dataclass(frozen=True)
class RegisteredEyeglasses:
    """A frame where the pictures show it; lengths in the cameras' unit. See `register_on_face`."""

    vertices: FloatArray
    faces: IntArray
    weights: FloatArray
    keypoints: FloatArray
    world_from_glasses: FloatArray
    """(4, 4) rigid, without the bend, into the world of `vertices` (V, 3) and `keypoints` (20, 3), NaN where
    the frame lacks them; `faces` (F, 3) and `weights` (V, 20) are as given."""
    handle_transforms: FloatArray
    """(20, 4, 4) from the glasses at rest to the world, bend included, for `skin`."""
    bend: FloatArray
    """(20, 3) shifts of the key points in the glasses' own frame; 0 where it lacks them."""
    visible: BoolArray
    """(C, V) vertices in the picture that the head does not hide, whether the frame hides them or not."""
    deviation: FloatArray
    """(V,) root mean square distance that each vertex may be off."""
    observed: BoolArray
    """(V,) visible in a view, known to `OBSERVED_MM`, and not contradicted by a mask; none where more than a
    third of the labels do not fit, or the budget ended before the bend was found."""
    keypoint_deviation: FloatArray
    keypoints_observed: BoolArray
    """(20,) key points that the head leaves visible in a view and whose `keypoint_deviation` (20,), NaN where
    the frame lacks them, is at most `OBSERVED_MM`."""
    depth_deviation: float
    depth_observed: bool
    """Whether `depth_deviation`, the root mean square standard deviation along the line of sight over key
    points in view, is at most `OBSERVED_MM`: one view hardly sees depth."""
    label_errors_px: FloatArray
    inliers: BoolArray
    """(C, 20) labels whose error, `label_errors_px`, is within three times `options.label_noise_px`."""
    outline_rms_px: FloatArray
    """(C,) distance of the outline from the mask's, where they can be compared; NaN without a mask."""
    iou: FloatArray
    """(C,) of the frame's mask and the given one; NaN without. Frames millimetres off reach 0.97."""
    converged: bool
    iterations: int
    """Evaluations of the objective; not `converged`: the budget ended first or outlines did not settle."""
    plan: Plan
    trace: Trace = Trace()
    """Errors in pixels; `plan` says which steps ran or were left out, and why."""
    proposed_labels: FloatArray = field(default_factory=lambda: np.zeros((0, 20, 2)))
    """(C, 20, 2) key points in views whose outline was sought in a picture, where nobody labelled them and
    it was found around them; NaN elsewhere. Files do not keep what was proposed: C is 0."""
    proposed_deviation_px: FloatArray = field(default_factory=lambda: np.zeros((0, 20)))
    """(C, 20) standard deviation of each along each axis of its picture."""
    proposed_masks: tuple[BoolArray | None, ...] = ()
    """(H, W) of the frame in these views, None for the others."""

    @property
    def unobserved(self) -> Texts:
        """What the pictures do not determine: "depth", and names of key points."""
        lost = np.isfinite(self.keypoint_deviation) & ~self.keypoints_observed
        return (() if self.depth_observed else ("depth",)) + tuple(compress(KEY_POINT_NAMES, lost))


@dataclass(frozen=True)
class RegistrationInputs:
    """Lengths in mm of a frame of usual size, the caller's lengths divided by `unit`.

    `keypoints` (20, 3) are NaN where the frame lacks them; the `plan` names masks that do not count.
    """

    vertices: FloatArray
    faces: IntArray
    keypoints: FloatArray
    weights: FloatArray | None
    views: tuple[ObservedView, ...]
    masks: tuple[BoolArray | None, ...]
    pictures: tuple[NDArray | None, ...]
    head: tuple[FloatArray, IntArray] | None
    start: FloatArray | None
    unit: float
    plan: tuple[PlanStep, ...]

    @property
    def known(self) -> BoolArray:
        """(20,) key points that the frame has."""
        return finite_rows(self.keypoints)

    @property
    def labelled(self) -> bool:
        """Whether any key point has a label in any view."""
        return any((finite_rows(view.labels) & self.known).any() for view in self.views)


def checked_inputs(
    glasses: Any,
    keypoints_2d: ArrayLike,
    masks: Sequence[ArrayLike | None] | ArrayLike | None,
    cameras: ArrayLike,
    head: Any | None,
    start: ArrayLike | None,
    shapes: Sequence[GridShape] | None = None,
    pictures: Sequence[ArrayLike | None] | None = None,
) -> RegistrationInputs:
    """Return the inputs of `register_on_face`, checked; see there for what is raised."""
    if hasattr(glasses, "vertices"):
        parts = [glasses.vertices, glasses.faces, glasses.keypoints, getattr(glasses, "weights", None)]
    elif isinstance(glasses, tuple | list) and len(glasses) in (3, 4):
        parts = [*glasses, None][:4]
    else:
        raise ValueError(
            "glasses must have vertices, faces and keypoints, or be a tuple of them and maybe weights, got "
            f"{type(glasses).__name__}"
        )
    vertices, faces = checked_mesh(parts[0], parts[1], "the glasses")
    keypoints = checked_keypoints("the glasses' keypoints", parts[2])
    keypoints[~finite_rows(keypoints)] = np.nan
    require_posable(keypoints, "the glasses")
    weights = None
    if parts[3] is not None:
        weights = checked_weights("the glasses' weights", parts[3], len(vertices))
        if np.abs(weights.sum(1) - 1).max(initial=0.0) > 1e-6:
            raise EyeglassesError("the glasses' weights must have rows of sum 1; solve them again")
        if weights[:, ~finite_rows(keypoints)].any():
            raise EyeglassesError("the glasses' weights give a share to key points that the frame lacks")
    matrices = normalized_cameras(cameras)
    count = len(matrices)
    if count == 0:
        raise ValueError("there is no camera; give one or more")
    labels = checked_array(keypoints_2d, (count, len(KEY_POINT_NAMES), 2), "keypoints_2d")
    view_masks: list[Any] = [None] * count if masks is None else list(masks)  # type: ignore[arg-type]
    for name, listed in (("masks", view_masks), ("shapes", shapes), ("pictures", pictures)):
        if listed is not None and len(listed) != count:
            raise ValueError(f"{name} must have one entry for each of {count} cameras, got {len(listed)}")
    unit = 1 / typical_size_factor(keypoints)
    matrices = normalized_cameras(matrices * np.array([unit, unit, unit, 1.0]))
    views, plan = [], []
    for number, (camera, marks, mask) in enumerate(zip(matrices, labels, view_masks, strict=True)):
        shape = None if shapes is None else (int(shapes[number][0]), int(shapes[number][1]))
        picture = None if pictures is None else pictures[number]
        view, covered, image = _checked_view(number, camera, marks, mask, shape, picture)
        views.append((view, covered, image))
        if covered is not None and view.distance is None:
            what = "covers all of its picture" if covered.any() else "is empty"
            reason = f"the mask of view {number} {what}: it does not count"
            plan.append(PlanStep("glasses.mask", False, reason))
    skull = None
    if head is not None:
        points, index = (head.vertices, head.faces) if hasattr(head, "vertices") else head
        points, index = checked_mesh(points, index, "the head")
        skull = points / unit, index
    pose = None
    if start is not None:
        pose = np.array(checked_array(start, (4, 4), "start"))
        if not is_rigid(pose):
            raise EyeglassesError("start must be a rigid world_from_glasses: a rotation and a translation")
        pose[:3, 3] /= unit
    frame = vertices / unit, faces, keypoints / unit, weights
    observed, covered_by, shown = zip(*views, strict=True)
    return RegistrationInputs(*frame, observed, covered_by, shown, skull, pose, unit, tuple(plan))


def _checked_view(
    number: int,
    camera: FloatArray,
    labels: FloatArray,
    mask: ArrayLike | None,
    shape: GridShape | None,
    picture: ArrayLike | None,
) -> tuple[ObservedView, BoolArray | None, NDArray | None]:
    """Return one view with its labels (20, 2), mask, size and picture; raises as `register_on_face`."""
    labelled = finite_rows(labels)
    found = labels[labelled]
    if (np.abs(found) > 1e6).any():
        raise EyeglassesError(f"labels of view {number} reach {np.abs(found).max():.3g}: expected pixels")
    image = None if picture is None else np.asarray(picture)
    if image is not None:
        if image.shape != (*(shape or image.shape[:2]), 3):
            raise ValueError(f"picture {number} has shape {image.shape}, expected (H, W, 3) of {shape}")
        if not all_finite(image):
            raise EyeglassesError(f"picture {number} holds numbers that are not finite")
        shape = image.shape[:2]
    distance = None
    covered = None if mask is None else np.asarray(mask).astype(bool)
    if covered is not None:
        if covered.ndim != 2 or min(covered.shape) < 2:
            raise ValueError(f"mask {number} must have shape (H, W), of 2 pixels or more: {covered.shape}")
        outside = ~within(found, covered.shape, 0.5)
        if len(found) and outside.mean() > 0.5:
            raise EyeglassesError(
                f"{outside.sum()} of {len(found)} labels of view {number} lie outside its mask of "
                f"{covered.shape[1]} x {covered.shape[0]} pixels: give masks of the labelled pictures' size"
            )
        if shape not in (None, covered.shape):
            raise ValueError(f"mask {number} has shape {covered.shape}, expected its picture's {shape}")
        shape = covered.shape
        if covered.any() and not covered.all():
            distance = MaskDistance.of(covered)
    marks = np.where(labelled[:, None], labels, np.nan)
    return ObservedView(camera, marks, distance, shape), covered, image
