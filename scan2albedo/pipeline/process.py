"""`process`: a raw scan through every stage it needs, with a plan, a trace and files."""

import difflib
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Never

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo import AlbedoEstimate, estimate_albedo
from scan2albedo.applications.engine_maps import engine_maps
from scan2albedo.applications.eyes_and_mouth import eyes_and_mouth, on_template
from scan2albedo.applications.files import load_result
from scan2albedo.applications.light_removal import unlit_scan, usual_light
from scan2albedo.applications.template_baking import template_texture
from scan2albedo.core import Budget, Plan, PlanStep, ProgressCallback, RawScan, Trace
from scan2albedo.core.arguments import require_type
from scan2albedo.core.first_run import compiled_beside
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import memory_errors_named
from scan2albedo.face_model.appearance import CLASSES
from scan2albedo.fitting import FittedFace, fit
from scan2albedo.fitting.linear_model import fit_linear_model
from scan2albedo.fitting.plausibility import doubts, face_coverage
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.io import load_scan
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.leftovers import remove_leftovers
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.io.load_scan import input_sha256, with_landmarks
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.pipeline.detected_landmarks import require_detector, with_detected
from scan2albedo.pipeline.options import ProcessOptions, Quality
from scan2albedo.pipeline.result import FILES, SURE, ProcessResult, write_result
from scan2albedo.pipeline.scale_search import load_of_any_size, registered_at_any_scale, registered_outward
from scan2albedo.pipeline.white_balance import balanced
from scan2albedo.registration import Registration, register
from scan2albedo.registration.register import refined_registration
from scan2albedo.sampling import geometry_image, geometry_image_of_scan
from scan2albedo.sampling.geometry_images import texture_doubt
from scan2albedo.templates import AnnotatedFaceModel, chosen_model
from scan2albedo.templates.annotated_face_model import linear_model_places

BUDGET_SHARES = {"register": 0.25, "fit": 0.4, "linear_model": 0.3, "albedo": 0.9, "unlit": 0.3}
"""Share of the seconds still left for searching that each stage may take; of the unlit scan, the share of the
whole budget that is kept for it at most: the face itself comes first."""
_TEXEL_S = 2.5e-6
"""Seconds a texel that each of sampling, division and painting a template takes, whatever the budget."""
_UNLIT_S = 0.8e-6
"""The same of the removal of light from the scan's own texture."""
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
    budget: Budget | float | None = None,
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
    on_progress: ProgressCallback | None = None,
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
    given = locals()  # the arguments, most of them options of the same name
    for wrong in unknown:  # a misspelt option is refused with the one that was meant
        names = ["name", "on_progress", *(option.name for option in fields(ProcessOptions))]
        near = difflib.get_close_matches(wrong, names, 1)
        hint = f": did you mean {near[0]!r}?" if near else f"; options are {', '.join(names)}"
        raise TypeError(f"process() has no option {wrong!r}{hint}")
    advice = "give the path of a scan, or what load_scan(path) returns"
    require_type(source, (str, Path, RawScan), "process: source", advice)
    if out is not None:
        require_type(out, (str, Path), "process: out", "give the folder for the results")
    chosen = ProcessOptions(**{option.name: given[option.name] for option in fields(ProcessOptions)})
    if name is None:
        known = source.name if isinstance(source, RawScan) else scan_name(source)
    elif not is_folder_name(known := name):
        raise ValueError(f"name is {name!r}, expected a name that a folder can have")
    # Result folders are checked before any work, so that an hour is not lost to a read-only disk.
    if out is not None:
        RunFolder(Path(out) / known, FILES).check()
        check_writable(Path(out))
        remove_leftovers(Path(out))
    plan: dict[str, Sequence[PlanStep]] = {}
    with memory_errors_named(known), compiled_beside():
        try:
            result = _processed(source, name, chosen, on_progress, plan)
        except Exception as error:  # whatever ends the run, it carries what the stages doubted before
            for step in Plan(tuple(chain(*plan.values()))).doubts():
                error.add_note(step.text)
            raise
        if out is None:
            return result
        folder = write_result(result, Path(out), files=chosen.files, pictures=chosen.pictures)
        return replace(result, out=folder)


@dataclass
class _Clock:
    """Times the stages of one run, and shares what is left of its budget among them."""

    budget: Budget
    texels: int
    kept_s: float = 0.0  # for what follows the last search
    timings_s: dict[str, float] = field(default_factory=dict)
    start: float = field(default_factory=time.perf_counter)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings_s[stage] = time.perf_counter() - begin

    def left_s(self) -> float:
        seconds = self.budget.seconds
        return float("inf") if seconds is None else seconds - (time.perf_counter() - self.start)

    def share(self, stage: str) -> Budget:
        """Return the stage's part of what is left of the budget."""
        if self.budget.seconds is None:
            return self.budget
        left = self.left_s() - _TEXEL_S * self.texels * (1 if stage == "albedo" else 2) - self.kept_s
        return replace(self.budget, seconds=max(left * BUDGET_SHARES[stage], 1e-3))


def _processed(
    source: str | Path | RawScan,
    name: str | None,
    options: ProcessOptions,
    on_progress: ProgressCallback | None,
    plan: dict[str, Sequence[PlanStep]],
) -> ProcessResult:
    """Take the scan through the stages; no file is written. `plan` gets the rows of each stage."""
    clock = _Clock(Budget.of(options.budget), options.texels**2)
    if options.landmarks_detected:
        require_detector()
    file = None if isinstance(source, RawScan) else Path(source)
    with clock.timed("load"):
        # Hashed before it is read: a file that changes meanwhile is stale at once.
        sha256 = input_sha256(file, options.textures) if file is not None and os.path.isfile(file) else None
        size_fits = None
        if isinstance(source, RawScan):
            scan = source if name is None else replace(source, name=name)
        elif options.unit == "auto" and options.model != "none" and "register" not in options.skip:
            scan, size_fits = load_of_any_size(Path(source), name, options.textures)
        else:
            scan = load_scan(source, unit=options.unit, name=name, textures=options.textures)
        if options.landmarks is not None and not options.landmarks_detected and options.model != "none":
            scan = with_landmarks(scan, options.landmarks, file)
        model, linear = chosen_model(options.model), options.linear_model
        if linear is not None and not isinstance(linear, LinearFaceModel):
            linear = LinearFaceModel.load(linear)
    unlit_s, seconds = 0.0, clock.budget.seconds
    if options.unlit is not None and scan.texture_linear is not None:
        # Beyond the face a texel takes half as long.
        unlit_s = _UNLIT_S * (1.5 if options.unlit == "all" else 1.0) * scan.texture_linear[..., 0].size
    clock.kept_s = min(unlit_s, BUDGET_SHARES["unlit"] * (seconds or 0.0))
    registration, fitted, estimate = None, None, None
    if model is None:
        steps = [PlanStep(stage, False, "no model was asked for") for stage in ("register", "fit")]
        if options.landmarks is not None or scan.landmarks is not None:
            reason = "landmarks are not used: without a model nothing is fitted to them"
            steps.append(PlanStep.doubt("fit.landmarks", reason))
        plan["fit"] = steps
    else:
        pose = np.eye(4)
        if "register" in options.skip:
            reason = "skipped by the caller: the scan is taken to lie in the model's frame"
            plan["register"] = [PlanStep("register", False, reason)]
        else:

            def posed(of: RawScan) -> Registration:
                share, tuning = clock.share("register"), options.of_registration()
                return register(of, model, share, options.seed, options=tuning, on_progress=on_progress)

            with clock.timed("register"):
                if size_fits is None:
                    scan, registration = registered_outward(scan, posed)
                else:  # nobody gave the unit: the scale of a face in it
                    outward = partial(registered_outward, register=posed)
                    scan, registration = registered_at_any_scale(scan, size_fits, outward)
            pose = registration.model_from_scan
            plan["register"] = _register_rows(registration)
        with clock.timed("fit"):
            steps = []
            if options.landmarks_detected:
                scan, steps = with_detected(scan, pose, clock.share("fit").seconds)
            share = clock.share("fit")
            fitted = fit(scan, model, pose, share, options=options.stages.fit, on_progress=on_progress)
            if registration is not None:
                pose, scale = fitted.model_from_scan, fitted.metrics["scale"]
                registration = refined_registration(registration, scan, model, pose, scale)
                plan["register"] = _register_rows(registration)
        plan["fit"] = [*steps, *_fit_rows(options, scan, fitted)]
    with clock.timed("geometry_image"):
        if fitted is not None:
            image = geometry_image(fitted, scan, options.texels)
        else:
            image = geometry_image_of_scan(scan, options.texels)
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
    plan["geometry_image"] = steps = [PlanStep("geometry_image", True, chart, evidence)]
    if fitted is not None and (doubt := texture_doubt(fitted, scan, image)):
        steps.append(doubt)
    coefficients = None
    if linear is not None and fitted is not None:
        with clock.timed("linear_model"):
            placed, skin = linear_model_places(linear, fitted.model), np.ones(len(fitted.vertices))
            if image.labels is not None:
                pixels = np.round(pixels_from_uv(fitted.uv, image.shape)).astype(int)
                column, row = np.clip(pixels, 0, image.shape[0] - 1).T
                covers = [CLASSES.index(name) for name in ("beard", "hair", "cloth")]
                skin -= np.isin(image.labels[row, column], covers)
            given = clock.share("linear_model"), on_progress
            coefficients = fit_linear_model(scan, fitted, *placed, skin, *given)
            fitted = coefficients.as_template(fitted)
        plan["linear_model"] = coefficients.plan
    if (white := options.white_balance) != "none" and image.texture_linear is not None:
        scan, image, balance = balanced(scan, image, white)
        steps.append(balance)
    if (filled := 100 * figures.get("filled", 0.0)) > 0:
        reason = f"no picture showed {filled:.1f} % of the surface: its colours there are from around it"
        steps.append(PlanStep.doubt("geometry_image.filled", reason))
    if image.texture_linear is not None and "albedo" not in options.skip:
        with clock.timed("albedo"):
            estimate = estimate_albedo(
                image,
                lights=options.lights,
                brdf=options.brdf,
                budget=clock.share("albedo"),
                seed=options.seed,
                options=options.of_albedo(),
                on_progress=on_progress,
            )
        plan["albedo"] = steps = [*estimate.plan]
        strongest = () if estimate.uncertainty is None else estimate.uncertainty.intensity[:1]
        if (unsure := max(strongest, default=0.0)) > KNOWN_LIGHT:
            known = f"a lamp's strength is known to {100 * unsure:.0f} % only"
            reason = f"{known}: its light may be in the albedo"
            steps.append(PlanStep.doubt("albedo.lamp_strength", reason))
    else:
        reason = "skipped by the caller" if "albedo" in options.skip else "the scan has no usable colour"
        plan["albedo"] = [PlanStep("albedo", False, reason)]
    more = dict[str, Any]()
    painted = fitted is not None and fitted.model.template_uv is not None
    if options.unlit is not None or options.maps is not None or painted:
        with clock.timed("unlit"):
            lit = (scan, fitted, estimate, options)
            more, plan["unlit"] = without_light(*lit, unlit_s, clock.left_s())
    ran = [stage for stage in (registration, fitted, coefficients, estimate) if stage is not None]
    return ProcessResult(
        scan=scan, registration=registration, fitted=fitted, geometry_image=image, albedo=estimate, **more,
        linear_model=coefficients,
        plan=Plan((*(PlanStep("load", True, note) for note in scan.notes), *chain(*plan.values()))),
        trace=sum((stage.trace for stage in ran), Trace()), timings_s=clock.timings_s,
        options=options.recorded(model), seed=options.seed, input_sha256=sha256, source=file,
    )  # fmt: skip


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
    if (area_mm2 := fitted.metrics["covered_mm2"]) > 0:
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


def without_light(
    scan: RawScan,
    fitted: FittedFace | None,
    estimate: AlbedoEstimate | None,
    options: ProcessOptions,
    unlit_s: float,
    left_s: float,
) -> tuple[dict[str, Any], list[PlanStep]]:
    """Return the unlit scan, the template's texture and maps, where asked for and in time, and the plan."""
    unlit, more, steps = None, dict[str, Any](), list[PlanStep]()
    late, left = "the budget ended before it", f"{left_s:.1f} s left"
    if options.unlit is not None:
        if fitted is None or estimate is None:
            why = "there is no face" if fitted is None else "no albedo was estimated"
            steps.append(PlanStep.wrong("unlit", f"unlit is left out: {why}, so the light is not known"))
        elif unlit_s > left_s:
            steps.append(PlanStep.wrong("unlit", f"unlit is left out: {late}", left))
        else:
            unlit = unlit_scan(scan, fitted, estimate, options.unlit)
            size = unlit.confidence.shape
            evidence = f"{' x '.join(map(str, size))} {'texels' if len(size) == 2 else 'vertices'}"
            what = "whole scan" if options.unlit == "all" else "face"
            steps.append(PlanStep("unlit", True, f"the light is taken off the {what}", evidence))
            steps.append(_hair_row("unlit.hair", unlit.hair))
    lit = None if fitted is None or estimate is None else (fitted, estimate)
    painted = fitted is not None and fitted.model.template_uv is not None
    everywhere = unlit if options.unlit == "all" else None
    for name, wanted in (("template_texture", painted), ("maps", options.maps is not None)):
        if not wanted:
            continue
        if lit is None:
            if name == "maps":
                steps.append(PlanStep.wrong(name, "maps are left out: there is no face with an albedo"))
        elif _TEXEL_S * options.texture_size**2 > left_s:
            steps.append(PlanStep.wrong(name, f"{name} is left out: {late}", left))
        else:
            # A template may reach beyond the face, so its texture has no light anywhere.
            everywhere = everywhere or unlit_scan(scan, *lit, "all")
            if name == "maps":
                baked = engine_maps(everywhere.scan, *lit, str(options.maps), options.texture_size)
                more["maps_of_skin"], reason = baked, f"asked for, on the {options.maps}"
            else:
                baked = template_texture(everywhere.scan, lit[0], options.texture_size, everywhere)
                more["template"], reason = baked, "the template has texture coordinates"
            seen = sum(float(tile.seen.mean()) for tile in baked.tiles) / max(len(baked.tiles), 1)
            evidence = f"{len(baked.tiles)} tile(s), {seen:.0%} of their texels seen"
            steps.append(PlanStep(name, True, reason, evidence))
            if name == "template_texture":
                steps.append(_hair_row("template_texture.hair", everywhere.hair))
    carriers = [name for name in more if name == "template" or options.maps != "scan"]
    if carriers and lit is not None and "eyes" in options.skip:
        steps.append(PlanStep("eyes", False, "skipped by the caller"))
    elif carriers and lit is not None:
        stages = {"scan": scan, "fitted": lit[0], "geometry_image": lit[1].image, "albedo": lit[1]}
        inside = eyes_and_mouth(load_result(SimpleNamespace(**stages)))
        for name in carriers:
            more[name] = on_template(inside, lit[0], usual_light(lit[1]), more[name])
        there = ", ".join(part.name for part in more[carriers[0]].parts)
        steps.append(PlanStep("eyes", bool(there), inside.reason, there))
    return {"unlit": unlit, **more}, steps


def _hair_row(stage: str, hair: NDArray[np.floating] | None) -> PlanStep:
    if hair is None:
        return PlanStep(stage, False, "no hair, beard or brows are found: nothing is kept apart")
    reason = "hair, beard and brows as they were lit are kept apart"
    return PlanStep(stage, True, reason, f"{hair.mean():.0%} of the colours")
