"""Figures of README and of the pages of docs/: each comes from a command and stands in docs/figures.json.

    python tools/figures.py                           # count anew, and write all figures into their pages
    python tools/figures.py --check                   # exit 1 where a page, a count or a record is stale
    python tools/figures.py --run NAME ...            # run commands (minutes each) and record what they print

On a page a figure stands between two comments, `<!--=skin.half-->2-9 %<!--/-->`; a whole table between the
same two, each on a line of its own. The record says for every NAME the command, when it ran, on which
commit of the package, and which of its scans were looked at while the package was made. Counts are made anew
by every call.
"""

import argparse
import json
import re
import shlex
import subprocess
import sys
import tempfile
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
    """A row of a page for each case of a bench, of one `group` or of all, and for the means of groups.

    A cell is a format of the case's columns by method, such as `{ours[RMSE %]:.1f}`; `{case}` is its name,
    for which `names` may have others. `means` are the names of rows by group.
    """

    bench: str
    cells: dict[str, str]
    names: dict[str, str] = field(default_factory=dict)
    group: str = ""
    means: dict[str, str] = field(default_factory=dict)

    def lines(self, record: dict[str, Any]) -> list[str]:
        """Return the lines of the page; a method without an answer has a dash."""
        cases: dict[str, dict[str, Any]] = {}
        for row in record["rows"]:
            if not row["failed"] and self.group in ("", row["group"]):
                name = self.names.get(row["case"], f"`{row['case']}`")
                cases.setdefault(name, {})[row["method"]] = row["values"]
        for group, name in self.means.items():
            cases[name] = {method: each["mean"] for method, each in record["summary"][group].items()}
        rows = [list(self.cells)]
        for name, methods in cases.items():
            rows.append([_filled(cell, {"case": name, **methods}) for cell in self.cells.values()])
        head, *lines = ("| " + " | ".join(row) + " |" for row in rows)
        return [head, "|---" * len(self.cells) + "|", *lines]


def _filled(cell: str, values: dict[str, Any]) -> str:
    try:
        return cell.format_map(values)
    except KeyError:
        return "-"


@dataclass(frozen=True)
class Source:
    """A command and what to take from its output.

    Of a bench a figure is a format of its summaries: `{rays/shadows[all][Open3D][mean][CPU s]:.2f}` has the
    bench, the group, the method, the summary and the column. Of other commands `lines` are beginnings of
    printed lines by name, `|` a blank, and `{worst[6]}` is the seventh word after the beginning called
    "worst". `needs` is a folder or file beside the repository.
    """

    command: str
    seen: str
    needs: str = ""
    lines: dict[str, str] = field(default_factory=dict)
    figures: dict[str, str] = field(default_factory=dict)
    tables: dict[str, Table] = field(default_factory=dict)

    @property
    def is_bench(self) -> bool:
        """Whether it writes JSON."""
        return self.command.startswith("python tools/bench ")


SKIN = {
    "d_dome": "a dome",
    "d_emily_pods": "two pods, Emily",
    "d_flash_room": "a flash in a room",
    "d_office": "an office ceiling",
    "d_studio3": "three studio lights",
    "d_sun_sky": "sun and sky",
    "d_two_colours": "two coloured lamps",
    "d_window_lamp": "a window and a lamp",
}
WORST = {"worst": "worst: "}
PAINTED = "all of them, while the light's model and its priors were made"
COLUMNS = {
    "RMSE of V: texture -> albedo": "{as is[RMSE %]:.1f} -> {ours[RMSE %]:.1f} %",
    "occlusion": "{AO[RMSE %]:.1f} %",
    "harmonics": "{SH[RMSE %]:.1f} %",
    "with shadows": "{SH+shadows[RMSE %]:.1f} %",
    "half of the texels": "{as is[50 %]:.1f} -> {ours[50 %]:.1f} %",
    "95 in 100": "{as is[95 %]:.1f} -> {ours[95 %]:.1f} %",
    "RMSE of colour": "{as is[colour %]:.1f} -> {ours[colour %]:.1f} %",
    "100 x MSE of V": "{as is[MSE]:.2f} -> {ours[MSE]:.2f} %",
    "within the stated": "{ours[as said]:.2f}",
}
UNLIT = {
    "the lit scan's own texels": ("lit", "face"),
    "the chart's albedo there": ("chart", "face"),
    "the unlit scan's own texels": ("unlit, face", "face"),
    "lit beyond the face": ("lit", "beyond"),
    "unlit beyond it, `all`": ("unlit, all", "beyond"),
}
"""Methods and parts of `bench/unlit.py` by heading."""
ENGINE_MAPS = {
    "texture": "texture",
    "one colour": "constant",
    "lit twice": "lit",
    "albedo, Lambert": "lambert",
    "albedo": "albedo",
    "+ normals": "+normals",
    "+ displacement": "+displaced",
    "+ roughness": "+roughness",
    "+ specular": "+specular",
    "+ cavity": "+cavity",
    "own normals": "own",
    "no rays": "open",
    "no rays, occlusion": "+occlusion",
    "true albedo": "true",
    "true albedo, all maps": "true+",
}
"""Methods of `bench/engine_maps.py` by heading."""
RELIT = ("lit twice", "one colour", "albedo", "+ normals", "+ displacement", "own normals", "true albedo")


def of(method: str, column: str, digits: int = 1, *, summary: str = "mean", group: str = "all") -> str:
    """Return the format of a figure of the bench that is put in for BENCH."""
    return f"{{BENCH[{group}][{method}][{summary}][{column}]:.{digits}f}}"


def from_bench(bench: str, figures: dict[str, str]) -> dict[str, str]:
    return {name: text.replace("BENCH", bench) for name, text in figures.items()}


def traced(kind: str, folder: str, seen: str, names: dict[str, str] | None = None) -> Source:
    """Return what there is to tell of a set of scenes of `tools/bench/traced.py`."""
    columns = ("RMSE %", "50 %", "95 %")
    figures = {
        "means": ", ".join(f"{of('as is', column)} -> {of('ours', column)}" for column in columns) + " %",
        "worst": ", ".join(of("ours", column, summary="worst") for column in columns) + " %",
        "half": f"{of('ours', '50 %')} %",
        "most": f"{of('ours', '95 %')} %",
        "mse": f"{of('as is', 'MSE', 2)} -> {of('ours', 'MSE', 2)} %",
        "said": " to ".join(of("ours", "as said", 2, summary=each) for each in ("least", "worst")),
        "peers": ", ".join(of(peer, "RMSE %") for peer in ("AO", "SH", "SH+shadows")) + " %",
    }
    bench = f"traced/{kind}"
    tables = {}
    if names is not None:
        means = {"all": "mean"} if names else {}
        tables = {"table": Table(bench, {"scene": "{case}"} | COLUMNS, names, means=means)}
    needs = f"../shared/data/{folder}"
    return Source(f"python tools/bench {bench}", seen, needs, {}, from_bench(bench, figures), tables)


SOURCES = {
    "skin": traced(
        "skin",
        "real_skin",
        "all eight, while thresholds were chosen; the priors were learned from heads of the same family",
        SKIN,
    ),
    "flashes": traced("flashes", "yale", "all six people, while thresholds were chosen"),
    "scans": traced("scans", "traced", PAINTED, {}),
    "images": traced("images", "traced", PAINTED, {}),
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
        "python tools/bench unlit/scans",
        PAINTED,
        "../shared/data/traced",
        tables={
            "table": Table(
                "unlit/scans",
                {"scan": "{case}"}
                | {
                    heading: f"{{{method}[{part} %]:.1f}}, {{{method}[{part} 50]:.1f}}, "
                    f"{{{method}[{part} 95]:.1f}} % ({{{method}[{part} MSE]:.2f}} %)"
                    for heading, (method, part) in UNLIT.items()
                },
                group="traced",
            )
        },
    ),
    "engine_maps": Source(
        "python tools/bench engine_maps",
        f"{PAINTED}; james and five others while these maps were mended",
        "../shared/data/traced",
        tables={
            "table": Table(
                "engine_maps/own_light",
                {"scan": "{case}"} | {heading: f"{{{m}[dB]:.1f}}" for heading, m in ENGINE_MAPS.items()},
                SKIN,
                means={"albedo known": "mean of those with a known albedo"},
            ),
            "relit": Table(
                "engine_maps/relit",
                {"scan": "{case}"} | {heading: f"{{{ENGINE_MAPS[heading]}[dB]:.1f}}" for heading in RELIT},
                SKIN,
                means={"albedo known": "mean of those with a known albedo"},
            ),
        },
    ),
    "finetune": Source(
        "python tools/bench finetune/people",
        "none of these people and lights, while fine-tuning was made",
        tables={
            "table": Table(
                "finetune/people",
                {
                    "person": "{case}",
                    "albedo: mean face": "{mean face[albedo %]:.1f} %",
                    "not tuned -> tuned": "{not tuned[albedo %]:.1f} -> {tuned[albedo %]:.1f} %",
                    "relit: mean face": "{mean face[relit %]:.1f} %",
                    "not tuned -> tuned (relit)": "{not tuned[relit %]:.1f} -> {tuned[relit %]:.1f} %",
                    "photometric: mean face": "{mean face[photometric %]:.1f} %",
                    "not tuned -> tuned (photometric)": "{not tuned[photometric %]:.1f} -> "
                    "{tuned[photometric %]:.1f} %",
                },
                {f"off {number}": f"{number}" for number in range(1, 11)},
                "off",
                {
                    "off": "mean of the ten",
                    "noisy": "mean, pictures with 3 % noise and 3 % outliers",
                    "few": "mean, model of four people alike",
                    "right": "mean, model of sixty people, already right",
                },
            )
        },
    ),
    "registration": Source(
        "python tools/bench registration/raw",
        "all shapes and both real scans, while thresholds were chosen",
        "../shared/data/ict_faces.npz",
        figures=from_bench(
            "registration/raw",
            {
                "found": f"{of('scan2albedo', 'repeated', 0, summary='sum')}/"
                f"{of('scan2albedo', 'repeated', 0, summary='n')}",
                "cpu": f"{of('scan2albedo', 'CPU s')} s CPU",
                "known": f"{of('scan2albedo', 'in basin', 0, summary='sum')}/"
                f"{of('scan2albedo', 'in basin', 0, summary='n')}, "
                f"{of('scan2albedo', 'CPU s', group='truth known')} s CPU",
                "peer": f"{of('Open3D FPFH+RANSAC+ICP', 'in basin', 0, summary='sum')}/"
                f"{of('Open3D FPFH+RANSAC+ICP', 'in basin', 0, summary='n')}, "
                f"{of('Open3D FPFH+RANSAC+ICP', 'CPU s', group='truth known')} s",
            },
        ),
    ),
    "fit": Source(
        "python tools/bench fit/heads fit/james",
        "all shapes and james, while the fit was made",
        "../shared/data/ict_faces.npz",
        figures=from_bench(
            "fit/heads",
            {
                "surface": f"{of('scan2albedo', 'surface mm', 2)} mm, {of('scan2albedo', 'CPU s')} s CPU",
                "surface_amberg": f"{of('nricp_amberg', 'surface mm', 2)} mm, "
                f"{of('nricp_amberg', 'CPU s')} s",
                "correspondence": f"{of('scan2albedo', 'corr. mm')} mm",
                "correspondence_amberg": f"{of('nricp_amberg', 'corr. mm')} mm",
            },
        )
        | from_bench(
            "fit/james",
            {
                "james": f"{of('scan2albedo', 'surface mm', 2)} mm",
                "james_five": f"{of('scan2albedo', 'surface mm', 2)} mm, "
                f"{of('scan2albedo', 'five points')} mm, {of('scan2albedo', 'CPU s')} s CPU",
            },
        ),
    ),
    "landmarks": Source(
        "python tools/bench landmarks/placed --only james flame_scan",
        "all, while the fit was made",
        "../shared/data/james.obj",
        figures=from_bench(
            "landmarks/placed",
            {
                "james": f"{of('scan2albedo', '51 mm', 2, group='james')} mm",
                "flame": f"{of('scan2albedo', '51 mm', 2, group='flame_scan')} mm",
            },
        ),
    ),
    "pipeline": Source(
        "python tools/bench pipeline/stages",
        "james, all the time",
        "../shared/data/james.obj",
        figures=from_bench(
            "pipeline/stages", {"whole": f"{of('scan2albedo', 'CPU s', group='everything')} s CPU"}
        ),
    ),
    "commands": Source(
        "python tools/bench pipeline/commands",
        "james, all the time",
        "../shared/data/james.obj",
        figures=from_bench(
            "pipeline/commands",
            {
                name: f"{of('scan2albedo', 'wall s', group=name)} s, "
                f"{of('scan2albedo', 'CPU s', group=name)} s CPU, "
                f"{of('scan2albedo', 'peak MB', 0, group=name)} MB"
                for name in ("process", "draft", "relight", "report")
            },
        ),
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
    """Return the figures of what a command printed, or a bench wrote as JSON.

    Raises
    ------
    ValueError
        Where a line, a word or a number is not there.
    """
    if source.is_bench:
        record = json.loads(printed)
        found: dict[str, Any] = {name: each["summary"] for name, each in record.items()}
    else:
        record, found = {}, {}
        lines = printed.replace("|", " ").splitlines()
        for name, beginning in source.lines.items():
            ends = [line[match.end() :] for line in lines if (match := re.match(beginning, line))]
            if not ends:
                raise ValueError(f"no line begins with {beginning!r}")
            found[name] = ends[0].split()
    values: dict[str, Value] = {}
    for name, text in source.figures.items():
        try:
            values[name] = text.format_map(found)
        except (IndexError, KeyError):
            raise ValueError(f"{name}: {text} asks for more than there is") from None
    for name, table in source.tables.items():
        if table.bench not in record:
            raise ValueError(f"{name}: there is no bench {table.bench}")
        values[name] = table.lines(record[table.bench])
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


def run(name: str) -> dict[str, Any]:
    """Run a command and return its record.

    Raises
    ------
    ValueError
        Where the command fails, or prints something else than is asked for.
    """
    source = SOURCES[name]
    program, *rest = shlex.split(source.command)
    called = [sys.executable, *(() if program == "python" else ("-m", program)), *rest]
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "bench.json"
        if source.is_bench:
            called += ["--json", str(written)]
        done = subprocess.run(called, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            raise ValueError(f"the command ended with {done.returncode}: {last}")
        text = written.read_text(encoding="utf-8") if source.is_bench else done.stdout
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
    arguments = parser.parse_args()
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    if arguments.check:
        problems = list(stale(record))
        mend = "python tools/figures.py rewrites pages and counts" if problems else "all current"
        print(*problems, mend, sep="\n")
        return int(bool(problems))
    failed = 0
    for name in arguments.run:
        needed = SOURCES[name].needs
        if not (ROOT / needed).exists():
            print(f"{name}: skipped, {needed} is not there; its figures stay as they were recorded")
            continue
        try:
            record[name] = run(name)
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
