"""Frames registered on faces as NPZ files: where they lie, what carries them there, how sure that is."""

from __future__ import annotations

from pathlib import Path

from scan2albedo.eyeglasses.files.array_files import Shapes, read_arrays, write_arrays
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT
from scan2albedo.eyeglasses.on_face.registration_result import RegisteredEyeglasses
from scan2albedo.optimization import Plan, Trace

_SHAPES: Shapes = {
    "vertices": ("V", 3),
    "faces": ("F", 3),
    "weights": ("V", KEY_POINT_COUNT),
    "keypoints": (KEY_POINT_COUNT, 3),
    "world_from_glasses": (4, 4),
    "handle_transforms": (KEY_POINT_COUNT, 4, 4),
    "bend": (KEY_POINT_COUNT, 3),
    "visible": ("C", "V"),
    "deviation": ("V",),
    "observed": ("V",),
    "keypoint_deviation": (KEY_POINT_COUNT,),
    "keypoints_observed": (KEY_POINT_COUNT,),
    "depth_deviation": (),
    "depth_observed": (),
    "label_errors_px": ("C", KEY_POINT_COUNT),
    "inliers": ("C", KEY_POINT_COUNT),
    "outline_rms_px": ("C",),
    "iou": ("C",),
    "converged": (),
    "iterations": (),
}


def write_registered(path: str | Path, frame: RegisteredEyeglasses) -> None:
    """Write a frame that `register_on_face` placed, all but its plan and trace, atomically.

    Parameters
    ----------
    path : str or Path
    frame : RegisteredEyeglasses

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    write_arrays(path, frame, _SHAPES)


def read_registered(path: str | Path) -> RegisteredEyeglasses:
    """Return a frame that `write_registered` wrote; its plan and trace are empty.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    EyeglassesError
        When the file is missing, damaged or something else; names it.
    """
    arrays = read_arrays(path, _SHAPES, what="registered frame", example="registered.npz")
    return RegisteredEyeglasses(
        vertices=arrays["vertices"],
        faces=arrays["faces"],
        weights=arrays["weights"],
        keypoints=arrays["keypoints"],
        world_from_glasses=arrays["world_from_glasses"],
        handle_transforms=arrays["handle_transforms"],
        bend=arrays["bend"],
        visible=arrays["visible"] != 0,
        deviation=arrays["deviation"],
        observed=arrays["observed"] != 0,
        keypoint_deviation=arrays["keypoint_deviation"],
        keypoints_observed=arrays["keypoints_observed"] != 0,
        depth_deviation=float(arrays["depth_deviation"]),
        depth_observed=bool(arrays["depth_observed"]),
        label_errors_px=arrays["label_errors_px"],
        inliers=arrays["inliers"] != 0,
        outline_rms_px=arrays["outline_rms_px"],
        iou=arrays["iou"],
        converged=bool(arrays["converged"]),
        iterations=int(arrays["iterations"]),
        plan=Plan(),
        trace=Trace(),
    )
