"""White balance: what it does to colours, and which values are refused."""

import numpy as np
import pytest
from helpers.records import read_json
from numpy.testing import assert_allclose

import scan2albedo as s2a
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.white_balance import balanced

RNG = np.random.default_rng(3)


def painted(skin=None):
    """A scan in vertex colours, and an image of 8 x 8 texels."""
    normal = np.tile([0.0, 0.0, 1.0], (8, 8, 1))
    texture = RNG.uniform(0.2, 0.6, (8, 8, 3)).astype(np.float32)
    everywhere = np.ones((8, 8), bool)
    image = GeometryImage(normal, normal, everywhere, texture, texture_valid=everywhere, skin=skin)
    colors = np.float32([[0.4, 0.5, 0.25]] * 3)
    return RawScan(np.eye(3), [[0, 1, 2]], vertex_color_linear=colors), image


def test_what_is_said_to_be_grey_becomes_grey():
    scan, image = painted()
    found, lit, step = balanced(scan, image, (0.4, 0.5, 0.25))
    assert_allclose(found.vertex_color_linear, 0.5, rtol=1e-6)
    assert_allclose(lit.texture_linear, image.texture_linear * [1.25, 1, 2], rtol=1e-6)
    assert step.text == "something grey is grey (red x 1.250, green x 1.000, blue x 2.000)"


def test_skin_gets_the_mean_colour_of_people():
    skin = np.zeros((8, 8), np.float32)
    skin[2:, :4] = 0.9
    _, image, step = balanced(*painted(skin), "grey-skin")
    red, green, blue = np.log(image.texture_linear[2:, :4].reshape(-1, 3), dtype=np.float64).T
    chroma = np.median(green - red), np.median(blue - red)
    assert_allclose(chroma, AlbedoPrior.faces().chroma[0], atol=1e-5)
    assert step.ran


@pytest.mark.parametrize("skin", [None, np.zeros((8, 8), np.float32)])
def test_without_skin_nothing_is_done_and_that_is_told(skin):
    scan, image = painted(skin)
    found, same, step = balanced(scan, image, "grey-skin")
    assert found is scan
    assert same is image
    assert step.level == "wrong"


@pytest.mark.parametrize("wrong", ["gray", "1,2", "1,0,1", "1,nan,1", (1, 2, 3, 4), 5, (1.0, "x", 1.0)])
def test_other_values_are_refused(wrong):
    with pytest.raises(ValueError, match=r"white_balance is .* expected none, grey-skin, or the linear"):
        ProcessOptions(white_balance=wrong)


def test_a_result_says_what_was_done(coarse_scan, tmp_path):
    budget = s2a.Budget(evaluations=20)
    asked = {"size": 64, "quality": "draft", "budget": budget, "pictures": False}
    plain = s2a.process(coarse_scan[0], skip=["albedo"], **asked)
    result = s2a.process(coarse_scan[0], tmp_path, white_balance="0.5, 1, 2", **asked)
    ratio = result.geometry_image.texture_linear / np.maximum(plain.geometry_image.texture_linear, 1e-6)
    assert_allclose(np.median(ratio[plain.geometry_image.seen], 0), [2, 1, 0.5], rtol=1e-4)
    assert read_json(result.out / "result.json")["options"]["white_balance"] == [0.5, 1, 2]
    (done,) = result.plan.of_stage("white_balance")
    assert done.evidence == "red x 2.000, green x 1.000, blue x 0.500"
    assert plain.options["white_balance"] == "none"
