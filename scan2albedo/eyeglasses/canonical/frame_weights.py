"""The frames of a set and their weights: one that cannot be weighted need not take the others down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core import Budget, Meter, Plan, PlanStep
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.canonical.mean_keypoints import fullest, require_posable
from scan2albedo.eyeglasses.canonical.sizes import front_width, unit_exponent
from scan2albedo.eyeglasses.checks import checked_keypoints, checked_weights
from scan2albedo.eyeglasses.keypoints import KEY_POINT_COUNT, KEY_POINT_NAMES
from scan2albedo.eyeglasses.weighting.embedding import WeightOptions
from scan2albedo.eyeglasses.weighting.weights import STAGE, UNIT, metered_weights


@dataclass(frozen=True)
class Frame:
    """A mesh with its key points (20, 3), NaN for missing ones, and its weights (V, 20) if there are any."""

    number: int
    name: str | None
    vertices: FloatArray
    faces: IntArray
    points: FloatArray
    weights: FloatArray | None = None

    def fault(self, reason: str) -> str:
        """Return what is wrong with the frame, beginning with its number and its name if it has one."""
        return f"frame {self.number}{f', {self.name}' if self.name else ''}: {reason}"


@dataclass(frozen=True)
class WeightedFrame:
    """A frame with its weights, zero columns for missing key points, and how they were found."""

    frame: Frame
    weights: FloatArray
    converged: bool
    plan: Plan
    unit_exponent: int = 0
    """Its coordinates times ten to this are in mm."""
    width: float = math.nan
    """Of the mesh's front, in the mesh's unit, see `front_width`."""


def frames_of(
    meshes: Sequence[Any], keypoints: Sequence[ArrayLike], weights: Sequence[ArrayLike] | None
) -> list[Frame]:
    """Return the arguments of `canonicalize` as frames.

    Raises EyeglassesError when there is none, ValueError when shapes do not fit together.
    """
    if len(meshes) == 0:
        raise EyeglassesError("there is no frame to canonicalise; give one mesh or more")
    for name, given in (("keypoints", keypoints), ("weights", weights)):
        if given is not None and len(given) != len(meshes):
            raise ValueError(f"{name} must have one entry for each of {len(meshes)} meshes, got {len(given)}")
    frames = []
    for i, (mesh, points) in enumerate(zip(meshes, keypoints, strict=True)):
        vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "vertices") else mesh
        xyz = np.asarray(vertices, np.float64)
        shares = None if weights is None else checked_weights(f"weights {i}", weights[i], len(xyz))
        for name, array in (("vertices", xyz), ("weights", shares)):
            if array is not None and not np.isfinite(array).all():
                raise ValueError(f"frame {i}: {name} hold NaN or infinity; repair the frame or leave it out")
        frames.append(
            Frame(
                number=i,
                name=getattr(mesh, "name", None),
                vertices=xyz,
                faces=np.asarray(faces, np.int64),
                points=checked_keypoints(f"keypoints {i}", points),
                weights=shares,
            )
        )
    return frames


def weigh_frames(
    frames: Sequence[Frame],
    reference: FloatArray | None,
    *,
    spacing: str | float,
    widths_mm: tuple[float, float],
    options: WeightOptions,
    skip_failed: bool,
    meter: Meter,
) -> tuple[list[WeightedFrame], dict[int, str]]:
    """Return the frames with their weights and, with `skip_failed`, why others are left out.

    Key points that `reference` (20, 3) lacks do not count. Frames share the meter's budget evenly. Raises
    EyeglassesError, naming the frame, when none can be done, or without `skip_failed` when one cannot.
    """
    anchor = fullest([frame.points for frame in frames]) if reference is None else reference
    done: list[WeightedFrame] = []
    failures: dict[int, str] = {}
    for i, frame in enumerate(frames):
        try:
            shared = np.where(np.isfinite(anchor), frame.points, np.nan)
            require_posable(shared)
            width = front_width(frame.points, frame.vertices)
            exponent = unit_exponent(frame.points, widths_mm, width)
            used = frame if reference is None else replace(frame, points=shared)
            weighted = _weighted(used, spacing, options, meter, len(frames) - i)
            done.append(replace(weighted, unit_exponent=exponent, width=width))
        except EyeglassesError as error:
            if not skip_failed:
                raise EyeglassesError(frame.fault(str(error))) from error
            failures[frame.number] = str(error)
    if not done:
        raise EyeglassesError("; ".join(f.fault(failures[f.number]) for f in frames))
    return done, failures


def _weighted(
    frame: Frame, spacing: str | float, options: WeightOptions, meter: Meter, frames_left: int
) -> WeightedFrame:
    """Solve the weights in an even share of the budget left, unless they are given."""
    if frame.weights is not None:
        return WeightedFrame(frame, frame.weights, True, Plan((PlanStep(STAGE, False, "given"),)))
    seen = np.flatnonzero(np.isfinite(frame.points).all(1))
    own = meter.sub_meter(f"{STAGE}.{frame.number}", UNIT)
    own.budget = _share(own.budget, frames_left)
    try:
        found = metered_weights(
            frame.vertices,
            frame.faces,
            frame.points[seen],
            spacing,
            options=options,
            meter=own,
            names=[KEY_POINT_NAMES[k] for k in seen],
        )
    finally:
        meter.merge(own)
    weights = np.zeros((len(frame.vertices), KEY_POINT_COUNT))
    weights[:, seen] = found.weights
    how = "solved" if found.converged else "cut short by the budget" if own.exhausted else "did not settle"
    evidence = (
        f"residual {found.residual.max():.1e} after {own.evaluations} steps on {found.node_count} nodes"
    )
    plan = Plan((PlanStep(STAGE, True, how, evidence),)) + found.plan
    return WeightedFrame(frame, weights, found.converged, plan)


def _share(budget: Budget, parts: int) -> Budget:
    seconds, evaluations = budget.seconds, budget.evaluations
    return Budget(
        None if seconds is None else seconds / parts,
        None if evaluations is None else max(evaluations // parts, 1),
    )
