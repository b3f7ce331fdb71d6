"""Extremes of `fit`: the surface is near the truth, or a note, a figure or an error says why not."""

from functools import cache, partial
from unittest.mock import patch

import numpy as np

from scan2albedo import RawScan, fit
from scan2albedo.fitting import FitOptions
from stability.case import Measured, below, each, gap, refuses, right, said, table, warns
from stability.scenes import (
    at_random,
    model,
    noisy,
    person,
    plane,
    spoilt,
    stray,
    with_outlier_triangles,
)

QUICK = {"levels": (0, 0), "finest_level": 0}
"""A schedule that ends where the full one does to 0.1 mm, in a quarter of the time."""

FINER = (0, 1, 1)
"""Levels at which what is too soft, or turned over, folds."""


@cache
def grey():
    """Return a person without colour, whose brows, eyes and lips pull nothing: for settings of the stages."""
    return person().with_mesh(person().scan.faces)


def fitted(scene, pose=None, **options):
    """Fit a scene; return it and its face."""
    pose = scene.model_from_scan if pose is None else pose
    return scene, fit(scene.scan, model(), pose, options=FitOptions(**{**QUICK, **options}))


def alone(vertices, faces, **options):
    """Fit a mesh that is no face, where it lies."""
    return fit(RawScan(vertices, faces, name="scan"), model(), np.eye(4), options=FitOptions(**options))


def with_constants(options=None, **values):
    """Fit the grey person with other constants of the stages."""
    with patch.multiple("scan2albedo.fitting.stages", **values):
        return fitted(grey(), **(options or {}))


def as_stiff(stiffness, **options):
    """Fit with one stiffness at all stages, 1 being a plate of 10 mm and a membrane of 1 mm."""
    bending = 10 * stiffness**0.25
    return with_constants({"bending_mm": (bending, bending), **options}, MEMBRANE_MM=(stiffness**0.5,) * 2)


def without_gates():
    """Fit with forces of any reach."""
    with patch("scan2albedo.fitting.forces.GATE_MM", (1e6, 1e6)):
        return fitted(grey())


def near(bound):
    """Return a figure: the mean distance of the true surface, below a bound, and the scan's coverage."""

    def figure(found):
        scene, face = found
        error = scene.surface_error_mm(face)
        assert error < bound, f"{error:.3f} mm from the truth"
        return said(f"{error:.2f} mm, coverage {face.metrics['coverage']:.0%}", face.plan)

    return figure


def unfinished(bound):
    """Return a figure of a fit that has not converged, the surface near all the same."""

    def figure(found):
        assert not found[1].converged
        metrics = found[1].metrics
        trouble = (
            f"{metrics['imbalance_mm']:.2f} mm from balance, residual {metrics['residual_mean_mm']:.2f} mm"
        )
        return Measured(f"{near(bound)(found)}, converged False: {trouble} mean")

    return figure


def covered(least, most, bound):
    """Return a figure of a fit to a part of a face, which its coverage tells."""

    def figure(found):
        assert least < found[1].metrics["coverage"] < most
        return Measured(near(bound)(found))

    return figure


def folded(bound):
    """Return a figure of a surface that is too soft."""

    def figure(found):
        near(bound)(found)
        return said(f"{found[1].metrics['flipped_faces']:.0f} faces flipped", found[1].plan)

    return figure


def moved_off(distance):
    """Return by how much a fit far from the origin differs from that at the origin."""
    (_, here), (_, far) = (fitted(scene) for scene in (person(), person().shifted(distance)))
    return gap(far.vertices, here.vertices)


def strained(face):
    """Return the strain of a model fitted to what is no face."""
    assert face.metrics["strain"] > 0.12
    return Measured(f"strain {face.metrics['strain']:.2f}")


MASSES = (
    {"MASS": 0.0},
    {"MASS": 1e-6},
    {"DAMPING": 0.0},
    {"MASS": 0.0, "DAMPING": 0.0},
    {"MASS": 1e3, "DAMPING": 1e-3},
    {"MASS": 1e-3, "DAMPING": 1e3},
)


CASES = table(
    "fit",
    right(near(0.4), "stiffness 1", lambda: as_stiff(1.0), slow=True),
    right(near(0.7), "stiffness 1e8", lambda: as_stiff(1e8), slow=True),
    warns(folded(0.4), "stiffness 1e-6", lambda: as_stiff(1e-6, levels=FINER)),
    warns(
        folded(0.6),
        "no stiffness at all",
        lambda: with_constants({"bending_mm": (0.0, 0.0), "levels": FINER}, MEMBRANE_MM=(0.0, 0.0)),
    ),
    right(
        near(0.7),
        "stiffness beyond doubles (lengths of 1e8 mm)",
        lambda: with_constants({"bending_mm": (1e8, 1e8)}, MEMBRANE_MM=(1e6, 1e6)),
    ),
    right(near(0.4), "time step {}", lambda step: with_constants(TIME_STEP=step), ("1", "1e3", "1e30")),
    warns(
        unfinished(0.7),
        {
            **each("time step {}", ("1e-6", "1e-3"), lambda step: with_constants(TIME_STEP=step)),
            "mass 1e6": lambda: with_constants(MASS=1e6),
        },
    ),
    right(
        near(0.5),
        {
            ", ".join(f"{name.lower()} {value:g}" for name, value in values.items()): partial(
                with_constants, **values
            )
            for values in MASSES
        },
    ),
    right(
        near(0.5),
        {
            "forces without gates (reach 1e6 mm)": without_gates,
            "slivers, coincident vertices, zero-area, double and non-manifold faces": lambda: fitted(
                spoilt(person())
            ),
            "five vertices at 1e20 mm": lambda: fitted(stray(grey(), 5, 1e20)),
            "300 vertices some 2 m away": lambda: fitted(stray(grey(), 300, 2e3)),
            "half of all vertices are outliers": lambda: fitted(with_outlier_triangles(person())),
            "inside out": lambda: fitted(person().with_mesh(person().scan.faces[:, ::-1])),
        },
    ),
    right(
        near(0.5),
        "{} of the triangles left",
        lambda share: fitted(person().kept(at_random(person(), share))),
        ("0.4", "0.2", "0.05"),
        slow=True,
    ),
    right(near(0.6), "noise of 1 mm", lambda: fitted(noisy(person(), 1.0))),
    warns(unfinished(1.3), "noise of 3 mm", lambda: fitted(noisy(person(), 3.0))),
    right(near(1.5), "1.5 times too large, in the model's pose", lambda: fitted(person().scaled(1.5))),
    right(
        below(0.02, "{:.1e} mm from the fit at the origin"),
        "offset {} mm",
        moved_off,
        ("1e6", "1e7", "1e9"),
        slow=True,
    ),
    warns(
        covered(0.3, 0.7, 0.4),
        "half of the triangles wound the wrong way",
        lambda: fitted(person().wound(at_random(person(), 0.5))),
    ),
    warns(
        near(99),
        "upside down in the model's frame",
        lambda: fitted(grey().turned([0, 0, np.pi]), np.eye(4), levels=FINER),
    ),
    warns(
        strained,
        "a plane in place of the face",
        lambda: alone(*plane(40, 250), **QUICK),
    ),
    refuses(
        "levels must be.*0 to 5",
        "refinements that would fill the memory",
        lambda: fitted(person(), levels=(9,)),
    ),
    refuses("steps must be finite and 0 or more", "negative steps", lambda: FitOptions(steps=-1)),
    refuses("bending_mm must be", "stiffness NaN", lambda: FitOptions(bending_mm=(np.nan, 1.0))),
    refuses("scale_range must be", "sizes exchanged", lambda: FitOptions(scale_range=(2.0, 1.0))),
    refuses("levels must be one or more", "an empty schedule", lambda: FitOptions(levels=())),
    refuses(
        "scan: only .* % of the (fitted )?model has scan.*the scan holds",
        "a single triangle",
        lambda: alone([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]]),
    ),
    refuses(
        "unit|wrong|face",
        "units of {} mm taken for mm",
        lambda unit: alone(person().in_model_frame / unit, person().scan.faces),
        ("1e-3", "1e3", "1e6"),
    ),
    refuses(
        "must be a rigid transform",
        "a pose {}",
        lambda change: fitted(person(), change @ person().model_from_scan),
        {"of NaN": np.full((4, 4), np.nan), "scaled": 2 * np.eye(4), "mirrored": np.diag([-1.0, 1, 1, 1])},
    ),
)
