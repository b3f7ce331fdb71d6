"""Key points proposed from a frame's shape: their errors, what they say of themselves, and the command."""

import numpy as np
import pytest
import trimesh
from helpers.cli import invoke
from helpers.commands import refusal, succeeded
from helpers.eyeglasses import glazed
from helpers.lens_frames import from_lens
from helpers.measures import row_lengths
from helpers.records import read_json
from helpers.schemas import check_schema

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import KEY_POINT_NAMES, propose_keypoints, read_keypoints, write_keypoints
from scan2albedo.eyeglasses.mean_keypoints import BEHIND
from scan2albedo.geometry.rigid import random_rotation
from scan2albedo.io import load_scan
from scan2albedo.synthetic import GlassesBend, eyeglasses

MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
RIM_BRIDGE = KEY_POINT_NAMES.index("left_rim_bridge")


def proposed(vertices, faces, unit="mm", seed=0):
    """Return proposed key points in the frame's own axes in mm, and the proposal, of a posed mesh."""
    rng = np.random.default_rng(seed)
    turn, shift = random_rotation(rng), rng.normal(0, 100, 3)
    found = propose_keypoints(((vertices @ turn.T + shift) / MM[unit], faces))
    return (MM[unit] * found.points - shift) @ turn, found


def judged(points, found, truth, limit):
    """Whether errors are small, and no point is both far off and sure of itself."""
    error = row_lengths(points - truth)
    assert np.median(error) < limit
    assert ((error < 2) | (error < 3 * found.deviation)).all()
    assert np.median(found.deviation) < 2.5


@pytest.mark.parametrize(
    ("unit", "made"),
    [
        ("inch", {}),
        pytest.param("m", {"welded": False, "double_bridge": True}, marks=pytest.mark.slow),
        ("cm", {"nose_pads": False, "bend": GlassesBend(8, 2, 4)}),
    ],
    ids=["plain", "parts", "bent"],
)
def test_frames_of_any_pose_and_unit(unit, made):
    glasses = eyeglasses(40, **made)
    points, found = proposed(glasses.vertices, glasses.faces, unit, seed=len(unit))
    assert (found.unit, found.mm_per_unit) == (unit, MM[unit])
    judged(points, found, glasses.keypoints, 1.0)
    assert found.log_odds > 0


@pytest.mark.parametrize(
    "sewn", [pytest.param(False, marks=pytest.mark.slow), True], ids=["loose", "sewn in"]
)
def test_lenses_are_looked_through(sewn):
    glasses = eyeglasses(41)
    vertices, faces = glazed(glasses, gap=0.0)
    if sewn:
        mesh = trimesh.Trimesh(vertices, faces)
        assert len(mesh.vertices) < len(vertices)
        vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    judged(*proposed(vertices, faces, seed=3), glasses.keypoints, 1.0)


@pytest.mark.slow
def test_a_front_alone_has_no_temples_and_says_so():
    glasses = eyeglasses(42, welded=False)
    temples = np.unique(glasses.part[glasses.keypoint_vertices[[8, 17]]])
    kept = ~np.isin(glasses.part, temples)[glasses.faces].any(1)
    points, found = proposed(glasses.vertices, glasses.faces[kept], "mm", seed=4)
    assert np.isnan(points[BEHIND]).all()
    assert np.isinf(found.deviation[BEHIND]).all()
    error = row_lengths(points - glasses.keypoints)
    error[[7, 16]] = 0
    assert error[~BEHIND].max() < 4


@pytest.mark.slow
def test_of_a_rim_in_pieces_what_is_there_is_found_and_the_rest_is_unsure():
    glasses = eyeglasses(43)
    x, y, _ = from_lens(glasses).T
    # 40 degrees of the left rim, about its lowest place.
    lost = (np.abs(np.arctan2(x, -y)) < np.deg2rad(20)) & (np.abs(x) < 30)
    points, found = proposed(glasses.vertices, glasses.faces[~lost], "cm", seed=5)
    error = row_lengths(points - glasses.keypoints)
    honest = error < 3 * found.deviation
    bottom = KEY_POINT_NAMES.index("left_rim_bottom")
    assert np.isinf(found.deviation[bottom]) or honest[bottom]
    assert np.delete((error < 2) | honest, bottom).all()


def test_what_is_no_frame_is_refused():
    ball = trimesh.creation.icosphere(3)
    with pytest.raises(EyeglassesError, match="place the key points"):
        propose_keypoints((ball.vertices, ball.faces))
    with pytest.raises(EyeglassesError, match="hold nothing"):
        propose_keypoints((np.zeros((0, 3)), np.zeros((0, 3), int)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "placed"),
    [
        # Left halves, placed by people on renderings with a millimetre grid; both are symmetric about x = 0.
        (
            "sunglasses_khronos.glb",
            {
                "bridge_top": (0, 56.9, -2.2),
                "bridge_bottom": (0, 38.9, 2.4),
                "left_rim_bridge": (5.2, 38.6, 1.9),
                "left_rim_bottom": (44, 0.5, 0.9),
                "left_hinge": (74.9, 36.5, -3),
                "left_temple_middle": (75, 31.3, -62.5),
                "left_ear_bend": (68.9, 23.3, -122),
                "left_temple_tip": (61.5, 3.2, -155.5),
            },
        ),
        (
            "frame_giraut.stl",
            {
                "bridge_top": (0, 0, 8.4),
                "bridge_bottom": (0, -1, 5.8),
                "left_rim_top": (-32.8, 0, 21),
                "left_rim_inner": (-13.8, 0, -8.9),
                "left_rim_outer": (-51.9, 0, -9),
                "left_rim_bottom": (-32.8, 0, -21),
                "left_hinge": (-58, -2.8, 0.5),
            },
        ),
    ],
)
def test_real_frames_are_near_placed_points_or_unsure(shared_data, file, placed):
    scan = load_scan(shared_data / file)
    found = propose_keypoints(scan)
    assert found.unit == "mm"
    for name, place in placed.items():
        for side, turn in (("left", 1), ("right", -1)):
            k = KEY_POINT_NAMES.index(name.replace("left", side))
            error = np.linalg.norm(found.points[k] - np.array(place) * [turn, 1, 1])
            assert error < 2 or error < 2 * found.deviation[k], (name, side, error)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A frame's mesh in inches, without key points."""
    path, glasses = tmp_path_factory.mktemp("frames") / "own.ply", eyeglasses(44)
    trimesh.Trimesh(glasses.vertices / 25.4, glasses.faces, process=False).export(path)
    return path, glasses


@pytest.mark.slow
def test_the_command_writes_a_file_and_a_picture_and_keeps_placed_points(folder, tmp_path):
    path, glasses = folder
    placed, out = tmp_path / "placed.json", tmp_path / "points.json"
    points = np.full((20, 3), np.nan)
    points[RIM_BRIDGE] = glasses.keypoints[RIM_BRIDGE] / 25.4 + 0.01
    write_keypoints(placed, points, unit="unknown")
    arguments = ["glasses", "key-points", path, "-o", out, "--keypoints", placed]
    answer = succeeded(invoke(*arguments))
    content = check_schema(out, "eyeglasses_keypoints")
    assert content["unit"] == "mm"
    assert sorted(content["deviations_mm"]) == sorted(set(KEY_POINT_NAMES) - {"left_rim_bridge"})
    np.testing.assert_allclose(read_keypoints(out)[RIM_BRIDGE], 25.4 * points[RIM_BRIDGE], atol=1e-3)
    assert "19 key points are proposed from its shape, 1 placed, 0 not found" in answer.stderr
    assert (tmp_path / "points.png").stat().st_size > 10_000
    assert "is there already" in refusal(invoke(*arguments))


@pytest.mark.slow
def test_canonicalize_takes_frames_without_key_points(folder, tmp_path):
    path, glasses = folder
    answer = succeeded(invoke("glasses", "canonicalize", path, "-o", tmp_path / "out"))
    assert "unit: inch, in which a mean face wears it" in answer.stderr
    assert "20 key points are proposed" in answer.stderr
    record = read_json(tmp_path / "out" / "own" / "result.json")
    assert record["keypoints_file"] is None
    assert any("proposed" in note for note in record["notes"])
    found = read_keypoints(tmp_path / "out" / "own" / "keypoints.json")
    sizes = [np.linalg.norm(p[7] - p[16]) for p in (found, glasses.rest_keypoints)]
    assert abs(sizes[0] - sizes[1]) < 2
