"""An unknown face from one photograph: what parts left out decide, and what stays the mean face."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from worlds.environments import generated_environment

from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    MorphableReflectanceModel,
    fit_face,
    fit_image,
    reflectance_from_albedo,
    shade_environment,
)
from scan2albedo.reflectance.albedo_details import ShadingDivided, detail_field
from scan2albedo.reflectance.face_fit import skin_hue

DIRECTIONS = distant_directions(1600)
NORMALS = DIRECTIONS[DIRECTIONS[:, 2] > 0]
VERTICES = 80 * NORMALS
FACES = Delaunay(NORMALS[:, :2] / (1 + NORMALS[:, 2:])).simplices
VIEW = np.tile([0.0, 0.0, 1.0], (len(NORMALS), 1))
SEEN = NORMALS[:, 2] > 0.15
SKIN = np.array([0.55, 0.38, 0.30])
PIGMENT = np.array([0.3, 1.0, 0.9])
WAVES = harmonics(NORMALS, 8).T


def waves(seed, orders, size):
    """Return (V,) a smooth random field of harmonics of some orders."""
    rows = slice(orders[0] ** 2, (orders[1] + 1) ** 2)
    field = np.random.default_rng(seed).normal(size=81)[rows] @ WAVES[rows]
    return size * field / field.std()


def skin(log_albedo=np.zeros((len(NORMALS), 3))):
    return reflectance_from_albedo(SKIN * np.exp(log_albedo), weights=[0.02] * 3)


BLOTCHES = waves(50, (7, 8), 0.25)[:, None] * PIGMENT


@pytest.fixture(scope="module")
def model():
    people = [skin(waves(seed, (1, 2), 0.1)[:, None] * PIGMENT) for seed in range(20)]
    return MorphableReflectanceModel.from_samples(people, components=6)


@pytest.fixture(scope="module")
def mean(model):
    return model.reconstruct(np.zeros(6)).reflectance


@pytest.fixture(scope="module")
def person(model):
    return model.reconstruct(np.full(6, 1.5)).reflectance


def is_mean(found):
    """Whether a fit kept the mean face."""
    return not found.fit.face.coefficients.any()


@pytest.fixture(scope="module")
def fitted(model, lighting):
    def fit(taken, **options):
        return fit_face(taken, model, VERTICES, FACES, lighting, **options)

    return fit


def picture(face, seed, noise=0.01, light=None, normals=NORMALS, seen=SEEN):
    light = project_environment(generated_environment(seed)) if light is None else light
    color = shade_environment(face, normals, VIEW, light).radiance_linear
    color = color * (1 + noise * np.random.default_rng(seed).normal(size=color.shape))
    return ImageObservation(color, NORMALS, VIEW, seen)


def error(found, truth):
    a, b = found.diffuse_linear[SEEN], truth.diffuse_linear[SEEN]
    return np.linalg.norm(np.sum(a * b) / np.sum(a * a) * a - b) / np.linalg.norm(b)


def test_details_that_no_model_knows_are_found(mean, fitted):
    truth = skin(BLOTCHES)
    found = fitted(picture(truth, 3))
    assert found.beats_mean
    assert found.plan.ran("reflectance.image.details")
    assert found.details is not None
    assert error(found.reflectance, truth) < 0.6 * error(mean, truth)
    assert error(found.fit.face.reflectance, truth) > 0.9 * error(mean, truth)
    assert found.relative_rmse < 0.5 * found.fit.relative_rmse


def test_the_mean_face_stays_where_nothing_is_better(mean, fitted):
    found = fitted(picture(mean, 4, noise=0.05))
    assert not found.beats_mean
    assert found.details is None
    assert is_mean(found)
    assert_array_equal(found.reflectance.diffuse_linear, mean.diffuse_linear)
    assert [step.ran for step in found.plan] == [False, False, False]
    assert all("do not predict" in step.reason and "blocks" in step.evidence for step in found.plan[:2])


def test_grey_shade_is_not_taken_for_skin(mean, fitted):
    taken = picture(mean, 5)
    shaded = taken.observed_linear * np.exp(waves(51, (7, 8), 0.15))[:, None]
    found = fitted(replace(taken, observed_linear=shaded))
    assert not found.plan.ran("reflectance.image.details")


def test_a_person_that_explains_less_than_the_mean_face_is_left_out(person, fitted, monkeypatch):
    def astray(observation, one, *rest, **options):
        found = fit_image(observation, one, *rest, **options)
        worse = one.components > 0 and observation.seen.sum() == SEEN.sum()
        return replace(found, objective=1e3) if worse else found

    assert fitted(picture(person, 3)).plan.ran("reflectance.image.person")
    monkeypatch.setattr("scan2albedo.reflectance.face_fit.fit_image", astray)
    found = fitted(picture(person, 3))
    (step,) = found.plan.of_stage("reflectance.image.person")
    assert not step.ran
    assert "worse than the mean face" in step.reason
    assert "-> 1000" in step.evidence
    assert is_mean(found)


def test_nothing_is_believed_where_the_photograph_stays_unexplained(person, fitted, monkeypatch):
    monkeypatch.setattr("scan2albedo.reflectance.face_fit.MOST_UNEXPLAINED", 0.001)
    found = fitted(picture(person, 3))
    assert "objective of all blocks" in found.plan[1].evidence
    assert found.badly_explained
    assert not found.beats_mean
    assert found.details is None
    assert is_mean(found)
    assert not any(step.ran for step in found.plan)
    assert all("too badly to believe" in step.reason for step in found.plan[:2])
    assert all("relative RMSE of all blocks" in step.evidence for step in found.plan[:2])


def test_too_little_of_a_face_gives_the_mean(fitted, monkeypatch):
    monkeypatch.setattr("scan2albedo.reflectance.face_fit._BLOCK_MM", 20.0)
    near = SEEN & (np.linalg.norm(VERTICES - [0, 0, 80], axis=1) < 15)
    found = fitted(picture(skin(), 3, seen=near))
    assert not found.beats_mean
    assert all("too little of the face" in step.reason for step in found.plan[:2])


def test_another_mesh_is_refused(model, lighting):
    taken = picture(skin(), 3)
    half = np.arange(len(VERTICES)) < len(VERTICES) // 2
    upper, elsewhere = replace(taken, seen=SEEN & half), replace(model, known=~half)
    spoilt = np.where(np.arange(len(VERTICES))[:, None] == 5, np.nan, VERTICES)
    for observed, one, mesh, words in (
        (taken, model, (VERTICES[:9], [[0, 1, 2]]), "one topology"),
        (taken, model, (spoilt, FACES), r"the mesh: 1 of \d+ vertices are NaN"),
        (upper, elsewhere, (VERTICES, FACES), "no vertex is both seen and known"),
    ):
        with pytest.raises(ReflectanceError, match=words):
            fit_face(observed, one, *mesh, lighting)


def test_a_weak_cast_is_the_skins_and_a_strong_one_the_lights():
    def share(cast):
        log = cast * np.array([1.0, 0.0, -1.0])
        return float(np.log(skin_hue(np.exp(log)[None])) @ log / (log @ log))

    assert np.abs(skin_hue(np.full((4, 3), 7.0)) - 1).max() < 0.01
    assert 0.5 < share(0.1) < 1
    assert share(0.3) < share(-0.3) - 0.1  # a bulb's light, which is warm
    assert 0 < share(1.6) < 0.1
    assert 0 < share(10.0) < 0.1


def test_white_lies_between_the_hues_of_two_lights():
    """Sun and sky, or a window and a coloured room: the bright part counts no more than the dark one."""
    warm = np.exp(0.1 * np.array([1.0, 0.0, -1.0]))
    assert np.abs(skin_hue(np.stack([5 * warm, 0.5 / warm])) - 1).max() < 0.01
    assert skin_hue(np.stack([5 * warm, 0.5 * warm]))[0] > 1.05


def test_light_changes_by_its_slope_where_positions_are_off():
    slopes = np.array([[0.02, 0.01, 0.0], [0.0, 0.03, 0.0], [-0.01, 0.0, 0.01]])  # a mm, by channel
    along = slopes[:, None] - (slopes @ NORMALS.T)[..., None] * NORMALS
    nothing, there = np.zeros((len(VERTICES), 3)), SEEN & (NORMALS[:, 2] > 0.4)
    light = np.where(SEEN[:, None], VERTICES @ slopes.T, np.nan)
    divided = ShadingDivided(nothing, there, there, nothing, nothing, np.zeros((len(VERTICES), 3, 3)), light)
    found = divided.by_shift(VERTICES, FACES)
    assert (found[~there] == 0).all()
    expected = np.einsum("cvi,dvi->vcd", along, along)[there]
    assert np.linalg.norm(found[there] - expected) < 0.5 * np.linalg.norm(expected)
    assert_allclose(found[there].mean(0), expected.mean(0), atol=0.12 * expected.max())


def test_the_mean_face_gets_the_hue_of_its_skin(model, fitted):
    """In white light, where details are believed; the light is then what sends the photograph's colours."""
    redder = np.array([0.15, -0.1, -0.05])
    truth = skin(redder + BLOTCHES)
    light = project_environment(generated_environment(3))
    light *= light[0, 1] / light[0]
    found = fitted(picture(truth, 3, noise=0, light=light))
    (step,) = found.plan.of_stage("reflectance.image.hue")
    assert step.ran
    assert "factors of red, green, blue" in step.evidence
    toned = found.fit.face.reflectance.diffuse_linear / model.diffuse.mean
    hue = np.log(toned[SEEN][0]) - np.log(toned[SEEN][0]).mean()
    assert_allclose(toned[SEEN], np.broadcast_to(toned[SEEN][0], toned[SEEN].shape))
    assert 0.4 < hue @ redder / (redder @ redder) < 1.1
    assert found.relative_rmse < 0.05


def test_what_wrong_normals_could_explain_is_no_detail(model, mean, fitted):
    """Under normals that are off, shades are left out; pigment, which has another colour, stays in part."""
    tilted = NORMALS + 0.2 * np.stack([waves(60 + k, (5, 7), 1.0) for k in range(3)], axis=1) / np.sqrt(3)
    tilted = normalized(tilted)
    sizes = []
    for truth in (mean, skin(BLOTCHES)):
        taken = picture(truth, 3, noise=0, normals=tilted, seen=SEEN & (tilted[:, 2] > 0.1))
        found = fitted(taken, normal_error=0.2)
        divided = ShadingDivided.from_observation(taken, model, mean, found.fit.light)
        fields = [detail_field(divided, VERTICES, FACES, angle)[SEEN] for angle in (0.0, 0.2)]
        sizes.append([np.linalg.norm(field) for field in fields])
        (person,) = found.plan.of_stage("reflectance.image.person")
        assert not person.ran
        assert "the normals may be wrong by 11 degrees" in person.reason
    assert sizes[0][1] < 0.35 * sizes[0][0]
    assert sizes[1][1] > 2 * sizes[0][1]
    assert found.plan.ran("reflectance.image.details")
    assert error(found.reflectance, truth) < 0.97 * error(mean, truth)
