"""Names, skeleton and files of key points."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import succeeded
from helpers.eyeglasses import posed
from helpers.schemas import check_schema
from numpy.testing import assert_array_equal
from scipy.sparse.csgraph import connected_components

from scan2albedo.cli.commands import main
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, read_keypoints, write_keypoints
from scan2albedo.eyeglasses.keypoints import KEY_POINT_PLACES, MIRROR, SKELETON, typical_key_points
from scan2albedo.report.eyeglasses_views import key_point_chart, key_point_table
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses


def test_the_skeleton_joins_all_20_and_is_symmetric():
    assert len(KEY_POINT_NAMES) == len(set(KEY_POINT_NAMES)) == 20
    for name, other in zip(KEY_POINT_NAMES, MIRROR, strict=True):
        swapped = name.replace("left", "LEFT").replace("right", "left").replace("LEFT", "right")
        assert KEY_POINT_NAMES[other] == swapped
    edges = np.zeros((20, 20), bool)
    edges[tuple(np.transpose(SKELETON))] = True
    edges |= edges.T
    assert connected_components(edges)[0] == 1
    assert_array_equal(edges[np.ix_(MIRROR, MIRROR)], edges)


def test_files_keep_key_points_and_fit_their_schema(tmp_path):
    points = np.random.default_rng(0).normal(0, 50, (20, 3))
    points[4] = np.nan
    write_keypoints(tmp_path / "a.json", points)
    assert_array_equal(read_keypoints(tmp_path / "a.json"), points)
    wrong = {"surprise": 1}, {"key_points": {"nose": [1, 2, 3]}}, {"unit": "inch"}
    tree = check_schema(tmp_path / "a.json", "eyeglasses_keypoints", *wrong)
    # A name left out is a missing key point.
    del tree["key_points"]["left_hinge"]
    (tmp_path / "a.json").write_text(json.dumps(tree))
    points[KEY_POINT_NAMES.index("left_hinge")] = np.nan
    assert_array_equal(read_keypoints(tmp_path / "a.json"), points)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "Invalid JSON"),
        (b"\xff\xfe\x80", "is UTF-16 text"),
        (b'{"key_points": {"nose": [1, 2, 3]}}', "'nose' is not a key point"),
        (
            b'{"key_points": {"left_rim_tpo": null, "hinge_left": null}}',
            r"'hinge_left', 'left_rim_tpo' \(probably 'left_rim_top'\) are not key points; names are",
        ),
        (b'{"key_points": {"left_hinge": [1, 2]}}', "left_hinge"),
        (b'{"format_version": 2, "key_points": {}}', "format_version"),
    ],
)
def test_faults_name_the_file(tmp_path, text, message):
    (tmp_path / "broken.json").write_bytes(text)
    with pytest.raises(EyeglassesError, match=rf"broken\.json.*{message}"):
        read_keypoints(tmp_path / "broken.json")


def test_no_file_and_another_shape_are_told(tmp_path):
    with pytest.raises(EyeglassesError, match=r"none\.json cannot be read \(No such file"):
        read_keypoints(tmp_path / "none.json")
    with pytest.raises(ValueError, match=r"\(19, 3\), expected \(20, 3\)"):
        write_keypoints(tmp_path / "a.json", np.zeros((19, 3)))


DOCS = Path(__file__).resolve().parents[2] / "docs" / "eyeglasses.md"
WIRE = GlassesShape(rim_width=0.6, rim_depth=0.6, bridge_height=0.6, temple_height=0.6, temple_width=0.6)
BENDS = (
    GlassesBend(),
    GlassesBend(temple_spread_mm=40, bridge_deg=10),
    GlassesBend(temple_spread_mm=-25, bridge_deg=-10),
    GlassesBend(twist_deg=15),
)


def test_the_table_names_every_key_point_once_and_docs_show_it():
    page, found = DOCS.read_text(encoding="utf-8"), []
    for number, (name, *rest, _) in enumerate(KEY_POINT_PLACES):
        names = [name] if number < 2 else [f"left_{name}", f"right_{name}"]
        found += names
        spans = ", ".join(f"`{name}`" for name in names)
        assert f"| {spans} | {' | '.join(rest)} |" in page
        assert all(text in key_point_table() for text in rest)
    assert sorted(found) == sorted(KEY_POINT_NAMES)


def test_the_chart_labels_every_key_point_of_the_front_and_one_temple():
    shown = {text.get_text() for axes in key_point_chart().axes for text in axes.texts}
    assert set(KEY_POINT_NAMES) - shown == {f"right_{n}" for n in ("temple_middle", "ear_bend", "temple_tip")}
    assert shown <= set(KEY_POINT_NAMES)


def test_the_typical_frame_is_like_the_synthetic_one():
    away = np.linalg.norm(typical_key_points() - eyeglasses(shape=GlassesShape()).rest_keypoints, axis=1)
    assert away.max() < 1


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("bridge_top", "bridge_bottom"),
        ("left_rim_top", "left_rim_bottom"),
        ("right_rim_inner", "right_rim_outer"),
        ("left_hinge", "right_hinge"),
        ("right_ear_bend", "right_temple_tip"),
    ],
)
def test_exchanged_names_are_told(tmp_path, first, second):
    points = posed(eyeglasses(3, bend=BENDS[3]).keypoints, 0)
    pair = [KEY_POINT_NAMES.index(name) for name in (first, second)]
    points[pair] = points[pair[::-1]]
    write_keypoints(tmp_path / "a.json", points)
    told = rf"a\.json: names seem exchanged: ({first} and {second}|{second} and {first})\."
    with pytest.raises(EyeglassesError, match=told):
        read_keypoints(tmp_path / "a.json")


def test_exchanged_sides_are_told(tmp_path):
    write_keypoints(tmp_path / "a.json", posed(eyeglasses(0).keypoints, 0)[list(MIRROR)])
    with pytest.raises(EyeglassesError, match="exchanged: all left ones and all right ones"):
        read_keypoints(tmp_path / "a.json")


def test_bent_frames_wires_and_rough_key_points_are_not_called_exchanged(tmp_path):
    frames = [eyeglasses(seed, bend=bend) for seed in range(4) for bend in BENDS]
    frames += [eyeglasses(0, shape=WIRE, double_bridge=double) for double in (False, True)]
    for seed, frame in enumerate(frames):
        rough = frame.keypoints + np.random.default_rng(seed).normal(0, 1, (20, 3))
        write_keypoints(tmp_path / "a.json", posed(rough, seed))
        read_keypoints(tmp_path / "a.json")


def test_the_command_makes_the_pictures_folder_or_refuses_at_once(tmp_path, monkeypatch, capsys):
    picture = tmp_path / "new" / "chart.png"
    succeeded(invoke("glasses", "key-points", "-o", picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    arguments = ["glasses", "key-points", "-o", str(picture / "chart.png")]
    monkeypatch.setattr("sys.argv", ["scan2albedo", *arguments])
    with pytest.raises(SystemExit) as refused:
        main()
    said = capsys.readouterr()
    assert refused.value.code == 2
    assert said.err.startswith("scan2albedo: error: cannot create the folder")
    assert said.out == ""
