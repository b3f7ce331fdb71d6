"""`process_person`: one shape and one albedo from several scans of a person, with a light for each."""

import pickle
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, CommonAlbedo, estimate_common_albedo
from scan2albedo.core import (
    Budget,
    GeometryImage,
    OnProgress,
    Plan,
    PlanStep,
    RawScan,
    Trace,
)
from scan2albedo.core.arrays import Texts, Values, attributes
from scan2albedo.core.first_run import compiled_beside
from scan2albedo.core.raw_scan import is_folder_name, lost_texture, scan_name
from scan2albedo.errors import RegistrationError, Scan2AlbedoError, one_line
from scan2albedo.fitting import FittedFace, PersonShape, common_shape
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.process import FILES, process, write_result
from scan2albedo.pipeline.result import ProcessResult, Run
from scan2albedo.pipeline.unlit import Unlit
from scan2albedo.recognition import Templates, albedo_templates, certainty, same_person_log_odds
from scan2albedo.recognition.result_identification import CALIBRATION, log_odds_by_kind
from scan2albedo.recognition.templates import Kind
from scan2albedo.sampling import geometry_image
from scan2albedo.templates import chosen_model


@dataclass(frozen=True)
class PersonResult(ProcessResult):
    """A person's neutral face with the albedo of all scans, and what each scan adds.

    `scan` is the neutral face as a mesh, `fitted` the model on it, `albedo` without any light.
    """

    shape: PersonShape | None = None
    """The neutral face and each scan's expression."""
    common: CommonAlbedo | None = None
    """The albedo of all scans, its error and where they disagree; None when no scan has colour."""
    members: Texts = ()
    """Names of the scans of this person."""
    left_out: tuple[tuple[str, str], ...] = ()
    """Names of scans that were left out, and why."""
    results: tuple[ProcessResult, ...] = ()
    """Each scan in its own light beside the common albedo; empty when they were written."""

    def metrics(self) -> Values:
        """Return the figures of the person."""
        found = super().metrics()
        shape = self.shape
        assert shape is not None
        found["person"] = {
            "scans": list(self.members),
            "left_out": dict(self.left_out),
            "deviation_mm": round(float(np.median(shape.deviation_mm)), 3),
            "distance_mm": np.round(shape.distance_mm, 3).tolist(),
            "other_person_log_odds": np.round(shape.other_person, 2).tolist(),
        }
        if self.common is not None:
            found["person"]["gains"] = np.round(self.common.gains, 4).tolist()
        return found


class _Spool:
    """Results of scans on disk, one at a time in memory; walked through, their geometry images."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.names = folder, list[str]()

    def keep(self, name: str, result: ProcessResult) -> None:
        (self.folder / name).write_bytes(pickle.dumps(result, protocol=5))

    def read(self, name: str) -> ProcessResult:
        # Written by this process, into a folder of its own.
        return pickle.loads((self.folder / name).read_bytes())

    def fits(self) -> Iterator[FittedFace]:
        for name in self.names:
            fitted = self.read(name).fitted
            assert fitted is not None
            yield fitted

    def __iter__(self) -> Iterator[GeometryImage]:
        return (self.read(name).geometry_image for name in self.names)


def process_person(
    scans: Sequence[str | Path | RawScan] | Mapping[str, str | Path | RawScan],
    out: str | Path | None = None,
    *,
    name: str = "person",
    on_progress: OnProgress = None,
    **options: Any,
) -> PersonResult:
    """Return one neutral shape and one albedo of a person from any number of scans.

    Each scan is registered and fitted as `process` does; light, expression, pose, device, coverage and scale
    may differ. `common_shape` and `estimate_common_albedo` find what they share. A scan that cannot be used,
    and one that rather shows another person by the odds of shape and albedo, is left out by name; of two
    scans that differ, none is.

    Raises RegistrationError when no scan can be used, OutputError when the results cannot be written;
    ValueError for no scan, two of one name, and what `ProcessOptions` refuses; TypeError for unknown options.

    Parameters
    ----------
    scans : sequence or mapping of path or RawScan
        Of a mapping, the keys are the scans' names.
    out : path, optional
        Folder that gets a subfolder `name` with the files of a result, those of the neutral face with the
        common albedo, coverage.png and disagreement.png; and in it a folder for each scan.
    name : str
        Of the person.
    on_progress : callable, optional
        Called with every `TraceRow`.
    **options
        Those of `process`; a budget holds for each scan, and once more for the common albedo.
    """
    if not scans:
        raise ValueError("no scan was given: give one or more scans of the person")
    if not is_folder_name(name):
        raise ValueError(f"name is {name!r}, expected a name that a folder can have")
    if isinstance(scans, Mapping):
        names, scans = list(scans), list(scans.values())
    else:
        names = [scan.name if isinstance(scan, RawScan) else scan_name(scan) for scan in scans]
    if twice := sorted({one for one in names if names.count(one) > 1}):
        raise ValueError(f"{len(scans)} scans, of which several are called {twice[0]!r}: rename the files")
    chosen, begin = ProcessOptions(**options), time.perf_counter()
    if chosen.model == "none":
        raise ValueError("a person needs the model of a face: leave model='none' out")
    if chosen.linear_model is not None:
        raise ValueError("linear_model is fitted to single scans: process them with it one by one")
    if out is not None:
        RunFolder(Path(out) / name, FILES).check()
        check_writable(Path(out))
    left_out, plan = list[tuple[str, str]](), list[PlanStep]()
    model = chosen_model(chosen.model)
    alone = {
        "model": model,
        "skip": (*chosen.skip, "albedo"),
        "unlit": None,
        "maps": None,
        "files": "standard",
    }
    arguments = chosen.arguments() | alone
    with tempfile.TemporaryDirectory(prefix="scan2albedo") as folder, compiled_beside():
        spool = _Spool(Path(folder))
        for one, scan in zip(names, scans, strict=True):
            try:
                result = process(scan, name=one, on_progress=on_progress, **arguments)
            except Scan2AlbedoError as error:
                left_out.append((one, one_line(error)))
                continue
            spool.keep(one, result)
            spool.names.append(one)
        if not spool.names:
            every = "; ".join(reason for _, reason in left_out)
            raise RegistrationError(f"{name}: no scan can be used: {every}")
        shape, common = common_shape(spool.fits()), None
        while True:
            colours = [k for k, image in enumerate(spool) if image.texture_linear is not None]
            if colours and "albedo" not in chosen.skip:
                coloured = _Spool(spool.folder)
                coloured.names = [spool.names[k] for k in colours]
                common = _common_albedo(coloured, chosen, on_progress)
            odds = shape.other_person.copy()
            if common is not None:
                odds[colours] -= _same_person(coloured)
            worst = int(odds.argmax())
            if len(odds) < 3 or odds[worst] <= 0:
                break
            reason = f"rather shows another person (log odds {odds[worst]:.1f})"
            left_out.append((spool.names.pop(worst), reason))
            shape, common = common_shape(spool.fits()), None
        if len(odds) == 2 and odds.max() > 0:
            reason = f"the two scans rather show two people (log odds {odds.max():.1f})"
            plan.append(PlanStep.doubt("person.people", reason))
        plan += [PlanStep.doubt("person.scan", f"{one} is left out: {why}") for one, why in left_out]
        for one in spool.names:
            result = spool.read(one)
            lost = lost_texture(result.scan.notes)
            told = ([lost] if lost else []) + [step.text for step in result.plan.doubts()]
            plan += [PlanStep.doubt("person.scan", f"{one}: {note}") for note in told]
        person = _assembled(name, spool, shape, common, chosen, plan)
        person = replace(
            person,
            left_out=tuple(left_out),
            options=chosen.recorded(model),
            timings_s={"person": time.perf_counter() - begin},
            results=() if out is not None else tuple(map(spool.read, spool.names)),
        )
        if out is None:
            return person
        place = write_result(person, Path(out), files=chosen.files, pictures=chosen.pictures)
        for one in spool.names:
            write_result(spool.read(one), place, files=chosen.files, pictures=chosen.pictures)
        return replace(person, out=place)


def _common_albedo(spool: _Spool, chosen: ProcessOptions, on_progress: OnProgress) -> CommonAlbedo:
    """Return the albedo of all scans; each is kept with its own light."""

    def keep(k: int, estimate: AlbedoEstimate) -> None:
        result = spool.read(spool.names[k])
        # The scan's own budget, of which its stages took their part.
        clock = Clock(Budget.of(chosen.budget), sum(result.timings_s.values()))
        run = Run(result.scan, chosen)
        run.scan, run.fitted, run.albedo = result.scan, result.fitted, estimate
        steps = Unlit().run(run, clock)
        plan = Plan((*(step for step in result.plan if step.stage != "albedo"), *estimate.plan, *steps))
        options = {**result.options, "skip": sorted(set(chosen.skip)), "unlit": chosen.unlit}
        lit = replace(result, albedo=estimate, plan=plan, options=options)
        made = attributes(run, "unlit", "template", "maps_of_skin")
        spool.keep(spool.names[k], replace(lit, **made))

    return estimate_common_albedo(
        spool,
        lights=chosen.lights,
        brdf=chosen.brdf,
        budget=chosen.budget,
        seed=chosen.seed,
        options=chosen.of_albedo(),
        on_estimate=keep,
        on_progress=on_progress,
    )


def _same_person(spool: _Spool) -> np.ndarray:
    """Return (K,) the mean log odds by albedo that each scan shows the person of the others; 0 for one."""
    albedos, masks = list[Any](), list[Any]()
    for name in spool.names:
        estimate = spool.read(name).albedo
        assert estimate is not None
        albedos.append(estimate.albedo_linear)
        seen, error = estimate.image.seen, estimate.expected_error
        masks.append(seen if error is None else certainty(estimate.albedo_linear, error, seen))
    if len(albedos) < 2:
        return np.zeros(len(albedos))
    templates: dict[Kind, Templates] = {"albedo": albedo_templates(albedos, spool.names, masks=masks)}
    odds = same_person_log_odds(templates, templates)
    np.fill_diagonal(odds, 0.0)
    count, sums = len(odds), odds.sum(1)
    found = sums / (count - 1)
    if count > 2:
        # Albedos of one person are less alike by some scanners and lights: pairs of the other scans say so.
        others = (sums.sum() - 2 * sums) / ((count - 1) * (count - 2))
        usual = log_odds_by_kind({"albedo": np.full((1, 1), CALIBRATION.same[0])})["albedo"][0, 0]
        found += np.maximum(usual - others, 0.0)
    return np.asarray(found)


def _assembled(
    name: str,
    spool: _Spool,
    shape: PersonShape,
    common: CommonAlbedo | None,
    chosen: ProcessOptions,
    plan: Sequence[PlanStep],
) -> PersonResult:
    """Return the neutral face as a result like that of a scan."""
    near, first = np.full(len(shape.vertices), np.nan), next(spool.fits())
    for fit in spool.fits():
        near = np.fmin(near, fit.residual_mm)
    found_shape = attributes(shape, "vertices", "faces", "control_points", "landmarks")
    neutral = replace(
        first,
        **found_shape,
        template_vertices=shape.model.template_of(shape.control_points),
        residual_mm=near,
        metrics={
            "residual_mean_mm": float(np.nanmean(near)),
            "residual_median_mm": float(np.nanmedian(near)),
            "residual_p95_mm": float(np.nanpercentile(near, 95)),
            "coverage": float(np.mean(~np.isnan(near))),
        },
        model_from_scan=np.eye(4),
    )
    image, estimate, rows = geometry_image(neutral, None, chosen.texels), None, [*plan]
    maps = Values()
    if common is not None:
        mask, seen = image.mask, common.coverage > 0
        found = (one.albedo for one in map(spool.read, spool.names) if one.albedo is not None)
        lit = next(found)
        skin, labels, shown = lit.image.skin, lit.image.labels, lit.image.seen
        for other in (one.image for one in found):
            more = other.seen & ~shown
            if skin is not None and other.skin is not None:
                skin = np.where(more, other.skin, skin)
            if labels is not None and other.labels is not None:
                labels = np.where(more, other.labels, labels)
            shown = shown | more
        image = replace(
            image, texture_linear=common.albedo_linear, texture_valid=seen & mask, skin=skin, labels=labels
        )
        rows += common.plan
        maps = {"coverage.png": common.coverage / len(spool.names), "disagreement.png": common.disagreement}
        taken = ("albedo_linear", "expected_error", "plan", "trace", "converged")
        shared: Values = attributes(common, *taken)
        shared |= dict.fromkeys(("uncertainty", "albedo_deviation", "environment"))
        estimate = replace(
            lit,
            **shared,
            lights=(),
            shading=np.repeat(mask[..., None], 3, 2).astype(np.float32),
            specular=np.zeros(mask.shape, np.float32),
            shadow=mask.astype(np.float32),
            confidence=1 - common.expected_error,
            image=image,
        )
    return PersonResult(
        scan=RawScan(shape.vertices, shape.faces, name=name),
        registration=None,
        fitted=neutral,
        geometry_image=image,
        albedo=estimate,
        plan=Plan(tuple(rows)),
        trace=Trace() if common is None else common.trace,
        timings_s={},
        options={},
        seed=chosen.seed,
        maps=maps,
        shape=shape,
        common=common,
        members=tuple(spool.names),
    )
