"""The command `report`."""

from helpers.cli import invoke
from helpers.commands import printed


def test_report_writes_the_page_and_tells_of_it(tmp_path):
    scan = tmp_path / "out" / "cut"
    scan.mkdir(parents=True)
    (scan / "result.json").write_text("{")
    summary = printed(invoke("report", tmp_path / "out", "-o", tmp_path / "p.html", "--json"))
    assert summary == {
        "status": "done",
        "out": str(tmp_path / "p.html"),
        "scans": 1,
        "done": 0,
        "failed": 1,
        "sections": 0,
        "size_bytes": (tmp_path / "p.html").stat().st_size,
    }


def test_report_refuses_other_names_and_folders_without_results(tmp_path):
    wrong = invoke("report", tmp_path, "-o", "page.pdf")
    assert wrong.exit_code == 2
    nothing = invoke("report", tmp_path)
    assert "holds no result.json" in str(nothing.exception)
