"""Pictures of glasses with lenses: magnification, light, photographs, and what may go wrong."""

import numpy as np
import pytest
from helpers.eyeglasses import glazed
from helpers.lens_frames import half_rimless
from helpers.plates import CORNERS, plate
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import (
    DistantLights,
    LensMaterial,
    LensPictureOptions,
    Surface,
    insert_lenses,
    refract,
)
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import camera_centers, look_at, pixel_directions, pixel_grid, project
from scan2albedo.synthetic import GlassesShape, eyeglasses

FLAT = eyeglasses(shape=GlassesShape(wrap_radius=1e9))
"""Both rims in one plane across z."""
BENT = eyeglasses(1)
SHAPE = (240, 320)
NOISE = np.random.default_rng(0).random((*SHAPE, 3))
"""A photograph."""
DARK = (0.1, 0.1, 0.1)
FRONT = DistantLights([[0, 0, 1]], [np.pi])
SUNGLASSES = LensMaterial(-3.0, (0.3, 0.2, 0.1), alpha=0.5, beta=0.2, fresnel=True)
ONE_RAY = LensPictureOptions(supersampling=1)


def wavy(z=-30.0, half=80.0, **finish):
    """A wall with a smooth texture."""
    y, x = np.mgrid[:200, :200] / 5
    texture = 0.5 + 0.48 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], -1)
    return plate(half, z, uv=(CORNERS + 1) / 2, texture_linear=texture, **finish)


WAVY = wavy()


def room(seed=0):
    return np.random.default_rng(seed).random((8, 16, 3))


def before(glasses):
    """A camera in front of the left lens."""
    center = glasses.lens_centers[0]
    return look_at(center + [0, 0, 600.0], center, focal_px=1500.0, shape=SHAPE)


FACING = look_at([0, 0, 600], [0, 0, 0], focal_px=1000, shape=SHAPE)
"""A camera in front of both lenses."""


def insert(lenses, glasses=BENT, frame=None, **options):
    given = {"keypoints": glasses.keypoints, "surfaces": [WAVY], "camera": before(glasses), **options}
    if "picture_linear" not in given:
        given = {"shape": SHAPE, **given}
        if "environment_linear" not in given:
            given = {"lights": FRONT, **given}
    return insert_lenses(frame or Surface(glasses.vertices, glasses.faces, DARK), lenses=lenses, **given)


def test_clear_plane_glass_is_not_seen():
    for options in ({}, {"environment_linear": room()}):
        picture = insert(LensMaterial(), **options)
        assert (picture.lens == 0).sum() > 5000
        assert_array_equal(picture.image_linear, picture.without_lenses_linear)
    for rays in (1, 2, 3):
        options = LensPictureOptions(supersampling=rays)
        picture = insert(LensMaterial(), picture_linear=NOISE, options=options)
        assert_array_equal(picture.image_linear, NOISE)
        assert not picture.unknown.any()


def test_a_photograph_takes_other_mirror_images():
    dark = insert(SUNGLASSES, picture_linear=NOISE)
    assert "no environment" in dark.notes[-1]
    lit = insert(SUNGLASSES, environment_linear=room(6), picture_linear=NOISE)
    assert lit.notes == dark.notes[:-1]
    assert np.abs(lit.image_linear - dark.image_linear).max() > 0.1


def test_an_even_room_is_mirrored_evenly_and_painted_lenses_take_its_light():
    options = {"surfaces": (), "environment_linear": np.full((4, 8, 3), 2.0)}
    mirror = insert(LensMaterial(beta=1.0), **options)
    shown = mirror.image_linear[mirror.lens >= 0]
    assert np.isclose(shown, 2, rtol=0, atol=1e-12).all(1).mean() > 0.85
    assert shown.max() <= 2 + 1e-12
    plate_ = insert(LensMaterial(tint_linear=(0.5, 1, 0), alpha=1.0), options=ONE_RAY, **options)
    painted = plate_.image_linear[plate_.lens >= 0]
    # The frame itself takes some of the light.
    assert_allclose(np.median(painted, axis=0), [1.0, 2.0, 0], rtol=0.12)
    assert (painted.max(0) <= np.array([1.0, 2, 0]) * 1.03).all()


@pytest.mark.parametrize("dioptres", [-8.0, 3.0])
def test_a_photograph_shows_what_the_drawn_scene_shows(dioptres):
    options = {"lenses": LensMaterial(dioptres=dioptres), "surfaces": [wavy(-25.0, 150.0)]}
    # From so high that the frame's shadow falls below the picture.
    drawn = insert(lights=DistantLights([[0, 4, 1]], [4 * np.pi]), **options)
    photograph = drawn.without_lenses_linear
    taken = insert(picture_linear=photograph, **options)
    assert_array_equal(taken.without_lenses_linear, photograph)
    lens, unknown = taken.lens >= 0, taken.unknown
    shown = lens & ~unknown
    error = np.abs(taken.image_linear - drawn.image_linear).max(2)
    assert np.quantile(error[shown], 0.97) < 0.01
    assert shown.sum() > 3000
    if dioptres < 0:
        # What comes into view at the rim lies behind the frame in the photograph.
        assert 300 < unknown.sum() < 0.5 * lens.sum()
        assert "guesses" in taken.notes[-1]
        assert np.quantile(error[unknown], 0.5) < 0.15
    assert unknown[~lens].mean() < 0.01


def test_pixels_that_see_no_lens_stay_as_photographed():
    camera = look_at([60, 30, 500], [0, 0, 0], focal_px=500, shape=SHAPE)
    picture = insert(SUNGLASSES, picture_linear=NOISE, camera=camera)
    changed = (picture.image_linear != NOISE).any(2)
    assert changed.sum() > 1000
    assert changed[picture.lens >= 0].all()
    row, column = np.nonzero(picture.lens >= 0)
    changed[row.min() - 1 : row.max() + 2, column.min() - 1 : column.max() + 2] = False
    assert not changed.any()


def test_a_photographs_background_is_far_away():
    photograph = np.stack([*np.indices(SHAPE), np.ones(SHAPE)], -1) / 240
    camera = before(FLAT)
    picture = insert(LensMaterial(dioptres=2.0), FLAT, surfaces=(), picture_linear=photograph)
    known = (picture.lens == 0) & ~picture.unknown
    assert known.sum() > 3000
    center = camera_centers(camera[None])[0]
    directions = pixel_directions(camera, pixel_grid(SHAPE)[known.ravel()])
    bent = refract(picture.lenses[0].optics, center, center + directions).directions
    at, _ = project(camera, center + bent)
    expected = np.column_stack([at[:, ::-1], np.ones(len(at))]) / 240
    error = np.abs(picture.image_linear[known] - expected).max(1)
    # Pixels on the lens's edge are means with what lies beside it.
    assert np.quantile(error, 0.9) < 1e-3


def test_each_lens_has_its_own_power_and_an_empty_rim_none():
    both = insert((LensMaterial(-6.0), LensMaterial(4.0)), camera=FACING)
    assert [lens.optics.dioptres for lens in both.lenses] == [-6, 4]
    left = insert((LensMaterial(-6.0), None), camera=FACING)
    assert [lens.side for lens in left.lenses] == [0]
    assert set(left.lens.ravel().tolist()) == {-1, 0}
    # +x is the wearer's left, which this camera sees on the right.
    assert np.nonzero(left.lens == 0)[1].min() > 160
    assert_array_equal(left.image_linear[:, 160:], both.image_linear[:, 160:])
    assert_array_equal(left.image_linear[:, :150], left.without_lenses_linear[:, :150])
    none = insert((None, None), camera=FACING)
    assert_array_equal(none.image_linear, none.without_lenses_linear)
    assert "no lens is given" in none.notes[0]


def test_a_half_rimless_frame_holds_a_lens():
    picture = insert((LensMaterial(-5.0), None), frame=Surface(BENT.vertices, half_rimless(BENT)))
    assert "points of its rim come from its key points" in picture.notes[0]
    assert (picture.lens == 0).sum() > 5000


def test_the_frames_own_glass_is_left_out_where_a_lens_goes():
    material = LensMaterial(-4.0)
    bare = insert(material, camera=FACING)
    vertices, faces = glazed(BENT)
    textured = {"uv": np.zeros((len(faces), 3, 2)), "texture_linear": np.full((4, 4, 3), DARK)}
    for finish in ({"albedo_linear": DARK}, textured):
        frame = Surface(vertices, faces, **finish)
        both = insert(material, frame=frame, camera=FACING)
        assert_array_equal(both.lens, bare.lens)
        # Rims are measured to 0.2 mm, whatever glass they hold.
        assert_allclose(both.image_linear, bare.image_linear, atol=1e-9)
        assert ["own glass there, 144 faces, is left out" in note for note in both.notes] == [True] * 2
    # Where no lens goes, the glass stays.
    left = insert((material, None), frame=frame, camera=FACING)
    assert len(left.notes) == 1
    apart = np.abs(left.image_linear - bare.image_linear).max(2)
    assert (apart[bare.lens == 1] > 1e-3).mean() > 0.5


def test_glass_of_one_piece_with_the_rim_is_told():
    vertices, faces = glazed(BENT, (0,))
    first, rim = len(BENT.vertices), BENT.keypoint_vertices[3]
    # One face joins each sheet to the rim.
    joined = np.concatenate([faces, [[rim, first, first + 1], [rim, first + 73, first + 74]]])
    picture = insert((LensMaterial(), None), frame=Surface(vertices, joined), shape=(60, 80))
    assert any("the left lens: the frame covers it" in note for note in picture.notes)


def test_a_camera_that_sees_no_lens_leaves_the_picture_alone_and_says_so():
    center = insert(LensMaterial(-8.0), FLAT).lenses[0].optics.center
    in_plane = look_at(center + [0, 400, 0], center + [0, 0, 1e-9], focal_px=800, shape=SHAPE)
    for camera in (look_at([0, 0, 600], [600, 0, 600], focal_px=800, shape=SHAPE), in_plane):
        picture = insert(LensMaterial(-8.0), FLAT, picture_linear=NOISE, camera=camera)
        assert_array_equal(picture.image_linear, NOISE)
        assert (picture.lens == -1).all()
        assert "the left lens: no pixel sees it" in picture.notes


def test_a_frame_may_leave_the_picture():
    wide = insert(SUNGLASSES)
    # The same camera's picture, cut to its upper left part.
    cut = insert(SUNGLASSES, shape=(110, 170))
    assert_array_equal(cut.lens, wide.lens[:110, :170])
    assert_allclose(cut.image_linear[:-1, :-1], wide.image_linear[:109, :169], atol=1e-12)


def test_more_rays_smooth_the_edges_only():
    rough, smooth = (
        insert(LensMaterial(-4.0), surfaces=[plate(80.0, -30.0)], options=LensPictureOptions(supersampling=n))
        for n in (1, 4)
    )
    differs = (rough.image_linear != smooth.image_linear).any(2)
    assert 0.005 < differs.mean() < 0.1
    assert_array_equal(rough.lens, smooth.lens)


def test_edges_within_one_surface_are_smoothed_too():
    near, far = plate(100.0, -20.0), plate(300.0, -120.0)
    corners, faces = join([(near.vertices + [100.3, 0, 0], near.faces), (far.vertices, far.faces)])
    steps = Surface(corners, faces, np.repeat([1.0, 0.0], 12).reshape(8, 3))
    below = look_at([0, -60, 600], [0, -60, 0], focal_px=900, shape=(20, 60))
    light = DistantLights([[0, -9, 1]], [9])
    picture = insert((None, None), surfaces=[steps], camera=below, shape=(20, 60), lights=light)
    edge = picture.image_linear[:, 27:33, 0]
    assert ((edge > 0.1 * edge.max()) & (edge < 0.9 * edge.max())).any(1).all()


def test_what_a_mirror_shows_and_the_photograph_does_not_is_said():
    behind_camera = plate(2000.0, 900.0, albedo_linear=(0.25, 0.25, 0.25))
    mirror = LensMaterial(beta=1.0, front_radius_mm=500.0)
    picture = insert(mirror, surfaces=[behind_camera], picture_linear=NOISE)
    inner = (picture.lens >= 0) & np.isclose(picture.image_linear, 0.25).all(2)
    assert inner.sum() > 0.8 * (picture.lens >= 0).sum()
    assert picture.unknown[inner].all()


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"picture_linear": None}, ValueError, "either shape"),
        ({"shape": SHAPE}, ValueError, "either shape"),
        ({"picture_linear": None, "shape": SHAPE}, ValueError, "without light"),
        ({"lights": FRONT}, ValueError, "own light"),
        ({"picture_linear": None, "shape": (0, 5), "lights": FRONT}, ValueError, "pixels"),
        ({"picture_linear": np.zeros(SHAPE)}, ValueError, r"picture_linear is .* expected \(H, W, 3\)"),
        ({"picture_linear": NOISE + np.nan}, EyeglassesError, "picture_linear: .* NaN"),
        ({"keypoints": np.zeros((5, 3))}, ValueError, r"keypoints is \(5, 3\)"),
        ({"lenses": (LensMaterial(),)}, ValueError, "one material or"),
        ({"lens_centers": np.zeros(3)}, ValueError, "lens_centers"),
        ({"camera": np.zeros((3, 3))}, ValueError, "cameras"),
    ],
)
def test_what_is_not_clear_is_refused(changes, kind, words):
    with pytest.raises(kind, match=words):
        insert(**{"lenses": LensMaterial(), "surfaces": (), "picture_linear": NOISE, **changes})


@pytest.mark.parametrize("name", ["supersampling", "light_count"])
def test_settings_of_nothing_are_refused(name):
    with pytest.raises(ValueError, match=name):
        LensPictureOptions(**{name: 0})
