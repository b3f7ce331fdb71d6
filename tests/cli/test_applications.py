"""The commands for processed faces: what they write, one clear line an error, exit statuses."""

import shutil

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import printed, succeeded
from helpers.folders import contents
from helpers.records import files_in, read_json
from helpers.usage import usage_error
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import load_result, relight, write_face
from scan2albedo.errors import OutputError
from scan2albedo.io.images import read_exr_channels, write_exr
from scan2albedo.synthetic import face, light_at

pytestmark = pytest.mark.slow
INPUTS = {"swap": ("a", "b"), "blend": ("a", "b"), "transfer-expression": ("a", "a_smiling", "b")}


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
    assert files_in(folders / "a") == set(read_json(folders / "a" / "application.json")["files"])


@pytest.fixture
def new(folders, tmp_path):
    """What does not exist yet."""
    return tmp_path / "new"


def test_relight_writes_a_picture_with_json_on_stdout(folders, tmp_path):
    out = tmp_path / "relit.png"
    lights = ("--light", "-40,20", "--light", "50,0,2,400")
    summary = printed(invoke("relight", folders / "a", *lights, "-o", out, "--size", 64, "--json"))
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
    files = tmp_path / "sky.exr", tmp_path / "lit.exr"
    write_exr(files[0], sky)
    succeeded(invoke("relight", folders / "a", "--environment", files[0], "--size", 32, "-o", files[1]))
    green = read_exr_channels(files[1])["G"]
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
    ("command", "options"),
    [
        ("swap", ()),
        ("swap", ("--keep-color",)),
        ("blend", ("--weight", "0.3")),
        ("transfer-expression", ("--strength", "0.8")),
    ],
)
def test_new_faces_go_on_to_other_commands(folders, new, command, options):
    inputs = INPUTS[command]
    made = invoke(command, *(folders / name for name in inputs), *options, "-o", new, "--json")
    assert printed(made)["inputs"] == list(inputs)
    files = {"application.json", "geometry_image.npz", "albedo.exr", "fitted.glb", "picture.png"}
    assert files <= files_in(new)
    succeeded(invoke("relight", new, "--light", "20,20", "--size", 32, "-o", new / "relit.png"))


def test_the_correspondence_used_is_told(folders, new):
    faces = [folders / name for name in INPUTS["transfer-expression"]]

    def transferred(*faces_and_options):
        return invoke("transfer-expression", *faces_and_options, "-o", new)

    done = transferred(*faces, "--json")
    assert printed(done)["options"]["correspondence"] == "as-fitted"
    assert "two people" not in done.stderr
    assert "a and b seem to show two people" in transferred(*faces[::2], faces[0]).stderr
    shutil.rmtree(new)
    assert transferred(*faces, "--correspondence", "refined").exit_code != 0
    usage_error(transferred(*faces, "--correspondence", "guessed"))
    assert not new.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("relight {} --light ten,20", "AZ,EL"),
        ("relight {} --light 10", "AZ,EL"),
        ("relight {} --light 10,20,nan", "other numbers of at most 1e9"),
        ("relight {} --light 1e308,10", "angles of at most 360 degrees"),
        ("relight {} --light 0,0,1e308", "other numbers of at most 1e9"),
        ("relight {} --light 10,20,-1", "negative"),
        ("relight {} --light 0,0 --view 0,90", "elevation"),
        ("relight {}", "no light"),
        ("relight {} --sweep 2", "folder of frames"),
        ("relight {} --light 0,0 --exposure 0", "above 0"),
        ("relight {} --light 0,0 --gloss much", "--gloss"),
        ("blend {} {} --weight -0.1", "--weight"),
        ("blend {} {} --weight 1.5", "--weight"),
        ("blend {} {} --weight nan", "--weight"),
    ],
)
def test_wrong_options_are_usage_errors(folders, tmp_path, arguments, words):
    done = invoke(*arguments.format(*folders.iterdir()).split(), "-o", tmp_path / "out.png")
    assert words in usage_error(done)
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize("command", INPUTS)
def test_an_input_is_not_written_over(folders, command):
    before = contents(folders)
    done = invoke(command, *(folders / name for name in INPUTS[command]), "-o", folders / "a" / ".." / "b")
    assert "one of the inputs" in usage_error(done)
    assert contents(folders) == before


def test_relight_leaves_the_result_as_it_is(folders):
    before = contents(folders)
    for more in (("--light", "0,0", "-o", folders / "a" / "albedo.exr"), ("--sweep", 2, "-o", folders / "a")):
        assert "processed scan itself" in usage_error(invoke("relight", folders / "a", *more))
    for name in ("out.bmp", "out"):
        usage_error(invoke("relight", folders / "a", "--light", "0,0", "-o", folders / name))
    assert contents(folders) == before


def test_bad_input_is_named_and_leaves_nothing(folders, new):
    done = invoke("blend", folders / "a", new.parent, "-o", new)
    assert "result.json: is missing" in str(done.exception)
    assert not new.exists()


def test_personal_models_are_refused_where_they_cannot_be_made(folders, tmp_path):
    model = tmp_path / "model.json"
    for arguments, words in (
        (("-o", tmp_path / "model.npz"), "ends in .json"),
        (("-o", model, "--model", model), "the model itself"),
        (("-o", model, "--model", "none"), "no shape"),
    ):
        assert words in usage_error(invoke("personal-model", folders / "a", *arguments))
    done = invoke("personal-model", folders / "a", "-o", model)
    assert "processed with the model 'default', not" in str(done.exception)
    assert not list(tmp_path.iterdir())


def test_a_processed_scan_is_not_written_over(folders, tmp_path):
    (tmp_path / "result.json").write_text("{}")
    made = load_result(folders / "a")
    with pytest.raises(OutputError, match="choose another"):
        write_face(made, tmp_path, application="blend", inputs=(made,))
