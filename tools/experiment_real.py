"""Who is recognised by what, in a data set of your own: scans of people, two or more of each.

    python tools/experiment_real.py MANIFEST [-o real_out] [--quality draft] [--size N] [--brdf NAME ...]
        [--gallery SESSION] [--jobs N] [--calibrate] [--json]
        [--make traced|population] [--persons 14] [--seed 0]

MANIFEST is a CSV file with the columns person, session, scan, and any others that name a condition of a scan
(light, expression, ...). Every scan goes through the pipeline into OUT/scans, into a folder of its own name,
or PERSON-SESSION-NAME where several files have one name; a run that was stopped goes on where it was. Then
each probe is compared with the gallery, which is each person's first scan or the one of --gallery SESSION: by
the texture as it was scanned, equalised, by retinex, by red over green, by the albedo of each reflectance, by
shape, and by shape and albedo. Rank 1, verification and their intervals come for all probes and for each
value of each condition: OUT/table.txt, table.csv, real.json, cmc.png, roc.png and conditions.png.

--make writes the scans and MANIFEST itself first: `traced`, path-traced people on shapes of ICT-FaceKit from
../shared/data with procedural skin, in four sessions (needs Mitsuba, and a recent libLLVM that
DRJIT_LIBLLVM_PATH names); or `population`, the package's synthetic people in three. --calibrate prints the
weights of albedo and shape that these people ask for; those in the package are of the population.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path

from recognition_experiment.options import RecognitionExperimentOptions
from recognition_experiment.real import compared, processed
from recognition_experiment.real_report import figures_of, table, write_real_report

from scan2albedo.albedo.estimate import BRDFS
from scan2albedo.batch import ProcessOptions
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.records import plain_json


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def make(kind: str, manifest: Path, persons: int, seed: int) -> None:
    """Write the scans of synthetic people that are not there yet, and their manifest."""
    if kind == "traced":
        from worlds.traced_sessions import build_people

        for path in build_people(manifest, persons, seed):
            say(f"{path.name} is there")
        return
    from worlds.files import write_obj
    from worlds.population import population_scan

    manifest.parent.mkdir(parents=True, exist_ok=True)
    population, rows = RecognitionExperimentOptions().population, []
    for person in range(persons):
        for session in range(3):
            path = manifest.parent / f"person-{person}-session-{session}.obj"
            rows.append([f"person-{person}", session, path.name])
            if not path.is_file():
                write_obj(population_scan(person, session, seed=seed, population=population)[0], path)
                say(f"{path.name} is there")
    with manifest.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([["person", "session", "scan"], *rows])


def parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    made.add_argument("manifest", type=Path)
    made.add_argument("-o", "--out", type=Path, default=Path("real_out"), help="keeps the results, too")
    made.add_argument("--quality", choices=("draft", "standard", "best"), default="draft")
    made.add_argument("--size", type=int, help="side of the geometry images; that of the quality if omitted")
    made.add_argument("--brdf", action="append", choices=BRDFS, help="repeatable; oren-nayar if omitted")
    made.add_argument("--gallery", help="the session that is the gallery")
    made.add_argument("--jobs", type=int, default=1, help="scans at a time")
    made.add_argument("--calibrate", action="store_true", help="print weights of albedo and shape")
    made.add_argument("--json", action="store_true", help="print all figures as JSON on stdout")
    made.add_argument("--make", choices=("traced", "population"), help="make scans and manifest first")
    made.add_argument("--persons", type=int, default=14, help="how many to make")
    made.add_argument("--seed", type=int, default=0, help="of the people that are made")
    return made


def main(words: list[str] | None = None) -> None:
    arguments = parser().parse_args(words)
    if arguments.make:
        make(arguments.make, arguments.manifest, arguments.persons, arguments.seed)
    brdfs = tuple(arguments.brdf or ("oren-nayar",))
    check_writable(arguments.out)
    process = ProcessOptions(quality=arguments.quality, size=arguments.size, brdf=brdfs[0], files="minimal")
    scans = arguments.out / "scans"
    data = processed(
        arguments.manifest, scans, process, jobs=arguments.jobs, gallery=arguments.gallery, say=say
    )
    found = compared(data, scans, arguments.out / "albedos", RecognitionExperimentOptions(brdfs=brdfs))
    results = found.results()
    write_real_report(results, found.data, arguments.out)
    say(f"files in {arguments.out}")
    if arguments.json:
        rows = {
            f"{name} {value}".strip(): [figures_of(r) for r in rs] for (name, value), rs in results.items()
        }
        print(json.dumps(plain_json(rows), indent=2))
        return
    print(table(results, found.data))
    if arguments.calibrate:
        print(f"\n{found.calibration(f'albedo, {brdfs[0]}')}")


if __name__ == "__main__":
    try:
        main()
    except Scan2AlbedoError as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {error}")
