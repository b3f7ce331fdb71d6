"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

import difflib
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Never

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, estimate_albedo
from scan2albedo.core import Budget, BudgetLike, OnProgress, Plan, PlanStep, RawScan, Trace
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import Values
from scan2albedo.core.first_run import compiled_beside
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import memory_errors_named
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.fitting.linear_model import LinearModelFit, fit_linear_model
from scan2albedo.fitting.plausibility import doubts, face_coverage
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.io import load_scan
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.leftovers import remove_leftovers
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.load_scan import input_sha256, with_landmarks
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.detected_landmarks import require_detector, with_detected
from scan2albedo.pipeline.options import ProcessOptions, Quality
from scan2albedo.pipeline.outputs import Outputs, without_light
from scan2albedo.pipeline.result import FILES, SURE, ProcessResult, write_result
from scan2albedo.pipeline.scale_search import load_of_any_size, registered_at_any_scale, registered_outward
from scan2albedo.pipeline.white_balance import balanced
from scan2albedo.registration import Registration, register
from scan2albedo.registration.register import judged_with_fit, refined_registration
from scan2albedo.sampling import geometry_image, geometry_image_of_scan
from scan2albedo.sampling.geometry_images import texture_doubt
from scan2albedo.templates import AnnotatedFaceModel, chosen_model
from scan2albedo.templates.annotated_face_model import linear_model_places

TEXEL_S = 2.5e-6
"""Seconds a texel that sampling, and division by the light, each take, whatever the budget."""
WHOLE_FACE = 0.8
"""Part of the model with scan near, below which a person is warned: whole faces have 0.85 and more."""
KNOWN_LIGHT = 0.25
"""Relative standard deviation of a lamp's strength above which a person is warned."""


def process(
    source: str | Path | RawScan,
    out: str | Path | None = None,
    *,
    name: str | None = None,
    model: AnnotatedFaceModel | str | Path | None = "default",
    size: int | None = None,
    lights: int | str = "auto",
    brdf: str = "oren-nayar",
    unit: str = "auto",
    quality: Quality | str = "standard",
    budget: BudgetLike = None,
    seed: int = 0,
    skip: Sequence[str] = (),
    force: Sequence[str] = (),
    pictures: bool = True,
    files: str = "standard",
    textures: str | Path | None = None,
    landmarks: Any = None,
    unlit: str | None = None,
    maps: str | None = None,
    texture_size: int = 1024,
    white_balance: str | Sequence[float] = "none",
    linear_model: LinearFaceModel | str | Path | None = None,
    on_progress: OnProgress = None,
    **unknown: Never,
) -> ProcessResult:
    """Return the result of one raw scan, taken through every stage it needs.

    Raises Scan2AlbedoError with one clear message when the scan cannot be read, holds no face, cannot be
    fitted, or the results cannot be written; earlier doubts of the stages are in its notes (`__notes__`).
    Raises ValueError for options that `ProcessOptions` refuses, TypeError for unknown options and for another
    source than a path or a `RawScan`.

    Parameters
    ----------
    source : path or RawScan
    out : path, optional
        Folder that gets a subfolder named after the scan with the files of the result.
    name : str, optional
        Name of the scan and of its folder; the file's stem, or that of the `RawScan`, when omitted.
    model, size, lights, brdf, unit, quality, budget, seed, skip, force, pictures, files, textures, \
landmarks, unlit, maps, texture_size, white_balance, linear_model
        See `ProcessOptions`.
    on_progress : callable, optional
        Called with every `TraceRow`.
    **unknown
        Refused.
    """
    for wrong in unknown:  # a misspelt option is refused with the one that was meant
        names = ["name", "on_progress", *(option.name for option in fields(ProcessOptions))]
        near = difflib.get_close_matches(wrong, names, 1)
        hint = f": did you mean {near[0]!r}?" if near else f"; options are {', '.join(names)}"
        raise TypeError(f"process() has no option {wrong!r}{hint}")
    advice = "give the path of a scan, or what load_scan(path) returns"
    require_type(source, (str, Path, RawScan), "process: source", advice)
    if out is not None:
        require_type(out, (str, Path), "process: out", "give the folder for the results")
    chosen = ProcessOptions(
        model=model,
        size=size,
        lights=lights,
        brdf=brdf,
        unit=unit,
        quality=quality,
        budget=budget,
        seed=seed,
        skip=skip,
        force=force,
        pictures=pictures,
        files=files,
        textures=textures,
        landmarks=landmarks,
        unlit=unlit,
        maps=maps,
        texture_size=texture_size,
        white_balance=white_balance,
        linear_model=linear_model,
    )
    if name is None:
        known = source.name if isinstance(source, RawScan) else scan_name(source)
    elif not is_folder_name(known := name):
        raise ValueError(f"name is {name!r}, expected a name that a folder can have")
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        RunFolder(Path(out) / known, FILES).check()
        check_writable(Path(out))
        remove_leftovers(Path(out))
    plan: dict[str, list[PlanStep]] = {}
    with memory_errors_named(known), compiled_beside():
        try:
            result = _Run(source, name, chosen, on_progress, plan).result()
        except Exception as error:  # whatever ends the run, it carries what the stages doubted before
            for step in Plan(tuple(chain(*plan.values()))).doubts():
                error.add_note(step.text)
            raise
        if out is None:
            return result
        folder = write_result(result, Path(out), files=chosen.files, pictures=chosen.pictures)
        return replace(result, out=folder)


@dataclass
class _Run:
    """One scan on its way through the stages; no file is written. `plan` gets the rows of each stage."""

    source: str | Path | RawScan
    name: str | None
    options: ProcessOptions
    on_progress: OnProgress
    plan: dict[str, list[PlanStep]]
    registration: Registration | None = None
    fitted: FittedFace | None = None
    linear_fit: LinearModelFit | None = None
    estimate: AlbedoEstimate | None = None
    input_sha256: str | None = None
    linear: tuple[LinearFaceModel, SurfacePoints] | None = None

    def result(self) -> ProcessResult:
        """Return the result of all stages."""
        self.clock = Clock(Budget.of(self.options.budget))
        self.file = None if isinstance(self.source, RawScan) else Path(self.source)
        if self.options.landmarks_detected:
            require_detector()
        with self.clock.timed("load"):
            self._load()
        self.clock.due_s = dict.fromkeys(("geometry_image", "albedo"), TEXEL_S * self.options.texels**2)
        self.clock.keep(Outputs(self.scan, self.model, self.options).all_s())
        if self.model is None:
            self._leave_out_face()
        else:
            self._register_and_fit(self.model)
        self._sample()
        if self.linear is not None and self.fitted is not None:
            with self.clock.timed("linear_model"):
                self._fit_linear_model(*self.linear, self.fitted)
        self._balance()
        self._find_albedo()
        more = Values()
        if Outputs(self.scan, None if self.fitted is None else self.fitted.model, self.options).reaches:
            with self.clock.timed("unlit"):
                more, self.plan["unlit"] = without_light(
                    self.scan, self.fitted, self.estimate, self.options, self.clock
                )
        ran = (self.registration, self.fitted, self.linear_fit, self.estimate)
        loaded = (PlanStep("load", True, note) for note in self.scan.notes)
        return ProcessResult(
            scan=self.scan,
            registration=self.registration,
            fitted=self.fitted,
            geometry_image=self.image,
            albedo=self.estimate,
            linear_model=self.linear_fit,
            plan=Plan((*loaded, *chain(*self.plan.values()))),
            trace=sum((stage.trace for stage in ran if stage is not None), Trace()),
            timings_s=self.clock.timings_s,
            options=self.options.recorded(self.model),
            seed=self.options.seed,
            input_sha256=self.input_sha256,
            source=self.file,
            **more,
        )

    def _load(self) -> None:
        """Read the scan, the face model and the linear model."""
        options, file = self.options, self.file
        # Hashed before it is read: a file that changes meanwhile is stale at once.
        if file is not None and os.path.isfile(file):
            self.input_sha256 = input_sha256(file, options.textures)
        self.size_fits: bool | None = None
        if isinstance(self.source, RawScan):
            scan = self.source if self.name is None else replace(self.source, name=self.name)
        elif options.unit == "auto" and options.model != "none" and "register" not in options.skip:
            scan, self.size_fits = load_of_any_size(Path(self.source), self.name, options.textures)
        else:
            scan = load_scan(self.source, unit=options.unit, name=self.name, textures=options.textures)
        if options.landmarks is not None and not options.landmarks_detected and options.model != "none":
            scan = with_landmarks(scan, options.landmarks, file)
        self.scan = scan
        self.model, linear = chosen_model(options.model), options.linear_model
        if linear is not None and self.model is not None:
            read = linear if isinstance(linear, LinearFaceModel) else LinearFaceModel.load(linear)
            self.linear = linear_model_places(read, self.model)

    def _leave_out_face(self) -> None:
        steps = [PlanStep(stage, False, "no model was asked for") for stage in ("register", "fit")]
        if self.options.landmarks is not None or self.scan.landmarks is not None:
            reason = "landmarks are not used: without a model nothing is fitted to them"
            steps.append(PlanStep.doubt("fit.landmarks", reason))
        self.plan["fit"] = steps

    def _register_and_fit(self, model: AnnotatedFaceModel) -> None:
        clock, options = self.clock, self.options
        pose = np.eye(4)
        if "register" in options.skip:
            reason = "skipped by the caller: the scan is taken to lie in the model's frame"
            self.plan["register"] = [PlanStep("register", False, reason)]
        else:

            def posed(of: RawScan) -> Registration:
                tuning, share = options.of_registration(), clock.share("register")
                return register(of, model, share, options.seed, options=tuning, on_progress=self.on_progress)

            with clock.timed("register"):
                if self.size_fits is None:
                    self.scan, self.registration = registered_outward(self.scan, posed)
                else:  # nobody gave the unit: the scale of a face in it
                    outward = partial(registered_outward, register=posed)
                    self.scan, self.registration = registered_at_any_scale(self.scan, self.size_fits, outward)
            pose = self.registration.model_from_scan
            self.plan["register"] = _register_rows(self.registration)
        with clock.timed("fit"):
            steps = list[PlanStep]()
            if options.landmarks_detected:
                self.scan, steps = with_detected(self.scan, pose, clock.share("fit").seconds)
            share, tuning = clock.share("fit"), options.stages.fit
            fitted = fit(self.scan, model, pose, share, options=tuning, on_progress=self.on_progress)
            if self.registration is not None:
                pose, scale = fitted.model_from_scan, fitted.scale
                refined = refined_registration(self.registration, self.scan, model, pose, scale)
                near_mm, far_mm = np.nanpercentile(fitted.residual_mm, (50, 95))
                figures = (
                    f"its edges are stretched by {100 * fitted.strain:.0f} % (RMS), half of it lies within "
                    f"{near_mm:.2f} mm of the scan, a twentieth of it more than {far_mm:.1f} mm away"
                )
                self.registration = judged_with_fit(refined, self.scan, fitted.face_log_odds, figures)
                self.plan["register"] = _register_rows(self.registration)
        self.fitted = fitted
        self.plan["fit"] = [*steps, *_fit_rows(options, self.scan, fitted)]

    def _sample(self) -> None:
        """Lay the scan on the face's chart, or on its own."""
        scan, fitted = self.scan, self.fitted
        with self.clock.timed("geometry_image"):
            if fitted is not None:
                image = geometry_image(fitted, scan, self.options.texels)
            else:
                image = geometry_image_of_scan(scan, self.options.texels)
        figures = image.figures()
        evidence = (
            f"{figures['coverage']:.1%} of the texels used, {figures['texel_area_mm2']:.2f} mm2 each, "
            f"areas within a factor of {figures['texel_area_p95_to_p5']:.1f} (5 to 95 %)"
        )
        if fitted is not None and scan.has_color:
            evidence += f", texture seen in {figures['seen']:.1%} of them, {figures['skin']:.1%} of them skin"
        if image.on_face is not None:
            evidence += f"; {image.on_face.sum() / image.mask.sum():.0%} are the face, where light is sought"
        chart = "charts cut by xatlas" if fitted is None else "the model's own chart"
        self.plan["geometry_image"] = steps = [PlanStep("geometry_image", True, chart, evidence)]
        if fitted is not None and (doubt := texture_doubt(fitted, scan, image)):
            steps.append(doubt)
        self.image = image

    def _fit_linear_model(self, linear: LinearFaceModel, places: SurfacePoints, fitted: FittedFace) -> None:
        skin, image = np.ones(len(fitted.vertices)), self.image
        if image.labels is not None:
            pixels = np.round(pixels_from_uv(fitted.uv, image.shape)).astype(int)
            column, row = np.clip(pixels, 0, image.shape[0] - 1).T
            covers = [CLASSES.index(name) for name in ("beard", "hair", "cloth")]
            skin -= np.isin(image.labels[row, column], covers)
        share = self.clock.share("linear_model")
        found = fit_linear_model(self.scan, fitted, linear, places, skin, share, self.on_progress)
        self.linear_fit, self.fitted = found, found.as_template(fitted)
        self.plan["linear_model"] = [*found.plan]

    def _balance(self) -> None:
        """Balance the colours, and tell of those that were filled in."""
        steps, white = self.plan["geometry_image"], self.options.white_balance
        if white != "none" and self.image.texture_linear is not None:
            self.scan, self.image, balance = balanced(self.scan, self.image, white)
            steps.append(balance)
        if (filled := 100 * self.image.figures().get("filled", 0.0)) > 0:
            reason = f"no picture showed {filled:.1f} % of the surface: its colours there are from around it"
            steps.append(PlanStep.doubt("geometry_image.filled", reason))

    def _find_albedo(self) -> None:
        options = self.options
        if self.image.texture_linear is None or "albedo" in options.skip:
            reason = "skipped by the caller" if "albedo" in options.skip else "the scan has no usable colour"
            self.plan["albedo"] = [PlanStep("albedo", False, reason)]
            self.clock.due_s.pop("albedo")
            return
        with self.clock.timed("albedo"):
            estimate = estimate_albedo(
                self.image,
                lights=options.lights,
                brdf=options.brdf,
                budget=self.clock.share("albedo"),
                seed=options.seed,
                options=options.of_albedo(),
                on_progress=self.on_progress,
            )
        self.estimate = estimate
        self.plan["albedo"] = steps = [*estimate.plan]
        strongest = () if estimate.uncertainty is None else estimate.uncertainty.intensity[:1]
        if (unsure := max(strongest, default=0.0)) > KNOWN_LIGHT:
            known = f"a lamp's strength is known to {100 * unsure:.0f} % only"
            steps.append(PlanStep.doubt("albedo.lamp_strength", f"{known}: its light may be in the albedo"))


def _register_rows(registration: Registration) -> list[PlanStep]:
    evidence = f"rmse {registration.rmse_mm:.2f} mm"
    rows = [PlanStep("register", True, "pose of the face in the scan", evidence), *registration.plan]
    if registration.confidence < SURE:
        reason = (
            f"the pose is unsure (confidence {registration.confidence:.2f}): another one is nearly as good, "
            "or the scan hardly resembles a face; look at overview.png"
        )
        rows.append(PlanStep.doubt("register.confidence", reason))
    return rows


def _fit_rows(options: ProcessOptions, scan: RawScan, fitted: FittedFace) -> list[PlanStep]:
    rows = []
    if scan.landmarks is not None:
        reason = "MediaPipe finds landmarks" if options.landmarks_detected else "landmarks are given"
        rows.append(PlanStep("fit.landmarks", True, reason, f"{int(scan.landmarks.placed.sum())}"))
    evidence = f"{np.nanmean(fitted.residual_mm):.3f} mm mean"
    rows.append(PlanStep("fit", True, "the model is deformed onto the scan", evidence))
    evidence = ""
    if (area_mm2 := fitted.covered_mm2) > 0:
        reason = "some of the scan stands far before the eyes, as glasses do"
        evidence = f"{area_mm2 / 100:.0f} cm2 left out"
    elif not options.stages.fit.covers:
        reason = "the preset keeps all of the scan"
    elif fitted.landmarks is None:
        reason = "the model has no landmarks that say where eyes are"
    else:
        reason = "nothing is found before the eyes"
    rows.append(PlanStep("fit.covers", area_mm2 > 0, reason, evidence))
    if count := int(fitted.metrics.get("painted_landmarks", 0)):
        reason = "the scan's colours show brows, eyes or lips"
        rows.append(PlanStep("fit.colors", True, reason, f"{count} landmarks"))
    else:
        reason = "the scan's colours show no feature surely" if scan.has_color else "the scan has no colour"
        rows.append(PlanStep("fit.colors", False, reason))
    rows += fitted.plan
    if (coverage := face_coverage(fitted)) < WHOLE_FACE:
        why = "what lies before the eyes was left out" if area_mm2 else "a file cut short, or half a face?"
        near = f"only {100 * coverage:.0f} % of the face has scan near it"
        rows.append(PlanStep.doubt("fit.coverage", f"{near}, else the model's own shape: {why}"))
    return [*rows, *doubts(fitted)]
