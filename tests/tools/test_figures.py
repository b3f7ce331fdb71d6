"""Figures on README and the pages of docs/ are those that were recorded, and counts those of today."""

import json
import re
from dataclasses import replace

import figures
import pytest

PRINTED = """\
head        RMSE | said
worst       12.0 | 0.92
"""
SOURCE = figures.Source(
    "python tools/nothing.py", "none", lines={"worst": "worst "}, figures={"rmse": "{worst[0]} %"}
)
BENCH = figures.Source(
    "python tools/bench traced/skin",
    "none",
    figures={"rmse": "{traced/skin[all][ours][worst][RMSE %]:.1f} %"},
    tables={
        "table": figures.Table(
            "traced/skin",
            {"scene": "{case}", "error": "{ours[RMSE %]:.1f}", "peer": "{SH[RMSE %]:.1f}"},
            {"d_dome": "a dome"},
            means={"all": "mean"},
        )
    },
)
ROW = {"group": "", "method": "ours", "failed": False}
WRITTEN = json.dumps(
    {
        "traced/skin": {
            "rows": [
                {**ROW, "case": "d_dome", "values": {"RMSE %": 3.84}},
                {**ROW, "case": "d_dome", "method": "SH", "values": {"RMSE %": 5.0}},
                {**ROW, "case": "d_sun", "values": {"RMSE %": 12.0}},
                {**ROW, "case": "d_off", "failed": True, "values": {}},
            ],
            "summary": {
                "all": {
                    "ours": {"mean": {"RMSE %": 7.92}, "worst": {"RMSE %": 12.0}},
                    "SH": {"mean": {"RMSE %": 5.0}},
                }
            },
        }
    }
)


def test_pages_counts_and_records_are_current():
    record = json.loads(figures.RECORD.read_text(encoding="utf-8"))
    assert list(figures.stale(record)) == [], "python tools/figures.py mends pages and counts"


def test_no_line_of_a_paragraph_begins_with_a_comment():
    """Markdown takes such a line for HTML, and ends the paragraph."""
    for page in figures.pages():
        begun = re.findall(r"^<!--=[\w.]+-->(?=.)", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert not begun, page.name


def test_figures_are_read_from_what_a_command_prints():
    assert figures.read_from(SOURCE, PRINTED) == {"rmse": "12.0 %"}


def test_figures_are_read_from_what_a_bench_writes():
    values = figures.read_from(BENCH, WRITTEN)
    assert values["rmse"] == "12.0 %"
    assert values["table"] == [
        "| scene | error | peer |",
        "|---|---|---|",
        "| a dome | 3.8 | 5.0 |",
        "| `d_sun` | 12.0 | - |",
        "| mean | 7.9 | 5.0 |",
    ]


@pytest.mark.parametrize(
    ("source", "printed", "lack"),
    [
        (SOURCE, PRINTED, {"lines": {"worst": "mean "}}),
        (SOURCE, PRINTED, {"figures": {"rmse": "{worst[9]}"}}),
        (BENCH, WRITTEN, {"figures": {"rmse": "{traced/skin[all][ours][worst][gone]}"}}),
        (BENCH, "{}", {"figures": {}}),
    ],
)
def test_what_is_not_printed_is_not_recorded(source, printed, lack):
    with pytest.raises(ValueError, match=r"mean|worst|no bench"):
        figures.read_from(replace(source, **lack), printed)


def test_a_page_gets_the_recorded_figures_and_keeps_the_rest():
    values = figures.read_from(BENCH, WRITTEN)
    record = {"skin": {"date": "2026-01-02", "commit": "abc", "values": values}}
    page = "It errs by <!--=skin.rmse-->9 %<!--/--> (<!--=skin.measured--><!--/-->).\n\n"
    page += "<!--=skin.table--><!--/-->"
    text = figures.rewritten(page, record)
    assert text.startswith(
        "It errs by <!--=skin.rmse-->12.0 %<!--/--> (<!--=skin.measured-->2026-01-02, commit abc<!"
    )
    assert (
        "-->\n\n| scene | error | peer |\n|---|---|---|\n| a dome | 3.8 | 5.0 |\n| `d_sun` | 12.0 | - |\n"
        in text
    )
    assert figures.rewritten(text, record) == text
    with pytest.raises(ValueError, match=r"skin\.half.*--run skin"):
        figures.rewritten("<!--=skin.half--><!--/-->", record)


def test_a_stale_page_is_told(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("<!--=counts.commands-->1<!--/-->")
    monkeypatch.setattr(figures, "pages", lambda: [page])
    monkeypatch.setattr(figures, "counted", lambda: {"commands": "2", "extremes": "0"})
    told = list(figures.stale({"counts": {"values": {"commands": "3"}}, "gone": {"command": ""}}))
    assert [line.split(":")[0] for line in told] == [
        "counts have changed",
        "stability.md lists other extremes than there are; see its own command",
        "gone",
        "page.md",
    ]


def test_a_command_that_fails_leaves_the_record_alone(monkeypatch):
    monkeypatch.setitem(figures.SOURCES, "none", SOURCE)
    with pytest.raises(ValueError, match="ended with 2"):
        figures.run("none")
