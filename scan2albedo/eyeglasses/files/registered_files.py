"""Frames registered on faces as NPZ files: where they lie, what carries them there, how sure that is."""

from __future__ import annotations

from pathlib import Path

from scan2albedo.core import Plan, Trace
from scan2albedo.eyeglasses.files.array_files import Layout, read_arrays, write_arrays
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT
from scan2albedo.eyeglasses.on_face.registration_result import RegisteredEyeglasses

_REGISTERED_LAYOUT: Layout = {
    "vertices": (float, "V", 3),
    "faces": (int, "F", 3),
    "weights": (float, "V", KEY_POINT_COUNT),
    "keypoints": (float, KEY_POINT_COUNT, 3),
    "world_from_glasses": (float, 4, 4),
    "handle_transforms": (float, KEY_POINT_COUNT, 4, 4),
    "bend": (float, KEY_POINT_COUNT, 3),
    "visible": (bool, "C", "V"),
    "deviation": (float, "V"),
    "observed": (bool, "V"),
    "keypoint_deviation": (float, KEY_POINT_COUNT),
    "keypoints_observed": (bool, KEY_POINT_COUNT),
    "depth_deviation": (float,),
    "depth_observed": (bool,),
    "label_errors_px": (float, "C", KEY_POINT_COUNT),
    "inliers": (bool, "C", KEY_POINT_COUNT),
    "outline_rms_px": (float, "C"),
    "iou": (float, "C"),
    "converged": (bool,),
    "iterations": (int,),
}


def write_registered(path: str | Path, frame: RegisteredEyeglasses) -> None:
    """Write a frame that `register_on_face` placed, all but its plan and trace, atomically.

    Parameters
    ----------
    path : str or Path
    frame : RegisteredEyeglasses

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    OutputError
        When the folder cannot be written.
    """
    write_arrays(path, frame, _REGISTERED_LAYOUT, what="registered frame")


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
    arrays = read_arrays(path, _REGISTERED_LAYOUT, what="registered frame", example="registered.npz")
    return RegisteredEyeglasses(**arrays, plan=Plan(), trace=Trace())
