"""The extremes of the whole pipeline: its budgets, seeds, sizes, and scans without colour or face."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from scan2albedo import Budget, ProcessResult, RawScan, process
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_from_vector, transform_points
from stability_cases.case import Cases, Measured, assert_finite, naming
from stability_cases.scanned_person import Scanned, person

CASES = Cases()
STAGE = "process"
SIZE = 64
FEW = Budget(evaluations=30)


def processed(scan: RawScan, **settings: Any) -> ProcessResult:
    """Run the pipeline, and see that all it returns is finite."""
    result = process(scan, **{"size": SIZE, **settings})
    assert_finite(result.geometry_image.position)
    if result.fitted is not None:
        assert_finite(result.fitted.vertices)
    if result.albedo is not None:
        assert_finite(result.albedo.albedo_linear, result.albedo.shading)
    return result


def landmarks_off(result: ProcessResult, scene: Scanned) -> float:
    """Return how far the fitted landmarks are from the true ones in mm, mean."""
    assert result.fitted is not None
    true = transform_points(
        result.fitted.model_from_scan @ invert_rigid(scene.model_from_scan), scene.landmarks
    )
    return float(np.linalg.norm(true - result.fitted.landmarks, axis=1).mean())


def _hurried(budget: Budget | float) -> Measured:
    result = processed(person().scan, budget=budget)
    assert result.registration is not None
    assert result.fitted is not None
    assert result.albedo is not None
    ended = (result.registration.converged, result.fitted.converged, result.albedo.converged)
    assert ended == (False, False, False)
    off = landmarks_off(result, person())
    assert off < 4
    return Measured(f"landmarks {off:.1f} mm off, converged False in every stage")


CASES.extreme(STAGE, "a budget of 0.001 s", "measured warning")(lambda: _hurried(1e-3))
CASES.extreme(STAGE, "a budget of 1 evaluation", "measured warning")(lambda: _hurried(Budget(evaluations=1)))


def _refused(told: str, **settings: Any) -> str:
    with naming(told):
        processed(person().scan, **settings)
    return "processed"


@CASES.extreme(STAGE, "seeds 0 and 2**32 - 1", slow=True)
def _() -> str:
    figures = []
    for seed in (0, 2**32 - 1):
        off = landmarks_off(processed(person().scan, seed=seed, budget=FEW), person())
        assert off < 3
        figures.append(f"{off:.1f}")
    return f"landmarks {' and '.join(figures)} mm off"


CASES.extreme(STAGE, "a seed of -1", "named error")(lambda: _refused("seed is -1, expected", seed=-1))
CASES.extreme(STAGE, "no seed", "named error")(lambda: _refused("seed is None, expected", seed=None))


@CASES.extreme(STAGE, "a scan without colour", "measured warning")
def _() -> str:
    result = processed(RawScan(person().scan.vertices, person().scan.faces), budget=FEW)
    assert result.albedo is None
    (step,) = [step for step in result.plan if step.stage == "albedo"]
    assert not step.ran
    return Measured(f"albedo left out: {step.reason}")


@CASES.extreme(STAGE, "vertex colours all black", "named error")
def _() -> str:
    scan = person().scan
    with naming("only 0 of .* texels can be used to find the light", "black"):
        processed(RawScan(scan.vertices, scan.faces, vertex_color_linear=0 * scan.vertices), budget=FEW)
    return "processed"


@CASES.extreme(STAGE, "scan 1e9 mm away")
def _() -> str:
    far = person().shifted(1e9)
    off = landmarks_off(processed(far.scan, skip=["albedo"]), far)
    assert off < 2
    return f"landmarks {off:.2f} mm off"


@CASES.extreme(STAGE, "1.5 times too large", "measured warning", slow=True)
def _() -> str:
    result = processed(person().scaled(1.5).scan, skip=["albedo"])
    (told,) = [text for text in result.notes if "another size than adults'" in text]
    return Measured(told)


@CASES.extreme(STAGE, "not registered, and upside down", "measured warning", slow=True)
def _() -> str:
    turned = compose(rotation_from_vector([0.0, 0, np.pi]), np.zeros(3)) @ person().model_from_scan
    scan = person().moved(turned).scan
    result = processed(scan, skip=["register", "albedo"])
    (told,) = [text for text in result.notes if "stretched the model's edges" in text]
    return Measured(told)


@CASES.extreme(STAGE, "not registered, and in any pose", "named error")
def _() -> str:
    with naming("no part of the scan lies within .* mm of the model", "register the scan first"):
        processed(person().scan, skip=["register", "albedo"])
    return "processed"


@CASES.extreme(STAGE, "an object 1e7 mm away, without a model")
def _() -> str:
    ball = trimesh.creation.icosphere(3, 100.0)
    colour = np.full((len(ball.vertices), 3), 0.5, np.float32)
    scan = RawScan(ball.vertices, ball.faces, vertex_color_linear=colour)
    images = [
        processed(replace(scan, vertices=scan.vertices + away), model="none", skip=["albedo"]).geometry_image
        for away in (0.0, 1e7)
    ]
    gap = np.abs(images[0].position - images[1].position).max()
    assert gap < 1e-3
    return f"{gap:.0e} mm from the same object at the origin"


@CASES.extreme(STAGE, "a head without a model", slow=True)
def _() -> str:
    result = processed(person().scan, model="none", skip=["albedo"])
    figures = result.geometry_image.figures()
    assert figures["seen"] > 0.9
    return f"coverage {figures['coverage']:.0%}, seen {figures['seen']:.0%}"
