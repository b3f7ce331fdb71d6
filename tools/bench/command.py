"""Run benches: error and CPU time of this library's methods beside others'.

    python tools/bench                                    # what there is
    python tools/bench NAME ... [--only CASE ...] [--methods M ...] [--quick]
        [--json FILE] [--figure FILE.png] [--pictures FOLDER] [--check]

`--check` compares with tools/bench/bars.json, whose bars are of quick or of whole runs; exit status 1 where
one is broken.
"""

import argparse
import json
from pathlib import Path

from bench.registry import bars, benches_of, described
from bench.runner import Bench, Row, Summary, run, summarised
from bench.tables import Printer, print_summary


def parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    made = argparse.ArgumentParser("python tools/bench", description=__doc__, formatter_class=raw)
    made.add_argument("names", nargs="*", metavar="NAME", help="benches: FILE, or one of its own FILE/BENCH")
    made.add_argument("--only", nargs="+", default=[], metavar="CASE", help="first words of cases or groups")
    made.add_argument("--methods", nargs="+", default=[], metavar="M", help="only these, slow ones too")
    made.add_argument("--quick", action="store_true", help="few and small cases")
    made.add_argument("--json", type=Path, metavar="FILE", help="rows and summaries")
    made.add_argument("--figure", type=Path, metavar="FILE", help="error against run time")
    made.add_argument("--pictures", type=Path, metavar="FOLDER", help="what a bench draws of its cases")
    made.add_argument("--check", action="store_true", help="hold the summaries against the bars")
    return made


def main(words: list[str] | None = None) -> int:
    arguments = parser().parse_args(words)
    if not arguments.names:
        print(*(f"{name:28} {line}" for name, line in described().items()), sep="\n")
        return 0
    done: dict[str, tuple[Bench, Summary]] = {}
    record: dict[str, object] = {}
    wanted = [pair for name in arguments.names for pair in benches_of(name).items()]
    for name, bench in wanted:
        print(f"# {name}")
        printer = Printer()
        rows: list[Row] = []
        for row in run(bench, arguments.only, arguments.methods, arguments.quick, arguments.pictures):
            printer.show(row)
            rows.append(row)
        summary = summarised(rows)
        print_summary(bench, summary, rows)
        done[name] = bench, summary
        record[name] = {"quick": arguments.quick, "rows": [vars(row) for row in rows], "summary": summary}
    if arguments.json:
        from scan2albedo.io.records import plain_json

        arguments.json.write_text(json.dumps(plain_json(record), indent=1) + "\n", encoding="utf-8")
    if arguments.figure:
        from bench.figure import draw

        draw({name: each for name, each in done.items() if each[1]}, arguments.figure)
    broken = 0
    if arguments.check:
        for bar in bars():
            if bar.bench in done and bar.quick == arguments.quick:
                kept, line = bar.verdict(done[bar.bench][1])
                print(line)
                broken += not kept
    return int(broken > 0)
