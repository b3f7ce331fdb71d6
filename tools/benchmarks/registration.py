"""Registration: how far the face's points end from their place, against the effort of the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from worlds.synthetic_scans import ScanScene, hard_scan_scenes, scan_scenes

from benchmarks.presets import preset_settings
from benchmarks.registration_peers import (
    Surface,
    fpfh_ransac_icp,
    open3d_icp,
    small_gicp_icp,
)
from benchmarks.sweep import (
    Cost,
    ErrorKind,
    Outcome,
    Peer,
    Setting,
    StageBenchmark,
    missing_modules,
    timed,
    varied,
    within,
)
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.registration import RegistrationOptions, register

REFUSED_MM = 300.0
"""What a refusal, and a pose farther off, counts as."""
BASIN_DEG, BASIN_MM = 10.0, 15.0
"""Within these a fit finds the rest."""
_SCENES, _QUICK_SCENES = 6, 1
_EFFORTS: dict[str, dict[str, Any]] = {
    "1/64": {"anchor_spacing_mm": 60.0, "kept_starts": 20, "candidates": 2},
    "1/16": {"anchor_spacing_mm": 45.0, "kept_starts": 40, "candidates": 2},
    "1/4": {"kept_starts": 60, "candidates": 4},
    "4": {"anchor_spacing_mm": 20.0, "kept_starts": 480, "candidates": 16},
}
"""Several knobs at once; the name is about the number of starts relative to the default."""


def _settings(quick: bool) -> list[Setting]:
    options = RegistrationOptions()
    default = Setting("default", "", options)
    if quick:
        return [default, *varied("candidates", options, (2,))]
    annealed = [
        Setting(
            "annealing",
            f"{n} evaluations",
            RegistrationOptions(force_annealing=True, annealing_evaluations=n),
        )
        for n in (100, 400)
    ]
    return [
        default,
        *preset_settings("register"),
        *varied("anchor_spacing_mm", options, (60.0, 20.0), "{:g} mm".format),
        *varied("kept_starts", options, (20, 480)),
        *varied("candidates", options, (1, 2, 4, 16)),
        *varied("settling_iterations", options, (2, 10, 100)),
        *within(options, (20, 50, 100, 200, 500, 1000, 2000)),
        *(Setting("effort", name, replace(options, **fields)) for name, fields in _EFFORTS.items()),
        *annealed,
    ]


def _run(scene: ScanScene, setting: Setting) -> Outcome:
    def work() -> tuple[FloatArray | None, int]:
        try:
            found = register(scene.scan, scene.model, setting.budget, options=setting.options)
        except RegistrationError:
            return None, 0
        return found.model_from_scan, found.iterations

    (pose, evaluations), cost = timed(work)
    return pose_errors(scene, pose, cost, evaluations)


def pose_errors(scene: ScanScene, pose: FloatArray | None, cost: Cost, evaluations: int = 0) -> Outcome:
    """Return the errors of a `model_from_scan` (4, 4), None where it was refused.

    The error is the mean distance between the true face's points where the pose found and the true one put
    them.
    """
    if pose is None:
        missed = {"deg": 180.0, "basin %": 0.0}
        return Outcome(cost, (REFUSED_MM,), evaluations, missed)
    points = transform_points(invert_rigid(scene.truth.model_from_scan), scene.surface)
    apart = transform_points(pose, points) - transform_points(scene.model_from_scan, points)
    error = min(float(np.linalg.norm(apart, axis=1).mean()), REFUSED_MM)
    change = pose @ invert_rigid(scene.model_from_scan)
    degrees = float(np.degrees(rotation_angle_rad(change[:3, :3])))
    inside = degrees <= BASIN_DEG and error <= BASIN_MM
    return Outcome(cost, (error,), evaluations, {"deg": degrees, "basin %": 100.0 * inside})


def _peer(method: Callable[[Surface, RawScan], FloatArray]) -> Callable[[ScanScene], Outcome]:
    def run(scene: ScanScene) -> Outcome:
        surface = Surface(*scene.model.surface(1))
        pose, cost = timed(lambda: method(surface, scene.scan))
        return pose_errors(scene, invert_rigid(pose), cost)

    return run


def _peers(quick: bool) -> list[Peer]:
    open3d = missing_modules("open3d")
    ransac = [
        Peer(f"Open3D FPFH+RANSAC+ICP, {n:,}", _peer(fpfh_ransac_icp(n)), open3d)
        for n in ((10_000,) if quick else (1000, 10_000, 100_000))
    ]
    return [
        Peer("Open3D ICP from centroids", _peer(open3d_icp), open3d),
        *ransac,
        Peer("small_gicp from centroids", _peer(small_gicp_icp), missing_modules("small_gicp")),
    ]


def _scenes(quick: bool) -> list[ScanScene]:
    return list(scan_scenes(_QUICK_SCENES, 4.0) if quick else hard_scan_scenes(_SCENES))


BENCHMARK = StageBenchmark(
    "register", (ErrorKind("distance of the face from its place", "mm"),), _scenes, _settings, _run, _peers
)
