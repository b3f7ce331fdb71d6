"""Key points, canonical frames, registered ones, and poses to start from, as files."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from scan2albedo.core import Plan
from scan2albedo.core.arrays import ArrayLike, FloatArray, Values, all_finite, finite_rows
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import keypoints as places
from scan2albedo.eyeglasses.canonicalization import CanonicalEyeglasses
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR, PARENTS, checked_keypoints
from scan2albedo.eyeglasses.on_face.inputs import RegisteredEyeglasses
from scan2albedo.geometry.rigid import is_rigid, procrustes, transform_points
from scan2albedo.io.glb import write_skinned_glb
from scan2albedo.io.npz import read_npz, write_npz
from scan2albedo.io.records import Content, Matrix, Number, Record, plain_json, read_record, write_record
from scan2albedo.io.units import MM_PER_UNIT

LengthUnit = Literal["mm", "cm", "m"]
LengthUnitIfKnown = Literal["mm", "cm", "m", "unknown"]
Value = TypeVar("Value")
KeyPointName = Annotated[str, WithJsonSchema({"type": "string", "enum": list(KEY_POINT_NAMES)})]
_FRAME = "vertices float V 3; faces int F 3; weights float V K; keypoints float K 3; "
_CANONICAL = """canonical_from_frame float 4 4; scale float; handle_transforms float K 4 4; residual float;
    unbent bool; converged bool"""
_REGISTERED = """world_from_glasses float 4 4; handle_transforms float K 4 4; bend float K 3;
    visible bool C V; deviation float V; observed bool V; keypoint_deviation float K;
    keypoints_observed bool K; depth_deviation float; depth_observed bool; label_errors_px float C K;
    inliers bool C K; outline_rms_px float C; iou float C; converged bool; iterations int"""
_KINDS: dict[Callable[..., Any], tuple[str, dict[str, list[str]]]] = {
    kind: (name, {row.split()[0]: row.split()[1:] for row in (_FRAME + rows).split(";")})
    for kind, name, rows in (
        (CanonicalEyeglasses, "canonical", _CANONICAL),
        (RegisteredEyeglasses, "registered", _REGISTERED),
    )
}
"""Names of the two kinds; type and shape of their arrays by name, of which letters are lengths, K that of the
key points, and one wherever the letter is."""
_SAME_SIDE = (
    ("rim_top", "rim_bottom"),
    ("rim_inner", "rim_outer"),
    ("rim_bridge", "rim_outer"),
    ("rim_bridge", "rim_inner"),
    ("rim_bridge", "rim_bottom"),
    *itertools.combinations(("hinge", "temple_middle", "ear_bend", "temple_tip"), 2),
)
"""Key points of one side whose names are exchanged at times."""
_LIKE_GLASSES = 0.1
"""Residual, as a part of the size, up to which key points with exchanges undone are those of glasses."""


def read_json(
    path: str | Path, kind: type[Content], what: str, *, writer: str, schema: str, hint: str = ""
) -> Content:
    """Return the content of a file that the function `writer` wrote, or raise EyeglassesError with a hint."""
    advice = f"give a file that {writer} wrote (data_schemas/{schema}.schema.json){hint and '; ' + hint}"
    return read_record(path, kind, what=what, advice=advice, error=EyeglassesError)


def known_key_points(entries: dict[str, Value]) -> dict[str, Value]:
    """Return entries by name, or raise ValueError, with names probably meant, unless all are key points."""
    strange = sorted(set(entries) - set(KEY_POINT_NAMES))
    if not strange:
        return entries
    guesses = {name: difflib.get_close_matches(name, KEY_POINT_NAMES, n=1) for name in strange}
    said = [f"{name!r} (probably {found[0]!r})" if found else repr(name) for name, found in guesses.items()]
    verb = "is not a key point" if len(said) == 1 else "are not key points"
    raise ValueError(f"{', '.join(said)} {verb}; names are {', '.join(KEY_POINT_NAMES)}")


class KeyPointsFile(Record):
    """The content of a key-point file."""

    format: Literal["scan2albedo eyeglasses key points"] = "scan2albedo eyeglasses key points"
    format_version: Literal[1] = 1
    unit: LengthUnitIfKnown = "unknown"
    """Of the coordinates."""
    key_points: Annotated[
        dict[KeyPointName, tuple[float, float, float] | None], AfterValidator(known_key_points)
    ] = Field(description="Coordinates by name; null, or no entry, where a key point was not found.")
    deviations_mm: Annotated[dict[KeyPointName, Number], AfterValidator(known_key_points)] = Field(
        {}, description="Standard deviations of proposed key points by name; placed ones have none."
    )


def write_keypoints(
    path: str | Path,
    keypoints: ArrayLike,
    unit: LengthUnitIfKnown = "mm",
    deviations_mm: Mapping[str, float] | None = None,
) -> None:
    """Write key points (20, 3), in the order of `KEY_POINT_NAMES`, as JSON; rows with NaN as null.

    Their `unit`, and deviations by name, are only noted. Raises ValueError for another shape, OutputError
    when writing fails.

    Parameters
    ----------
    path, keypoints, unit, deviations_mm
    """
    entries = named_points(checked_keypoints("keypoints", keypoints))
    write_record(path, KeyPointsFile(unit=unit, key_points=entries, deviations_mm=dict(deviations_mm or {})))


def named_points(points: FloatArray) -> Values:
    """Return the coordinates of points (20, C) by the names of key points, None for those with NaN."""
    known = zip(KEY_POINT_NAMES, points, strict=True)
    return {name: tuple(point.tolist()) if all_finite(point) else None for name, point in known}


def read_keypoints(path: str | Path) -> FloatArray:
    """Return the key points (20, 3) of the file at `path` in its own unit, NaN where one is missing.

    Raises EyeglassesError, naming the file, when it cannot be read, has unknown names, or names exchanged.
    """
    return read_keypoints_with_unit(path)[0]


def read_keypoints_with_unit(path: str | Path) -> tuple[FloatArray, LengthUnitIfKnown]:
    """Return what `read_keypoints` does, and the unit that the file states."""
    entry = read_json(
        path,
        KeyPointsFile,
        "key points",
        writer="write_keypoints",
        schema="eyeglasses_keypoints",
        hint="`scan2albedo glasses key-points` says which key points to place, and where",
    )
    nothing = (np.nan, np.nan, np.nan)
    points = np.array([entry.key_points.get(name) or nothing for name in KEY_POINT_NAMES], float)
    if exchanged := "; ".join(exchanged_key_points(points)):
        advice = "`scan2albedo glasses key-points` shows where each belongs; temples must be open, not folded"
        raise EyeglassesError(f"key points {path}: names seem exchanged: {exchanged}. {advice}")
    return points, entry.unit


def exchanged_key_points(points: FloatArray) -> list[str]:
    """Return which names of key points (20, 3), NaN for missing ones, seem exchanged, as phrases.

    The exchange that brings the key points nearest to a typical frame, laid on them by a similarity, is made
    first, then the next. It counts where the way from one to the other is opposite to the typical one and
    half as long or more; of all left and right ones, where the residual halves.
    """
    known = finite_rows(points)
    # Fewer place no frame.
    if known.sum() < 6:
        return []
    typical = places.typical_key_points()
    number = KEY_POINT_NAMES.index
    pairs = [(0, 1)] + [(k, MIRROR[k]) for k in range(2, 11)]
    for side in ("left", "right"):
        pairs += [(number(f"{side}_{a}"), number(f"{side}_{b}")) for a, b in _SAME_SIDE]

    def laid(current: FloatArray) -> tuple[FloatArray, float]:
        seen = finite_rows(current)
        placed = transform_points(procrustes(typical[seen], current[seen], scale=True), typical)
        return placed, np.nansum((placed - current) ** 2)

    current, found = points.copy(), []
    if laid(current[MIRROR])[1] < laid(current)[1] / 4:
        current = current[MIRROR]
        found.append("all left ones and all right ones (left is the wearer's)")
    for _ in range(10):
        best, least = None, laid(current)[1]
        for a, b in pairs:
            if known[[a, b]].all():
                trial = current.copy()
                trial[[a, b]] = current[[b, a]]
                placed, misfit = laid(trial)
                way, expected = current[b] - current[a], placed[b] - placed[a]
                if misfit < least and way @ expected < -0.5 * (expected @ expected):
                    best, least, changed = (a, b), misfit, trial
        if best is None:
            break
        current = changed
        found.append(" and ".join(KEY_POINT_NAMES[k] for k in best))
    rms = np.sqrt(laid(current)[1] / known.sum())
    return found if rms < _LIKE_GLASSES * np.linalg.norm(np.ptp(points[known], axis=0)) else []


def _write(path: str | Path, frame: CanonicalEyeglasses | RegisteredEyeglasses) -> None:
    what, layout = _KINDS[type(frame)]
    arrays = {name: np.asarray(getattr(frame, name)) for name in layout}
    write_npz(path, arrays, what=f"{what} frame", compression=6)


def _read(path: str | Path, kind: Callable[..., Value]) -> Value:
    kind_name, layout = _KINDS[kind]
    what = f"{kind_name} frame"
    arrays = read_npz(path, layout, what=what, advice=f"give a {kind_name}.npz", error=EyeglassesError)
    lengths: Values = {"K": len(KEY_POINT_NAMES), "3": 3, "4": 4}
    for name, (_, *shape) in layout.items():
        got = arrays[name].shape
        wanted = tuple(lengths.setdefault(side, *got[k : k + 1]) or side for k, side in enumerate(shape))
        if got != wanted or arrays[name].dtype.kind not in "biuf":
            said = f"{name} has shape {got} of {arrays[name].dtype}, expected numbers of shape"
            raise EyeglassesError(f"{what} {path}: {said} ({', '.join(map(str, wanted))}); write it again")
    vertices, faces = arrays["vertices"], arrays["faces"]
    if not all_finite(vertices):
        raise EyeglassesError(f"{what} {path}: vertices are not finite; write it again")
    if faces.dtype.kind not in "iu" or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise EyeglassesError(f"{what} {path}: faces are not those of its vertices; write it again")
    typed = {name: arrays[name].astype(rule[0], copy=False) for name, rule in layout.items()}
    # Scalars as Python numbers.
    return kind(**{name: array if array.ndim else array.item() for name, array in typed.items()}, plan=Plan())


def write_canonical(path: str | Path, frame: CanonicalEyeglasses) -> None:
    """Write a `frame` that `canonicalize` made, all but its plan, as an NPZ file at `path`, atomically.

    Raises ValueError when the name does not end in .npz, OutputError when the folder cannot be written.
    """
    _write(path, frame)


def read_canonical(path: str | Path) -> CanonicalEyeglasses:
    """Return the frame that `write_canonical` wrote at `path`; its plan is empty.

    Raises EyeglassesError, naming the file, when it is missing, damaged or something else.
    """
    return _read(path, CanonicalEyeglasses)


def write_registered(path: str | Path, frame: RegisteredEyeglasses) -> None:
    """Write a `frame` that `register_on_face` placed at `path`, as `write_canonical`, without its trace."""
    _write(path, frame)


def read_registered(path: str | Path) -> RegisteredEyeglasses:
    """Return the frame that `write_registered` wrote at `path`, as `read_canonical`, without its trace."""
    return _read(path, RegisteredEyeglasses)


def write_frame_glb(
    path: Path, frame: CanonicalEyeglasses | RegisteredEyeglasses
) -> tuple[FloatArray, float]:
    """Write a frame with its key points as joints; see `write_skinned_glb` for results and errors."""
    mesh = frame.vertices, frame.faces, frame.keypoints, frame.weights
    return write_skinned_glb(path, *mesh, KEY_POINT_NAMES, parents=PARENTS)


class StartFile(Record):
    """The content of a file with a pose."""

    format: Literal["scan2albedo eyeglasses start"] = "scan2albedo eyeglasses start"
    format_version: Literal[1] = 1
    unit: LengthUnit = Field(description="Of the translation.")
    world_from_glasses: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: the frame's own coordinates into the cameras' "
        "world; rigid."
    )

    @model_validator(mode="after")
    def _rigid(self) -> StartFile:
        if not is_rigid(np.array(self.world_from_glasses)):
            raise ValueError("world_from_glasses must be a rotation and a translation over the row 0 0 0 1")
        return self


def write_start(path: str | Path, world_from_glasses: ArrayLike, unit: LengthUnit = "mm") -> None:
    """Write a rigid pose (4, 4) as JSON, atomically; the translation's `unit` is only noted in the file.

    Raises ValueError when it is not rigid, OutputError when the file cannot be written.

    Parameters
    ----------
    path, world_from_glasses, unit
    """
    content = StartFile(unit=unit, world_from_glasses=plain_json(np.asarray(world_from_glasses, float)))
    write_record(path, content)


def read_start(path: str | Path) -> FloatArray:
    """Return the pose (4, 4) of the file at `path`, its translation in mm.

    Raises EyeglassesError, naming the file, when it cannot be read or holds no rigid transform.
    """
    content = read_json(path, StartFile, "start", writer="write_start", schema="eyeglasses_start")
    pose = np.array(content.world_from_glasses)
    pose[:3, 3] *= MM_PER_UNIT[content.unit]
    return pose
