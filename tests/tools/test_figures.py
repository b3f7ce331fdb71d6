"""Figures on README and the pages of docs/ are those that were recorded, and counts those of today."""

import json
import re
from dataclasses import replace

import figures
import pytest

PRINTED = """\
head        RMSE | said
d_dome       3.8 | 0.92
d_sun       12.0 | 0.50
worst       12.0 | 0.92
"""
SOURCE = figures.Source(
    "python tools/nothing.py",
    "none",
    lines={"worst": "worst "},
    figures={"rmse": "{worst[0]} %"},
    tables={"table": figures.Table(r"d_\w+ ", {"scene": "{0}", "said": "{2}"}, {"d_dome": "a dome"})},
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
    values = figures.read_from(SOURCE, PRINTED)
    assert values["rmse"] == "12.0 %"
    assert values["table"] == ["| scene | said |", "|---|---|", "| a dome | 0.92 |", "| `d_sun` | 0.50 |"]


@pytest.mark.parametrize("lack", [{"lines": {"worst": "mean "}}, {"figures": {"rmse": "{worst[9]}"}}])
def test_what_is_not_printed_is_not_recorded(lack):
    with pytest.raises(ValueError, match=r"mean|worst\[9\]"):
        figures.read_from(replace(SOURCE, **lack), PRINTED)


def test_a_page_gets_the_recorded_figures_and_keeps_the_rest():
    values = figures.read_from(SOURCE, PRINTED)
    record = {"skin": {"date": "2026-01-02", "commit": "abc", "values": values}}
    page = "It errs by <!--=skin.rmse-->9 %<!--/--> (<!--=skin.measured--><!--/-->).\n\n"
    page += "<!--=skin.table--><!--/-->"
    text = figures.rewritten(page, record)
    assert text.startswith(
        "It errs by <!--=skin.rmse-->12.0 %<!--/--> (<!--=skin.measured-->2026-01-02, commit abc<!"
    )
    assert "-->\n\n| scene | said |\n|---|---|\n| a dome | 0.92 |\n| `d_sun` | 0.50 |\n\n<!--" in text
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
        figures.run("none", None)
