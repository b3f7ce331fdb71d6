"""The stages of `process` up to the albedo: what each costs, does with a `Run`, and writes."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from scan2albedo.albedo import estimate_albedo
from scan2albedo.core import PlanStep, RawScan
from scan2albedo.core.arrays import Texts
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.fitting.linear_model import fit_linear_model
from scan2albedo.fitting.plausibility import doubts, face_coverage
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io import load_scan
from scan2albedo.io.geometry_image_files import write_geometry_image, write_geometry_image_exr
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import write_exr, write_indexed_png, write_png
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.landmark_files import LANDMARKS_FILE, LandmarksRecord, write_landmarks_csv
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.load_scan import with_landmarks
from scan2albedo.io.npz import write_npz
from scan2albedo.io.records import write_record
from scan2albedo.io.result_records import RegistrationRecord
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.detected_landmarks import require_detector, with_detected
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.quality import PRESETS
from scan2albedo.pipeline.result import SURE, ProcessResult, Run
from scan2albedo.pipeline.scale_search import load_of_any_size, registered_at_any_scale, registered_outward
from scan2albedo.pipeline.white_balance import balanced
from scan2albedo.registration import Registration, RegistrationOptions, register
from scan2albedo.registration.register import judged_with_fit, refined_registration
from scan2albedo.sampling import geometry_image, geometry_image_of_scan
from scan2albedo.sampling.geometry_images import texture_doubt
from scan2albedo.templates import AnnotatedFaceModel, chosen_model
from scan2albedo.templates.annotated_face_model import linear_model_places
from scan2albedo.unlit.files import gray_bytes

TEXEL_S = 2.5e-6
"""Seconds a texel that sampling, and division by the light, each take, whatever the budget."""
WHOLE_FACE = 0.8
"""Part of the model with scan near, below which a person is warned: whole faces have 0.85 and more."""
KNOWN_LIGHT = 0.25
"""Relative standard deviation of a lamp's strength above which a person is warned."""
NO_MODEL = "no model was asked for"


@dataclass(frozen=True)
class Files:
    """The `folder` that the files of a result are written into, and which of them."""

    folder: Path
    left_out: Collection[str] = ()
    """Names of files that nobody wants."""
    exr: bool = False
    """Whether pictures are written in linear colour, too."""

    def write(self, name: str, writer: Callable[..., object], *content: Any, **options: Any) -> None:
        """Call a writer with the path of a file that is wanted, and with what it takes."""
        if name not in self.left_out:
            writer(self.folder / name, *content, **options)


class Stage:
    """One stage of `process`."""

    name: ClassVar[str]
    """In plans and timings."""
    share: ClassVar[float] = 0.0
    """Share that its search may take of the seconds still left for searching."""
    files: ClassVar[Texts] = ()
    """Names of the files that it may write."""
    details: ClassVar[Texts] = ()
    """The same of files that "minimal" results do without: other files have it, or it is the light's."""

    def cost_s(self, run: Run) -> float:
        """Return the seconds that it takes beside a search, once the scan is known."""
        return 0.0

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Fill in what it finds, and return what it did, left out and doubts."""
        raise NotImplementedError

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write its files."""


class Load(Stage):
    """Read the scan, the face model and the linear model."""

    name = "load"

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `scan` and `model`; the scan's notes say what was decided."""
        options, file = run.options, run.file
        if options.landmarks_detected:
            require_detector()
        with clock.timed(self.name):
            # Hashed before it is read: a file that changes meanwhile is stale at once.
            if file is not None and isfile(file):
                run.input_sha256 = input_sha256(file, options.textures)
            if isinstance(run.source, RawScan):
                scan = run.source if run.name is None else replace(run.source, name=run.name)
            elif options.unit == "auto" and options.model != "none" and "register" not in options.skip:
                scan, run.size_fits = load_of_any_size(Path(run.source), run.name, options.textures)
            else:
                scan = load_scan(run.source, unit=options.unit, name=run.name, textures=options.textures)
            if options.landmarks is not None and not options.landmarks_detected and options.model != "none":
                scan = with_landmarks(scan, options.landmarks, file)
            run.scan, run.model, linear = scan, chosen_model(options.model), options.linear_model
            if linear is not None and run.model is not None:
                read = linear if isinstance(linear, LinearFaceModel) else LinearFaceModel.load(linear)
                run.linear = linear_model_places(read, run.model)
        return []


class Register(Stage):
    """Find the pose of the face in the scan."""

    name = "register"
    share = 0.25
    files = ("registration.json",)

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `registration`, and bring the scan to the size and the side at which it holds a face."""
        options, model = run.options, run.model
        if model is None:
            return [PlanStep(self.name, False, NO_MODEL)]
        if self.name in options.skip:
            reason = "skipped by the caller: the scan is taken to lie in the model's frame"
            return [PlanStep(self.name, False, reason)]

        def outward(tuning: RegistrationOptions, scan: RawScan) -> tuple[RawScan, Registration]:
            def posed(scan: RawScan) -> Registration:
                share = clock.share(self.share)
                return register(scan, model, share, options.seed, options=tuning, on_progress=run.on_progress)

            return registered_outward(scan, posed)

        with clock.timed(self.name):
            search = partial(outward, options.of_registration())
            if run.size_fits is None:
                run.scan, run.registration = search(run.scan)
            else:  # nobody gave the unit: the scale of a face in it
                draft = partial(outward, PRESETS["draft"].registration)
                run.scan, run.registration = registered_at_any_scale(run.scan, run.size_fits, search, draft)
        return self.rows(run.registration)

    def rows(self, registration: Registration) -> list[PlanStep]:
        """Return what a registration says of itself."""
        evidence = f"rmse {registration.rmse_mm:.2f} mm"
        rows = [PlanStep(self.name, True, "pose of the face in the scan", evidence), *registration.plan]
        if registration.confidence < SURE:
            reason = (
                f"the pose is unsure (confidence {registration.confidence:.2f}): another one is nearly as "
                "good, or the scan hardly resembles a face; look at overview.png"
            )
            rows.append(PlanStep.doubt("register.confidence", reason))
        return rows

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the pose."""
        found, fitted = result.registration, result.fitted
        if found is None:
            return
        record = RegistrationRecord(
            model_from_scan=found.model_from_scan.tolist(),
            fitted_from_scan=None if fitted is None else fitted.model_from_scan.tolist(),
            rmse_mm=found.rmse_mm,
            depth_error=found.depth_error,
            converged=found.converged,
            confidence=found.confidence,
            iterations=found.iterations,
        )
        files.write("registration.json", write_record, record)


class Fit(Stage):
    """Deform the model onto the scan."""

    name = "fit"
    share = 0.4
    files = ("fitted.glb", LANDMARKS_FILE, "landmarks.csv")

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `fitted`, and judge the registration by it."""
        options, model = run.options, run.model
        if model is None:
            rows = [PlanStep(self.name, False, NO_MODEL)]
            if options.landmarks is not None or run.scan.landmarks is not None:
                reason = "landmarks are not used: without a model nothing is fitted to them"
                rows.append(PlanStep.doubt("fit.landmarks", reason))
            return rows
        rows = []
        with clock.timed(self.name):
            pose = np.eye(4) if run.registration is None else run.registration.model_from_scan
            if options.landmarks_detected:
                run.scan, rows = with_detected(run.scan, pose, clock.share(self.share).seconds)
            share, tuning = clock.share(self.share), options.stages.fit
            run.fitted = fit(run.scan, model, pose, share, options=tuning, on_progress=run.on_progress)
            if run.registration is not None:
                run.registration = _judged(run.registration, run.scan, model, run.fitted)
                run.plan[Register.name] = Register().rows(run.registration)
        return [*rows, *_fit_rows(options, run.scan, run.fitted)]

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the fitted face with its albedo, and the landmarks in the model's and the scan's frame."""
        fitted, in_scan = result.fitted, result.landmarks_scan
        if fitted is None:
            return
        files.write("fitted.glb", write_glb, fitted.vertices, fitted.faces, fitted.uv, result.texture_srgb)
        deviation_mm = fitted.landmark_deviation_mm
        if fitted.landmarks is not None and in_scan is not None and deviation_mm is not None:
            unit = result.scan.mm_per_unit
            landmarks = LandmarksRecord.of(fitted.landmarks, in_scan, deviation_mm, unit)
            files.write(LANDMARKS_FILE, write_record, landmarks)
            files.write("landmarks.csv", write_landmarks_csv, landmarks)


class Sample(Stage):
    """Lay the scan on the face's chart, or on its own, and balance its colours."""

    name = "geometry_image"
    files = ("geometry_image.npz",)
    details = ("geometry_image.exr", "skin.png", "labels.png")

    def cost_s(self, run: Run) -> float:
        """Return the seconds of sampling."""
        return TEXEL_S * run.options.texels**2

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `geometry_image`."""
        scan, fitted, size = run.scan, run.fitted, run.options.texels
        with clock.timed(self.name):
            if fitted is None:
                image = geometry_image_of_scan(scan, size)
            else:
                image = geometry_image(fitted, scan, size)
            chart = "charts cut by xatlas" if fitted is None else "the model's own chart"
            evidence = f"{image.figures()['coverage']:.1%} of the texels used"
            if image.on_face is not None:
                part = image.on_face.sum() / image.mask.sum()
                evidence += f"; {part:.0%} are the face, where light is sought"
            rows = [PlanStep(self.name, True, chart, evidence)]
            if fitted is not None and (doubt := texture_doubt(fitted, scan, image)):
                rows.append(doubt)
            white = run.options.white_balance
            if white != "none" and image.texture_linear is not None:
                run.scan, image, balance = balanced(scan, image, white)
                rows.append(balance)
        run.geometry_image = image
        if (filled := 100 * image.figures().get("filled", 0.0)) > 0:
            reason = f"no picture showed {filled:.1f} % of the surface: its colours there are from around it"
            rows.append(PlanStep.doubt("geometry_image.filled", reason))
        return rows

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the geometry image, and pictures of what its texels are."""
        image = result.geometry_image
        files.write("geometry_image.npz", write_geometry_image, image)
        files.write("geometry_image.exr", write_geometry_image_exr, image)
        if image.skin is not None:
            files.write("skin.png", write_png, gray_bytes(np.where(image.mask, image.skin, 0)))
        if image.labels is not None:
            files.write("labels.png", write_indexed_png, image.labels)


class FitLinearModel(Stage):
    """Find the coefficients of a linear model; its mesh is then the template."""

    name = "linear_model"
    share = 0.3
    files = ("coefficients.json", "linear_model.npz")

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `linear_model`, and the template of `fitted`."""
        fitted, image = run.fitted, run.geometry_image
        if run.linear is None or fitted is None:
            return []
        with clock.timed(self.name):
            model, places = run.linear
            skin = np.ones(len(fitted.vertices))
            if image.labels is not None:
                pixels = np.round(pixels_from_uv(fitted.uv, image.shape)).astype(int)
                column, row = np.clip(pixels, 0, image.shape[0] - 1).T
                covers = [CLASSES.index(name) for name in ("beard", "hair", "cloth")]
                skin -= np.isin(image.labels[row, column], covers)
            share = clock.share(self.share)
            found = fit_linear_model(run.scan, fitted, model, places, skin, share, run.on_progress)
            run.linear_model, run.fitted = found, found.as_template(fitted)
        return [*found.plan]

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the coefficients, and the mesh in the scan's own frame and unit."""
        fitted, found = result.fitted, result.linear_model
        if fitted is None or found is None:
            return
        unit = np.diag([*np.ones(3) / result.scan.mm_per_unit, 1])
        placed = unit @ invert_rigid(fitted.model_from_scan)
        files.write("coefficients.json", write_record, found.record(placed))
        arrays = {
            "vertices": transform_points(placed, found.vertices),
            "faces": found.model.faces,
            "residual_mm": found.residual_mm,
            "displacement_mm": found.displacement_mm,
        }
        files.write("linear_model.npz", write_npz, arrays, what="linear model")


class FindAlbedo(Stage):
    """Find the light on the geometry image, and take it off."""

    name = "albedo"
    share = 0.9
    files = ("albedo.exr", "albedo.png")
    details = ("expected_error.exr", "shading.exr", "specular.exr", "shadow.png")

    def cost_s(self, run: Run) -> float:
        """Return the seconds of the division by the light."""
        return 0.0 if self.name in run.options.skip else TEXEL_S * run.options.texels**2

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Set `albedo`."""
        options = run.options
        if run.geometry_image.texture_linear is None or self.name in options.skip:
            clock.due_s.pop(self.name, None)
            asked = self.name in options.skip
            reason = "skipped by the caller" if asked else "the scan has no usable colour"
            return [PlanStep(self.name, False, reason)]
        with clock.timed(self.name):
            run.albedo = estimate_albedo(
                run.geometry_image,
                lights=options.lights,
                brdf=options.brdf,
                budget=clock.share(self.share),
                seed=options.seed,
                options=options.of_albedo(),
                on_progress=run.on_progress,
            )
        rows = [*run.albedo.plan]
        uncertainty = run.albedo.uncertainty
        strongest = 0.0 if uncertainty is None else max(uncertainty.intensity[:1], default=0.0)
        if strongest > KNOWN_LIGHT:
            known = f"a lamp's strength is known to {100 * strongest:.0f} % only"
            rows.append(PlanStep.doubt("albedo.lamp_strength", f"{known}: its light may be in the albedo"))
        return rows

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the albedo, how sure it is, and the light that was taken off."""
        estimate, shown = result.albedo, result.texture_srgb
        if estimate is None or shown is None:
            return
        seen = np.where(result.geometry_image.seen, np.uint8(255), np.uint8(0))
        files.write("albedo.exr", write_exr, estimate.albedo_linear)
        files.write("albedo.png", write_png, np.dstack([shown, seen]))
        if estimate.expected_error is not None:
            files.write("expected_error.exr", write_exr, estimate.expected_error)
        files.write("shading.exr", write_exr, estimate.shading)
        files.write("specular.exr", write_exr, estimate.specular)
        files.write("shadow.png", write_png, gray_bytes(estimate.shadow))


def _judged(
    found: Registration, scan: RawScan, model: AnnotatedFaceModel, fitted: FittedFace
) -> Registration:
    """Return a registration with the pose of the fit, and as sure as the fit makes it."""
    refined = refined_registration(found, scan, model, fitted.model_from_scan, fitted.scale)
    near_mm, far_mm = np.nanpercentile(fitted.residual_mm, (50, 95))
    figures = (
        f"its edges are stretched by {100 * fitted.strain:.0f} % (RMS), half of it lies within "
        f"{near_mm:.2f} mm of the scan, a twentieth of it more than {far_mm:.1f} mm away"
    )
    return judged_with_fit(refined, scan, fitted.face_log_odds, figures)


def _fit_rows(options: ProcessOptions, scan: RawScan, fitted: FittedFace) -> list[PlanStep]:
    """Return what a fit says of itself."""
    rows = []
    if scan.landmarks is not None:
        reason = "MediaPipe finds landmarks" if options.landmarks_detected else "landmarks are given"
        rows.append(PlanStep("fit.landmarks", True, reason, f"{scan.landmarks.placed.sum()}"))
    evidence = f"{np.nanmean(fitted.residual_mm):.3f} mm mean"
    rows.append(PlanStep("fit", True, "the model is deformed onto the scan", evidence))
    area_mm2 = fitted.covered_mm2
    reason = "what stands far before the eyes, as glasses do, is left out"
    rows.append(PlanStep("fit.covers", area_mm2 > 0, reason, f"{area_mm2 / 100:.0f} cm2"))
    count = int(fitted.metrics.get("painted_landmarks", 0))
    reason = "features that the scan's colours show surely: brows, eyes or lips"
    rows.append(PlanStep("fit.colors", count > 0, reason, f"{count} landmarks"))
    rows += fitted.plan
    if (coverage := face_coverage(fitted)) < WHOLE_FACE:
        why = "what lies before the eyes was left out" if area_mm2 else "a file cut short, or half a face?"
        near = f"only {100 * coverage:.0f} % of the face has scan near it"
        rows.append(PlanStep.doubt("fit.coverage", f"{near}, else the model's own shape: {why}"))
    return [*rows, *doubts(fitted)]
