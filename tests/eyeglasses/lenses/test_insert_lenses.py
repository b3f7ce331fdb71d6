"""Pictures of glasses with lenses: magnification, light, photographs, and what may go wrong."""

import numpy as np
import pytest
from helpers.eyeglasses import angle_deg, conjugate_directions, glazed
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
from scan2albedo.geometry.pinhole import (
    camera_centers,
    look_at,
    normalized_cameras,
    pixel_directions,
    pixel_grid,
    project,
)
from scan2albedo.synthetic import GlassesShape, eyeglasses

FLAT = eyeglasses(shape=GlassesShape(wrap_radius=1e9))
"""Both rims in one plane across z."""
BENT = eyeglasses(1)
SHAPE = (240, 320)
FRONT = DistantLights([[0, 0, 1]], [np.pi])
SUNGLASSES = LensMaterial(-3.0, (0.3, 0.2, 0.1), alpha=0.5, beta=0.2, fresnel=True)


def frame_of(glasses, **finish):
    return Surface(glasses.vertices, glasses.faces, **{"albedo_linear": (0.1, 0.1, 0.1), **finish})


def wall(z, texture=None, half=80.0, **finish):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    if texture is not None:
        finish |= {"uv": (corners + 1) / 2, "texture_linear": texture}
    return Surface(np.column_stack([half * corners, np.full(4, z)]), [[0, 1, 2], [0, 2, 3]], **finish)


def waves(seed=0, size=200):
    """A smooth texture."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size * 2 * np.pi
    kx, ky, phase = rng.uniform(2, 7, (2, 3)), rng.uniform(-6, 6, (2, 3)), rng.uniform(0, 6, (2, 3))
    parts = np.sin(kx * x[..., None, None] + ky * y[..., None, None] + phase)
    return 0.5 + 0.24 * parts.sum(2)


def room(seed=0):
    return np.random.default_rng(seed).random((8, 16, 3))


def before(glasses, side=0, distance=600.0, focal_px=1500.0, shape=SHAPE):
    """A camera in front of one lens."""
    center = glasses.lens_centers[side]
    return look_at(center + [0, 0, distance], center, focal_px=focal_px, shape=shape)


def insert(glasses, lenses, *, surfaces=(), **options):
    settings = {"shape": SHAPE, "camera": before(glasses), **options}
    if "picture_linear" in settings:
        del settings["shape"]
    elif "lights" not in settings and "environment_linear" not in settings:
        settings["lights"] = FRONT
    return insert_lenses(frame_of(glasses), glasses.keypoints, lenses, surfaces=surfaces, **settings)


def test_clear_plane_glass_is_not_seen():
    for options in ({"lights": FRONT}, {"environment_linear": room()}):
        picture = insert(BENT, LensMaterial(), surfaces=[wall(-30.0, waves())], **options)
        assert (picture.lens == 0).sum() > 5000
        assert_array_equal(picture.image_linear, picture.without_lenses_linear)
    photograph = np.random.default_rng(0).random((*SHAPE, 3))
    for rays in (1, 2, 3):
        picture = insert(
            BENT,
            LensMaterial(),
            surfaces=[wall(-30.0)],
            picture_linear=photograph,
            options=LensPictureOptions(supersampling=rays),
        )
        assert_array_equal(picture.image_linear, photograph)
        assert not picture.unknown.any()


def test_pictures_under_two_environments_add_up():
    materials = (SUNGLASSES, LensMaterial(2.0, (0.9, 0.5, 0.2), alpha=0.6, beta=0.1, tinting="filter"))
    camera = look_at([-150, 80, 500], [0, 0, 0], focal_px=400, shape=(120, 160))

    def render(environment):
        return insert(
            BENT,
            materials,
            surfaces=[wall(-30.0, waves(), roughness_rad=0.4, specular=0.1)],
            camera=camera,
            shape=(120, 160),
            environment_linear=environment,
            lights=DistantLights.from_environment(environment, 16, "even"),
        )

    first, second, both = render(room(1)), render(3 * room(2)), render(room(1) + 3 * room(2))
    assert {0, 1} <= set(both.lens.ravel().tolist())
    for name in ("image_linear", "without_lenses_linear"):
        apart = getattr(first, name) + getattr(second, name)
        assert_allclose(getattr(both, name), apart, atol=1e-12)


def test_a_photograph_takes_other_mirror_images():
    photograph = np.random.default_rng(0).random((*SHAPE, 3))
    options = {"picture_linear": photograph, "surfaces": [wall(-30.0)]}
    dark = insert(BENT, SUNGLASSES, **options)
    assert "no environment" in dark.notes[-1]
    lit = insert(BENT, SUNGLASSES, environment_linear=room(6), **options)
    assert lit.notes == dark.notes[:-1]
    assert np.abs(lit.image_linear - dark.image_linear).max() > 0.1


def test_an_even_room_is_mirrored_evenly_and_painted_lenses_take_its_light():
    grey = np.full((4, 8, 3), 2.0)
    mirror = insert(BENT, LensMaterial(beta=1.0), environment_linear=grey)
    lens = mirror.lens >= 0
    inner = lens & (np.abs(mirror.image_linear - 2).max(2) < 1e-12)
    assert inner.sum() > 0.85 * lens.sum()
    assert mirror.image_linear[lens].max() <= 2 + 1e-12
    plate = insert(
        BENT,
        LensMaterial(tint_linear=(0.5, 1, 0), alpha=1.0),
        environment_linear=grey,
        options=LensPictureOptions(supersampling=1),
    )
    painted = plate.image_linear[plate.lens >= 0]
    # The frame itself takes some of the light.
    assert_allclose(np.median(painted, axis=0), [1.0, 2.0, 0], rtol=0.12)
    assert (painted.max(0) <= np.array([1.0, 2, 0]) * 1.03).all()


@pytest.mark.parametrize("dioptres", [-8.0, 3.0])
def test_a_photograph_shows_what_the_drawn_scene_shows(dioptres):
    surfaces = [wall(-25.0, waves(4), half=150.0)]
    material = LensMaterial(dioptres=dioptres)
    # From so high that the frame's shadow falls below the picture.
    lights = DistantLights([[0, 4, 1]], [4 * np.pi])
    drawn = insert(BENT, material, surfaces=surfaces, lights=lights)
    photograph = drawn.without_lenses_linear
    taken = insert(BENT, material, surfaces=surfaces, picture_linear=photograph)
    assert_array_equal(taken.without_lenses_linear, photograph)
    shown = (taken.lens >= 0) & ~taken.unknown
    error = np.abs(taken.image_linear - drawn.image_linear).max(2)
    assert np.quantile(error[shown], 0.97) < 0.01
    assert shown.sum() > 3000
    if dioptres < 0:
        # What comes into view at the rim lies behind the frame in the photograph.
        assert 300 < taken.unknown.sum() < 0.5 * (taken.lens >= 0).sum()
        assert "guesses" in taken.notes[-1]
        assert np.quantile(error[taken.unknown], 0.5) < 0.15
    assert not taken.unknown[taken.lens < 0].any() or taken.unknown[taken.lens < 0].mean() < 0.01


def test_pixels_that_see_no_lens_stay_as_photographed():
    photograph = np.random.default_rng(1).random((*SHAPE, 3))
    camera = look_at([60, 30, 500], [0, 0, 0], focal_px=500, shape=SHAPE)
    picture = insert(BENT, SUNGLASSES, surfaces=[wall(-30.0)], picture_linear=photograph, camera=camera)
    changed = (picture.image_linear != photograph).any(2)
    assert changed.sum() > 1000
    far = np.ones(SHAPE, bool)
    row, column = np.nonzero(picture.lens >= 0)
    far[row.min() - 1 : row.max() + 2, column.min() - 1 : column.max() + 2] = False
    assert not changed[far].any()
    assert changed[picture.lens >= 0].all()


def test_a_photographs_background_is_far_away():
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    photograph = np.stack([rows / 240, columns / 320, np.ones(SHAPE)], -1)
    material, camera = LensMaterial(dioptres=2.0), before(FLAT)
    picture = insert(FLAT, material, picture_linear=photograph)
    known = (picture.lens == 0) & ~picture.unknown
    assert known.sum() > 3000
    center = camera_centers(camera[None])[0]
    pixels = pixel_grid(SHAPE)[known.ravel()]
    directions = pixel_directions(camera, pixels)
    bent = refract(picture.lenses[0].optics, center, center + directions).directions
    at, _ = project(camera, center + bent)
    expected = np.column_stack([at[:, 1] / 240, at[:, 0] / 320, np.ones(len(at))])
    error = np.abs(picture.image_linear[known] - expected).max(1)
    # Pixels on the lens's edge are means with what lies beside it.
    assert np.quantile(error, 0.9) < 1e-3


def test_each_lens_has_its_own_power_and_an_empty_rim_none():
    surfaces = [wall(-30.0, waves())]
    camera = look_at([0, 0, 600], [0, 0, 0], focal_px=1000, shape=SHAPE)
    both = insert(BENT, (LensMaterial(-6.0), LensMaterial(4.0)), surfaces=surfaces, camera=camera)
    assert [lens.optics.dioptres for lens in both.lenses] == [-6, 4]
    left = insert(BENT, (LensMaterial(-6.0), None), surfaces=surfaces, camera=camera)
    assert [lens.side for lens in left.lenses] == [0]
    assert set(left.lens.ravel().tolist()) == {-1, 0}
    # +x is the wearer's left, which this camera sees on the right.
    columns = np.nonzero(left.lens == 0)[1]
    assert columns.min() > 160
    half = slice(160, None)
    assert_array_equal(left.image_linear[:, half], both.image_linear[:, half])
    assert_array_equal(left.image_linear[:, :150], left.without_lenses_linear[:, :150])
    none = insert(BENT, (None, None), surfaces=surfaces, camera=camera)
    assert_array_equal(none.image_linear, none.without_lenses_linear)
    assert "no lens is given" in none.notes[0]


def test_a_monocle_and_a_half_rimless_frame():
    center = BENT.lens_centers[0]
    middle = BENT.vertices[BENT.faces].mean(1)
    monocle = Surface(BENT.vertices, BENT.faces[middle[:, 0] > 8])
    marks = BENT.keypoints.copy()
    marks[[n.startswith("right") for n in BENT.names]] = np.nan
    camera, lens = before(BENT), LensMaterial(-5.0)
    options = {"surfaces": [wall(-30.0, waves())], "camera": camera, "shape": SHAPE, "lights": FRONT}
    picture = insert_lenses(monocle, marks, (lens, None), **options)
    assert (picture.lens == 0).sum() > 5000
    lower = (middle[:, 1] < -6) & (np.abs(middle[:, 0] - center[0]) < 45) & (np.abs(middle[:, 2]) < 20)
    half = Surface(BENT.vertices, BENT.faces[~lower])
    picture = insert_lenses(half, BENT.keypoints, (lens, None), **options)
    assert "points of its rim come from its key points" in picture.notes[0]
    assert (picture.lens == 0).sum() > 5000


def test_the_frames_own_glass_is_left_out_where_a_lens_goes():
    options = {"surfaces": [wall(-30.0, waves())], "shape": SHAPE, "lights": FRONT}
    camera = look_at([0, 0, 600], [0, 0, 0], focal_px=1000, shape=SHAPE)
    material = LensMaterial(-4.0)
    bare = insert(BENT, material, camera=camera, **options)
    vertices, faces = glazed(BENT)
    uv = np.random.default_rng(0).random((len(faces), 3, 2))
    for finish in ({"albedo_linear": (0.1, 0.1, 0.1)}, {"uv": uv, "texture_linear": np.full((4, 4, 3), 0.1)}):
        frame = Surface(vertices, faces, **finish)
        both = insert_lenses(frame, BENT.keypoints, material, camera=camera, **options)
        assert_array_equal(both.lens, bare.lens)
        # Rims are measured to 0.2 mm, whatever glass they hold.
        assert_allclose(both.image_linear, bare.image_linear, atol=1e-9)
        assert [note for note in both.notes if "own glass there, 144 faces, is left out" in note] == list(
            both.notes
        )
        assert len(both.notes) == 2
    # Where no lens goes, the glass stays.
    left = insert_lenses(frame, BENT.keypoints, (material, None), camera=camera, **options)
    assert len(left.notes) == 1
    right = bare.lens == 1
    assert (np.abs(left.image_linear - bare.image_linear).max(2) > 1e-3)[right].mean() > 0.5


def test_glass_of_one_piece_with_the_rim_is_told():
    vertices, faces = glazed(BENT, (0,))
    first, rim = len(BENT.vertices), BENT.keypoint_vertices[3]
    # One face joins each sheet to the rim.
    joined = np.concatenate([faces, [[rim, first, first + 1], [rim, first + 73, first + 74]]])
    frame = Surface(vertices, joined)
    options = {"surfaces": [], "camera": before(BENT), "shape": (60, 80), "lights": FRONT}
    picture = insert_lenses(frame, BENT.keypoints, (LensMaterial(), None), **options)
    assert any("the left lens: the frame covers it" in note for note in picture.notes)


@pytest.mark.parametrize("dioptres", [-8.0, -4, -0.25, 0.25, 2, 8])
@pytest.mark.parametrize("position", [[25.0, 10, 600], [-120, 60, 420]])
def test_pictures_bend_rays_as_an_independent_thin_lens_to_1e_5_degrees(dioptres, position):
    # The wall's colour tells where a ray ends.
    half = 2000.0
    z = -30.0
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    colors = np.column_stack([corners / (2 * half) + 0.5, np.ones(4)])
    screen = Surface(np.column_stack([corners, np.full(4, z)]), [[0, 1, 2], [0, 2, 3]], colors)
    shape = (48, 64)
    camera = look_at(position, FLAT.lens_centers[0], focal_px=700, shape=shape)
    picture = insert(
        FLAT,
        LensMaterial(dioptres),
        surfaces=[screen],
        camera=camera,
        shape=shape,
        # From so high that the frame's shadow falls out of sight.
        lights=DistantLights([[0, 9, 1]], [1.0]),
        options=LensPictureOptions(supersampling=1),
    )
    lens = picture.lenses[0].optics
    seen = picture.image_linear[picture.lens == 0]
    # The frame is seen through the lens too.
    wall_ = np.isclose(seen[:, 2], np.median(seen[:, 2]), rtol=1e-9)
    seen = seen[wall_]
    ends = np.column_stack([(seen[:, :2] / seen[:, 2:] - 0.5) * 2 * half, np.full(len(seen), z)])
    matrix = normalized_cameras(camera[None])
    origin, pixels = camera_centers(matrix)[0], pixel_grid(shape)[(picture.lens == 0).ravel()][wall_]
    straight = pixel_directions(matrix[0], pixels)
    normal, center = np.asarray(lens.normal), np.asarray(lens.center)
    points = origin + ((center - origin) @ normal / (straight @ normal))[:, None] * straight
    angle = angle_deg(ends - points, conjugate_directions(origin, points, center, normal, dioptres))
    assert len(angle) > 400
    assert angle.max() <= 1e-5


@pytest.mark.parametrize("dioptres", [-20.0, 20.0])
@pytest.mark.parametrize(
    ("position", "target"),
    [
        ([0, 0, 600], [0, 0, 0]),
        ([450, 20, 300], [0, 0, 0]),
        ([0, 30, -400], [0, 0, 0]),
        ([30, 0, -12], [30, 1, 40]),
        ([0, 0, 60], [35, 0, 0]),
    ],
)
def test_strong_lenses_give_numbers_from_everywhere(dioptres, position, target):
    camera = look_at(position, target, focal_px=250, shape=(60, 80))
    material = LensMaterial(dioptres, (0.2, 0.1, 0), alpha=0.2, beta=0.2, fresnel=True)
    surfaces = [wall(-80.0, waves(), half=50)]
    picture = insert(
        BENT,
        material,
        surfaces=surfaces,
        camera=camera,
        shape=(60, 80),
        environment_linear=room(),
        options=LensPictureOptions(light_count=4),
    )
    assert (picture.lens >= 0).any()
    assert np.isfinite(picture.image_linear).all()
    assert picture.image_linear.min() >= -1e-12
    photograph = np.random.default_rng(0).random((60, 80, 3))
    taken = insert(BENT, material, surfaces=surfaces, camera=camera, picture_linear=photograph)
    assert np.isfinite(taken.image_linear).all()


def test_a_camera_that_sees_no_lens_leaves_the_picture_alone_and_says_so():
    photograph = np.random.default_rng(0).random((*SHAPE, 3))
    in_plane = insert(FLAT, LensMaterial(-8.0)).lenses[0].optics.center + [0, 400.0, 0]
    beside = look_at([0, 0, 600], [600, 0, 600], focal_px=800, shape=SHAPE)
    for camera in (beside, _overhead(in_plane)):
        picture = insert(
            FLAT, LensMaterial(-8.0), surfaces=[wall(-30.0)], picture_linear=photograph, camera=camera
        )
        assert_array_equal(picture.image_linear, photograph)
        assert (picture.lens == -1).all()
        assert "the left lens: no pixel sees it" in picture.notes


def _overhead(position):
    """A camera that looks down -y."""
    intrinsic = np.array([[800.0, 0, 160], [0, 800, 120], [0, 0, 1]])
    rotation = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    return intrinsic @ np.column_stack([rotation, -rotation @ np.asarray(position)])


def test_a_frame_may_leave_the_picture():
    wide = insert(BENT, SUNGLASSES, surfaces=[wall(-30.0, waves())])
    camera = before(BENT)
    # The same camera's picture, cut to its upper left part.
    cut = insert(BENT, SUNGLASSES, surfaces=[wall(-30.0, waves())], camera=camera, shape=(110, 170))
    assert_array_equal(cut.lens, wide.lens[:110, :170])
    assert_allclose(cut.image_linear[:-1, :-1], wide.image_linear[:109, :169], atol=1e-12)


def test_more_rays_smooth_the_edges_only():
    rough, smooth = (
        insert(BENT, LensMaterial(-4.0), surfaces=[wall(-30.0)], options=LensPictureOptions(supersampling=n))
        for n in (1, 4)
    )
    differs = (rough.image_linear != smooth.image_linear).any(2)
    assert 0.005 < differs.mean() < 0.1
    assert_array_equal(rough.lens, smooth.lens)


def test_edges_within_one_surface_are_smoothed_too():
    near, far = wall(-20.0, half=100.0), wall(-120.0, half=300.0)
    corners = np.concatenate([near.vertices + [100.3, 0, 0], far.vertices])
    albedo = np.repeat([[1.0] * 3, [0.0] * 3], 4, 0)
    steps = Surface(corners, np.concatenate([near.faces, far.faces + 4]), albedo)
    below = look_at([0, -60, 600], [0, -60, 0], focal_px=900, shape=(20, 60))
    light = DistantLights([[0, -9, 1]], [9])
    picture = insert(BENT, (None, None), surfaces=[steps], camera=below, shape=(20, 60), lights=light)
    edge = picture.image_linear[:, 27:33, 0]
    assert ((edge > 0.1 * edge.max()) & (edge < 0.9 * edge.max())).any(1).all()


def test_what_a_mirror_shows_and_the_photograph_does_not_is_said():
    photograph = np.random.default_rng(0).random((*SHAPE, 3))
    behind_camera = wall(900.0, half=2000.0, albedo_linear=(0.25, 0.25, 0.25))
    mirror = LensMaterial(beta=1.0, front_radius_mm=500.0)
    picture = insert(BENT, mirror, surfaces=[behind_camera], picture_linear=photograph)
    inner = (picture.lens >= 0) & np.isclose(picture.image_linear, 0.25).all(2)
    assert inner.sum() > 0.8 * (picture.lens >= 0).sum()
    assert picture.unknown[inner].all()


PHOTOGRAPH = np.zeros((*SHAPE, 3))


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({}, ValueError, "either shape"),
        ({"shape": SHAPE, "picture_linear": PHOTOGRAPH}, ValueError, "either shape"),
        ({"shape": SHAPE}, ValueError, "without light"),
        ({"picture_linear": PHOTOGRAPH, "lights": FRONT}, ValueError, "own light"),
        ({"shape": (0, 5), "lights": FRONT}, ValueError, "pixels"),
        ({"picture_linear": np.zeros(SHAPE)}, ValueError, r"picture_linear is .* expected \(H, W, 3\)"),
        ({"picture_linear": PHOTOGRAPH + np.nan}, EyeglassesError, "picture_linear: .* NaN"),
        ({"picture_linear": PHOTOGRAPH, "keypoints": np.zeros((5, 3))}, ValueError, r"keypoints is \(5, 3\)"),
        ({"picture_linear": PHOTOGRAPH, "lenses": (LensMaterial(),)}, ValueError, "one material or"),
        ({"picture_linear": PHOTOGRAPH, "lens_centers": np.zeros(3)}, ValueError, "lens_centers"),
        ({"picture_linear": PHOTOGRAPH, "camera": np.zeros((3, 3))}, ValueError, "cameras"),
    ],
)
def test_what_is_not_clear_is_refused(changes, kind, words):
    given = {"keypoints": BENT.keypoints, "lenses": LensMaterial(), "surfaces": [], "camera": before(BENT)}
    with pytest.raises(kind, match=words):
        insert_lenses(frame_of(BENT), **{**given, **changes})


@pytest.mark.parametrize("name", ["supersampling", "light_count"])
def test_settings_of_nothing_are_refused(name):
    with pytest.raises(ValueError, match=name):
        LensPictureOptions(**{name: 0})
