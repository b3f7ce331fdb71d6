"""Canonical frames as NPZ files, with all that takes them back."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT
from scan2albedo.io.atomic import atomic_path
from scan2albedo.optimization import Plan

_SHAPES = {
    "vertices": (-1, 3),
    "faces": (-1, 3),
    "weights": (-1, KEY_POINT_COUNT),
    "keypoints": (KEY_POINT_COUNT, 3),
    "canonical_from_frame": (4, 4),
    "scale": (),
    "handle_transforms": (KEY_POINT_COUNT, 4, 4),
    "residual": (),
    "converged": (),
}
"""Arrays of a file and their shapes."""


def write_canonical(path: str | Path, frame: CanonicalEyeglasses) -> None:
    """Write a frame that `canonicalize` made, all but its plan, atomically.

    Raises
    ------
    OutputError
        When the folder cannot be written.
    """
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = {name: np.asarray(getattr(frame, name)) for name in _SHAPES}
        np.savez_compressed(temporary, **arrays)


def read_canonical(path: str | Path) -> CanonicalEyeglasses:
    """Return a frame that `write_canonical` wrote; its plan is empty.

    Raises
    ------
    EyeglassesError
        When the file is missing, damaged or something else; names it.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in _SHAPES}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise EyeglassesError(
            f"canonical frame {path} cannot be read ({' '.join(str(error).split())}); give a canonical.npz"
        ) from error
    for name, shape in _SHAPES.items():
        got = arrays[name].shape
        if len(got) != len(shape) or any(
            want not in (-1, side) for want, side in zip(shape, got, strict=True)
        ):
            raise EyeglassesError(f"canonical frame {path}: {name} has shape {got}; write it again")
    if len(arrays["weights"]) != len(arrays["vertices"]):
        raise EyeglassesError(
            f"canonical frame {path}: weights are not those of its vertices; write it again"
        )
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
