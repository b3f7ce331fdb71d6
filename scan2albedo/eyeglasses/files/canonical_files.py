"""Canonical frames as NPZ files, with all that takes them back."""

from __future__ import annotations

from pathlib import Path

from scan2albedo.eyeglasses.canonical.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.files.array_files import Shapes, read_arrays, write_arrays
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT
from scan2albedo.optimization import Plan

_SHAPES: Shapes = {
    "vertices": ("V", 3),
    "faces": ("F", 3),
    "weights": ("V", KEY_POINT_COUNT),
    "keypoints": (KEY_POINT_COUNT, 3),
    "canonical_from_frame": (4, 4),
    "scale": (),
    "handle_transforms": (KEY_POINT_COUNT, 4, 4),
    "residual": (),
    "converged": (),
}


def write_canonical(path: str | Path, frame: CanonicalEyeglasses) -> None:
    """Write a frame that `canonicalize` made, all but its plan, atomically.

    Parameters
    ----------
    path : str or Path
    frame : CanonicalEyeglasses

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    write_arrays(path, frame, _SHAPES)


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
    arrays = read_arrays(path, _SHAPES, what="canonical frame", example="canonical.npz")
    return CanonicalEyeglasses(
        vertices=arrays["vertices"],
        faces=arrays["faces"],
        weights=arrays["weights"],
        keypoints=arrays["keypoints"],
        canonical_from_frame=arrays["canonical_from_frame"],
        scale=float(arrays["scale"]),
        handle_transforms=arrays["handle_transforms"],
        residual=float(arrays["residual"]),
        converged=bool(arrays["converged"]),
        plan=Plan(),
    )
