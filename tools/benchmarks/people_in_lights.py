"""Recognition of the six people in ../shared/data/yale under 11 to 12 lamps each, and of any processed
people."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from worlds.files import face_data
from worlds.population import Population, population_scan, random_lights

from benchmarks.light_normalization import multi_scale_retinex
from scan2albedo import GeometryImage, estimate_albedo, process
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.recognition import (
    Calibration,
    TemplateOptions,
    albedo_templates,
    certainty,
    fused,
    read_labelled_templates,
    similarity_matrix,
)
from scan2albedo.recognition.result_identification import CALIBRATION, log_odds_by_kind
from scan2albedo.recognition.similarity import WINDOW
from scan2albedo.recognition.templates import Kind

KINDS: tuple[Kind, ...] = ("albedo", "texture", "shape", "shading")


@dataclass(frozen=True)
class Judged:
    """`similarities` (N, N) of all pairs of N scans or photographs by kind; of each the `persons`, the
    `sittings`, pairs of one of which tell nothing, and the `lights`."""

    similarities: Mapping[Kind, FloatArray]
    persons: Sequence[str]
    sittings: Sequence[str]
    lights: Sequence[str]

    @property
    def pairs(self) -> tuple[tuple[IntArray, IntArray], BoolArray]:
        """Rows and columns of the pairs, and which are of one person."""
        who, sitting = np.array(self.persons), np.array(self.sittings)
        rows, columns = np.triu_indices(len(who), 1)
        told = sitting[rows] != sitting[columns]
        rows, columns = rows[told], columns[told]
        return (rows, columns), who[rows] == who[columns]

    def part(self, persons: Collection[str]) -> Judged:
        """Return those of some persons."""
        kept = np.flatnonzero(np.isin(self.persons, list(persons))).tolist()
        found = {kind: values[np.ix_(kept, kept)] for kind, values in self.similarities.items()}
        columns = self.persons, self.sittings, self.lights
        return Judged(found, *([column[k] for k in kept] for column in columns))


def robust_harmonics(normals: FloatArray, values: FloatArray) -> FloatArray:
    """Return the light (N,) of nine harmonics fitted to values (N,), with Cauchy weights."""
    x, y, z = normals.T
    base = np.stack([0 * x + 1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)
    weight = np.ones(len(values))
    for _ in range(40):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(base * root[:, None], values * root, rcond=None)[0]
        left = values - base @ found
        weight = 1 / (1 + (left / (1.5 * 1.4826 * np.median(abs(left)) + 1e-9)) ** 2)
    return np.maximum(base @ found, 0.03 * np.median(base @ found))


def photographs(cache: Path, lamps: Collection[str] | None = None) -> list[dict]:
    """Return photographs of the six people under lamps (all when omitted).

    Albedos are estimated once (4 s of CPU each) and kept.
    """
    rows = []
    for file in sorted(face_data("yale/yaleB11.npz").parent.glob("*.npz")):
        with np.load(file) as stored:
            data = dict(stored)
        normal, mask = data["normal"].astype(float), data["mask"]
        for k, light in enumerate(data["lights"]):
            if lamps is not None and light not in lamps:
                continue
            texture = np.where(mask, data["texture_linear8"][k] / 255.0, 0)
            kept = cache / f"{file.stem}_{k}.npz"
            if not kept.is_file():
                colour = np.repeat(texture[..., None], 3, -1).astype(np.float32)
                image = GeometryImage(data["position_mm"].astype(float), normal, mask, texture_linear=colour)
                made = estimate_albedo(image, seed=0)
                cache.mkdir(parents=True, exist_ok=True)
                error = np.asarray(made.expected_error)
                np.savez_compressed(kept, albedo=made.albedo_linear.max(-1), expected_error=error)
            with np.load(kept) as stored:
                albedo, error = stored["albedo"].astype(float), stored["expected_error"].astype(float)
            harmonics = np.zeros(mask.shape)
            harmonics[mask] = texture[mask] / robust_harmonics(normal[mask], texture[mask])
            rows.append(
                {
                    "person": file.stem,
                    "light": str(light),
                    "mask": mask,
                    "certainty": certainty(albedo, error, mask),
                    "texture": texture,
                    "albedo": albedo,
                    "harmonics": harmonics,
                    "retinex": multi_scale_retinex(texture, mask),
                    "shading": np.divide(texture, albedo, out=np.zeros(mask.shape), where=albedo > 0),
                }
            )
    return rows


def light_similarities(
    rows: Sequence[dict], names: Sequence[str], size: int = 256, window: int = WINDOW
) -> dict[str, FloatArray]:
    """Return (N, N) similarities of all photographs, by each of the named images."""
    people, found = [row["person"] for row in rows], {}
    for name in names:
        masks = [row["certainty" if name in KINDS else "mask"] for row in rows]
        options = TemplateOptions(size=size, unit_mean=name != "retinex")  # retinex is logarithmic already
        made = albedo_templates([row[name] for row in rows], people, masks=masks, options=options)
        found[name] = similarity_matrix(made, made, window=window)
    return found


def rates(
    similarities: Mapping[str, FloatArray],
    people: Sequence[str],
    lights: Sequence[str],
    calibration: Calibration,
    draws: int = 60,
    together: int = 1,
    best: bool = False,
) -> dict[str, tuple[float, float]]:
    """Return rank 1 by each kind and fused: gallery of one lamp (all choices), and of random lamps.

    One photograph a person is the gallery; the probes are all others of these people, `together` at a time by
    the mean of what they say, or the best.
    """
    who, lamp = np.array(people), np.array(lights)
    galleries = [(0, np.flatnonzero(lamp == one)) for one in sorted(set(lights))]
    random = np.random.default_rng(0)
    persons = sorted(set(people))
    for _ in range(draws):
        galleries.append((1, np.array([random.choice(np.flatnonzero(who == one)) for one in persons])))
    right: dict[str, tuple[list, list]] = {}
    for which, gallery in galleries:
        if len(gallery) < 2:
            continue
        probes = np.flatnonzero(np.isin(who, who[gallery]) & ~np.isin(np.arange(len(who)), gallery))
        scores = {name: values[np.ix_(probes, gallery)] for name, values in similarities.items()}
        cues = {kind: scores[kind] for kind in calibration.kinds if kind in scores}
        scores["fused"] = fused(cues, calibration)
        shuffled = random.permutation(len(probes)) if together > 1 else np.arange(len(probes))
        of_person = [shuffled[who[probes[shuffled]] == one] for one in sorted(set(who[probes]))]
        groups = [one[k : k + together] for one in of_person for k in range(0, len(one), together)]
        shown = np.array([who[probes[group[0]]] for group in groups])
        for name, values in scores.items():
            said = np.stack([values[group].max(0) if best else values[group].mean(0) for group in groups])
            right.setdefault(name, ([], []))[which].extend(who[gallery[said.argmax(1)]] == shown)
    return {name: (float(np.mean(one)), float(np.mean(mixed))) for name, (one, mixed) in right.items()}


def make_people(folder: Path, persons: int, seed: int, sessions: Sequence[int] = (0, 1, 2)) -> None:
    """Scan and process synthetic people; results are PERSON_SESSION, those that are there are kept.

    Sessions 0 and 1 have the same lamps for everybody, others their own; expressions and poses are random.
    """
    own = Population()
    studio = random_lights(np.random.default_rng([seed, 77]), own)
    for person in range(persons):
        for session in sessions:
            name = f"p{person:02d}_s{session}"
            if (folder / name / "result.json").is_file():
                continue
            scan, _ = population_scan(person, session, seed=seed, lamps=studio if session < 2 else None)
            try:
                process(scan, folder, name=name, size=256, quality="draft", pictures=False)
            except Scan2AlbedoError as error:
                print(f"{name}: {error}")


def pair_similarities(results: Path) -> Judged:
    """Return the pairs of all results PERSON_sSESSION in a folder; sessions 0 and 1 have one light."""
    table = results / "pairs.csv"
    folders = sorted(one.parent.name for one in results.glob("*/albedo.exr"))
    lines = [f"{name.split('_')[0]},{name}" for name in folders]
    table.write_text("\n".join(["person,result", *lines]) + "\n")
    read = read_labelled_templates(table)
    found = {kind: similarity_matrix(made, made) for kind, made in read.sets.items()}
    lights = ["studio" if name.endswith(("_s0", "_s1")) else name for name in folders]
    return Judged(found, [str(person) for person in read.persons], folders, lights)


def calibrated_on(sets: Sequence[Judged]) -> Calibration:
    """Return the calibration by sets of people, each weighing as much.

    How alike strangers are differs by population, chart and camera. The covariance is the mean of those of
    pairs of one person and of two within the sets, and that of the levels half-way between their means over
    the sets: what a pair's set adds is not known of a new one. The shape's level is that of the population,
    so its variance stands apart.
    """
    means, spreads, variances = [], [], []
    for judged in sets:
        pairs, own = judged.pairs
        missing = np.full((len(judged.persons),) * 2, np.nan)
        values = np.stack([judged.similarities.get(kind, missing)[pairs] for kind in KINDS])
        means.append([values[:, own].mean(1), values[:, ~own].mean(1)])
        spreads.append(np.mean([np.cov(values[:, own]), np.cov(values[:, ~own])], axis=0))
        who, lamp, cells = np.array(judged.persons), np.array(judged.lights), []
        for a in sorted(set(judged.lights)):
            for b in sorted(set(judged.lights)):
                rows, columns = np.flatnonzero(lamp == a), np.flatnonzero(lamp == b)
                alike = judged.similarities["shading"][np.ix_(rows, columns)]
                strangers = alike[who[rows][:, None] != who[columns]]
                shared = min(len(rows), len(columns)) > 2  # a light of several people's
                cells += [strangers.var()] if shared and len(strangers) > 2 else []
        variances += [np.mean(cells)] if len(cells) > 1 else []  # one shared light tells of no others
    (same, other), level = np.nanmean(means, axis=0), np.ma.masked_invalid(np.mean(means, axis=1))
    over_sets = np.ma.cov(level, rowvar=False).filled(0.0)
    shape = KINDS.index("shape")
    apart = np.where(np.arange(len(KINDS)) == shape, 0.0, 1.0)
    covariance = np.nanmean(spreads, axis=0) + over_sets * np.outer(apart, apart)
    return Calibration(
        KINDS,
        tuple(np.round(same, 4).tolist()),
        tuple(np.round(other, 4).tolist()),
        tuple(map(tuple, np.round(covariance, 6).tolist())),
        float(np.round(np.mean(variances), 6)),
        float(np.round(over_sets[shape, shape], 6)),
    )


def verified(
    judged: Judged, kinds: Sequence[Kind] = KINDS, calibration: Calibration = CALIBRATION
) -> tuple[float, float, int, int]:
    """Return the shares above 0 of the log odds of pairs of one person and of two, and their numbers."""
    found = {kind: judged.similarities[kind] for kind in kinds if kind in judged.similarities}
    pairs, own = judged.pairs
    odds = log_odds_by_kind(found, calibration, shape_variance=calibration.shape_variance)
    above = np.asarray(sum(odds.values()))[pairs] > 0
    shares = (float(above[which].mean()) if which.any() else 0.0 for which in (own, ~own))
    return *shares, int(own.sum()), int((~own).sum())  # type: ignore[return-value]
