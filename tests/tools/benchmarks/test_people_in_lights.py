"""People under other lamps: the parts of the benchmark in closed form, its figures on real photographs."""

import numpy as np
import pytest
from benchmarks.people_in_lights import (
    KINDS,
    calibrated_on,
    light_similarities,
    photographs,
    rates,
    robust_harmonics,
    verified,
)

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
    assert verified(right, people, calibration) == (1.0, 1.0, 3, 12)
    wrong = rates({"albedo": -right["albedo"]}, people, lights, calibration, draws=3)
    assert wrong["albedo"] == (0.0, 0.0)


def test_a_calibration_comes_from_both_sets():
    random, people = np.random.default_rng(0), list("aabbccdd")
    same = np.array(people)[:, None] == people

    def noisy(apart):
        noise = 0.02 * random.standard_normal((4, 8, 8))
        return dict(zip(KINDS, 0.5 + apart * same + noise + noise.transpose(0, 2, 1), strict=True))

    lit = {kind: values for kind, values in noisy(0.4).items() if kind != "shape"}
    found = calibrated_on(lit, people, ["1", "2"] * 4, noisy(0.2), people)
    apart = dict(zip(found.kinds, np.subtract(found.same, found.other), strict=True))
    assert apart["albedo"] == pytest.approx(0.3, abs=0.04)
    assert apart["shape"] == pytest.approx(0.2, abs=0.04)
    assert found.shading_variance == pytest.approx(2 * 0.02**2, rel=0.5)


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
