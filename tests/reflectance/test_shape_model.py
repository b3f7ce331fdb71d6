"""The morphable shape model: its statistics, its file, what it refuses."""

import numpy as np
import pytest
from helpers.npz import assert_comes_back, rewritten
from numpy.testing import assert_allclose

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import MorphableShapeModel

FACES = np.array([[0, 1, 2], [1, 3, 2]])
MARKS = np.arange(68)


def people(count, seed=0, vertices=90):
    """Shapes with four ways to differ."""
    modes = np.random.default_rng(7).normal(size=(4, vertices, 3)) * [[[4.0]], [[2.0]], [[1.0]], [[0.5]]]
    return 50 + np.tensordot(np.random.default_rng(seed).normal(size=(count, 4)), modes, 1)


def learned(count=30, expressions=6):
    offsets = people(expressions, 3) - 50 if expressions else None
    return MorphableShapeModel.from_samples(people(count), offsets, FACES, MARKS)


def test_expressions_have_the_covariance_of_offsets_around_the_neutral_face():
    offsets = (people(6, 3) - 50).reshape(6, -1)
    flat = learned().basis[4:].reshape(4, -1)
    assert_allclose(flat.T @ flat, 2 * offsets.T @ offsets / 11, atol=1e-10)


def test_components_are_cut_at_what_there_is():
    assert learned(count=3, expressions=2).basis.shape == (2 + 2, 90, 3)
    assert learned(count=1, expressions=0).basis.shape == (0, 90, 3)
    same = MorphableShapeModel.from_samples(np.repeat(people(1), 4, axis=0), None, FACES, MARKS)
    assert same.identity_components == 0


def test_a_model_comes_back_from_its_file(tmp_path):
    assert_comes_back(learned(), tmp_path)
    with pytest.raises(ValueError, match="npz"):
        learned().save(tmp_path / "model.json")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": np.array('{"format": "something"}')}, "format"),
        ({"mean": np.full((90, 3), np.nan)}, "NaN"),
        ({"mean": np.zeros((89, 3))}, r"mean is \(89, 3\), expected \(90, 3\)"),
        ({"faces": np.array([[0, 1, 90]])}, "vertices 0 to 90 of 90"),
        ({"faces": np.zeros((2, 3))}, "faces holds float64"),
        ({"landmark_vertices": np.arange(5)}, "landmark_vertices"),
        ({"expression_basis": np.zeros((4, 80, 3))}, "expression_basis"),
    ],
)
def test_files_that_are_no_model_are_refused(tmp_path, changes, message):
    path = tmp_path / "model.npz"
    learned().save(path)
    rewritten(path, **changes)
    with pytest.raises(ReflectanceError, match=message):
        MorphableShapeModel.load(path)


SPOILT = people(3)
SPOILT[1, 5] = np.nan


@pytest.mark.parametrize(
    ("neutral", "offsets", "faces", "message"),
    [
        (np.zeros((0, 90, 3)), None, FACES, "no face"),
        ([np.zeros((90, 3)), np.zeros((80, 3))], None, FACES, "one topology"),
        (people(3), np.zeros((2, 80, 3)), FACES, "one topology"),
        (SPOILT, None, FACES, "shape 1"),
        (people(3), None, np.zeros((0, 3), int), "faces"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(neutral, offsets, faces, message):
    with pytest.raises(ReflectanceError, match=message):
        MorphableShapeModel.from_samples(neutral, offsets, faces, MARKS)
