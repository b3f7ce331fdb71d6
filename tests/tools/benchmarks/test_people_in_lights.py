"""People under other lamps: the parts of the benchmark in closed form, its figures on real photographs."""

import numpy as np
import pytest
from benchmarks.people_in_lights import (
    KINDS,
    Judged,
    calibrated_on,
    light_similarities,
    photographs,
    rates,
    robust_harmonics,
    verified,
)
from worlds.lit_heads import Surface, photographed, slopes

from scan2albedo.recognition import Calibration
from scan2albedo.recognition.result_identification import CALIBRATION

LAMPS = ("A+000E+00", "A+035E+15", "A+070E+45", "A-035E+40")


def test_harmonics_find_their_own_light():
    normals = np.random.default_rng(0).standard_normal((500, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    light = 2 + normals @ [0.5, -0.3, 0.8] + 0.2 * normals[:, 0] * normals[:, 1]
    values = light.copy()
    values[:50] *= 3  # what is no light
    np.testing.assert_allclose(robust_harmonics(normals, values)[50:], light[50:], rtol=0.01)


def test_pairs_and_galleries_are_counted():
    people, lights = list("aabbcc"), ["1", "2"] * 3
    same = np.array(people)[:, None] == people
    right = {"albedo": np.where(same, 0.9, 0.5)}
    calibration = Calibration(("albedo",), (0.9,), (0.5,), ((0.01,),))
    found = rates(right, people, lights, calibration, draws=3)
    assert found == {"albedo": (1.0, 1.0), "fused": (1.0, 1.0)}
    judged = Judged(right, people, [str(k) for k in range(6)], lights)
    assert verified(judged, ["albedo"], calibration) == (1.0, 0.0, 3, 12)
    assert rates(right, people, lights, calibration, draws=3, together=2) == found
    wrong = rates({"albedo": -right["albedo"]}, people, lights, calibration, draws=3)
    assert wrong["albedo"] == (0.0, 0.0)


def test_a_calibration_comes_from_all_sets():
    random, people = np.random.default_rng(0), list("aabbccdd")
    same = np.array(people)[:, None] == people

    def noisy(apart, level, kinds=KINDS):
        noise = 0.02 * random.standard_normal((len(kinds), 8, 8))
        found = dict(zip(kinds, level + apart * same + noise + noise.transpose(0, 2, 1), strict=True))
        return Judged(found, people, [str(k) for k in range(8)], ["1", "2"] * 4)

    without_shape = ("albedo", "texture", "shading")
    found = calibrated_on([noisy(0.4, 0.4, without_shape), noisy(0.2, 0.5), noisy(0.3, 0.45)])
    apart = dict(zip(found.kinds, np.subtract(found.same, found.other), strict=True))
    assert apart["albedo"] == pytest.approx(0.3, abs=0.04)
    assert apart["shape"] == pytest.approx(0.25, abs=0.04)
    # Half-way between the means all three sets lie at .6: nothing but noise is added.
    assert found.covariance[0][0] == pytest.approx(2 * 0.02**2, rel=0.8)
    assert found.shading_variance == pytest.approx(2 * 0.02**2, rel=0.5)
    far = calibrated_on([noisy(0.2, 0.3), noisy(0.2, 0.5)])
    assert far.covariance[0][1] == pytest.approx(0.02, rel=0.2)
    assert far.shape_variance == pytest.approx(0.02, rel=0.4)


def test_scans_of_one_sitting_are_no_pair():
    found = {"albedo": np.zeros((4, 4))}
    judged = Judged(found, list("aabb"), ["a0", "a0", "b0", "b1"], ["1"] * 4)
    (rows, _), own = judged.pairs
    assert len(rows) == 5
    assert own.sum() == 1
    assert judged.part("b").persons == ["b", "b"]


def test_light_falls_on_what_faces_it():
    corners = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    surface = Surface(corners, corners, np.array([[0, 1, 2], [0, 2, 3]]), [1])
    face, weights = np.arange(200) % 2, np.random.default_rng(0).dirichlet(np.ones(3), 200)
    bright, dark = (photographed(surface, face, weights, np.full((200, 3), a), 10, [2]) for a in (0.6, 0.3))
    assert bright.shape == (200, 3)
    assert 0.5 < bright.mean() < 1
    np.testing.assert_allclose(bright.mean(), dark.mean(), rtol=0.1)  # exposed alike
    heights, gradient = slopes(corners, [3], (5.0, 20.0))
    step = slopes(corners + [1e-5, 0, 0], [3], (5.0, 20.0))[0]
    np.testing.assert_allclose((step - heights) / 1e-5, gradient[:, 0], atol=1e-4)


@pytest.mark.slow
def test_fused_is_never_below_one_cue(shared_data, tmp_path):
    rows = photographs(tmp_path, LAMPS)
    people, lights = [row["person"] for row in rows], [row["light"] for row in rows]
    cues = light_similarities(rows, ("texture", "albedo", "shading", "harmonics", "retinex"))
    found = rates(cues, people, lights, CALIBRATION)
    for name in ("texture", "albedo", "harmonics", "retinex"):
        assert (np.array(found["fused"]) >= found[name]).all(), (name, found)
    assert found["fused"][0] >= 0.97
    assert found["fused"][1] >= 0.75
