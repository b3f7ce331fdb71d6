"""Vertices are looked up where cameras see and flashes light them: against a scene in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.plates import plate
from numpy.testing import assert_allclose
from worlds.two_balls import (
    BALL,
    BALL_RADIUS,
    first_hit,
    radiance_at,
    unit,
)

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import (
    CaptureRig,
    OlatImages,
    OlatOptions,
    VertexSamples,
    extract_olat,
    sample_vertices,
)
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

NOISELESS = OlatOptions(noise=1e-5, saturation=np.inf)


@pytest.fixture(scope="module")
def olat(scene):
    return extract_olat(scene.flash, scene.room, options=NOISELESS)


@pytest.fixture(scope="module")
def look_up(scene, olat):
    """`sample_vertices` of the scene, but for what is given."""

    def call(olat=olat, rig=scene.rig, **given):
        mesh = {"vertices": scene.vertices, "faces": scene.faces, "normals": scene.normals} | given
        return sample_vertices(olat, rig, **mesh)

    return call


@pytest.fixture(scope="module")
def samples(look_up):
    return look_up()


def places(scene):
    """Camera and flash of each picture."""
    return zip(scene.rig.camera_positions, scene.rig.light_positions, strict=True)


def truly_seen_and_lit(scene):
    """(J, V) of the large ball's vertices: no ball between them and camera, nor flash."""
    points = scene.vertices[scene.head]
    clear = []
    for camera, light in places(scene):
        ways = [unit(place - points) for place in (camera, light)]
        facing = [(scene.normals[scene.head] * way).sum(1) for way in ways]
        free = [~np.isfinite(first_hit(points, way, BALL, BALL_RADIUS)) for way in ways]
        clear.append((facing[0] > 0.1) & (facing[1] > 0) & free[0] & free[1])
    return np.stack(clear)


def test_observations_are_the_radiance_and_nothing_hidden_or_in_shadow_is_sampled(scene, samples):
    true = truly_seen_and_lit(scene)
    found = samples.valid.all(-1)[:, scene.head]
    assert not (found & ~true).any()
    assert found.sum() > 0.8 * true.sum()
    for observed, here, place in zip(samples.observed_linear, found, places(scene), strict=True):
        expected = radiance_at(scene.vertices[scene.head], scene.normals[scene.head], *place)
        error = np.abs(observed[scene.head] - expected)[here]
        assert np.median(error) < 2e-4
        assert error.max() < 0.02


def test_the_margin_keeps_edges_out(scene, look_up, monkeypatch):
    """Without it pixels of the ball before the face, or of what lies behind, mix into vertices beside it."""
    worst = {}
    for margin in (0.0, 1.5):
        monkeypatch.setattr(VertexVisibility.seen, "__defaults__", (margin,))
        found = look_up()
        worst[margin] = max(
            np.abs(found.observed_linear[j] - radiance_at(scene.vertices, scene.normals, *place))[
                found.valid[j].all(-1) & scene.head
            ].max()
            for j, place in enumerate(places(scene))
        )
    assert worst[1.5] < 0.5 * worst[0.0]


def test_sampling_is_the_same_far_from_the_origin(scene, look_up, samples):
    shift = np.array([3000.0, -2000, 5000])
    cameras = scene.rig.cameras.copy()
    cameras[:, :, 3] -= cameras[:, :, :3] @ shift
    rig = replace(scene.rig, cameras=cameras, light_positions=scene.rig.light_positions + shift)
    moved = look_up(rig=rig, vertices=scene.vertices + shift)
    assert (moved.valid == samples.valid).mean() > 0.9999
    both = moved.valid & samples.valid
    assert_allclose(moved.observed_linear[both], samples.observed_linear[both], atol=1e-6)


def test_a_bad_pixel_takes_its_neighbours_channel_only(look_up, olat, samples):
    valid = olat.valid.copy()
    valid[:, 80, 90, 1] = False
    found = look_up(replace(olat, valid=valid))
    lost = samples.valid & ~found.valid
    assert 0 < lost.sum() < 300
    assert not lost[..., [0, 2]].any()
    assert (found.observed_linear[lost] == 0).all()


def test_sigma_follows_the_weights_of_pixels_where_the_position_is_known(look_up, olat, monkeypatch):
    monkeypatch.setattr("scan2albedo.reflectance.vertex_samples._POSITION_SIGMA_PX", 0.0)
    found = look_up()
    sigma = olat.sigma[olat.valid].astype(float)
    assert found.sigma[found.valid].max() <= sigma.max() * (1 + 1e-6)
    assert found.sigma[found.valid].min() >= 0.5 * sigma.min()


def test_sigma_grows_with_the_slope_of_the_picture(monkeypatch):
    # One picture whose light rises by 0.02 a pixel to the right, of a square seen from straight ahead.
    linear = 0.02 * np.tile(np.arange(41, dtype=np.float32)[:, None], (1, 41, 1, 3))
    sigma, valid = np.full_like(linear, 1e-6), np.ones(linear.shape, bool)
    olat = OlatImages(linear, sigma, valid, ~valid)
    camera = np.array([[[400.0, 0, -20, 12000], [0, -400, -20, 12000], [0, 0, -1, 600]]])
    rig = CaptureRig(camera, np.array([[0.0, 0, 600]]), np.zeros(1, np.int64))
    square = np.vstack([plate(20, 0.0).vertices, [3, 4, 0]])
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    for spread in (0.0, 0.3, 1.0):
        monkeypatch.setattr("scan2albedo.reflectance.vertex_samples._POSITION_SIGMA_PX", spread)
        found = sample_vertices(olat, rig, square, faces)
        assert found.valid[0, 4].all()
        assert found.sigma[0, 4] == pytest.approx(np.full(3, np.hypot(spread * 0.02, 1e-6)), rel=0.3)


def test_grazing_views_and_lights_are_left_out(scene, look_up, samples, monkeypatch):
    monkeypatch.setattr("scan2albedo.reflectance.vertex_samples.VIEW_COSINE", 0.5)
    found = look_up()
    assert not (found.valid & ~samples.valid).any()
    for j, (camera, light) in enumerate(places(scene)):
        here = found.valid[j].any(-1)
        for place, cosine in ((camera, 0.5), (light, 0.0)):
            assert ((scene.normals * unit(place - scene.vertices)).sum(1)[here] > cosine).all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"normals": np.zeros((3, 3))}, ValueError, "normals is"),
        ({"faces": np.zeros((0, 3), int)}, ReflectanceError, "no triangles"),
        ({"faces": np.full((1, 3), 10**6)}, ReflectanceError, "refer to vertices"),
        ({"faces": np.zeros((4,), int)}, ReflectanceError, "its faces have shape"),
        ({"reference_distance_mm": 0}, ValueError, "reference_distance_mm"),
        ({"reference_distance_mm": np.nan}, ValueError, "reference_distance_mm"),
        ({"reference_distance_mm": np.inf}, ValueError, "reference_distance_mm"),
    ],
)
def test_what_does_not_fit_is_refused(look_up, change, error, message):
    with pytest.raises(error, match=message):
        look_up(**change)


def test_normals_that_are_not_unit_and_another_number_of_cameras_are_refused(scene, look_up):
    rig = CaptureRig(scene.rig.cameras[:3], scene.rig.light_positions[:3], scene.rig.light[:3])
    for given, words in (
        ({"normals": 2 * scene.normals}, "of length 2"),
        ({"rig": rig}, "20 pictures but 3 cameras"),
    ):
        with pytest.raises(ReflectanceError, match=words):
            look_up(**given)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lobes": np.full((2, 3, 4), np.inf)}, "lobes are not finite"),
        ({"sigma": np.ones((2, 3))}, r"sigma is \(2, 3\)"),
        ({"observed_linear": np.ones((2, 3))}, r"expected \(J, V, 3\)"),
        ({"valid": np.ones((2, 3, 3))}, "expected bool"),
        ({"light": np.array([0, -1])}, "light is -1 at least"),
    ],
)
def test_samples_that_do_not_fit_are_refused(changes, message):
    ones = np.ones((2, 3, 3))
    good = VertexSamples(ones, ones, ones > 0, np.ones((2, 3, 4)), np.arange(2))
    with pytest.raises(ReflectanceError, match=message):
        replace(good, **changes)
