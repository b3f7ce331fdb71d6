"""`process_person`: one shape and one albedo from several scans of a person, with a light for each."""

import pickle
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, CommonAlbedo, estimate_common_albedo
from scan2albedo.core import Budget, GeometryImage, OnProgress, Plan, PlanStep, RawScan, Trace
from scan2albedo.core.arrays import Float32Array, FloatArray, Texts, Values, attributes
from scan2albedo.core.raw_scan import lost_texture, scan_name
from scan2albedo.errors import RegistrationError
from scan2albedo.fitting import FittedFace, PersonShape, common_shape
from scan2albedo.io.images import write_png
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.result import ProcessResult, Run
from scan2albedo.pipeline.takes import Source, Takes
from scan2albedo.pipeline.unlit import Unlit
from scan2albedo.recognition import Templates, albedo_templates, certainty, same_person_log_odds
from scan2albedo.recognition.result_identification import CALIBRATION, log_odds_by_kind
from scan2albedo.recognition.templates import Kind
from scan2albedo.sampling import geometry_image
from scan2albedo.unlit.files import gray_bytes


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

    def write_more(self, folder: Path) -> None:
        """Write coverage.png and disagreement.png."""
        if self.common is not None:
            coverage = self.common.coverage / len(self.members)
            write_png(folder / "coverage.png", gray_bytes(coverage))
            write_png(folder / "disagreement.png", gray_bytes(self.common.disagreement))

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


def process_person(
    scans: Sequence[Source] | Mapping[str, Source],
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
    begin = time.perf_counter()
    if not scans:
        raise ValueError("no scan was given: give one or more scans of the person")
    if isinstance(scans, Mapping):
        scans_by_name = list(scans.items())
    else:
        scans_by_name = [
            (scan.name if isinstance(scan, RawScan) else scan_name(scan), scan) for scan in scans
        ]
    names = [one for one, _ in scans_by_name]
    if twice := sorted({one for one in names if names.count(one) > 1}):
        raise ValueError(f"{len(scans)} scans, of which several are called {twice[0]!r}: rename the files")
    takes = Takes(name, out, ProcessOptions(**options), on_progress)
    left_out = list[tuple[str, str]]()
    with tempfile.TemporaryDirectory(prefix="scan2albedo") as folder:
        spool = _Spool(Path(folder), [])
        for take in takes.each(scans_by_name, partial(_alone, takes)):
            if take.fit is None:
                left_out.append((take.name, take.reason))
            else:
                spool.keep(take.name, take.fit)
                spool.names.append(take.name)
        if not spool.names:
            every = "; ".join(reason for _, reason in left_out)
            raise RegistrationError(f"{name}: no scan can be used: {every}")
        shape, common = _shared(spool, takes, left_out)
        for one, reason in left_out:
            takes.doubt("person.scan", f"{one} is left out", reason)
        for result in spool.results():
            lost = lost_texture(result.scan.notes)
            doubts = [step.text for step in result.plan.doubts()]
            takes.doubt("person.scan", result.scan.name, *([lost] if lost else []), *doubts)
        person = replace(
            _person(spool, takes, shape, common),
            left_out=tuple(left_out),
            timings_s={"person": time.perf_counter() - begin},
        )
        if takes.out is None:
            return replace(person, results=tuple(spool.results()))
        place = takes.write(person, takes.out)
        for result in spool.results():
            takes.write(result, place)
        return replace(person, out=place)


@dataclass(frozen=True)
class _Spool:
    """Results of scans on disk, one at a time in memory; walked through, their geometry images."""

    folder: Path
    names: list[str]

    def keep(self, name: str, result: ProcessResult) -> None:
        (self.folder / name).write_bytes(pickle.dumps(result, protocol=5))

    def results(self) -> Iterator[ProcessResult]:
        # Written by this process, into a folder of its own.
        return (pickle.loads((self.folder / name).read_bytes()) for name in self.names)

    def fits(self) -> Iterator[FittedFace]:
        return (result.fitted for result in self.results() if result.fitted is not None)

    def estimates(self) -> Iterator[AlbedoEstimate]:
        return (result.albedo for result in self.results() if result.albedo is not None)

    def __iter__(self) -> Iterator[GeometryImage]:
        return (result.geometry_image for result in self.results())


def _alone(takes: Takes, name: str, source: Source) -> ProcessResult:
    """Return the scan registered and fitted; what has no light is made once all lights are known."""
    skip = (*takes.options.skip, "albedo")
    return takes.processed(source, name, skip=skip, unlit=None, maps=None, files="standard")


def _shared(
    spool: _Spool, takes: Takes, left_out: list[tuple[str, str]]
) -> tuple[PersonShape, CommonAlbedo | None]:
    """Return what the scans share; those that rather show somebody else move to `left_out`."""
    while True:
        shape = common_shape(spool.fits())
        common = None
        odds = shape.other_person.copy()
        has_colour = [image.texture_linear is not None for image in spool]
        if any(has_colour) and "albedo" not in takes.options.skip:
            coloured = _Spool(spool.folder, list(compress(spool.names, has_colour)))
            common = _common_albedo(coloured, takes)
            odds[has_colour] -= _same_person(coloured)
        worst = int(odds.argmax())
        if odds[worst] <= 0:
            break
        if len(odds) == 2:
            reason = f"the two scans rather show two people (log odds {odds[worst]:.1f})"
            takes.doubts.append(PlanStep.doubt("person.people", reason))
        if len(odds) < 3:
            break
        left_out.append((spool.names.pop(worst), f"rather shows another person (log odds {odds[worst]:.1f})"))
    return shape, common


def _common_albedo(spool: _Spool, takes: Takes) -> CommonAlbedo:
    """Return the albedo of all scans; each is kept with its own light."""
    chosen = takes.options

    def keep(number: int, estimate: AlbedoEstimate) -> None:
        name = spool.names[number]
        result = next(_Spool(spool.folder, [name]).results())
        # The scan's own budget, of which its stages took their part.
        clock = Clock(Budget.of(chosen.budget), sum(result.timings_s.values()))
        run = Run(result.scan, chosen)
        run.scan, run.fitted, run.albedo = result.scan, result.fitted, estimate
        steps = Unlit().run(run, clock)
        plan = Plan((*(step for step in result.plan if step.stage != "albedo"), *estimate.plan, *steps))
        options = {**result.options, "skip": sorted(set(chosen.skip)), "unlit": chosen.unlit}
        made = attributes(run, "unlit", "template", "maps_of_skin")
        spool.keep(name, replace(result, albedo=estimate, plan=plan, options=options, **made))

    return estimate_common_albedo(
        spool,
        lights=chosen.lights,
        brdf=chosen.brdf,
        budget=chosen.budget,
        seed=chosen.seed,
        options=chosen.of_albedo(),
        on_estimate=keep,
        on_progress=takes.on_progress,
    )


def _same_person(spool: _Spool) -> FloatArray:
    """Return (K,) the mean log odds by albedo that each scan shows the person of the others; 0 for one."""
    count = len(spool.names)
    if count < 2:
        return np.zeros(count)
    albedos = list[Float32Array]()
    masks = list[FloatArray]()
    for estimate in spool.estimates():
        assert estimate.expected_error is not None
        albedos.append(estimate.albedo_linear)
        masks.append(certainty(estimate.albedo_linear, estimate.expected_error, estimate.image.seen))
    templates: dict[Kind, Templates] = {"albedo": albedo_templates(albedos, spool.names, masks=masks)}
    odds = same_person_log_odds(templates, templates)
    np.fill_diagonal(odds, 0.0)
    sums = odds.sum(1)
    found = sums / (count - 1)
    if count > 2:
        # Albedos of one person are less alike by some scanners and lights: pairs of the other scans say so.
        others = (sums.sum() - 2 * sums) / ((count - 1) * (count - 2))
        similarity = np.full((1, 1), CALIBRATION.same[0])
        expected = log_odds_by_kind({"albedo": similarity})["albedo"][0, 0]
        found += np.maximum(expected - others, 0.0)
    return found


def _person(spool: _Spool, takes: Takes, shape: PersonShape, common: CommonAlbedo | None) -> PersonResult:
    """Return the neutral face as a result like that of a scan."""
    near = np.full(len(shape.vertices), np.nan)
    for fit in spool.fits():
        near = np.fmin(near, fit.residual_mm)
    coverage = float(np.mean(~np.isnan(near)))
    fitted = replace(
        next(spool.fits()),
        **attributes(shape, "vertices", "faces", "control_points", "landmarks"),
        template_vertices=shape.model.template_of(shape.control_points),
        residual_mm=near,
        metrics={
            "residual_mean_mm": float(np.nanmean(near)),
            "residual_median_mm": float(np.nanmedian(near)),
            "residual_p95_mm": float(np.nanpercentile(near, 95)),
            "coverage": coverage,
        },
        coverage=coverage,
        model_from_scan=np.eye(4),
    )
    image = geometry_image(fitted, None, takes.options.texels)
    estimate = None
    if common is not None:
        estimate = _unlit(spool, common, image)
        image = estimate.image
    return PersonResult(
        scan=RawScan(shape.vertices, shape.faces, name=takes.name),
        registration=None,
        fitted=fitted,
        geometry_image=image,
        albedo=estimate,
        plan=Plan((*takes.doubts, *(common.plan if common else ()))),
        trace=common.trace if common else Trace(),
        timings_s={},
        options=takes.options.recorded(takes.model),
        seed=takes.options.seed,
        shape=shape,
        common=common,
        members=tuple(spool.names),
    )


def _unlit(spool: _Spool, common: CommonAlbedo, image: GeometryImage) -> AlbedoEstimate:
    """Return the common albedo as an estimate without light; a texel is what the first scan saw there."""
    mask = image.mask
    estimates = spool.estimates()
    first = next(estimates)
    looks = attributes(first.image, "skin", "labels")
    seen = first.image.seen
    for estimate in estimates:
        other = estimate.image
        for name, values in looks.items():
            looks[name] = np.where(other.seen & ~seen, getattr(other, name), values)
        seen = seen | other.seen
    image = replace(
        image,
        texture_linear=common.albedo_linear,
        texture_valid=(common.coverage > 0) & mask,
        **looks,
    )
    return replace(
        first,
        **attributes(common, "albedo_linear", "expected_error", "plan", "trace", "converged"),
        lights=(),
        shading=np.repeat(mask[..., None], 3, 2).astype(np.float32),
        specular=np.zeros(mask.shape, np.float32),
        shadow=mask.astype(np.float32),
        confidence=1 - common.expected_error,
        image=image,
        uncertainty=None,
        albedo_deviation=None,
        environment=None,
    )
