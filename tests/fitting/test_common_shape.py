"""A person's neutral shape from several fits: what stays, what an expression moves, and who it is."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fits import fit_of
from helpers.measures import row_lengths

from scan2albedo.fitting import common_shape
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.synthetic.face_shape import person


def fitted(model, control, seed=0, *, half=0, scale=1.0):
    """A fit of control points, moved and with smooth noise; `half` -1 or 1 leaves out that side."""
    rng = np.random.default_rng(seed)
    pose = compose(scale * rotation_from_vector(rng.normal(0, 0.03, 3)), rng.normal(0, 2, 3))
    made = fit_of(model, transform_points(pose, control + rng.normal(0, 0.2, control.shape)))
    return replace(made, residual_mm=np.where(half * made.vertices[:, 0] > 10, np.nan, 0.1))


def face(model, who, expression="neutral"):
    return person(model, np.random.default_rng(who), expression=expression)


def off(found, truth):
    """Distances (N,) after the best similarity."""
    return row_lengths(transform_points(procrustes(found, truth, scale=True), found) - truth)


@pytest.fixture(scope="module")
def rest(model):
    return face(model, 1)


def opened(model, control):
    """The chin and the lower lip 18 mm down."""
    away = row_lengths(model.control_vertices - model.landmarks[[8, 57]].mean(0))
    return control - np.exp(-(away**2) / (2 * 26**2))[:, None] * [0.0, 18.0, 6.0]


@pytest.mark.parametrize("place", [0, 2])
@pytest.mark.parametrize("others", [1, 3])
def test_a_lone_open_mouth_does_not_open_the_neutral_face(model, rest, place, others):
    fits = [fitted(model, rest, seed) for seed in range(others)]
    place = min(place, others)
    fits.insert(place, fitted(model, opened(model, rest), 9))
    shape = common_shape(iter(fits))
    # The plain mean is 18 / 4 or 18 / 2 mm off.
    most_mm = 0.6 if others > 1 else 4.0
    assert off(shape.control_points, rest).max() < most_mm
    moved = row_lengths(shape.expression).max(1)
    assert moved.argmax() == place
    assert moved[place] > 14
    common = transform_points(shape.common_from_fit[place], fits[place].control_points)
    np.testing.assert_allclose(common, shape.control_points + shape.expression[place], atol=1e-9)


def test_deviation_falls_with_the_number_of_scans_and_rises_where_none_looked(model, rest):
    stated = [
        common_shape([fitted(model, rest, seed) for seed in range(n)]).deviation_mm.mean() for n in (1, 3, 9)
    ]
    assert stated[0] > 1.5 * stated[1] > 2 * stated[2]
    side = common_shape([fitted(model, rest, seed, half=1) for seed in range(3)])
    left = side.vertices[:, 0] > 20
    assert side.deviation_mm[left].mean() > 2 * side.deviation_mm[~left].mean()


def test_halves_make_a_whole(model, rest):
    wrong = rest + np.where(rest[:, :1] > 15, [0.0, 0.0, 6.0], 0.0)
    halves = [fitted(model, rest, 0, half=-1), fitted(model, wrong, 1, half=1)]
    assert off(common_shape(halves).control_points, rest).mean() < 1.0


def test_one_scan_is_nearly_taken_as_it_is(model, rest):
    fit = fitted(model, rest)
    shape = common_shape([fit])
    assert off(shape.control_points, fit.control_points).mean() < 0.2
    assert shape.distance_mm.tolist() == shape.other_person.tolist() == [0.0]
    assert np.linalg.det(shape.common_from_fit[0][:3, :3]) == pytest.approx(1)


def test_wrong_units_are_mended_and_the_size_is_their_mean(model, rest):
    scales = np.array([0.96, 1.0, 1.05])
    fits = [fitted(model, rest, seed, scale=scale) for seed, scale in enumerate(scales)]
    shape = common_shape(fits)
    sizes = np.cbrt(np.linalg.det(shape.common_from_fit[:, :3, :3]))
    np.testing.assert_allclose(sizes * scales, np.exp(np.log(scales).mean()), rtol=2e-3)
    assert off(shape.control_points, rest).mean() < 0.4


@pytest.mark.parametrize("count", [2, 4])
def test_another_person_is_the_farthest(model, count):
    faces = [face(model, 1, expression) for expression in ("neutral", "smile", "surprise", "frown")[:count]]
    same = [fitted(model, control, seed) for seed, control in enumerate(faces)]
    alone = common_shape(same).other_person.max()
    odds = []
    for stranger in (2, 3, 4, 5):
        mixed = common_shape([*same, fitted(model, face(model, stranger), 8)])
        assert mixed.other_person.argmax() == mixed.distance_mm.argmax() == count
        odds.append(mixed.other_person[-1])
    assert alone < min(0, *odds)
    assert np.median(odds) > 0


def test_misuse_is_told(model, mask_model, rest):
    with pytest.raises(ValueError, match="no fits"):
        common_shape([])
    mask = fitted(mask_model, mask_model.control_vertices)
    with pytest.raises(ValueError, match=r"fit 1 is of 'mask'.*fit all scans with one model"):
        common_shape([fitted(model, rest), mask])
    assert np.isfinite(common_shape([mask, mask]).deviation_mm).all()
