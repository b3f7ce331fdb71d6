"""Figures of README and of the pages of docs/: each comes from a command and stands in docs/figures.json.

    python tools/figures.py                           # count anew, and write all figures into their pages
    python tools/figures.py --check                   # exit 1 where a page, a count or a record is stale
    python tools/figures.py --run NAME ...            # run commands (minutes each) and record what they print
    python tools/figures.py --run NAME --printed FILE # the same from what the command has printed before

On a page a figure stands between two comments, `<!--=skin.half-->2-9 %<!--/-->`; a whole table between the
same two, each on a line of its own. The record says for every NAME the command, when it ran, on which
commit of the package, and which of its scans were looked at while the package was made. Counts are made anew
by every call.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import house

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "docs" / "figures.json"
MARKED = re.compile(r"<!--=([\w.]+)-->(.*?)<!--/-->", re.DOTALL)
Value = str | list[str]
"""What stands on a page: some words, or the lines of a table."""


@dataclass(frozen=True)
class Table:
    """Rows of a page: one for each printed line that `line` matches; `{0}` in a cell is its first word.

    `names` says what the first words stand for.
    """

    line: str
    cells: dict[str, str]
    names: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Source:
    """A command and what to take from its output, in which `|` is a blank.

    `lines` are beginnings of printed lines by name. A figure is a format of the words after them:
    `{worst[6]}` is the seventh word after the beginning called "worst". `needs` is a folder or file beside
    the repository.
    """

    command: str
    seen: str
    needs: str = ""
    lines: dict[str, str] = field(default_factory=dict)
    figures: dict[str, str] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)


SUMMARY = {"least": "least ", "mean": "mean ", "worst": "worst "}
ALBEDO = {
    "means": "{mean[0]} -> {mean[4]}, {mean[5]} -> {mean[6]}, {mean[7]} -> {mean[8]} %",
    "worst": "{worst[4]}, {worst[6]}, {worst[8]} %",
    "half": "{mean[6]} %",
    "most": "{mean[8]} %",
    "mse": "{mean[11]} -> {mean[12]} %",
    "said": "{least[13]} to {worst[13]}",
    "peers": "{mean[1]}, {mean[2]}, {mean[3]} %",
}
"""Figures of what `tools/bench_traced.py` prints."""
COLUMNS = {
    "RMSE of V: texture -> albedo": "{1} -> {5} %",
    "occlusion": "{2} %",
    "harmonics": "{3} %",
    "with shadows": "{4} %",
    "half of the texels": "{6} -> {7} %",
    "95 in 100": "{8} -> {9} %",
    "RMSE of colour": "{10} -> {11} %",
    "100 x MSE of V": "{12} -> {13} %",
    "within the stated": "{14}",
}
SKIN = {
    "d_dome": "a dome",
    "d_emily_pods": "two pods, Emily",
    "d_flash_room": "a flash in a room",
    "d_office": "an office ceiling",
    "d_studio3": "three studio lights",
    "d_sun_sky": "sun and sky",
    "d_two_colours": "two coloured lamps",
    "d_window_lamp": "a window and a lamp",
    "mean": "mean",
}
MAPPED = (SKIN | {name: f"`{name}`" for name in ("p105_front", "p106_gloss", "p108_smile_m")}) | {
    "mean": "mean of those with a known albedo"
}
WORST = {"worst": "worst: "}
PAINTED = "all of them, while the light's model and its priors were made"


def traced(kind: str, folder: str, seen: str, line: str, names: dict[str, str] | None = None) -> Source:
    """Return what there is to tell of a set of scenes that `tools/bench_traced.py` judges."""
    return Source(
        f"S2A_TRACED=../shared/data/{folder} python tools/bench_traced.py --set {kind}",
        seen,
        f"../shared/data/{folder}",
        SUMMARY,
        ALBEDO,
        {"table": Table(line, {"scene": "{0}"} | COLUMNS, names or {})} if line else {},
    )


SOURCES = {
    "skin": traced(
        "skin",
        "real_skin",
        "all eight, while thresholds were chosen; the priors were learned from heads of the same family",
        r"(d_\w+|mean) ",
        SKIN,
    ),
    "flashes": traced("flashes", "yale", "all six people, while thresholds were chosen", ""),
    "scans": traced("scans", "traced", PAINTED, r"p\d+_\w+ "),
    "images": traced("images", "traced", PAINTED, r"soft_\w+ "),
    "mitsuba": Source(
        "python tools/bench_albedo.py --scenes mitsuba",
        "all scenes, while the search for the light was made",
        lines={
            name: rf"all +{method} +\d+ "
            for name, method in {
                "before": "as it is",
                "ours": "scan2albedo",
                "paper": "paper's objective",
                "harmonics": "robust SH-2",
                "homomorphic": "homomorphic",
                "retinex": "retinex",
            }.items()
        },
        figures={
            "worst": "{before[1]} -> {ours[1]} %",
            "texels": "{ours[3]}, {ours[5]} %",
            "mse": "{ours[7]} %",
            "paper": "{paper[1]} %",
            "peers": "robust SH-2: {harmonics[1]}, homomorphic: {homomorphic[1]}, retinex: {retinex[1]} %",
            "cpu": "{ours[11]} s",
        },
    ),
    "hemisphere": Source("scan2albedo validate hemisphere", "all", "", WORST, {"worst": "{worst[0]} %"}),
    "face": Source("scan2albedo validate face", "all", "", WORST, {"worst": "{worst[0]} %"}),
    "demo": Source(
        "scan2albedo demo --seed 0 -o demo_out",
        "this one, all the time",
        lines={"texture": " *texture as scanned ", "albedo": " *estimated albedo "},
        figures={
            "rmse": "{texture[2]} -> {albedo[2]} %",
            "mse": "{texture[8]} -> {albedo[8]} %",
        },
    ),
    "unlit": Source(
        "python tools/bench_unlit.py traced",
        PAINTED,
        "../shared/data/traced",
        tables={
            "table": Table(
                r"p\d+_\w+ ",
                {
                    "scan": "{0}",
                    "the lit scan's own texels": "{1}, {2}, {3} % ({4} %)",
                    "the chart's albedo there": "{5}, {6}, {7} % ({8} %)",
                    "the unlit scan's own texels": "{9}, {10}, {11} % ({12} %)",
                    "lit beyond the face": "{13}, {14}, {15} % ({16} %)",
                    "unlit beyond it, `all`": "{17}, {18}, {19} % ({20} %)",
                },
            )
        },
    ),
    "engine_maps": Source(
        "python tools/bench_engine_maps.py",
        f"{PAINTED}; james and five others while these maps were mended",
        "../shared/data/traced",
        tables={
            "table": Table(
                r"(james|fran|p\d+_\w+|d_\w+|mean) ",
                {
                    "scan": "{0}",
                    "texture": "{1}",
                    "one colour": "{2}",
                    "lit twice": "{3}",
                    "albedo, Lambert": "{4}",
                    "albedo": "{5}",
                    "+ normals": "{6}",
                    "+ displacement": "{7}",
                    "+ roughness": "{8}",
                    "+ specular": "{9}",
                    "+ cavity": "{10}",
                    "own normals": "{11}",
                    "no rays": "{12}",
                    "no rays, occlusion": "{13}",
                    "true albedo": "{14}",
                    "true albedo, all maps": "{15}",
                },
                MAPPED,
            ),
            "relit": Table(
                r"relit:\w+ ",
                {
                    "scan": "{0}",
                    "lit twice": "{1}",
                    "one colour": "{2}",
                    "albedo": "{3}",
                    "+ normals": "{4}",
                    "+ displacement": "{5}",
                    "own normals": "{6}",
                    "true albedo": "{7}",
                },
                {f"relit:{name}": shown for name, shown in MAPPED.items()},
            ),
        },
    ),
    "quality": Source(
        "python tools/bench_quality.py presets",
        "all six people",
        tables={
            "table": Table(
                "(draft|standard) ",
                {
                    "preset": "{0}",
                    "texels": "{1} x {1}",
                    "CPU": "{2} s",
                    "surface": "{3} mm",
                    "correspondence": "{5} mm",
                    "landmarks": "{7} mm",
                    "albedo: relative RMSE": "{9} %",
                    "100 x MSE": "{11} %",
                },
            )
        },
    ),
    "finetune": Source(
        "python tools/bench_reflectance_finetune.py people",
        "none of these people and lights, while fine-tuning was made",
        tables={
            "table": Table(
                r"(off_\d+|mean_\w+) ",
                {
                    "person": "{0}",
                    "albedo: mean face": "{1} %",
                    "not tuned -> tuned": "{2} -> {3} %",
                    "relit: mean face": "{4} %",
                    "not tuned -> tuned (relit)": "{5} -> {6} %",
                    "photometric: mean face": "{7} %",
                    "not tuned -> tuned (photometric)": "{8} -> {9} %",
                },
                {f"off_{number}": f"{number}" for number in range(1, 11)}
                | {
                    "mean_off": "mean of the ten",
                    "mean_noisy": "mean, pictures with 3 % noise and 3 % outliers",
                    "mean_few": "mean, model of four people alike",
                    "mean_right": "mean, model of sixty people, already right",
                },
            )
        },
    ),
    "registration": Source(
        "python tools/bench_registration.py --poses 300 --real-poses 50",
        "all shapes and both real scans, while thresholds were chosen",
        "../shared/data/ict_faces.npz",
        {"every": "all ", "ours": "ours, where the truth is known", "peer": r"Open3D FPFH\+RANSAC\+ICP"},
        {
            "found": "{every[0]}",
            "cpu": "{every[8]} s CPU",
            "known": "{ours[7]}, {ours[11]} s CPU",
            "peer": "{peer[1]}, {peer[5]} s",
        },
    ),
    "fit": Source(
        "python tools/bench_fit.py --shapes 8",
        "all shapes and james, while the fit was made",
        "../shared/data/ict_faces.npz",
        {
            "ours": "mean +scan2albedo ",
            "amberg": "mean +nricp_amberg ",
            "james": "scan2albedo ",
        },
        {
            "surface": "{ours[0]} mm, {ours[6]} s CPU",
            "surface_amberg": "{amberg[0]} mm, {amberg[6]} s",
            "correspondence": "{ours[3]} mm",
            "correspondence_amberg": "{amberg[3]} mm",
            "james": "{james[0]} mm",
            "james_five": "{james[0]} mm, {james[6]} mm, {james[7]} s CPU",
        },
    ),
    "landmarks": Source(
        "python tools/bench_landmarks.py",
        "all, while the fit was made",
        "../shared/data/james.obj",
        {"james": "james ", "flame": "flame_scan "},
        {"james": "{james[0]} mm", "flame": "{flame[0]} mm"},
    ),
    "pipeline": Source(
        "python tools/bench_pipeline.py",
        "james, all the time",
        "../shared/data/james.obj",
        {"whole": "whole run with files"},
        {"whole": "{whole[1]} s CPU, {whole[2]} MB"},
    ),
}


def counted() -> dict[str, Value]:
    """Return what can be counted in some seconds; what changes with every day's work in round numbers."""
    import typer
    from stability_report import all_cases

    from scan2albedo.cli.commands import app

    def leaves(command: Any) -> Iterator[Any]:
        inner = getattr(command, "commands", None)
        for each in inner.values() if inner else ():
            yield from leaves(each)
        if not inner:
            yield command

    commands = list(leaves(typer.main.get_command(app)))
    size = json.loads(house.CEILINGS.read_text(encoding="utf-8"))
    tests = [
        re.findall(r"^ *def test_", file.read_text("utf-8"), re.M)
        for file in (ROOT / "tests").rglob("test_*.py")
    ]
    words = len((ROOT / "README.md").read_text(encoding="utf-8").split())
    return {
        "commands": f"{len(commands)}",
        "flags": f"{sum(len(command.params) for command in commands)}",
        "package": f"{round(size['scan2albedo']['tokens'], -3):,}",
        "tools": f"{round(size['tools']['tokens'], -3):,}",
        "checks": f"{round(size['tests']['tokens'], -3):,}",
        "tests": f"{round(sum(map(len, tests)), -2):,}",
        "extremes": f"{len(list(all_cases()))}",
        "schemas": f"{len(list((ROOT / 'data_schemas').glob('*.json')))}",
        "words": f"{round(words, -2):,}",
        "pages": f"{len(list((ROOT / 'docs').glob('*.md')))}",
        "examples": f"{len(list((ROOT / 'examples').glob('*.py')))}",
    }


def read_from(source: Source, printed: str) -> dict[str, Value]:
    """Return the figures of a command's output.

    Raises
    ------
    ValueError
        Where a line or a word is not there.
    """
    lines = printed.replace("|", " ").splitlines()
    found: dict[str, list[str]] = {}
    for name, beginning in source.lines.items():
        match = next((match for line in lines if (match := re.match(beginning, line))), None)
        if match is None:
            raise ValueError(f"no line begins with {beginning!r}")
        found[name] = match.string[match.end() :].split()
    values: dict[str, Value] = {}
    for name, text in source.figures.items():
        try:
            values[name] = text.format(**found)
        except IndexError:
            raise ValueError(f"{name}: {text} asks for more words than are printed") from None
    for name, table in source.tables.items():
        rows = [line.split() for line in lines if re.match(table.line, line)]
        if not rows:
            raise ValueError(f"{name}: no line matches {table.line!r}")
        called = [[table.names.get(row[0], f"`{row[0]}`"), *row[1:]] for row in rows]
        cells = [table.cells, *([cell.format(*row) for cell in table.cells.values()] for row in called)]
        head, *lines_of_page = ("| " + " | ".join(row) + " |" for row in cells)
        values[name] = [head, "|---" * len(table.cells) + "|", *lines_of_page]
    return values


def as_text(value: Value) -> str:
    """Return a figure as it stands between its comments."""
    return value if isinstance(value, str) else "\n".join(["\n", *value, "\n"])


def rewritten(text: str, record: dict[str, Any]) -> str:
    """Return a page with the figures of the record.

    Raises
    ------
    ValueError
        For a figure that the record does not have.
    """

    def figure(match: re.Match[str]) -> str:
        source, _, name = match[1].partition(".")
        entry = record.get(source, {"values": {}})
        if name not in entry["values"] and name != "measured":
            raise ValueError(f"{match[1]}: no such figure; python tools/figures.py --run {source} records it")
        measured = f"{entry.get('date')}, commit {entry.get('commit')}"
        return f"<!--={match[1]}-->{as_text(entry['values'].get(name, measured))}<!--/-->"

    return MARKED.sub(figure, text)


def pages() -> list[Path]:
    """Return README and the pages of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def stale(record: dict[str, Any]) -> Iterator[str]:
    """Yield a sentence for each page, count and record that is not what it should be."""
    counts = counted()
    if record.get("counts", {}).get("values") != counts:
        yield "counts have changed"
    if f" of {counts['extremes']} extremes end" not in (ROOT / "docs" / "stability.md").read_text(
        encoding="utf-8"
    ):
        yield "stability.md lists other extremes than there are; see its own command"
    for name, entry in record.items():
        source = SOURCES.get(name)
        if name == "counts":
            continue
        if source is None or entry["command"] != source.command:
            yield f"{name}: recorded of another command than is asked for; run it anew"
        elif set(entry["values"]) != set(source.figures) | set(source.tables):
            yield f"{name}: other figures are asked for than were recorded; run it anew"
    for page in pages():
        text = page.read_text(encoding="utf-8")
        try:
            current = rewritten(text, record) == text
        except ValueError as error:
            yield f"{page.name}: {error}"
            continue
        if not current:
            yield f"{page.name}: holds other figures than the record"


def run(name: str, printed: Path | None) -> dict[str, Any]:
    """Return the record of a command, run now unless it is given what was `printed`.

    Raises
    ------
    ValueError
        Where the command fails, or prints something else than is asked for.
    """
    source = SOURCES[name]
    if printed is None:
        words = shlex.split(source.command)
        settings = dict(word.split("=", 1) for word in words if re.match(r"[A-Z0-9_]+=", word))
        program, *rest = words[len(settings) :]
        called = [sys.executable, *(() if program == "python" else ("-m", program)), *rest]
        done = subprocess.run(
            called, cwd=ROOT, env={**os.environ, **settings}, capture_output=True, text=True, check=False
        )
        if done.returncode:
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            raise ValueError(f"the command ended with {done.returncode}: {last}")
        text = done.stdout
    else:
        text = printed.read_text(encoding="utf-8")
    head = subprocess.run(
        ["git", "log", "-1", "--format=%h", "--abbrev=8", "--", "scan2albedo"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return {
        "command": source.command,
        "date": date.today().isoformat(),
        "commit": head.stdout.strip(),
        "seen": source.seen,
        "values": read_from(source, text),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing")
    parser.add_argument(
        "--run", nargs="+", default=[], choices=tuple(SOURCES), metavar="NAME", help=", ".join(SOURCES)
    )
    parser.add_argument("--printed", type=Path, help="what the one command of --run has printed")
    arguments = parser.parse_args()
    if arguments.printed and len(arguments.run) != 1:
        parser.error("--printed belongs to one NAME of --run")
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    if arguments.check:
        problems = list(stale(record))
        print(
            "\n".join(
                [*problems, "python tools/figures.py rewrites pages and counts"]
                if problems
                else ["all current"]
            )
        )
        return int(bool(problems))
    failed = 0
    for name in arguments.run:
        needed = SOURCES[name].needs
        if arguments.printed is None and not (ROOT / needed).exists():
            print(f"{name}: skipped, {needed} is not there; its figures stay as they were recorded")
            continue
        try:
            record[name] = run(name, arguments.printed)
        except ValueError as error:
            print(f"{name}: not recorded, {error}")
            failed = 1
    record["counts"] = {"command": "python tools/figures.py", "values": counted()}
    RECORD.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for page in pages():
        text = page.read_text(encoding="utf-8")
        try:
            changed = rewritten(text, record)
        except ValueError as error:
            print(f"{page.relative_to(ROOT)}: left as it is, {error}")
            failed = 1
            continue
        if changed != text:
            page.write_text(changed, encoding="utf-8")
            print(f"{page.relative_to(ROOT)}: rewritten")
    return failed


if __name__ == "__main__":
    sys.exit(main())
