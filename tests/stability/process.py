"""Extremes of the whole pipeline: its budgets, seeds, sizes, and scans without colour or face."""

from dataclasses import replace

import numpy as np
from helpers.meshes import ball

from scan2albedo import Budget, process
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from stability.case import BUDGETS, Measured, below, gap, noted, refuses, right, table, warns
from stability.scenes import person

FEW = Budget(evaluations=30)


def processed(scan=None, **settings):
    """Run the pipeline on a scan, the person's by default."""
    return process(scan or person().scan, **{"size": 64, **settings})


def without_albedo(scan, *skip, **settings):
    """Run the pipeline up to the geometry image."""
    return processed(scan, skip=[*skip, "albedo"], **settings)


def landmarks(scene, **settings):
    """Process a scene; return how far the fitted landmarks are from the true ones in mm (mean), and all."""
    result = processed(scene.scan, **settings)
    model_from_truth = result.fitted.model_from_scan @ invert_rigid(scene.model_from_scan)
    off = transform_points(model_from_truth, scene.landmarks) - result.fitted.landmarks
    return float(np.linalg.norm(off, axis=1).mean()), result


def out_of_time(found):
    """Assert that nothing has converged, and that the landmarks are near all the same."""
    off, result = found
    assert off < 4
    assert not any(stage.converged for stage in (result.registration, result.fitted, result.albedo))
    return Measured(f"landmarks {off:.1f} mm off, converged False in every stage")


def far_object():
    """Return by how much the geometry image of an object 1e7 mm away differs from the one at the origin."""
    scan = ball(3, 100.0)
    here, there = (
        without_albedo(replace(scan, vertices=scan.vertices + away), model="none").geometry_image.position
        for away in (0.0, 1e7)
    )
    return gap(here, there)


def head_without_model():
    """Return what of a head its texels do not see, and what they cover."""
    figures = without_albedo(person().scan, model="none").geometry_image.figures()
    return 1 - figures["seen"], figures["coverage"]


SEED = "seed is {}, expected"

CASES = table(
    "process",
    warns(out_of_time, "a budget of {}", lambda budget: landmarks(person(), budget=budget), BUDGETS),
    right(
        below(3, "landmarks {:.1f} mm off"),
        {
            "seed 0": lambda: landmarks(person(), seed=0, budget=FEW),
            "seed 2**32 - 1": lambda: landmarks(person(), seed=2**32 - 1, budget=FEW),
        },
        slow=True,
    ),
    right(
        below(2, "landmarks {:.2f} mm off"),
        "scan 1e9 mm away",
        lambda: landmarks(person().shifted(1e9), skip=["albedo"]),
    ),
    refuses(SEED.format(-1), "a seed of -1", lambda: processed(seed=-1)),
    refuses(SEED.format(None), "no seed", lambda: processed(seed=None)),
    refuses(
        "only 0 of .* texels can be used to find the light.*black",
        "vertex colours all black",
        lambda: processed(person().painted(0), budget=FEW),
    ),
    warns(
        noted("another size than adults'"),
        "1.5 times too large",
        lambda: without_albedo(person().scaled(1.5).scan),
        slow=True,
    ),
    warns(
        noted("stretched the model's edges"),
        "not registered, and upside down",
        lambda: without_albedo(person().turned([0, 0, np.pi]).scan, "register"),
        slow=True,
    ),
    refuses(
        "no part of the scan lies within .* mm of the model.*register the scan first",
        "not registered, and in any pose",
        lambda: without_albedo(person().scan, "register"),
    ),
    right(
        below(1e-3, "{:.0e} mm from the same object at the origin"),
        "an object 1e7 mm away, without a model",
        far_object,
    ),
    right(
        below(0.1, "{:.0%} of the texels not seen, coverage {:.0%}"),
        "a head without a model",
        head_without_model,
        slow=True,
    ),
)
