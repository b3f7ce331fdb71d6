"""Wrong objects, and colours that are not linear, are named where they are handed over."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.square import quarters, write_square_obj

import scan2albedo as s2a
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.errors import GeometryImageError
from scan2albedo.io.images import write_exr

FLAT = np.zeros((8, 8, 3))
UPWARD = np.broadcast_to([0.0, 0, 1], (8, 8, 3))
SCAN = RawScan(np.eye(3) * 100, [[0, 1, 2]])
MODEL = s2a.AnnotatedFaceModel.default()
WRONG = (None, "face.obj", Path("face.obj"), 3, np.eye(4), s2a)


def textured(texture):
    return replace(SCAN, uv=np.zeros((1, 3, 2)), texture_linear=texture)


@pytest.fixture(scope="module")
def face():
    image = GeometryImage(FLAT, UPWARD, np.ones((8, 8), bool))
    return s2a.applications.ProcessedFace.of("flat", image, np.ones((8, 8, 3), np.float32))


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda x: s2a.register(x, MODEL), "register: scan is .*, expected RawScan; load_scan"),
        (lambda x: s2a.register(SCAN, x), "register: model is .*, expected AnnotatedSurface"),
        (lambda x: s2a.fit(x, MODEL, np.eye(4)), "fit: scan is .*, expected RawScan"),
        (lambda x: s2a.fit(SCAN, x, np.eye(4)), "fit: model is .*, expected AnnotatedSurface"),
        (
            lambda x: s2a.fit(SCAN, MODEL, None),
            r"fit: reg is None, expected a Registration or a \(4, 4\) array",
        ),
        (lambda x: s2a.geometry_image(x, SCAN), "geometry_image: fitted is .*, expected a FittedFace"),
        (lambda x: s2a.estimate_albedo(x), "estimate_albedo: image is .*, expected GeometryImage"),
        (lambda x: s2a.applications.relight(x), "relight: face is .*, expected ProcessedFace; load_result"),
        (lambda x: s2a.applications.swap_texture(x, x), "swap_texture: a is .*, expected ProcessedFace"),
    ],
)
def test_other_objects_are_named_with_what_was_expected(call, expected, wrong):
    with pytest.raises(TypeError, match=expected):
        call(wrong)


def test_messages_say_what_was_given():
    shown = ("None", "the text 'face.obj'", "the path 'face.obj'", "an object of int")
    for wrong, words in zip(WRONG, shown, strict=False):
        with pytest.raises(TypeError, match=f"register: scan is {words}, "):
            s2a.register(wrong, MODEL)


@pytest.mark.parametrize("wrong", [None, 3, np.eye(4), MODEL, ["a.obj"]])
@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (s2a.process, r"process: source is .*, expected str or .*Path.* or RawScan"),
        (s2a.load_scan, r"load_scan: path is .*give the path of a scan's file"),
        (s2a.applications.load_result, r"load_result: source is .*, expected str or Path"),
    ],
)
def test_sources_are_paths_or_what_they_hold(call, expected, wrong):
    with pytest.raises(TypeError, match=expected):
        call(wrong)


@pytest.mark.parametrize("wrong", [{}, 3, "draft"])
@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda face, x: s2a.register(SCAN, MODEL, options=x), "register: options is .*, expected Registrat"),
        (
            lambda face, x: s2a.fit(SCAN, MODEL, np.eye(4), options=x),
            "fit: options is .*, expected FitOptions",
        ),
        (lambda face, x: s2a.applications.swap_texture(face, face, options=x), "swap_texture: options is .*"),
    ],
)
def test_options_are_those_of_the_function(face, call, expected, wrong):
    with pytest.raises(TypeError, match=expected):
        call(face, wrong)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"options": {}}, "relight: options is .*, expected Relight"),
        ({"lights": s2a.PointLight(0.0, 0.0)}, "lights is an object of PointLight, expected Sequence"),
        ({"lights": [(0, 0)]}, "relight: one of lights is an object of tuple, expected PointLight"),
        ({"environment": np.ones((4, 8, 3))}, "environment is an array .*, expected EnvironmentLight or"),
        (
            {"environment_linear": "x.hdr"},
            "environment_linear is the text .x.hdr., expected an array of linear",
        ),
        (
            {"environment_linear": np.full((4, 8, 3), 200, np.uint8)},
            "environment_linear holds uint8, expected floats of linear light",
        ),
    ],
)
def test_lights_and_options_of_relighting_are_of_their_types(face, given, expected):
    with pytest.raises(TypeError, match=expected):
        s2a.applications.relight(face, **given)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, bool])
def test_colours_in_integers_are_no_linear_light(dtype):
    with pytest.raises(TypeError, match=r"texture_linear holds .*, expected floats of linear light"):
        textured(np.ones((4, 4, 3), dtype))
    with pytest.raises(TypeError, match="vertex_color_linear holds "):
        replace(SCAN, vertex_color_linear=np.ones((3, 3), dtype))
    with pytest.raises(GeometryImageError, match=r"texture_linear holds .*decode_srgb_integers"):
        GeometryImage(FLAT, UPWARD, np.ones((8, 8), bool), np.ones((8, 8, 3), dtype))


def test_values_up_to_255_are_told_and_highlights_are_not():
    pixels = np.random.default_rng(0).uniform(0, 255, (6, 6, 3))
    with pytest.warns(UserWarning, match=r"scan: texture has a median of 1\d\d and reaches 2\d\d"):
        textured(pixels)
    with pytest.warns(UserWarning, match="vertex colours has a median"):
        replace(SCAN, vertex_color_linear=np.full((3, 3), 200.0))
    shiny = np.full((6, 6, 3), 0.4)
    shiny[0] = 90.0
    textured(shiny)


def test_a_file_of_values_up_to_255_has_a_note(tmp_path):
    path = write_square_obj(tmp_path)
    (tmp_path / "face.png").unlink()
    write_exr(tmp_path / "face.exr", 10 + quarters().astype(np.float32))
    assert any("display white: are these sRGB values" in note for note in s2a.load_scan(path).notes)
