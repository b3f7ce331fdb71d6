"""The fit: distance of the true surface and of corresponding points, against stages, steps and samples.

Both are measured where skin was scanned: under hair there is nothing to be right about.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from worlds.synthetic_scans import ScanScene, scan_scenes

from benchmarks import fit_peers
from benchmarks.presets import preset_settings
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
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import FitError
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.fit import CROP_MARGIN
from scan2albedo.fitting.scan_surface import scan_near_model
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, transform_points

_LEVEL = 2
"""Refinement of the model's surface at which corresponding points are compared."""
_PEER_LEVEL = 1
_SCENES, _QUICK_SCENES = 3, 1
MESH_PEERS = ("nricp_amberg", "nricp_sumner")


def _settings(quick: bool) -> list[Setting]:
    options = FitOptions()
    default = Setting("default", "", options)
    if quick:
        return [default, *varied("steps", options, (3,))]
    levels = ((0,), (0, 0), (0, 0, 0), (0, 0, 1), (0, 0, 1, 1), (0, 0, 0, 1, 1, 1), (0,) * 3 + (1,) * 9)
    return [
        default,
        *preset_settings("fit"),
        *varied("levels", options, levels, lambda v: " ".join(map(str, v))),
        *varied("finest_level", options, (0, 3)),
        *varied("steps", options, (1, 2, 4, 6, 20, 40)),
        *varied("rigid_iterations", options, (0, 2, 15)),
        *varied("proportion_iterations", options, (0, 3, 20)),
        *varied("smoothing_mm", options, (0.0, 1.6), "{:g} mm".format),
        *within(options, (1, 5, 10, 20, 40, 80)),
    ]


def _run(scene: ScanScene, setting: Setting) -> Outcome:
    pose, options = scene.found_pose, setting.options

    def work():  # type: ignore[no-untyped-def]
        return fit(scene.scan, scene.model, pose, setting.budget, options=options)

    try:
        fitted, cost = timed(work)
    except FitError:
        return Outcome(Cost(float("nan"), float("nan")), (float("nan"), float("nan")))
    points = scene.model.subdivision(_LEVEL).matrix @ fitted.control_points
    return surface_errors(
        scene,
        (fitted.vertices, fitted.faces),
        points,
        _LEVEL,
        fitted.model_from_scan,
        cost,
        fitted.iterations,
    )


def surface_errors(
    scene: ScanScene,
    surface: tuple[FloatArray, IntArray],
    points: FloatArray,
    level: int,
    model_from_scan: FloatArray,
    cost: Cost,
    evaluations: int = 0,
) -> Outcome:
    """Return the errors of a surface, and of `points` (V, 3), the model's vertices of a level."""
    found_from_truth = model_from_scan @ invert_rigid(scene.truth.model_from_scan)
    skin, places = scene.surface, scene.limit_points(level)
    true = transform_points(found_from_truth, skin[scene.scanned(skin)])
    distance = ClosestPointQuery(*surface).query(true).distance
    apart = np.linalg.norm(points - transform_points(found_from_truth, places), axis=1)[scene.scanned(places)]
    details = {"p95 mm": float(np.percentile(distance, 95))}
    return Outcome(cost, (float(distance.mean()), float(apart.mean())), evaluations, details)


def rigid_only(scene: ScanScene) -> Outcome:
    """Return the errors of the model as it is, in the pose given."""
    surface = scene.model.surface(_PEER_LEVEL)
    return surface_errors(scene, surface, surface[0], _PEER_LEVEL, scene.found_pose, Cost(1e-3, 1e-3))


def _peers(quick: bool) -> list[Peer]:
    return mesh_peers(sys.executable, ("nricp_sumner",) if quick else MESH_PEERS)


def mesh_peers(python: str, names: tuple[str, ...] = MESH_PEERS) -> list[Peer]:
    """Return mesh peers of `fit_peers.py` run by a Python that may have what this one lacks."""
    own = python == sys.executable
    missing = missing_modules("trimesh", "rtree") if own else _imports(python, "trimesh", "rtree")
    return [Peer(f"trimesh {name}", _mesh_peer(name, python), missing) for name in names]


def _imports(python: str, *modules: str) -> str:
    done = subprocess.run([python, "-c", f"import {', '.join(modules)}"], capture_output=True, check=False)
    return f"pip install {' '.join(modules)}" if done.returncode else ""


def _mesh_peer(name: str, python: str) -> Callable[[ScanScene], Outcome]:
    done: dict[int, Outcome] = {}

    def run(scene: ScanScene) -> Outcome:
        """Run once a scene: a process of its own needs no warming up."""
        if id(scene) not in done:
            done[id(scene)] = fitted(scene)
        return done[id(scene)]

    def fitted(scene: ScanScene) -> Outcome:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
            _write_peer_input(scene, source)
            command = [python, fit_peers.__file__, name, str(source), str(target)]
            subprocess.run(command, capture_output=True, text=True, check=True)
            with np.load(target) as found:
                vertices, cost = found["vertices"].astype(float), Cost(float(found["cpu_s"]), float("nan"))
        faces = scene.model.surface(_PEER_LEVEL)[1]
        return surface_errors(scene, (vertices, faces), vertices, _PEER_LEVEL, scene.found_pose, cost)

    return run


def _write_peer_input(scene: ScanScene, path: Path) -> None:
    rest, faces = scene.model.surface(_PEER_LEVEL)
    low, high = rest.min(0), rest.max(0)
    margin = CROP_MARGIN * float(np.max(high - low))
    scan = scene.scan
    near = scan_near_model(scan.vertices, scan.faces, scene.found_pose, low - margin, high + margin)
    assert near is not None
    np.savez(path, vertices=rest, faces=faces, scan_vertices=near.vertices, scan_faces=near.faces)


def _scenes(quick: bool) -> list[ScanScene]:
    return list(scan_scenes(_QUICK_SCENES, 4.0) if quick else scan_scenes(_SCENES))


BENCHMARK = StageBenchmark(
    "fit",
    (ErrorKind("surface distance", "mm"), ErrorKind("correspondence", "mm")),
    _scenes,
    _settings,
    _run,
    _peers,
)
