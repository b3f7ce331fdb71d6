"""The extremes of `fit`."""

from __future__ import annotations

from contextlib import AbstractContextManager, suppress
from functools import cache
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from scan2albedo import Budget, FittedFace, RawScan, fit
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.rigid import compose, rotation_from_vector
from stability_cases.case import Cases, Measured, assert_finite, naming, said
from stability_cases.scanned_person import (
    Scanned,
    model,
    noisy,
    person,
    shredded,
    spoilt,
    stray,
    with_outlier_triangles,
)

CASES = Cases()
STAGE = "fit"

QUICK = {"levels": (0, 0), "finest_level": 0}
"""A schedule that ends where the full one does to 0.1 mm, in a quarter of the time."""
FINER = (0, 1, 1)
"""Levels at which what is too soft, or turned over, folds."""


@cache
def grey() -> Scanned:
    """Return a person without colour, whose brows, eyes and lips pull nothing: for settings of the stages."""
    return person().with_faces(person().scan.faces)


def fitted(
    scene: Scanned,
    most_mm: float,
    pose: NDArray[np.float64] | None = None,
    budget: object = None,
    **options: object,
) -> tuple[FittedFace, str]:
    """Fit a scene, assert that it lies within `most_mm` of the truth (mean), and return the figure too."""
    face = fit(
        scene.scan,
        model(),
        scene.model_from_scan if pose is None else pose,
        budget,  # type: ignore[arg-type]
        options=FitOptions(**{**QUICK, **options}),  # type: ignore[arg-type]
    )
    assert_finite(face.vertices, face.landmarks, *face.metrics.values())
    error = scene.surface_error_mm(face)
    assert error < most_mm, f"{error:.3f} mm from the truth"
    return face, said(f"{error:.2f} mm", face.plan)


def as_stiff(stiffness: float, most_mm: float, **options: object) -> tuple[FittedFace, str]:
    """Fit with one stiffness at all stages, 1 being a plate of 10 mm and a membrane of 1 mm."""
    bending, membrane = 10 * stiffness**0.25, stiffness**0.5
    with constants(MEMBRANE_MM=(membrane, membrane)):
        return fitted(grey(), most_mm, bending_mm=(bending, bending), **options)


def constants(**values: object) -> AbstractContextManager[object]:
    """Give constants of the stages other values for a while."""
    return patch.multiple("scan2albedo.fitting.stages", **values)


def each_of(most_mm: float, *settings: dict[str, float]) -> str:
    """Fit with each of some values of constants, and return the figures."""
    figures = []
    for values in settings:
        with constants(**values):
            figures.append(fitted(grey(), most_mm)[1])
    return ", ".join(figures)


@CASES.extreme(STAGE, "stiffness 1 and 1e8", slow=True)
def _() -> str:
    return ", ".join(as_stiff(*each)[1] for each in ((1.0, 0.4), (1e8, 0.7)))


@CASES.extreme(STAGE, "stiffness 1e-6", "measured warning")
def _() -> str:
    face, _ = as_stiff(1e-6, 0.4, levels=FINER)
    return said(f"{face.metrics['flipped_faces']:.0f} faces flipped", face.plan)


@CASES.extreme(STAGE, "no stiffness at all", "measured warning")
def _() -> str:
    with constants(MEMBRANE_MM=(0.0, 0.0)):
        face, _ = fitted(grey(), 0.6, bending_mm=(0.0, 0.0), levels=FINER)
    assert face.metrics["flipped_faces"] + face.metrics["strain"] > 0.15
    return said(f"{face.metrics['flipped_faces']:.0f} faces flipped", face.plan)


@CASES.extreme(STAGE, "stiffness beyond doubles (lengths of 1e8 mm)")
def _() -> str:
    with constants(MEMBRANE_MM=(1e6, 1e6)):
        return fitted(grey(), 0.7, bending_mm=(1e8, 1e8))[1] + ": a rigid sheet"


@CASES.extreme(STAGE, "time step 1e-6 and 1e-3", "measured warning")
def _() -> str:
    faces = []
    for step in (1e-6, 1e-3):
        with constants(TIME_STEP=step):
            faces.append(fitted(grey(), 0.7)[0])
    assert not any(face.converged for face in faces)
    return Measured(f"converged False: {faces[0].metrics['imbalance_mm']:.2f} mm from balance")


@CASES.extreme(STAGE, "time step 1, 1e3 and 1e30")
def _() -> str:
    return each_of(0.4, *({"TIME_STEP": step} for step in (1.0, 1e3, 1e30)))


@CASES.extreme(STAGE, "mass 1e6", "measured warning")
def _() -> str:
    with constants(MASS=1e6):
        face, figure = fitted(grey(), 0.7)
    assert not face.converged
    return Measured(f"{figure}, converged False: {face.metrics['imbalance_mm']:.2f} mm from balance")


@CASES.extreme(STAGE, "mass 0 and 1e-6; no damping")
def _() -> str:
    return each_of(0.4, {"MASS": 0.0}, {"MASS": 1e-6}, {"DAMPING": 0.0}, {"MASS": 0.0, "DAMPING": 0.0})


@CASES.extreme(STAGE, "mass to damping 1e6 and 1e-6")
def _() -> str:
    return each_of(0.5, *({"MASS": r**0.5, "DAMPING": r**-0.5} for r in (1e6, 1e-6)))


@CASES.extreme(STAGE, "forces without gates (reach 1e6 mm)")
def _() -> str:
    with patch("scan2albedo.fitting.forces.GATE_MM", (1e6, 1e6)):
        return fitted(grey(), 0.5)[1]


@CASES.extreme(STAGE, "refinements that would fill the memory", "named error")
def _() -> str:
    with naming("levels must be", "0 to 5"):
        return fitted(person(), 1.0, levels=(9,))[1]


@CASES.extreme(STAGE, "negative steps, no stiffness, an empty schedule", "named error")
def _() -> str:
    for wrong, told in (
        ({"steps": -1}, "steps must be finite and 0 or more"),
        ({"bending_mm": (np.nan, 1.0)}, "bending_mm must be"),
        ({"scale_range": (2.0, 1.0)}, "scale_range must be"),
    ):
        try:
            FitOptions(**wrong)  # type: ignore[arg-type]
        except ValueError as error:
            assert told in str(error)  # noqa: PT017 - all but the last are looked at here
        else:
            raise AssertionError(f"{wrong} passed")
    with naming("levels must be one or more"):
        return fitted(person(), 1.0, levels=())[1]


@CASES.extreme(STAGE, "offset 1e6, 1e7 and 1e9 mm", slow=True)
def _() -> str:
    plain = fitted(person(), 0.4)[0]
    gaps = []
    for distance in (1e6, 1e7, 1e9):
        far = fitted(person().shifted(distance), 0.4)[0]
        gaps.append(np.abs(far.vertices - plain.vertices).max())
    assert max(gaps) < 0.02
    return f"{max(gaps):.1e} mm from the fit at the origin"


@CASES.extreme(STAGE, "slivers, coincident vertices, zero-area, double and non-manifold faces")
def _() -> str:
    return fitted(spoilt(person()), 0.4)[1]


@CASES.extreme(STAGE, "five vertices at 1e20 mm; 300 some 2 m away")
def _() -> str:
    return ", ".join(fitted(stray(grey(), *thrown), 0.4)[1] for thrown in ((5, 1e20), (300, 2e3)))


@CASES.extreme(STAGE, "half of all vertices are outliers")
def _() -> str:
    return fitted(with_outlier_triangles(person()), 0.4)[1]


@CASES.extreme(STAGE, "noise of 1 mm")
def _() -> str:
    return fitted(noisy(person(), 1.0), 0.6)[1]


@CASES.extreme(STAGE, "noise of 3 mm", "measured warning")
def _() -> str:
    face, figure = fitted(noisy(person(), 3.0), 1.3)
    assert not face.converged
    return Measured(f"{figure}, converged False, residual {face.metrics['residual_mean_mm']:.2f} mm mean")


@CASES.extreme(STAGE, "60, 80 and 95 % of the triangles lost", slow=True)
def _() -> str:
    return ", ".join(fitted(shredded(person(), share), 0.5)[1] for share in (0.4, 0.2, 0.05))


@CASES.extreme(STAGE, "three holes of 60 mm")
def _() -> str:
    holes = np.array([[30.0, 20, 30], [-40, -30, 20], [0, 50, 40]])
    open_ = np.linalg.norm(person().centres[:, None] - holes, axis=2).min(1) > 30
    face, figure = fitted(person().kept(open_), 0.5)
    return f"{figure}, coverage {face.metrics['coverage']:.0%}"


@CASES.extreme(STAGE, "half a face", "measured warning")
def _() -> str:
    face, figure = fitted(person().kept(person().centres[:, 0] > 0), 1.5)
    assert 0.3 < face.metrics["coverage"] < 0.6
    return Measured(f"{figure}, coverage {face.metrics['coverage']:.0%}")


@CASES.extreme(STAGE, "hair only", "named error")
def _() -> str:
    with naming("of the fitted model has scan within 5 mm", "too little of a face"):
        return fitted(person().kept(person().centres[:, 2] < -40), 99)[1]


@CASES.extreme(STAGE, "inside out")
def _() -> str:
    return fitted(person().with_faces(person().scan.faces[:, ::-1]), 0.4)[1]


@CASES.extreme(STAGE, "half of the triangles wound the wrong way", "measured warning")
def _() -> str:
    faces = person().scan.faces
    turned = np.random.default_rng(0).random(len(faces)) < 0.5
    face, figure = fitted(person().with_faces(np.where(turned[:, None], faces[:, ::-1], faces)), 0.4)
    assert face.metrics["coverage"] < 0.7
    return Measured(f"{figure}, coverage {face.metrics['coverage']:.0%}: the others face away")


@CASES.extreme(STAGE, "1.5 times too large, in the model's pose")
def _() -> str:
    face, figure = fitted(person().scaled(1.5), 1.5)
    return f"{figure}, scale {face.metrics['scale']:.2f}"


@CASES.extreme(STAGE, "upside down in the model's frame", "measured warning")
def _() -> str:
    turned = compose(rotation_from_vector([0, 0, np.pi]), np.zeros(3)) @ person().model_from_scan
    return fitted(grey(), 99, pose=turned, levels=FINER)[1]


@CASES.extreme(STAGE, "a plane in place of the face", "measured warning")
def _() -> str:
    import igl

    grid, faces = igl.triangulated_grid(40, 40)
    plane = RawScan(np.column_stack([250 * grid - 125, np.zeros(len(grid))]), faces, name="plane")
    face = fit(plane, model(), np.eye(4), options=FitOptions(**QUICK))  # type: ignore[arg-type]
    assert_finite(face.vertices)
    assert face.metrics["strain"] > 0.12
    return Measured(f"strain {face.metrics['strain']:.2f}")


@CASES.extreme(STAGE, "a single triangle", "named error")
def _() -> str:
    with naming("one triangle: only .* % of the (fitted )?model has scan", "the scan holds"):
        triangle = RawScan([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]], [[0, 1, 2]], name="one triangle")
        fit(triangle, model(), np.eye(4))
    return "fitted"


@CASES.extreme(STAGE, "micrometres, metres and kilometres taken for mm", "named error")
def _() -> str:
    for unit in (1e3, 1e-3, 1e-6):
        with naming("unit|wrong|face"):
            small = person().moved(person().model_from_scan)
            fit(RawScan(unit * small.scan.vertices, small.scan.faces, name="scan"), model(), np.eye(4))
    return "fitted"


@CASES.extreme(STAGE, "a pose of NaN, mirrored or scaled", "named error")
def _() -> str:
    pose = person().model_from_scan
    for wrong in (np.full((4, 4), np.nan), 2 * pose):
        with suppress(ValueError), naming("must be a rigid transform"):
            return fitted(person(), 1.0, pose=wrong)[1]
    with naming("must be a rigid transform"):
        return fitted(person(), 1.0, pose=np.diag([-1.0, 1, 1, 1]) @ pose)[1]


@CASES.extreme(STAGE, "a budget of 0.001 s, and of 1 evaluation", "measured warning")
def _() -> str:
    figures = []
    for budget in (1e-3, Budget(evaluations=1)):
        face, figure = fitted(person(), 2.0, budget=budget)
        assert not face.converged
        figures.append(figure)
    return Measured(", ".join(figures) + ", converged False")
