"""Proportions of faces: people's pass, stretched ones do not."""

import numpy as np
import pytest

from scan2albedo.fitting.plausibility import FARTHEST, proportions
from scan2albedo.geometry.rigid import random_rotation
from scan2albedo.synthetic.face_shape import EXPRESSION_BUMPS, person


def peoples_landmarks(model, count):
    for seed in range(count):
        expression = sorted(EXPRESSION_BUMPS)[seed % len(EXPRESSION_BUMPS)]
        yield model.landmarks_of(person(model, np.random.default_rng(seed), expression=expression))


def test_the_models_own_proportions_are_the_unit(model):
    np.testing.assert_allclose(proportions(model.landmarks).logarithms, 0, atol=1e-9)


def test_they_are_those_of_the_stretch_in_any_pose_and_size(model):
    rotation = random_rotation(np.random.default_rng(0))
    turned = 0.3 * (model.landmarks * [1.2, 0.9, 1.1]) @ rotation.T + [5.0, -2.0, 1.0]
    found = proportions(turned).logarithms
    np.testing.assert_allclose(np.exp(found[:2]), [1.2 / 0.9, 1.1 / 0.9], rtol=1e-6)
    # The axes of the depth of the nose are those of the stretched face, laid on the model.
    assert np.exp(found[2]) == pytest.approx(1.1 / 1.2, rel=0.05)


def test_no_person_is_doubted(model):
    distances = [proportions(landmarks).distance for landmarks in peoples_landmarks(model, 120)]
    assert max(distances) < 3.2
    assert proportions(model.landmarks).doubt() == ""


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("factor", [1.5, 1 / 1.5])
def test_stretched_faces_are_doubted(model, axis, factor):
    stretch = np.ones(3)
    stretch[axis] = factor
    found = [proportions(landmarks * stretch) for landmarks in peoples_landmarks(model, 24)]
    assert min(one.distance for one in found) > FARTHEST
    ratio = np.exp(found[0].logarithms[0])
    assert found[0].doubt().startswith(f"width to height {ratio:.2f} (0.87 to 1.19), depth to height")
