"""Canonical frames as NPZ files, with all that takes them back."""

from __future__ import annotations

from pathlib import Path

from scan2albedo.core import Plan
from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.files.array_files import Layout, read_arrays, write_arrays
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT

_CANONICAL_LAYOUT: Layout = {
    "vertices": (float, "V", 3),
    "faces": (int, "F", 3),
    "weights": (float, "V", KEY_POINT_COUNT),
    "keypoints": (float, KEY_POINT_COUNT, 3),
    "canonical_from_frame": (float, 4, 4),
    "scale": (float,),
    "handle_transforms": (float, KEY_POINT_COUNT, 4, 4),
    "residual": (float,),
    "converged": (bool,),
}


def write_canonical(path: str | Path, frame: CanonicalEyeglasses) -> None:
    """Write a frame that `canonicalize` made, all but its plan, atomically.

    Parameters
    ----------
    path : str or Path
    frame : CanonicalEyeglasses

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    OutputError
        When the folder cannot be written.
    """
    write_arrays(path, frame, _CANONICAL_LAYOUT, what="canonical frame")


def read_canonical(path: str | Path) -> CanonicalEyeglasses:
    """Return a frame that `write_canonical` wrote; its plan is empty.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    EyeglassesError
        When the file is missing, damaged or something else; names it.
    """
    arrays = read_arrays(path, _CANONICAL_LAYOUT, what="canonical frame", example="canonical.npz")
    return CanonicalEyeglasses(**arrays, plan=Plan())
