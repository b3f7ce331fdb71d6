"""What the experiment leaves behind can be read, and looked at."""

import csv
import json
from dataclasses import replace

import cv2
import pytest
from experiment_recognition import main, options_of, parser
from recognition_experiment import run_recognition_experiment
from recognition_experiment.files import RECORD, write_report

from scan2albedo.core import Trace, TraceRow
from scan2albedo.errors import OutputError

pytestmark = pytest.mark.slow


def test_all_files_are_there(filled_cache, small_options, tmp_path):
    report = run_recognition_experiment(filled_cache, options=small_options)
    folder = write_report(report, tmp_path / "out", filled_cache)
    figures = json.loads((folder / RECORD).read_text())
    assert figures["persons"] == 4
    assert figures["probes"] == 8
    assert figures["methods"][0]["method"] == "raw texture"
    assert figures["options"]["population"]["individuality"] == 1.0
    with (folder / "probes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["person"] for row in rows] == list(report.results[0].identification.probe_names)
    assert all(row["albedo, oren-nayar"] == row["person"] for row in rows)
    for name in ("cmc.png", "roc.png", "people.png"):
        assert min(cv2.imread(str(folder / name)).shape[:2]) > 200
    assert (folder / "table.txt").read_text() == report.table() + "\n"
    assert not list(folder.glob(".*"))


def test_a_run_with_nothing_to_do_leaves_the_trace(filled_cache, small_options, tmp_path):
    report = run_recognition_experiment(filled_cache, options=small_options)
    row = TraceRow("experiment.recognition", 9.0, 8.0, 4, 0.5, "1 - rank-1 rate")
    folder = write_report(replace(report, trace=Trace((row,))), tmp_path / "out")
    before = (folder / "trace.csv").read_text(), (folder / "error_vs_time.png").read_bytes()
    write_report(report, folder)
    assert before == ((folder / "trace.csv").read_text(), (folder / "error_vs_time.png").read_bytes())


def test_without_the_scans_there_is_no_sheet_of_people(filled_cache, small_options, tmp_path):
    report = run_recognition_experiment(filled_cache, options=small_options)
    assert not (write_report(report, tmp_path / "out") / "people.png").exists()


def test_a_folder_that_cannot_be_written_is_named(filled_cache, small_options, tmp_path):
    report = run_recognition_experiment(filled_cache, options=small_options)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file"):
        write_report(report, tmp_path / "file" / "out")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--persons", "1"], "persons"),
        (["--individuality", "2"], "individuality is 2"),
        (["--brdf", "phong"], "phong"),
        (["--budget", "-1"], "budget is -1"),
        (["--size", "4"], "size is 4"),
        (["--light", "sun"], "invalid choice: 'sun'"),
    ],
)
def test_wrong_choices_are_usage_errors(arguments, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["-o", str(tmp_path / "out"), *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_room_is_coloured_unless_told_otherwise():
    def population(*arguments):
        return options_of(parser().parse_args(arguments)).population

    assert (population().light, population().lamp_colors) == ("flashes", 0.0)
    assert (population("--light", "room").light, population("--light", "room").lamp_colors) == ("room", 0.3)
    assert population("--light", "room", "--lamp-colors", "0").lamp_colors == 0.0


def test_the_tool_reports_what_a_folder_holds(small_options, charts, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("recognition_experiment.sessions.made_session", lambda o, p, s: charts[p, s])
    arguments = ["--persons", "3", "--probes", "1", "--jobs", "1", "--size", "128"]
    arguments += ["--brdf", "oren-nayar", "--brdf", "lambert", "-o", str(tmp_path), "--json"]
    main(arguments)
    assert json.loads(capsys.readouterr().out)["persons"] == 3
    assert (tmp_path / RECORD).exists()
    assert len(list(tmp_path.glob("scans/*/*.npz"))) == 6
