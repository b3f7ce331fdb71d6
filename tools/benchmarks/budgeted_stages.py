"""The stages that take a budget in seconds, each on a scene of usual size."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.budgets import REPEATS, BudgetedStage, BudgetRow, checked_budgets
from scan2albedo.core import GeometryImage, ProgressCallback
from scan2albedo.core.arrays import FloatArray

Make = Callable[[], BudgetedStage]


def budgeted_stages(names: Sequence[str], quick: bool) -> list[Make]:
    """Return what makes the stages named, of all when none is."""
    known: dict[str, tuple[Make, ...]] = {
        "register": (partial(_register, quick),),
        "fit": (partial(_fit, quick),),
        "albedo": (partial(_albedo, quick),),
        "weights": (partial(_weights, quick),),
        "glasses": (partial(_glasses, quick),),
        "reflectance": (_fit_image, _refine_geometry, _finetune),
    }
    if quick and not names:
        return [make for name in ("register", "fit", "albedo") for make in known[name]]
    return [make for name in names or known for make in known.get(name, ())]


def budget_rows(
    stages: Sequence[str] = (),
    *,
    quick: bool = False,
    on_row: Callable[[BudgetRow], None] = lambda row: None,
) -> list[BudgetRow]:
    """Check the budgets of the stages named, all that have one when none is.

    Parameters
    ----------
    stages : sequence of str
        Those without a budget are passed over; "reflectance" stands for the three of reflectance, which run
        with all others too.
    quick : bool
        One run each, of tiny scenes; without names of registration, fit and albedo alone.
    on_row : callable
        Called with each row.
    """
    rows = []
    with warnings.catch_warnings():
        # That they have not converged is what is measured.
        warnings.simplefilter("ignore")
        for make in budgeted_stages(stages, quick):
            for row in checked_budgets(make(), repeats=1 if quick else REPEATS):
                rows.append(row)
                on_row(row)
    return rows


def _register(quick: bool) -> BudgetedStage:
    from worlds.synthetic_scans import scan_scenes

    from benchmarks.registration import pose_errors
    from benchmarks.registration_peers import Surface, centered
    from benchmarks.sweep import Cost
    from scan2albedo.geometry.rigid import invert_rigid
    from scan2albedo.registration import register

    scene = scan_scenes(1, 4.0 if quick else 2.2)[0]

    def error(pose: FloatArray) -> float:
        return pose_errors(scene, pose, Cost(0, 0)).errors[0]

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        return register(scene.scan, scene.model, budget, on_progress=on_progress).model_from_scan

    start = error(invert_rigid(centered(Surface(*scene.model.surface(1)), scene.scan)))
    return BudgetedStage("register", "mm", run, error, start)


def _fit(quick: bool) -> BudgetedStage:
    from worlds.synthetic_scans import scan_scenes

    from benchmarks.fitting import rigid_only, surface_errors
    from benchmarks.sweep import Cost
    from scan2albedo.fitting import FittedFace, fit

    scene = scan_scenes(1, 4.0 if quick else 2.2)[0]
    points = scene.model.subdivision(2).matrix

    pose = scene.found_pose

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FittedFace:
        return fit(scene.scan, scene.model, pose, budget, on_progress=on_progress)

    def error(found: FittedFace) -> float:
        surface = found.vertices, found.faces
        outcome = surface_errors(
            scene, surface, points @ found.control_points, 2, found.model_from_scan, Cost(0, 0)
        )
        return outcome.errors[0]

    return BudgetedStage("fit", "mm", run, error, rigid_only(scene).errors[0])


def _albedo(quick: bool) -> BudgetedStage:
    from benchmarks.albedo import value_of
    from scan2albedo.albedo import albedo_error, estimate_albedo
    from scan2albedo.synthetic import face, light_at

    scene = face(
        3,
        size=64 if quick else 512,
        texture="skin",
        lights=[light_at(50, 10), light_at(-40, 5, intensity=2)],
        noise=0.005,
    )
    truth, image = value_of(scene.albedo_linear), _with_light_occluder(scene.image)
    assert image.texture_linear is not None

    def error(albedo: Any) -> float:
        return albedo_error(value_of(albedo), truth, image.mask).mse_percent

    def run(budget: float | None, on_progress: ProgressCallback | None) -> Any:
        return estimate_albedo(image, budget=budget, on_progress=on_progress).albedo_linear

    return BudgetedStage("albedo", "%", run, error, error(image.texture_linear))


def _with_light_occluder(image: GeometryImage) -> GeometryImage:
    """Return the image with an occluder of about 128 x 128 texels: as many triangles as a fitted face has."""
    part = slice(None, None, max(max(image.shape) // 128, 1))
    coarse = GeometryImage(image.position[part, part], image.normal[part, part], image.mask[part, part])
    return replace(image, occluder=coarse.triangulated())


def _weights(quick: bool) -> BudgetedStage:
    from benchmarks.sweep import Cost
    from benchmarks.weights import WeightedFrame, weight_errors
    from scan2albedo.eyeglasses import solve_weights
    from scan2albedo.synthetic import GlassesBend, eyeglasses

    glasses = eyeglasses(0, bend=GlassesBend(temple_spread_mm=8, bridge_deg=2))
    mesh = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints)
    spacing: float | str = 2.8 if quick else "auto"
    scene = WeightedFrame(glasses, solve_weights(*mesh, spacing).weights)

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        return solve_weights(*mesh, spacing, budget, on_progress=on_progress).weights

    def error(weights: FloatArray) -> float:
        return weight_errors(scene, weights, Cost(0, 0), 0, 0.0).errors[1]

    nearest = np.linalg.norm(mesh[0][:, None] - mesh[2], axis=2).argmin(1)
    rigid = np.eye(len(mesh[2]))[nearest]
    return BudgetedStage("weights", "mm", run, error, error(rigid))


def _glasses(quick: bool) -> BudgetedStage:
    from benchmarks.glasses import QUICK_WEARER_PX, registered, rms_mm, worn_glasses
    from scan2albedo.core import Budget
    from scan2albedo.eyeglasses import FaceRegistrationOptions

    scene = worn_glasses(0, *QUICK_WEARER_PX) if quick else worn_glasses(0)
    options = FaceRegistrationOptions()

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        return registered(scene, options, budget, on_progress).vertices

    def error(vertices: FloatArray) -> float:
        return rms_mm(vertices, scene.worn)

    start = error(registered(scene, options, Budget(evaluations=1)).vertices)
    return BudgetedStage("glasses", "mm", run, error, start)


def _fit_image() -> BudgetedStage:
    from worlds.model_faces import albedo_error, learned, person, shot

    from scan2albedo.reflectance import fit_image

    model, face = learned(40, 30), person(3)
    observation = shot(face, 3)

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        found = fit_image(observation, model, budget=budget, on_progress=on_progress)
        return found.face.reflectance.diffuse_linear

    def error(albedo: FloatArray) -> float:
        return 100 * albedo_error(albedo, face)

    return BudgetedStage("fit_image", "%", run, error, error(model.diffuse.mean))


def _refine_geometry() -> BudgetedStage:
    from worlds.model_faces import geometry_scene, rigid_error_mm, shape_model

    from scan2albedo.reflectance import refine_geometry

    scene, shapes = geometry_scene(0), shape_model(60)

    def run(budget: float | None, on_progress: ProgressCallback | None) -> FloatArray:
        found = refine_geometry(
            scene.image_linear,
            scene.camera,
            scene.landmarks_px,
            shapes,
            reflectance=scene.reflectance,
            light=scene.light,
            mask=scene.skin,
            budget=budget,
            on_progress=on_progress,
        )
        return found.vertices

    def error(vertices: FloatArray) -> float:
        return rigid_error_mm(vertices, scene.vertices)

    return BudgetedStage("refine_geometry", "mm", run, error, error(shapes.mean))


def _finetune() -> BudgetedStage:
    from worlds.model_faces import learned, person, shot, surface

    from scan2albedo.reflectance import finetune

    model = learned(8, 7)
    seen = [shot(person(k), k) for k in range(8)]
    s = surface()

    def run(budget: float | None, on_progress: ProgressCallback | None) -> float:
        tuned = finetune(
            model, seen[::2], seen[1::2], s.faces, vertices=s.vertices, budget=budget, on_progress=on_progress
        )
        return tuned.held_out_after

    return BudgetedStage("finetune", "objective", run, float, finetune_start(model, seen[1::2]))


def finetune_start(model, held_out) -> float:  # type: ignore[no-untyped-def]
    """Return the objective of the held-out images with the model as it is."""
    from scan2albedo.reflectance import fit_image

    return float(np.mean([fit_image(image, model).objective for image in held_out]))
