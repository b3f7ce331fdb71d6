"""The command `identify`: its files, its table, one clear line an error."""

import csv

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import printed, succeeded
from helpers.records import files_in, read_json
from helpers.usage import usage_error
from jsonschema import Draft202012Validator
from PIL import Image

from scan2albedo.errors import OutputError
from scan2albedo.io.images import write_exr
from scan2albedo.runs.recognition import FILES, IdentificationRecord
from scan2albedo.synthetic import face


def table_in(folder):
    """Return the rows of the table that a run wrote."""
    return list(csv.DictReader((folder / "identification.csv").read_text(encoding="utf-8").splitlines()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Albedos of three persons, as images, and lists of them."""
    root = tmp_path_factory.mktemp("people")
    for seed, name in enumerate(("ann", "bob", "cy")):
        albedo = face(seed, size=64).albedo_linear
        write_exr(root / f"{name}.exr", albedo)
        grain = np.random.default_rng(seed).standard_normal(albedo.shape[:2])[..., None]
        write_exr(root / f"{name}-2.exr", albedo * (1 + 0.05 * grain))
    for name, lines in {
        "gallery": ["ann,ann.exr", "bob,bob.exr", "cy,cy.exr"],
        "probes": ["bob,bob-2.exr", "cy,cy-2.exr", ",ann-2.exr"],
        "unnamed": [",ann-2.exr"],
        "one": ["ann,ann.exr"],
        "signs": ["=1+1,ann.exr", "+bob,bob.exr", "@cy,cy.exr", "-ann,ann-2.exr"],
    }.items():
        (root / f"{name}.csv").write_text("\n".join(["person,result", *lines]))
    return root


def run(folder, *arguments, probes="probes", gallery="gallery.csv"):
    arguments += ("--probes", folder / f"{probes}.csv") if probes else ()
    return invoke("identify", "--gallery", folder / gallery, "--size", 64, *arguments)


def test_a_table_on_stdout_and_the_rate_on_stderr(folder):
    done = succeeded(run(folder))
    head, *rows = [line.split() for line in done.stdout.splitlines()]
    assert head[:5] == ["probe", "person", "predicted", "log", "odds"]
    assert "decided by albedo (3)" in done.stderr
    assert [row[:3] for row in rows] == [
        ["bob-2.exr", "bob", "bob"],
        ["cy-2.exr", "cy", "cy"],
        ["ann-2.exr", "?", "ann"],
    ]
    assert "right at rank 1: 100.0% of 2 named probes (15.8% to 100.0% at 95%)" in done.stderr


def test_files_and_json_tell_the_same(folder, tmp_path):
    done = run(folder, "-o", tmp_path, "--json")
    assert files_in(tmp_path) == {*FILES.names, FILES.record}
    record = read_json(tmp_path / "identification.json")
    assert printed(done) == record
    Draft202012Validator(IdentificationRecord.model_json_schema(mode="serialization")).validate(record)
    assert record["rates"]["rank_1_rate"] == 1
    rows = table_in(tmp_path)
    assert record["use"] == ["albedo"]  # images have no shape
    assert "gallery.csv: 3 of 3 results have no shape; the first: " in done.stderr
    assert list(rows[0])[:5] == ["probe", "person", "predicted", "log_odds", "decided_by"]
    assert [row["rank"] for row in rows] == ["1", "1", ""]
    with np.load(tmp_path / "similarities.npz") as arrays:
        assert arrays["persons"].tolist() == ["ann", "bob", "cy"]
        assert arrays["probe_persons"].tolist() == ["bob", "cy", ""]
        best = pytest.approx(arrays["log_odds"].max(1), abs=1e-3)
    assert [float(row["log_odds"]) for row in rows] == best
    assert {row["decided_by"] for row in rows} == {"albedo"}
    for name in ("cmc.png", "roc.png"):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) > 300


def test_without_named_probes_there_is_no_rate_and_no_curve_of_an_older_run(folder, tmp_path):
    succeeded(run(folder, "-o", tmp_path))
    done = succeeded(run(folder, "-o", tmp_path, probes="unnamed"))
    assert "rank 1" not in done.stderr
    assert files_in(tmp_path) == {"identification.csv", "similarities.npz", FILES.record}
    assert read_json(tmp_path / "identification.json")["rates"] is None


def test_names_that_a_spreadsheet_would_run_are_quoted(folder, tmp_path):
    succeeded(run(folder, "-o", tmp_path, probes="unnamed", gallery="signs.csv"))
    (row,) = table_in(tmp_path)
    assert row["predicted"] in ("'=1+1", "'-ann")
    assert row["next_person"] in ("'=1+1", "'-ann", "'+bob", "'@cy")
    assert float(row["log_odds"])
    assert row["person"] == ""


def test_a_gallery_of_one_person_has_no_impostor(folder, tmp_path):
    done = succeeded(run(folder, "-o", tmp_path, probes="one", gallery="one.csv"))
    assert "1 of 1 probes are in the gallery themselves" in done.stderr
    record = read_json(tmp_path / "identification.json")
    assert record["rates"]["equal_error_rate"] is None
    assert record["results"][0]["next_person"] is None
    assert not (tmp_path / "roc.png").exists()


def test_a_gallery_is_kept_and_used_again(folder, tmp_path):
    kept = run(folder, "--save-templates", tmp_path / "gallery.npz", "--json", probes=None)
    assert printed(kept)["persons"] == ["ann", "bob", "cy"]
    again = invoke("identify", "--gallery", tmp_path / "gallery.npz", "--probes", folder / "probes.csv")
    assert succeeded(again).stdout == run(folder).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "no probes"),
        ("-o out", "no probes"),
        ("--probes probes.csv --combine worst", "--combine"),
        ("--probes probes.csv --use colour", "--use is 'colour', expected some of albedo,texture,shape"),
        ("--save-templates gallery.bin", "ends in .npz"),
    ],
)
def test_wrong_options_are_usage_errors(folder, arguments, words):
    assert words in usage_error(run(folder, *arguments.split(), probes=None))


def test_a_list_without_persons_is_named_and_leaves_nothing(folder, tmp_path):
    (tmp_path / "gallery.csv").write_text("name,result\nann,ann.exr\n")
    done = run(folder, "-o", tmp_path / "out", gallery=tmp_path / "gallery.csv")
    assert "lacks the column person" in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_told_before_anything_is_read(folder, tmp_path):
    (tmp_path / "file").touch()
    done = run(folder, "-o", tmp_path / "file", gallery="none.csv")
    assert isinstance(done.exception, OutputError)
