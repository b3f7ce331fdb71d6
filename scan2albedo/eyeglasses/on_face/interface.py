"""Settings and result of `register_on_face`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Plan, Trace
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.weighting.embedding import WeightOptions

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
    outline_correlation_px: float = 20.0
    """Length over which a mask's errors are alike: pixels of the outline nearer than that share one vote."""
    outline_stride: int = 1
    """Every n-th pixel of the outline is used, spread evenly, and counts for n."""
    outline_reach_px: float = 40.0
    """Pixels of the outline farther from the observed one than this are left out, and nearer ones where the
    frame's place is known better."""
    contact: bool = True
    """Whether the frame is made to rest on the nose where the views do not see depth and there is a head."""
    weights: WeightOptions = WeightOptions()
    """How weights are solved, where the glasses bring none."""

    def __post_init__(self) -> None:
        if self.outline_stride < 1:
            raise ValueError(f"outline_stride is {self.outline_stride}, expected 1 or more")


@dataclass(frozen=True)
class RegisteredEyeglasses:
    """A frame where the pictures show it; lengths in the cameras' unit. See `register_on_face`."""

    vertices: FloatArray
    """(V, 3) in the world."""
    faces: IntArray
    """(F, 3)."""
    weights: FloatArray
    """(V, 20); zero columns for key points that the frame lacks."""
    keypoints: FloatArray
    """(20, 3) in the world, NaN where the frame lacks them."""
    world_from_glasses: FloatArray
    """(4, 4) rigid, the bend left aside."""
    handle_transforms: FloatArray
    """(20, 4, 4) from the glasses at rest to the world, bend included, for `skin`."""
    bend: FloatArray
    """(20, 3) shifts of the key points in the glasses' own frame; 0 where it lacks them."""
    visible: BoolArray
    """(C, V) vertices in the picture that the head does not hide, whether the frame hides them or not."""
    deviation: FloatArray
    """(V,) root mean square distance that each vertex may be off, from what pictures and the bend's prior
    leave open, errors that views share, and bends that key points cannot follow: two in three lie nearer, 19
    in 20 within twice as much."""
    observed: BoolArray
    """(V,) visible in a view, known to `OBSERVED_MM`, and not contradicted by a mask; none where more
    than a third of the labels do not fit, or the budget ended before the bend was found."""
    keypoint_deviation: FloatArray
    """(20,) as `deviation`, NaN where the frame lacks them."""
    keypoints_observed: BoolArray
    """(20,) key points that the head leaves visible in a view and that are known to `OBSERVED_MM`."""
    depth_deviation: float
    """Root mean square of the standard deviations along the line of sight, over key points in view."""
    depth_observed: bool
    """Whether that is known to `OBSERVED_MM`: one view hardly sees depth."""
    label_errors_px: FloatArray
    """(C, 20); NaN where there is no label."""
    inliers: BoolArray
    """(C, 20) labels within three times `options.label_noise_px`."""
    outline_rms_px: FloatArray
    """(C,) distance of the outline from the mask's, where they can be compared; NaN without a mask."""
    iou: FloatArray
    """(C,) of the frame's mask and the given one; NaN without. High values are no evidence of a good fit in
    space: frames millimetres off reach 0.97."""
    converged: bool
    """False when the budget ended first or outlines did not settle."""
    iterations: int
    """Evaluations of the objective."""
    plan: Plan
    """Steps that ran or were left out, and why."""
    trace: Trace
    """Errors in pixels."""

    @property
    def unobserved(self) -> tuple[str, ...]:
        """What the pictures do not determine: "depth", and names of key points."""
        lost = np.isfinite(self.keypoint_deviation) & ~self.keypoints_observed
        names = tuple(name for name, gone in zip(KEY_POINT_NAMES, lost, strict=True) if gone)
        return (() if self.depth_observed else ("depth",)) + names
