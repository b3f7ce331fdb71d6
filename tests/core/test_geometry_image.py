"""The cameras of a geometry image: directions in closed form, and what is refused."""

import numpy as np
import pytest

from scan2albedo.core.geometry_image import NO_CAMERA, GeometryImage
from scan2albedo.errors import GeometryImageError

SHAPE = 3, 4
MASK = np.arange(12).reshape(SHAPE) != 5


def image(**fields):
    position = np.random.default_rng(0).normal(0, 50, (*SHAPE, 3))
    normal = np.broadcast_to([0.0, 0.0, 1.0], (*SHAPE, 3))
    return GeometryImage(position, normal, MASK, **fields)


def test_texels_look_toward_their_camera_and_others_along_the_view_direction():
    camera = np.full(SHAPE, NO_CAMERA)
    camera[0] = 0
    camera[1] = 1
    places = np.array([[0, 0, 900.0], [700, 0, 600]])
    made = image(camera=camera, camera_positions=places)
    toward = np.zeros((*SHAPE, 3))
    toward[MASK] = made.toward_camera((0, 0, 1))
    for row, place in enumerate(places):
        away = place - made.position[row]
        expected = away / np.linalg.norm(away, axis=1, keepdims=True)
        assert toward[row][MASK[row]] == pytest.approx(expected[MASK[row]], abs=1e-12)
    assert (toward[2] == [0, 0, 1]).all()


def test_without_cameras_one_direction_serves_all_texels():
    assert (image().toward_camera((0, 0.6, 0.8)) == [0, 0.6, 0.8]).all()
    assert "cameras" not in image().figures()


def test_a_texel_in_the_camera_itself_gives_no_nan():
    made = image()
    at = image(camera=np.zeros(SHAPE, int), camera_positions=made.position[:1, 0])
    assert np.isfinite(at.toward_camera((0, 0, 1))).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"camera": np.zeros(SHAPE)}, "belong together"),
        ({"camera_positions": np.zeros((1, 3))}, "belong together"),
        ({"camera": np.zeros((2, 2)), "camera_positions": np.zeros((1, 3))}, "shape"),
        ({"camera": np.zeros(SHAPE), "camera_positions": np.zeros(3)}, r"expected \(K, 3\)"),
        ({"camera": np.zeros(SHAPE), "camera_positions": np.full((1, 3), np.nan)}, "finite"),
        ({"camera": np.full(SHAPE, 2), "camera_positions": np.zeros((2, 3))}, "number 2 of 2"),
        ({"occluder": (np.zeros((3, 2)), [[0, 1, 2]])}, r"occluder: its vertices have shape \(3, 2\)"),
        ({"skin": np.full(SHAPE, 1.1)}, "skin holds values beyond 0 to 1"),
        ({"skin": np.full(SHAPE, -1)}, "skin holds values beyond 0 to 1"),
        ({"specular_scale": np.full(SHAPE, np.nan)}, "specular_scale holds NaN"),
    ],
)
def test_what_does_not_fit_is_refused(fields, message):
    with pytest.raises(GeometryImageError, match=message):
        image(**fields)
