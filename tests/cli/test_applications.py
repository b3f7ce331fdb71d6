"""The commands for processed faces: what they write, one clear line an error, exit statuses."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import printed, succeeded
from helpers.records import files_in
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import load_result, relight, write_face
from scan2albedo.errors import OutputError
from scan2albedo.io.images import read_exr_channels, write_exr
from scan2albedo.synthetic import face, light_at

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two people at rest, and the first one smiling, as an application writes faces."""
    root = tmp_path_factory.mktemp("faces")
    for name, seed, expression in (("a", 0, "neutral"), ("a_smiling", 0, "smile"), ("b", 1, "neutral")):
        scene = face(seed, expression=expression, size=48, lights=[light_at(30)])
        made = s2a.applications.ProcessedFace.of(name, scene.image, scene.albedo_linear, model_name="default")
        write_face(made, root / name, application="blend", inputs=())
    return root


def test_what_is_written_is_read_back(folders):
    made = load_result(folders / "a")
    scene = face(0, size=48, lights=[light_at(30)])
    assert_array_equal(made.albedo_linear, scene.albedo_linear)
    assert_array_equal(made.image.position, scene.image.position)
    assert made.model_name == "default"
    files = files_in(folders / "a")
    assert files == set(json.loads((folders / "a" / "application.json").read_text())["files"])


def test_relight_writes_a_picture_with_json_on_stdout(folders, tmp_path):
    out = tmp_path / "relit.png"
    summary = printed(
        invoke(
            "relight",
            folders / "a",
            "--light",
            "-40,20",
            "--light",
            "50,0,2,400",
            "-o",
            out,
            "--size",
            64,
            "--json",
        )
    )
    assert summary["lights"] == 2
    assert "usual" in summary["notes"][0]
    assert np.asarray(Image.open(out)).shape == (64, 64, 3)


def test_relight_in_linear_colour_is_what_the_library_does(folders, tmp_path):
    out = tmp_path / "relit.exr"
    lamp = ("--light", "30,20,2", "--lamp-radius", 8)
    succeeded(invoke("relight", folders / "b", *lamp, "--texture", "-o", out))
    channels = read_exr_channels(out)
    made = load_result(folders / "b")
    light = s2a.PointLight(np.radians(30), np.radians(20), intensity=2.0, radius_deg=8.0)
    expected = relight(made, [light]).texture_linear
    assert_allclose(channels["G"], expected[..., 1], atol=1e-6)
    assert_array_equal(channels["A"], made.mask)


def test_an_environment_lights_from_its_side(folders, tmp_path):
    sky = np.zeros((8, 16, 3), np.float32)
    sky[:, 10:13] = 1.0
    write_exr(tmp_path / "sky.exr", sky)
    out = tmp_path / "lit.exr"
    succeeded(
        invoke("relight", folders / "a", "--environment", tmp_path / "sky.exr", "--size", 32, "-o", out)
    )
    green = read_exr_channels(out)["G"]
    assert green[:, 16:].sum() > 2 * green[:, :16].sum()


def test_relight_writes_glb_and_sweeps(folders, tmp_path):
    succeeded(invoke("relight", folders / "a", "--light", "0,0", "-o", tmp_path / "relit.glb"))
    assert (tmp_path / "relit.glb").read_bytes()[:4] == b"glTF"
    sweep = ("relight", folders / "a", "--sweep", 3, "--size", 32, "-o")
    succeeded(invoke(*sweep, tmp_path / "sweep.gif"))
    with Image.open(tmp_path / "sweep.gif") as gif:
        assert gif.n_frames == 4
    succeeded(invoke(*sweep, tmp_path / "frames"))
    assert len(list((tmp_path / "frames").glob("frame_*.png"))) == 3


@pytest.mark.parametrize(
    ("command", "inputs", "options"),
    [
        ("swap", ("a", "b"), ()),
        ("swap", ("a", "b"), ("--keep-color",)),
        ("blend", ("a", "b"), ("--weight", "0.3")),
        ("transfer-expression", ("a", "a_smiling", "b"), ("--strength", "0.8")),
    ],
)
def test_new_faces_go_on_to_other_commands(folders, tmp_path, command, inputs, options):
    summary = printed(
        invoke(command, *(folders / name for name in inputs), *options, "-o", tmp_path / "new", "--json")
    )
    assert summary["inputs"] == list(inputs)
    names = files_in(tmp_path / "new")
    assert {"application.json", "geometry_image.npz", "albedo.exr", "fitted.glb", "picture.png"} <= names
    succeeded(
        invoke("relight", tmp_path / "new", "--light", "20,20", "--size", 32, "-o", tmp_path / "new.png")
    )


def test_the_correspondence_used_is_told(folders, tmp_path):
    faces = [folders / name for name in ("a", "a_smiling", "b")]
    done = invoke("transfer-expression", *faces, "-o", tmp_path / "new", "--json")
    assert json.loads(done.stdout)["options"]["correspondence"] == "as-fitted"
    assert "two people" not in done.stderr
    mixed = invoke("transfer-expression", *faces[::2], faces[0], "-o", tmp_path / "mixed")
    assert "a and b seem to show two people" in mixed.stderr
    refused = invoke("transfer-expression", *faces, "-o", tmp_path / "no", "--correspondence", "refined")
    assert refused.exit_code != 0
    wrong = invoke("transfer-expression", *faces, "-o", tmp_path / "no", "--correspondence", "guessed")
    assert wrong.exit_code == 2
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--light", "ten,20"), "AZ,EL"),
        (("--light", "10"), "AZ,EL"),
        (("--light", "10,20,nan"), "other numbers of at most 1e9"),
        (("--light", "1e308,10"), "angles of at most 360 degrees"),
        (("--light", "0,0,1e308"), "other numbers of at most 1e9"),
        (("--light", "10,20,-1"), "negative"),
        (("--light", "0,0", "--view", "0,90"), "elevation"),
        ((), "no light"),
        (("--sweep", "2"), "folder of frames"),
        (("--light", "0,0", "--exposure", "0"), "above 0"),
        (("--light", "0,0", "--gloss", "much"), "expected one of"),
    ],
)
def test_wrong_options_are_usage_errors(folders, tmp_path, arguments, words):
    done = invoke("relight", folders / "a", *arguments, "-o", tmp_path / "out.png")
    assert done.exit_code == 2
    assert words in " ".join(done.output.replace("│", " ").split())
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("weight", ["-0.1", "1.5", "nan"])
def test_weights_are_parts(folders, tmp_path, weight):
    done = invoke("blend", folders / "a", folders / "b", "--weight", weight, "-o", tmp_path / "new")
    assert done.exit_code == 2
    assert "--weight is" in done.output


@pytest.mark.parametrize(
    ("command", "inputs"),
    [("swap", ("a", "b")), ("blend", ("a", "b")), ("transfer-expression", ("a", "a_smiling", "b"))],
)
def test_an_input_is_not_written_over(folders, command, inputs):
    before = (folders / "b" / "albedo.exr").read_bytes()
    done = invoke(command, *(folders / name for name in inputs), "-o", folders / "a" / ".." / "b")
    assert done.exit_code == 2
    assert "one of the inputs" in " ".join(done.output.replace("│", " ").split())
    assert (folders / "b" / "albedo.exr").read_bytes() == before


def test_relight_leaves_the_result_as_it_is(folders):
    before = (folders / "a" / "albedo.exr").read_bytes()
    shown = invoke("relight", folders / "a", "--light", "0,0", "-o", folders / "a" / "albedo.exr")
    swept = invoke("relight", folders / "a", "--sweep", 2, "-o", folders / "a")
    assert (shown.exit_code, swept.exit_code) == (2, 2)
    assert "processed scan itself" in " ".join(shown.output.replace("│", " ").split())
    assert (folders / "a" / "albedo.exr").read_bytes() == before
    assert not list((folders / "a").glob("frame_*"))


def test_wrong_extensions_are_usage_errors(folders, tmp_path):
    assert invoke("relight", folders / "a", "--light", "0,0", "-o", tmp_path / "out.bmp").exit_code == 2
    assert invoke("relight", folders / "a", "--light", "0,0", "-o", tmp_path / "out").exit_code == 2


def test_bad_input_is_one_line_and_exit_2(folders, tmp_path):
    command = [
        sys.executable,
        "-m",
        "scan2albedo",
        "blend",
        folders / "a",
        tmp_path,
        "-o",
        tmp_path / "new",
    ]
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "result.json: is missing" in done.stderr
    assert not (tmp_path / "new").exists()


def test_personal_models_are_refused_where_they_cannot_be_made(folders, tmp_path):
    for arguments, words in (
        (("-o", tmp_path / "model.npz"), "ends in .json"),
        (("-o", tmp_path / "model.json", "--model", tmp_path / "model.json"), "the model itself"),
        (("-o", tmp_path / "model.json", "--model", "none"), "no shape"),
    ):
        done = invoke("personal-model", folders / "a", *arguments)
        assert done.exit_code == 2
        assert words in " ".join(done.output.replace("│", " ").split())
    done = invoke("personal-model", folders / "a", "-o", tmp_path / "model.json")
    assert "processed with the model 'default', not" in str(done.exception)
    assert not list(tmp_path.iterdir())


def test_a_processed_scan_is_not_written_over(folders, tmp_path):
    (tmp_path / "result.json").write_text("{}")
    made = load_result(folders / "a")
    with pytest.raises(OutputError, match="choose another"):
        write_face(made, tmp_path, application="blend", inputs=(made,))
