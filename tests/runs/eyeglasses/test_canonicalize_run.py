"""Canonical eyeglasses from files and to files, and the command for it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.eyeglasses import posed
from helpers.records import files_in, read_json, valid_record
from helpers.usage import usage_error
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError, ScanError
from scan2albedo.eyeglasses import (
    read_canonical,
    read_keypoints,
    write_keypoints,
)
from scan2albedo.eyeglasses.mean_keypoints import front_width
from scan2albedo.io import load_scan
from scan2albedo.runs.eyeglasses.canonicalize_run import canonicalize_frames
from scan2albedo.runs.eyeglasses.inputs import keypoints_path, read_frame
from scan2albedo.synthetic import GlassesBend, eyeglasses

pytestmark = pytest.mark.slow

MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
FRAME_FILES = {"canonical.glb", "canonical.npz", "keypoints.json", "result.json"}
SET_FILES = {"mean_keypoints.json", "trace.csv", "error_vs_time.png", "overview.png", "set.json"}


def remarked(path, points, unit="unknown"):
    """Replace the key points of a frame."""
    write_keypoints(keypoints_path(path), points, unit=unit)


def save(
    folder, name="frame", *, unit="mm", marks="mm", size=1.0, seed=0, bend=GlassesBend(), keep=range(20)
):
    """Write a posed frame times `size` and its key points; return the mesh's path and the frame."""
    glasses, path = eyeglasses(seed, bend=bend), folder / f"{name}.ply"
    vertices = posed(size * glasses.vertices, seed) / MM[unit]
    trimesh.Trimesh(vertices, glasses.faces, process=False).export(path)
    points = posed(size * glasses.keypoints, seed) / MM[unit if marks == "unknown" else marks]
    points[np.setdiff1d(np.arange(20), keep)] = np.nan
    remarked(path, points, marks)
    return path, glasses


def run(*arguments):
    return invoke("glasses", "canonicalize", *arguments)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Two frames through the command, in different units, with one that cannot be read between them."""
    folder = tmp_path_factory.mktemp("glasses")
    first, _ = save(folder, "first", unit="m", bend=GlassesBend(temple_spread_mm=8))
    second, _ = save(folder, "second", marks="unknown", unit="cm", bend=GlassesBend(temple_spread_mm=-8))
    broken, _ = save(folder, "broken")
    broken.write_bytes(b"ply\nnothing")
    return folder, run(first, broken, second, "-o", folder / "out", "--json", "--mode", "mean")


def test_one_frame_that_cannot_be_read_leaves_the_others_alone(done):
    folder, answer = done
    assert answer.exit_code == 1, answer.output
    rows = json.loads(answer.stdout)
    assert [row["status"] for row in rows] == ["done", "failed", "done"]
    assert "broken.ply" in rows[1]["reason"]
    assert answer.stderr.count("error:") == 1
    assert "first: unit: m, decided" in answer.stderr
    assert "second: unit: cm" in answer.stderr
    assert files_in(folder / "out") == {"first", "second", *SET_FILES}
    for name in ("first", "second"):
        assert files_in(folder / "out" / name) == FRAME_FILES


def test_the_files_hold_what_was_done(done):
    folder, answer = done
    mean = read_keypoints(folder / "out" / "mean_keypoints.json")
    first = read_canonical(folder / "out" / "first" / "canonical.npz")
    for row in json.loads(answer.stdout)[::2]:
        part = Path(row["out"])
        assert_array_equal(read_keypoints(part / "keypoints.json"), mean)
        canonical = read_canonical(part / "canonical.npz")
        given = read_frame(Path(row["frame"])).scan.vertices
        assert_allclose(given, canonical.uncanonicalize(canonical.vertices), atol=1e-9)
        shown = load_scan(part / "canonical.glb")
        assert_allclose(shown.vertices, canonical.vertices, atol=1e-4)
        record = valid_record(part / "result.json", "canonical_eyeglasses")
        assert_array_equal(record["canonical_from_frame"], canonical.canonical_from_frame)
        assert set(record["files"]) == FRAME_FILES
        assert record["metrics"] == {k: row[k] for k in record["metrics"]}
        # Both were bent by 8 mm at the tips, one out and one in: half of it each way off the mean, or so.
        assert 5 < record["metrics"]["moved_max_mm"] < 12
        assert record["metrics"]["glb_moved_max_mm"] < 0.05
        assert record["converged"]
        assert record["mode"] == "mean"
        # One shape twice: without their bends the two are the same.
        assert np.abs(canonical.vertices - first.vertices).max() < 0.7
        assert len(given) == record["input"]["vertices"]
    record = valid_record(folder / "out" / "set.json", "canonical_eyeglasses_set")
    assert record["frames"] == ["first", "second"]
    assert record["failures"][0]["file"].endswith("broken.ply")
    assert {step["stage"] for step in record["plan"]} >= {"eyeglasses.weights", "eyeglasses.mean"}
    assert set(record["files"]) == SET_FILES
    stages = {line.split(",")[0] for line in (folder / "out" / "trace.csv").read_text().splitlines()[1:]}
    assert stages == {"eyeglasses.weights.0", "eyeglasses.weights.1", "eyeglasses.mean"}


def test_a_later_frame_goes_to_an_earlier_mean(done, tmp_path):
    folder, _ = done
    mean, out = folder / "out" / "mean_keypoints.json", tmp_path / "out"
    options = ("--mean", mean, "--budget", 0.2, "--mode", "mean", "--handles", "translated")
    answer = succeeded(run(folder / "first.ply", "-o", out, *options))
    assert_array_equal(read_keypoints(out / "mean_keypoints.json"), read_keypoints(mean))
    record = read_json(out / "set.json")
    assert record["iterations"] == 0
    assert not record["converged"]
    assert "not converged" in answer.stderr
    assert record["options"]["handles"] == "translated"
    assert record["options"]["budget_s"] == 0.2


def test_frames_are_unbent_by_default_and_small_ones_refused(tmp_path):
    path, glasses = save(tmp_path, bend=GlassesBend(twist_deg=4), keep=range(19))
    small, _ = save(tmp_path, "small", size=0.6)
    answer = run(path, small, "-o", tmp_path / "out", "--budget", 2)
    assert answer.exit_code == 1, answer.output
    assert "frame: without key points right_temple_tip" in answer.stderr
    assert "rms off the unbent frame's" in answer.stderr
    assert re.search(r"small\.ply: front 8\S* units wide, 8\S* mm \(unit: mm, .*give what", answer.stderr)
    record = read_json(tmp_path / "out" / "frame" / "result.json")
    assert record["mode"] == "unbend"
    assert any(step["stage"] == "eyeglasses.unbend" and step["ran"] for step in record["plan"])
    found = read_canonical(tmp_path / "out" / "frame" / "canonical.npz")
    assert found.unbent
    width = np.ptp(found.keypoints[[7, 16], 0])
    assert width == pytest.approx(np.ptp(glasses.rest_keypoints[[7, 16], 0]), abs=0.2)


@pytest.mark.parametrize("unit", MM)
@pytest.mark.parametrize("marks", ["mm", "m", "unknown"])
def test_units_come_from_the_key_points(tmp_path, unit, marks):
    path, glasses = save(tmp_path, unit=unit, marks=marks)
    frame = read_frame(path)
    assert frame.mm_per_unit == MM[unit]
    assert frame.scan.notes[0].startswith(f"unit: {unit}")
    assert_allclose(frame.scan.vertices, posed(glasses.vertices, 0), atol=1e-3)
    given = read_frame(path, unit=unit)
    assert_array_equal(given.scan.vertices, frame.scan.vertices)
    assert_array_equal(given.keypoints, frame.keypoints)


def test_a_front_without_temples_has_a_size_too(tmp_path):
    path, _ = save(tmp_path, unit="cm", marks="unknown", keep=[0, 1, *range(2, 8), *range(11, 17)])
    frame = read_frame(path)
    assert frame.mm_per_unit == 10.0
    done = canonicalize_frames([frame, read_frame(save(tmp_path, "whole")[0])], budget=0.1)
    assert done.notes[0] == "frame: without temples, left and right cannot be checked reliably"
    bare, whole = done.notes[1:]
    assert re.match(r"frame 0: a bend common to both sides stays, .* \+- 5\.8 degrees\)", bare)
    assert re.match(r"frame 1: a bend common to both sides stays, .* \+- \d+\.\d mm\)", whole)


@pytest.mark.parametrize("unit", MM)
def test_the_width_of_a_front_decides_before_its_length(tmp_path, unit):
    path, _ = save(tmp_path, unit=unit, marks="unknown")
    marks = read_keypoints(keypoints_path(path))
    # The tips make a length that glasses have in no unit.
    marks[[10, 19]] += 3 * (marks[[10, 19]] - marks[[7, 16]])
    remarked(path, marks)
    frame = read_frame(path)
    assert frame.mm_per_unit == MM[unit]
    (note,) = (n for n in frame.scan.notes if n.startswith("unit: "))
    assert re.match(rf"unit: {unit}, decided from its front's width .* front [\d.]+ units wide, 1\d\d", note)


def test_sizes_of_no_glasses_are_told(tmp_path):
    path, _ = save(tmp_path)
    marks = read_keypoints(keypoints_path(path))
    for points, of_marks, unit, error, words in (
        (marks / 5, "unknown", "auto", ScanError, r"the glasses are \d\d\.\d* units long, which .* --widths"),
        (marks / 5, "unknown", "m", ScanError, r"are \d\d\.\d* m long, but glasses measure 50 to 400 mm"),
        (marks, "m", "auto", ScanError, r"frame\.keypoints\.json: the glasses are"),
        (marks + 1000, "mm", "auto", EyeglassesError, r"frame\.ply: in no unit .* in (mm|cm|m), they are"),
        (marks, "mm", "inch", ValueError, "expected 'auto', 'mm', 'cm' or 'm'"),
    ):
        remarked(path, points, of_marks)
        with pytest.raises(error, match=words):
            read_frame(path, unit=unit)


def test_other_widths_admit_small_frames(tmp_path):
    path, _ = save(tmp_path, size=0.2)
    marks = read_keypoints(keypoints_path(path))
    for unit in ("mm", "unknown"):
        remarked(path, marks, unit)
        with pytest.raises(ScanError, match=r"takes the front's --frame-width in mm, .* with --widths"):
            read_frame(path, unit="mm")
        frame = read_frame(path, unit="mm", widths_mm=(25, 60))
        assert_allclose(frame.keypoints, marks)
    assert read_frame(path, widths_mm=(25, 60)).mm_per_unit == 1.0
    with pytest.raises(ScanError, match=r"glasses in mm or cm; .* --frame-width in mm or other --widths"):
        read_frame(path, widths_mm=(25, 400))


@pytest.mark.parametrize(("marks", "unit", "size"), [("mm", "cm", 1 / 3), ("unknown", "mm", 1 / 30)])
def test_a_measured_front_sets_the_scale_of_its_set(tmp_path, marks, unit, size):
    """Without it the front, 4.67 units wide, was called one of 46.7 units, and in cm, in one log."""
    made = [save(tmp_path, name, marks=marks, unit=unit, size=size, seed=k) for k, name in enumerate("ab")]
    paths = [path for path, _ in made]
    widths = [front_width(glasses.keypoints, glasses.vertices) for _, glasses in made]
    refused = run(*paths, "-o", tmp_path / "none")
    assert "--frame-width" in usage_error(refused)
    assert len(re.findall(r"front 4\.\d* units wide", refused.stderr)) == 2
    assert not re.search(r"4\d\.\d* units|unit: c?m,.*\n.*in the file", refused.stderr)
    options = ("--frame-width", widths[0], "--budget", 0.2)
    told = succeeded(run(*paths, "-o", tmp_path / "out", *options)).stderr
    for name, width, source in zip("ab", widths, ("from --frame-width", "as in the first file"), strict=True):
        assert re.search(rf"{name}: unit: 30 mm, {source}; front 4\.\d* units wide, 1\d\d", told)
        found = read_canonical(tmp_path / "out" / name / "canonical.npz")
        assert found.scale == 1
        assert front_width(found.keypoints, found.vertices) == pytest.approx(width, rel=0.02)
    points = read_keypoints(keypoints_path(paths[0]))
    remarked(paths[0], np.where(np.arange(20)[:, None] < 11, points, np.nan))
    with pytest.raises(EyeglassesError, match=r"a\.ply: place both hinges"):
        read_frame(paths[0], frame_width_mm=140)


def test_usage_errors_and_nothing_done_are_2(done, tmp_path):
    folder, _ = done
    first, out = folder / "first.ply", tmp_path / "out"
    usage_error(run(first))
    for options in (
        "--unit yard",
        "--handles bent",
        "--handles translated",
        "--mode bend",
        "--widths 170,110",
        "--budget 0",
        f"{tmp_path}/first.obj",
        f"{folder}/second.ply --keypoints {folder}/first.keypoints.json",
    ):
        usage_error(run(first, "-o", out, *options.split()))
        assert not out.exists()
    answer = run(folder / "broken.ply", tmp_path / "none.stl", "-o", out, "--json")
    assert "none.stl" in usage_error(answer)
    assert [row["status"] for row in json.loads(answer.stdout)] == ["failed", "failed"]
    assert answer.stderr.count("error:") == 2
    assert "no frame" not in answer.stderr
    assert not out.exists()
    assert "none.json" in usage_error(run(first, "-o", out, "--mean", tmp_path / "none.json"))
