"""Learn the calibration of recognition: how alike scans of one person are, and of two.

    python tools/build recognition_calibration FOLDER [--persons 12] [--seed 101] [--pairs RESULTS ...]

Prints the numbers of `scan2albedo/recognition/data/calibration.json`, and what a calibration by
one half of the heads says of the other half: shares of log odds above 0, of pairs of one person and of two.
They are learned from sixteen MIT-licensed heads in many lights (`worlds.lit_heads`), as scans and as
photographs, and from synthetic people, each set weighing as much. FOLDER keeps what is made of them (hours).
--pairs tells the shares of all pairs of results PERSON_sSESSION in other folders.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from worlds.files import face_data
from worlds.lit_heads import SCAN_LIGHTS, VIEW_LIGHTS, VIEWED, head, photographed, scanned
from worlds.population import Population, population_scan, random_lights

from scan2albedo import estimate_albedo, process
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.recognition import (
    Calibration,
    albedo_templates,
    certainty,
    read_labelled_templates,
    shape_templates,
    similarity_matrix,
)
from scan2albedo.recognition.result_identification import CALIBRATION, log_odds_by_kind
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


def make_heads(folder: Path) -> None:
    """Write what `estimate_albedo` makes of all heads: HEAD_SITTING_LIGHT.npz; those there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    files = face_data("heads/White_M_1.obj").parent.glob("*.obj")
    for name in sorted(file.stem for file in files):
        sitting, view = head(name)
        for k, lights in (("0", SCAN_LIGHTS[0]), ("1", SCAN_LIGHTS[1]), (VIEWED, VIEW_LIGHTS)):
            left = [light for light in lights if not (folder / f"{name}_{k}_{light}.npz").is_file()]
            if not left:
                continue
            if k == VIEWED:
                image, surface, places, albedo = view()
            else:
                scan, surface, surface_from_scan = sitting(int(k))
                image, places = scanned(scan, surface, surface_from_scan)
                assert image.texture_linear is not None
                albedo = image.texture_linear[image.seen].astype(float)
            seen = image.mask if k == VIEWED else image.seen
            for light in left:
                colours = photographed(surface, *places, albedo, light, list(name.encode()))
                texture = np.zeros((*image.shape, 3), np.float32)
                texture[seen] = colours.mean(1, keepdims=True) if k == VIEWED else colours
                made = estimate_albedo(replace(image, texture_linear=texture), seed=0)
                np.savez_compressed(
                    folder / f"{name}_{k}_{light}.npz",
                    albedo=made.albedo_linear.astype(np.float16),
                    texture=texture.astype(np.float16),
                    expected_error=np.asarray(made.expected_error, np.float16),
                    seen=made.image.seen,
                    normal=image.normal.astype(np.float16),
                )


def head_similarities(folder: Path, viewed: bool) -> Judged:
    """Return the pairs of the heads' scans, or of their views, in a folder of `make_heads`."""
    made: dict[Kind, list[FloatArray]] = {"albedo": [], "texture": [], "shading": [], "shape": []}
    known, seen, labels = [], [], []
    for file in sorted(folder.glob("*.npz")):
        name, sitting, light = file.stem.rsplit("_", 2)
        if (sitting == VIEWED) != viewed:
            continue
        with np.load(file) as stored:
            albedo, texture, error, normal = (
                stored[key].astype(float) for key in ("albedo", "texture", "expected_error", "normal")
            )
            seen.append(stored["seen"])
        texture[~seen[-1]] = 0
        shading = np.divide(texture, albedo, out=np.zeros(albedo.shape), where=albedo > 0)
        for kind, values in zip(made, (albedo, texture, shading, normal), strict=True):
            made[kind].append(values)
        known.append(certainty(albedo, error, seen[-1]))
        labels.append((name, f"{name}_{light if viewed else sitting}", light))
    names, sittings, lights = (list(column) for column in zip(*labels, strict=True))
    found: dict[Kind, FloatArray] = {}
    for kind, images in made.items():
        if kind == "shape":
            templates = shape_templates(images, names, masks=seen)
        else:
            templates = albedo_templates(images, names, masks=known)
        if kind != "shape" or not viewed:  # photographs of one surface have one shape
            found[kind] = similarity_matrix(templates, templates)
    return Judged(found, names, sittings, lights)


def make_people(folder: Path, persons: int, seed: int) -> None:
    """Scan and process synthetic people; results are PERSON_SESSION, those that are there are kept.

    Sessions 0 and 1 have the same lamps for everybody, others their own; expressions and poses are random.
    """
    own = Population()
    studio = random_lights(np.random.default_rng([seed, 77]), own)
    for person in range(persons):
        for session in range(3):
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


def print_shares(judged: Judged, calibration: Calibration) -> None:
    """Print how many pairs of one person and of two have log odds above 0, by each kind and by all."""
    kinds = [kind for kind in KINDS if kind in judged.similarities and kind != "shading"]
    for name, cues in (*((kind, [kind]) for kind in kinds), ("fused", KINDS)):
        same, other, own, others = verified(judged, cues, calibration)
        print(f"  {name:10} above 0: one person {same:6.1%} of {own} pairs, two {other:6.1%} of {others}")


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--persons", type=int, default=12)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--pairs", type=Path, nargs="+", default=[])
    given = parser.parse_args(arguments)
    for results in given.pairs:
        print(results)
        print_shares(pair_similarities(results), CALIBRATION)
    make_heads(given.folder / "heads")
    make_people(given.folder / "people", given.persons, given.seed)
    sets = [head_similarities(given.folder / "heads", viewed) for viewed in (False, True)]
    synthetic = pair_similarities(given.folder / "people")
    print(calibrated_on([*sets, synthetic]))
    heads = sorted(set(sets[0].persons))
    for learned, left in ((heads[::2], heads[1::2]), (heads[1::2], heads[::2])):
        calibration = calibrated_on([*(judged.part(learned) for judged in sets), synthetic])
        for what, judged in zip(("scans", "views"), sets, strict=True):
            print(f"{what} of {', '.join(left)}, calibrated without them")
            print_shares(judged.part(left), calibration)
