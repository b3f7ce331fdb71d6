"""A data set of people through the pipeline, and who is recognised by what, by condition."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recognition_experiment.calibration import calibrated
from recognition_experiment.methods import joined, method_names, session_templates
from recognition_experiment.options import RecognitionExperimentOptions
from recognition_experiment.report import MethodResult
from recognition_experiment.sessions import TEXTURE, Session
from scan2albedo.albedo import estimate_albedo
from scan2albedo.batch import BatchManifest, ProcessOptions, read_manifest, run_batch
from scan2albedo.core import GeometryImage
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import RecognitionError, Scan2AlbedoError
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.geometry_image_files import read_geometry_image
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.npz import read_npz, write_npz
from scan2albedo.recognition import (
    Calibration,
    Templates,
    cmc_curve,
    fused,
    identify_by_similarity,
    roc_curve,
    shape_templates,
    similarity_matrix,
)

SHAPE, BOTH = "shape", "shape and albedo"
PERSON, SESSION = "person", "session"
ALL = "all"


@dataclass(frozen=True)
class ListedScan:
    """A line of the data set's manifest; `conditions` are its other columns, the session first."""

    name: str
    person: str
    conditions: Mapping[str, str]

    @property
    def session(self) -> str:
        """When it was taken."""
        return self.conditions[SESSION]


def listed_scans(manifest: BatchManifest) -> list[ListedScan]:
    """Return the scans of a manifest with the columns person and session; RecognitionError names the line."""
    scans = []
    for scan in manifest.scans:
        cells = {name.strip().lower(): text for name, text in scan.extra.items()}
        if not (cells.get(PERSON) and cells.get(SESSION)):
            raise RecognitionError(
                f"{scan.where}: {scan.source} has no person or no session; give a CSV file with the columns "
                "person, session and scan, filled in every line"
            )
        person, session = cells.pop(PERSON), cells.pop(SESSION)
        scans.append(ListedScan(scan.name, person, {SESSION: session, **cells}))
    return scans


@dataclass(frozen=True)
class DataSet:
    """Processed scans: the gallery's, one a person, and the probes."""

    gallery: tuple[ListedScan, ...]
    probes: tuple[ListedScan, ...]
    failures: Mapping[str, str]
    """By scan: why it could not be processed, or has no use."""


def processed(
    manifest: Path,
    out: Path,
    options: ProcessOptions,
    *,
    jobs: int,
    gallery: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> DataSet:
    """Return the data set after the pipeline has run over it; results that are there already are kept.

    Parameters
    ----------
    manifest : Path
        CSV file with the columns person, session, scan and any conditions. Results are named after their
        scans, or the column name; those of one name after person, session and scan.
    out : Path
        Gets a folder for each scan.
    options : ProcessOptions
    jobs : int
        Scans at a time.
    gallery : str, optional
        The session that is the gallery; of each person the first in the manifest when omitted.
    say : callable
        Called with lines for the user.
    """
    listed = read_manifest(manifest, leave_out=out, name_columns=(PERSON, SESSION))
    scans = listed_scans(listed)

    def told(progress: object) -> None:
        last = getattr(progress, "last", None)
        if last is not None:
            say(f"{last.name}: {last.status} {last.reason}".rstrip())

    report = run_batch(listed, out, options=options, jobs=jobs, resume=True, on_progress=told)
    return _data_set(scans, dict(report.failures), gallery)


def _data_set(scans: Sequence[ListedScan], failures: dict[str, str], gallery: str | None) -> DataSet:
    known: dict[str, ListedScan] = {}
    for scan in scans:
        if scan.person not in known and gallery in (None, scan.session):
            known[scan.person] = scan
    probes = [scan for scan in scans if known.get(scan.person) is not scan and scan.name not in failures]
    usable = {person for person, scan in known.items() if scan.name not in failures}
    left = {
        scan.name: f"{scan.person} has no scan in the gallery" for scan in probes if scan.person not in usable
    }
    probes = [scan for scan in probes if scan.name not in left]
    if len(usable) < 2 or not probes:
        raise RecognitionError(
            f"{len(usable)} persons have a scan in the gallery and {len(probes)} probes are left, expected "
            f"two and one or more; {len(failures)} scans failed"
            + "".join(f"; {name}: {reason}" for name, reason in list(failures.items())[:3])
        )
    kept = tuple(scan for person, scan in known.items() if person in usable)
    return DataSet(kept, tuple(probes), {**failures, **left})


def albedo_of(image: GeometryImage, name: str, brdf: str, cache: Path, seed: int) -> NDArray[np.float32]:
    """Return the albedo (H, W, 3) by another reflectance, estimated on the geometry image or kept."""
    file = cache / brdf / f"{name}.npz"
    if file.is_file():
        return read_npz(file, ("albedo",), what="albedo", advice="delete it", error=Scan2AlbedoError)[
            "albedo"
        ]
    albedo = estimate_albedo(image, brdf=brdf, seed=seed).albedo_linear
    make_folder(file.parent)
    write_npz(file, {"albedo": albedo}, what="albedo")
    return albedo


def templates_of(
    scan: ListedScan, scans: Path, cache: Path, options: RecognitionExperimentOptions
) -> dict[str, Templates]:
    """Return the templates of a processed scan by each method; of one without colour its shape alone."""
    folder = scans / scan.name
    image = read_geometry_image(folder / "geometry_image.npz")
    made = {
        SHAPE: shape_templates([image.normal], [scan.person], masks=[image.seen], options=options.templates)
    }
    if image.texture_linear is None or not (folder / "albedo.exr").is_file():
        return made
    images: dict[str, NDArray[np.floating]] = {TEXTURE: image.texture_linear}
    images[options.brdfs[0]] = read_image_linear(folder / "albedo.exr")
    for brdf in options.brdfs[1:]:
        images[brdf] = albedo_of(image, scan.name, brdf, cache, options.seed)
    return made | session_templates(Session(images, image.seen), scan.person, options)


@dataclass(frozen=True)
class ComparedSet:
    """Similarities (P, G) of all probes to the gallery by each method."""

    data: DataSet
    similarities: Mapping[str, FloatArray]

    @property
    def genuine(self) -> np.ndarray:
        """(P, G) whether both show one person."""
        return np.array([[p.person == g.person for g in self.data.gallery] for p in self.data.probes])

    def calibration(self, albedo: str) -> Calibration:
        """Return how albedo, by its method's name, and shape are best weighed on these people."""
        return calibrated(
            {"albedo": self.similarities[albedo], "shape": self.similarities[SHAPE]}, self.genuine
        )

    def results(self) -> dict[tuple[str, str], list[MethodResult]]:
        """Return the results of all methods by condition and its value; ("all", "") of all probes.

        Conditions that hold the same probes as an earlier one, as a lamp of one session, are not repeated.
        """
        groups: dict[tuple[str, str], list[int]] = {(ALL, ""): list(range(len(self.data.probes)))}
        for k, probe in enumerate(self.data.probes):
            for condition, value in probe.conditions.items():
                groups.setdefault((condition, value), []).append(k)
        different: dict[tuple[str, str], list[int]] = {}
        for group, rows in groups.items():
            if rows not in different.values():
                different[group] = rows
        return {
            group: [self._result(name, rows) for name in self.similarities]
            for group, rows in different.items()
        }

    def _result(self, method: str, rows: Sequence[int]) -> MethodResult:
        names = [self.data.probes[k].person for k in rows]
        persons = [scan.person for scan in self.data.gallery]
        found = identify_by_similarity(self.similarities[method][list(rows)], persons, names)
        return MethodResult(method, found, cmc_curve(found), roc_curve(found, resamples=200))


def compared(data: DataSet, scans: Path, cache: Path, options: RecognitionExperimentOptions) -> ComparedSet:
    """Return all similarities; scans without colour are left out where others have it, and named."""
    made = {scan.name: templates_of(scan, scans, cache, options) for scan in (*data.gallery, *data.probes)}
    coloured = {name for name, templates in made.items() if len(templates) > 1}
    if coloured and len(coloured) < len(made):
        gray = {name: "has no albedo" for name in made if name not in coloured}
        data = _data_set([*data.gallery, *data.probes], {**data.failures, **gray}, None)
    methods = [*(method_names(options) if coloured else ()), SHAPE]
    found = {}
    for method in methods:
        probes, gallery = (
            joined([made[scan.name][method] for scan in scans_]) for scans_ in (data.probes, data.gallery)
        )
        found[method] = similarity_matrix(probes, gallery, window=options.window)
    if coloured:
        albedo = next(name for name in methods if name.startswith("albedo"))
        found[BOTH] = fused({"albedo": found[albedo], "shape": found[SHAPE]})
    return ComparedSet(data, found)


def people_counted(data: DataSet) -> str:
    """Return a sentence on how many took part."""
    sessions = Counter(probe.session for probe in data.probes)
    each = ", ".join(f"{count} of session {session}" for session, count in sessions.items())
    people = f"{len(data.gallery)} persons, {len(data.probes)} probes ({each})"
    return f"{people}; {len(data.failures)} scans left out"


__all__ = ["ALL", "BOTH", "SHAPE", "ComparedSet", "DataSet", "compared", "people_counted", "processed"]
