"""Frames of one take: the same vertices, a lost frame found again, a broken one filled in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench.sequence import figures, followed
from helpers.measures import rms, row_lengths
from helpers.records import files_in
from numpy.testing import assert_allclose
from worlds.raw_like import raw_like
from worlds.takes import SCRIPTS, take

from scan2albedo.errors import OutputError, ScanError
from scan2albedo.fitting.tracking import FaceTracker
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_angle_rad, rotation_from_vector
from scan2albedo.io.obj import write_obj
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import ResultRecord
from scan2albedo.pipeline.quality import PRESETS
from scan2albedo.pipeline.sequence import process_sequence
from scan2albedo.synthetic.face_shape import person
from tests.io.test_glb import moving

COUNT = 6
LOST = 2
BROKEN = 3
HALF = 4


def turned(scan, degrees):
    """The scan turned about its middle, around the vertical axis."""
    center, rotation = scan.vertices.mean(0), rotation_from_vector([0, np.deg2rad(degrees), 0])
    pose = compose(rotation, center - rotation @ center)
    return replace(scan, vertices=scan.vertices @ pose[:3, :3].T + pose[:3, 3])


def halved(scan):
    return scan.without_faces(scan.vertices[scan.faces].mean(1)[:, 0] > scan.vertices[:, 0].mean())


def smiling(model, number):
    """Return the control points of a person whose smile comes and goes within the take."""
    smile = np.sin(np.pi * number / (COUNT - 1))
    rng = np.random.default_rng(5)
    return person(model, rng, expression="smile", expression_strength=smile, strength=0.5)


@pytest.fixture(scope="module")
def frames(model):
    """A smile that comes and goes within six frames, each frame resampled: 3 mm apart, noise 0.15 mm."""
    made, shape = [], model.subdivision(2)
    still = {"hair": False, "shoulders": False, "rotation_max_deg": 0.0, "translation_max_mm": 0.0}
    for number in range(COUNT):
        vertices = shape.matrix @ smiling(model, number)
        scan, _ = raw_like(vertices, shape.faces, number, spacing_mm=3.0, noise_mm=0.15, **still)
        made.append(replace(scan, name=f"frame {number}"))
    return made


@pytest.fixture(scope="module")
def whole(frames, tmp_path_factory):
    return process_sequence(frames, tmp_path_factory.mktemp("out"), name="smile")


@pytest.fixture(scope="module")
def damaged(frames, tmp_path_factory):
    """The take with a frame turned away, a broken file and half a face."""
    broken = tmp_path_factory.mktemp("in") / "broken.obj"
    broken.write_text("v 1 2\nf 1 2 3\n")
    given = list(frames)
    given[LOST] = turned(frames[LOST], 60)
    given[BROKEN] = broken
    given[HALF] = halved(frames[HALF])
    return process_sequence(given, name="damaged")


def test_frames_of_other_topologies_get_the_same_vertices(whole, frames):
    assert len({len(scan.vertices) for scan in frames}) > 1
    assert all(frame["used"] and not frame["found_again"] for frame in whole.frames)
    assert max(frame["residual_mm"] for frame in whole.frames) < 0.3
    with np.load(whole.out / "frames.npz") as stored:
        assert stored["vertices_mm"].shape == (COUNT, *whole.vertices(0).shape)
        assert_allclose(stored["vertices_mm"][3], whole.vertices(3), atol=1e-4)
        assert stored["landmarks_mm"].shape == (COUNT, 68, 3)


def test_the_smile_comes_and_goes(whole, model):
    """Mouth corners, farther apart in the middle of the take than at its ends, end where they began."""

    def widths(faces):
        corners = np.array([model.landmarks_of(points)[[48, 54]] for points in faces])
        return row_lengths(corners[:, 1] - corners[:, 0])

    width = widths(whole.control_points)
    true = widths(smiling(model, number) for number in range(COUNT))
    assert width[2] - width[0] == pytest.approx(true[2] - true[0], rel=0.5)
    assert abs(width[-1] - width[0]) < 1.0


def test_the_folder_is_a_result_s_with_the_take_in_it(whole):
    record = read_record(whole.out / "result.json", ResultRecord)
    assert [frame["file"] for frame in record.metrics["frames"]] == [f"frame {n}" for n in range(COUNT)]
    assert not record.notes
    assert "sequence" in {step.stage for step in record.plan}
    assert {"frames.npz", "sequence.glb", "geometry_image.npz"} <= set(record.files)
    assert files_in(whole.out) == set(record.files)


def test_targets_and_weights_give_the_frames(whole):
    base, targets, curves = moving(whole.out / "sequence.glb")
    assert 0 < len(targets) < COUNT
    for number in range(COUNT):
        bent = base + np.tensordot(curves["weights"].reshape(COUNT, -1)[number], targets, 1)
        assert row_lengths(1000 * bent - whole.vertices(number)).max() < 0.05


def test_a_lost_frame_is_found_again_and_told(whole, damaged):
    frame = damaged.frames[LOST]
    assert frame["used"] is frame["found_again"] is True
    assert "found again" in frame["notes"][0]
    apart = damaged.poses[LOST] @ invert_rigid(whole.poses[LOST])
    assert np.rad2deg(rotation_angle_rad(apart[:3, :3])) == pytest.approx(60, abs=2)
    assert any(f"frame {LOST + 1}, " in step.reason for step in damaged.plan.doubts())


def test_a_turn_of_forty_degrees_is_followed_there_and_back_on_half_a_face(frames, whole):
    tracker = FaceTracker(whole.fitted, PRESETS["draft"].fit)
    face, still = tracker.start, invert_rigid(tracker.start.model_from_scan)
    for scan, degrees in ((frames[1], 0), (turned(frames[2], 40), 40), (halved(frames[3]), 0)):
        face = tracker.follow(scan, face)
        assert face.odds > 0
        angle = rotation_angle_rad((face.model_from_scan @ still)[:3, :3])
        assert np.rad2deg(angle) == pytest.approx(degrees, abs=2)


def test_a_broken_file_is_named_left_out_and_filled_in(whole, damaged):
    frame = damaged.frames[BROKEN]
    assert not frame["used"]
    assert "broken.obj" in frame["notes"][0]
    assert frame["residual_mm"] is None
    assert rms(row_lengths(damaged.control_points[BROKEN] - whole.control_points[BROKEN])) < 1.5
    assert frame["deviation_mm"] > damaged.frames[1]["deviation_mm"]


def test_what_half_a_frame_does_not_show_follows_from_the_others(whole, damaged):
    frame = damaged.frames[HALF]
    assert frame["used"]
    assert frame["coverage"] < 0.7
    assert any("% of the face has scan near it" in note for note in frame["notes"])
    assert rms(row_lengths(damaged.control_points[HALF] - whole.control_points[HALF])) < 1.0


def test_files_are_read_in_the_unit_of_the_first(frames, whole, tmp_path):
    """Also where the first cannot be read: the next takes its place; one without faces is left out."""
    paths = [tmp_path / f"{name}.obj" for name in ("missing", "first", "empty", "second")]
    for path, scan in zip(paths[1::2], frames[:2], strict=True):
        write_obj(path, scan.vertices / 1000, scan.faces)
    paths[2].write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    found = process_sequence(paths, name="files")
    assert [frame["used"] for frame in found.frames] == [False, True, False, True]
    assert [Path(file).name for file, _ in found.left_out] == ["missing.obj", "empty.obj"]
    assert "empty.obj: holds a point cloud" in found.left_out[1][1]
    assert "missing.obj" in found.frames[0]["notes"][0]
    size = [np.ptp(points, axis=0) for points in (found.control_points[1], whole.control_points[0])]
    assert_allclose(*size, atol=1.5)
    assert found.frames[0]["deviation_mm"] is None


def test_one_frame_is_a_take(frames, whole, tmp_path):
    found = process_sequence(frames[:1], tmp_path, name="one")
    assert_allclose(found.vertices(0), found.fitted.vertices, atol=1e-9)
    assert (tmp_path / "one" / "sequence.glb").stat().st_size > 10_000


def test_wrong_input_is_refused(frames, tmp_path):
    for given, options, error, message in (
        ([], {}, ValueError, "frames is empty"),
        ("a.obj", {}, ValueError, "a list of the take's scans"),
        ([1.0], {}, TypeError, "give the path of a scan"),
        (frames, {"name": "a/b"}, ValueError, "expected a folder's name"),
        (frames, {"fps": 0.0}, ValueError, "fps 0.0: expected"),
        (frames, {"quality": "fast"}, ValueError, "quality is 'fast'"),
        ([tmp_path / "none.obj"], {}, ScanError, "none.obj"),
        (frames, {"model": "none"}, ValueError, "the model of a face with landmarks"),
    ):
        with pytest.raises(error, match=message):
            process_sequence(given, **{"name": "take", **options})
    (tmp_path / "take").mkdir()
    (tmp_path / "take" / "sequence.glb").write_text("mine")
    with pytest.raises(OutputError, match="take"):
        process_sequence(frames, tmp_path, name="take")


@pytest.mark.slow
@pytest.mark.parametrize("person", ["person1", "person4"])
def test_measured_faces_keep_their_landmarks(shared_data, person):
    """Sixty frames of `tools/bench/sequence.py`, each resampled, with expressions there and back."""
    if not (shared_data / "ict_expressions.npz").exists():
        pytest.skip("ict_expressions.npz is not among the real scans")
    made = take(person, SCRIPTS[person], seed=1)
    found = figures(made, followed(made))
    assert found["motion"] < 1.8
    assert found["jitter"] < found["true"]
    assert found["nose"] < 0.25
    assert found["drift"] < 0.6
