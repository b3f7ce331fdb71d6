"""Recognition of the six people in ../shared/data/yale under 11 to 12 lamps each, and of any processed
people."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recognition_experiment.population import Population, population_scan, random_lights

from benchmarks.light_normalization import multi_scale_retinex
from benchmarks.scan_files import face_data
from scan2albedo import GeometryImage, estimate_albedo, process
from scan2albedo.core.arrays import BoolArray, FloatArray
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
) -> dict[str, tuple[float, float]]:
    """Return rank 1 by each kind and fused: gallery of one lamp (all choices), and of random lamps.

    One photograph a person is the gallery; the probes are all others of these people.
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
        for name, values in scores.items():
            right.setdefault(name, ([], []))[which].extend(who[gallery[values.argmax(1)]] == who[probes])
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


def pair_similarities(results: Path) -> tuple[dict[Kind, FloatArray], list[str]]:
    """Return (N, N) similarities of all results PERSON_SCAN in a folder, and their persons."""
    table = results / "pairs.csv"
    folders = sorted(one.parent.name for one in results.glob("*/albedo.exr"))
    lines = [f"{name.split('_')[0]},{name}" for name in folders]
    table.write_text("\n".join(["person,result", *lines]) + "\n")
    read = read_labelled_templates(table)
    found = {kind: similarity_matrix(made, made) for kind, made in read.sets.items()}
    return found, [str(person) for person in read.persons]


def calibrated_on(
    lit: Mapping[str, FloatArray],
    people: Sequence[str],
    lights: Sequence[str],
    scans: Mapping[Kind, FloatArray],
    persons: Sequence[str],
) -> Calibration:
    """Return the calibration by photographs of the six people and by synthetic people's scans.

    Differences of the means, and covariances, are those of both sets, each weighing as much; shape is of the
    scans alone, and so is the level half-way between the means.
    """

    def moments(
        of: Mapping[Any, FloatArray], same: BoolArray, kinds: Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        pairs = np.triu_indices(len(same), 1)
        values, own = np.stack([of[kind][pairs] for kind in kinds]), same[pairs]
        spread = np.mean([np.cov(values[:, which]) for which in (own, ~own)], axis=0)
        return values[:, own].mean(1), values[:, ~own].mean(1), spread

    who, names, lamp = np.array(people), np.array(persons), np.array(lights)
    same, other, covariance = moments(scans, names[:, None] == names, KINDS)
    there = [k for k, kind in enumerate(KINDS) if kind in lit]
    of_lit = moments(lit, who[:, None] == who, [KINDS[k] for k in there])
    middle, apart = (same + other) / 2, same - other
    apart[there] = (apart[there] + of_lit[0] - of_lit[1]) / 2
    block = np.ix_(there, there)
    covariance[block] = (covariance[block] + of_lit[2]) / 2
    variances = []
    for a in sorted(set(lights)):
        for b in sorted(set(lights)):
            rows, columns = np.flatnonzero(lamp == a), np.flatnonzero(lamp == b)
            strangers = lit["shading"][np.ix_(rows, columns)][who[rows][:, None] != who[columns]]
            variances += [strangers.var()] if len(strangers) > 2 else []
    return Calibration(
        KINDS,
        tuple(np.round(middle + apart / 2, 4).tolist()),
        tuple(np.round(middle - apart / 2, 4).tolist()),
        tuple(map(tuple, np.round(covariance, 6).tolist())),
        float(np.round(np.mean(variances), 6)),
    )


def verified(
    similarities: Mapping[Kind, FloatArray], persons: Sequence[str], calibration: Calibration = CALIBRATION
) -> tuple[float, float, int, int]:
    """Return the shares of pairs of one person and of two that log odds judge rightly, and their numbers."""
    odds, names = sum(log_odds_by_kind(similarities, calibration).values()), np.array(persons)
    pairs = np.triu_indices(len(names), 1)
    same = names[:, None] == names
    right, own = ((odds > 0) == same)[pairs], same[pairs]
    shares = (float(right[which].mean()) if which.any() else 1.0 for which in (own, ~own))
    return *shares, int(own.sum()), int((~own).sum())  # type: ignore[return-value]
