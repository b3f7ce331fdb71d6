"""From photographs in any light to reflectance and light, or to a finer model, and their files."""

import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo import reflectance
from scan2albedo.core import BudgetLike, OnProgress, RawScan, Trace
from scan2albedo.core.arrays import FloatArray, IntArray, Texts, Values, attributes
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.fitting import fit
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.reflectance import GeometryFit, ImageObservation, PhotographFiles
from scan2albedo.reflectance.olat import linear_values, picture_values
from scan2albedo.registration import register
from scan2albedo.report.overview import overview_picture
from scan2albedo.report.reflectance_views import draw_in_camera, reflectance_panels, relit_panels
from scan2albedo.runs.reflectance import MEAN_FILE, MODEL_FILE, SHAPE_FILE, publishing
from scan2albedo.runs.reflectance.capture_run import gamma_notes, write_colored_mesh
from scan2albedo.runs.reflectance.model_run import SURFACE_LEVELS, FaceModels
from scan2albedo.templates import AnnotatedFaceModel

LANDMARK_NORMALS = 0.2
"""Angle in radians by which the normals of a shape from landmarks are off: the median over 36 photographs of
faces that the shape model does not know (root mean square 0.27: a few are far off)."""


@dataclass(frozen=True)
class FittedPhotograph:
    """A photograph, its face's vertices (V, 3) in mm in the camera's frame, and the fits."""

    photograph: PhotographFiles
    vertices: FloatArray
    faces: IntArray
    observation: ImageObservation
    face: reflectance.FaceFit
    geometry: GeometryFit | None
    """Where landmarks gave the shape."""
    trace: Trace
    """Of all fits, one after the other; each begins at 0 seconds."""

    def notes(self) -> Texts:
        """Return the caveats of the figures."""
        notes = gamma_notes(self.photograph)
        for name, part in {"shape": self.geometry, "reflectance and light": self.face.fit}.items():
            if part is not None and not part.converged:
                notes += (f"the fit of {name} stopped before it had converged",)
        if self.face.badly_explained:
            notes += (
                "light and model explain the photograph badly: relative RMSE "
                f"{100 * self.face.fit.relative_rmse:.1f} %; the reflectance is that of the model's mean "
                "face, scaled; do not trust the light, and check mesh, landmarks, gamma and mask",
            )
        elif not self.face.beats_mean:
            notes += (
                "the reflectance is that of the model's mean face, scaled: nothing found in this photograph "
                "predicts parts of it that were left out any better",
            )
        return notes


def fit_photograph(
    photograph: PhotographFiles,
    models: FaceModels,
    *,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> FittedPhotograph:
    """Fit reflectance and light to a photograph and, where it has no mesh, the shape.

    The shape is found from the landmarks, reflectance and light with that shape, the shape again from
    landmarks and colours. `fit_face` comes last; each of these fits gets the whole budget.
    Raises `ReflectanceError` when mesh and model have other vertices, there is no shape model for landmarks,
    or nothing is seen.
    """
    faces = models.mean.faces
    with _photograph_errors(photograph):
        vertices, geometry, trace = shaped_vertices(photograph, models, budget, on_progress)
        observation = observe(photograph, vertices, faces)
        angle = 0.0 if geometry is None else LANDMARK_NORMALS
        more: Values = {"normal_error": angle, "budget": budget, "on_progress": on_progress}
        face = reflectance.fit_face(observation, models.model, vertices, faces, **more)
    return FittedPhotograph(photograph, vertices, faces, observation, face, geometry, trace + face.fit.trace)


def shaped_vertices(
    photograph: PhotographFiles,
    models: FaceModels,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> tuple[FloatArray, GeometryFit | None, Trace]:
    """Return the vertices (V, 3) on a photograph's mesh, or those that its landmarks and colours give."""
    if photograph.vertices is not None:
        return corresponding(photograph, models), None, Trace()
    if models.shape is None:
        raise ReflectanceError(
            f"it has landmarks but no mesh, and {models.folder} holds no {SHAPE_FILE}; give a mesh, or build "
            "the model with --landmark-vertices"
        )
    within: Values = {"budget": budget, "on_progress": on_progress}
    first = _geometry(photograph, models.shape, **within)
    seen = observe(photograph, first.vertices, models.mean.faces)
    skin = reflectance.fit_image(seen, models.model, **within)
    refined = _geometry(
        photograph,
        models.shape,
        **within,
        reflectance=skin.face.reflectance,
        light=skin.light,
        initial_scene_from_model=first.scene_from_model,
        initial_identity=first.identity,
        initial_expression=first.expression,
    )
    return refined.vertices, refined, first.trace + skin.trace + refined.trace


def corresponding(photograph: PhotographFiles, models: FaceModels) -> FloatArray:
    """Return the vertices (V, 3) in mm that the model's ones are on a photograph's mesh.

    A mesh with the model's triangles is taken as it is. To any other one the face model is registered and
    fitted, where the model of reflectance lies on its surface. Raises `ReflectanceError` where it does not,
    `RegistrationError` where the mesh shows no face.
    """
    vertices, faces = photograph.vertices, photograph.faces
    assert vertices is not None
    same_count = len(vertices) == len(models.mean.vertices)
    if same_count and (faces is None or not len(faces) or np.array_equal(faces, models.mean.faces)):
        return vertices
    template = AnnotatedFaceModel.default()
    surface = template.subdivision(SURFACE_LEVELS)
    if faces is None or not len(faces) or not np.array_equal(surface.faces, models.mean.faces):
        raise ReflectanceError(
            f"its mesh {photograph.content.mesh} has {len(vertices)} vertices and other triangles than "
            f"{models} with {len(models.mean.vertices)}; give a mesh in the model's topology, or a model on "
            "the default face model's surface"
        )
    scan = RawScan(vertices, faces, name=str(photograph.content.mesh))
    fitted = fit(scan, template, register(scan, template))
    return transform_points(invert_rigid(fitted.model_from_scan), surface.matrix @ fitted.control_points)


@contextmanager
def _photograph_errors(photograph: PhotographFiles) -> Iterator[None]:
    """Name a photograph in errors, and leave out warnings of fits that stopped early, which notes say."""
    owner = f"photograph {photograph.path}"
    with errors_of(owner, ReflectanceError), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*without having converged", category=RuntimeWarning)
        yield


def observe(photograph: PhotographFiles, vertices: FloatArray, faces: IntArray) -> ImageObservation:
    """Look up vertices (V, 3) in a photograph."""
    content = photograph.content
    return reflectance.observe_photograph(
        photograph.image,
        photograph.camera,
        vertices,
        faces,
        mask=photograph.mask,
        gamma=content.gamma,
        saturation=content.saturation,
    )


def write_fitted_photograph(done: FittedPhotograph, models: FaceModels, out: Path, options: Values) -> Values:
    """Write reflectance, mesh, pictures and trace; return figures as in `reflectance.json`."""
    face, fit, geometry = done.face, done.face.fit, done.geometry
    seen = np.asarray(done.observation.seen)
    figures: Values = {
        "vertices": len(done.vertices),
        "seen_vertices": seen.sum(),
        **attributes(face, "beats_mean", "badly_explained", "relative_rmse"),
        "details": face.details is not None,
        "plan": [vars(step) for step in face.plan],
        "coefficients": fit.face.coefficients,
        "light_harmonics": fit.light,
    }
    figures |= attributes(fit, "objective", "converged", "iterations", "light_coefficients", "scale_rgb")
    if geometry is not None:
        figures["geometry"] = attributes(
            geometry,
            "scene_from_model",
            "identity",
            "expression",
            "landmark_rmse_px",
            "converged",
            "photometric_rmse_before",
            "photometric_rmse_after",
        )
    mesh = reflectance.MeshReflectance(done.vertices, done.faces, face.reflectance, seen=seen)
    upright = reflectance.MeshReflectance(models.mean.vertices, done.faces, face.reflectance)
    inputs = [path for path in (done.photograph.path, models.folder) if path is not None]
    with publishing(out, "fit-image", inputs, options, figures, done.notes()) as results:
        reflectance.write_reflectance(results.folder / "reflectance.npz", mesh)
        write_colored_mesh(results.folder / "face.ply", mesh)
        results.trace(done.trace)
        linear = _linear(done.photograph)
        camera, size = done.photograph.camera, linear.shape[:2]
        made, shown = draw_in_camera(camera, size, done.vertices, done.faces, face.radiance_linear)
        panels = relit_panels("face", np.nan_to_num(linear), made, shown, np.isfinite(linear))
        title = f"relative RMSE {100 * face.relative_rmse:.1f} % over {figures['seen_vertices']} vertices\n"
        title += "; ".join(step.reason for step in face.plan if step.ran) or "the mean face"
        results.picture("overview.png", overview_picture(title, panels + reflectance_panels(upright), 7))
    return figures


def _geometry(
    photograph: PhotographFiles, shape: reflectance.MorphableShapeModel, **options: Any
) -> GeometryFit:
    image, camera, pixels = _linear(photograph), photograph.camera, photograph.landmarks_px
    assert pixels is not None
    return reflectance.refine_geometry(image, camera, pixels, shape, mask=photograph.mask, **options)


def _linear(photograph: PhotographFiles) -> FloatArray:
    """Return light (H, W, 3), NaN where it is clipped."""
    content = photograph.content
    values = picture_values(photograph.image, str(photograph.path.parent / content.image), content.saturation)
    return np.where(values < content.saturation, linear_values(values, content.gamma), np.nan)


def tune_model(
    models: FaceModels,
    photographs: Sequence[Path],
    held_out: Sequence[Path],
    out: Path,
    options: Values,
    *,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
    say: Callable[[str], None] = lambda line: None,
) -> Values:
    """Fine-tune a model with photograph files, test it on others, and write the model's folder anew.

    Others are `held_out`, or one of three photographs when empty. `say` gets a line for each photograph.
    Returns figures as in `reflectance.json`. Raises `ReflectanceError` when there are too few, or one cannot
    be used.
    """
    assert models.folder is not None  # models that are tuned come from files
    tuned_with, tested_on = list(photographs), list(held_out)
    both = {path.resolve() for path in tuned_with} & {path.resolve() for path in tested_on}
    if both:
        raise ReflectanceError(f"{min(both)} is held out and tuned with; give it once")
    if not tested_on:
        tested_on = tuned_with[2::3]
        tuned_with = [path for path in tuned_with if path not in tested_on]
    if not tuned_with or not tested_on:
        raise ReflectanceError(
            f"{len(tuned_with)} photographs to tune with and {len(tested_on)} held out; give one or more of "
            "each, or 3 or more in all"
        )
    notes: list[str] = []

    def observed(path: Path) -> ImageObservation:
        say(f"reading {path}")
        photograph = reflectance.read_photograph(path)
        notes.extend(gamma_notes(photograph))
        with _photograph_errors(photograph):
            vertices, _, _ = shaped_vertices(photograph, models)
            return observe(photograph, vertices, models.mean.faces)

    tuning = reflectance.finetune(
        models.model,
        [observed(path) for path in tuned_with],
        [observed(path) for path in tested_on],
        models.mean.faces,
        models.mean.vertices,
        budget=budget,
        on_progress=on_progress,
    )
    if not tuning.converged:
        notes.append("budget or rounds ended while changes still helped")
    figures: Values = {"photographs": [*map(str, tuned_with)], "held_out": [*map(str, tested_on)]}
    figures |= attributes(tuning, "accepted_steps", "held_out_before", "held_out_after", "converged")
    inputs = (models.folder, *tuned_with, *tested_on)
    with publishing(out, "finetune", inputs, options, figures, notes) as results:
        tuning.model.save(results.folder / MODEL_FILE)
        mean = replace(models.mean, reflectance=tuning.model.mean_reflectance)
        reflectance.write_reflectance(results.folder / MEAN_FILE, mean)
        if models.shape is not None:
            shutil.copyfile(models.folder / SHAPE_FILE, results.folder / SHAPE_FILE)
        results.trace(tuning.trace)
    return figures
