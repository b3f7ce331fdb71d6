"""Curves smoothed over time: what stays, what goes, what is filled in and how sure that is."""

import numpy as np
import pytest
from helpers.measures import rms

from scan2albedo.fitting.tracking import smoothed_in_time

COUNT = 80


def test_noise_on_a_smooth_motion_is_taken_off_and_its_deviation_stated():
    rng, time = np.random.default_rng(0), np.arange(COUNT)
    truth = 5 * np.sin(2 * np.pi * time / 40)[:, None] * np.ones(50)
    curves, deviation = smoothed_in_time(truth + 0.3 * rng.normal(size=truth.shape), np.ones(COUNT, bool))
    assert rms(curves - truth) < 0.2
    assert rms(deviation) == pytest.approx(rms(curves - truth), rel=0.25)
    jitter = rms(np.diff(curves - truth, 2, axis=0))
    assert jitter < 0.1 * 0.3 * np.sqrt(6)


def test_a_blink_far_above_the_noise_stays():
    rng, time = np.random.default_rng(1), np.arange(COUNT)
    blink = -6 * np.sin(np.pi * np.clip((time - 40) / 6, 0, 1))[:, None] ** 2
    curves, _ = smoothed_in_time(blink + 0.1 * rng.normal(size=blink.shape), np.ones(COUNT, bool))
    assert curves.min() < -5.7
    assert np.abs(curves - blink).max() < 0.4


def test_constant_noise_becomes_a_line():
    noise = np.random.default_rng(2).normal(size=(COUNT, 40))
    curves, _ = smoothed_in_time(noise, np.ones(COUNT, bool))
    assert np.median(np.abs(np.diff(curves, 2, axis=0)).max(0)) < 0.01


def test_frames_not_seen_are_filled_in_whatever_stands_there_and_are_less_sure():
    rng, time = np.random.default_rng(3), np.arange(COUNT)
    truth = np.sin(2 * np.pi * time / 40)[:, None] * [3.0, -2.0]
    seen = ~np.isin(time, [30, 31, 32, 60])
    values = truth + 0.02 * rng.normal(size=truth.shape)
    values[~seen] = 1e6
    curves, deviation = smoothed_in_time(values, seen)
    error = np.abs(curves - truth)
    assert error[~seen].max() < 0.1
    assert (deviation[31] > 1.5 * deviation[20]).all()
    assert (error[~seen] < 4 * deviation[~seen]).all()


def test_the_solution_balances_data_and_prior():
    """A reference by dense algebra: (W + l D^T D) s = W a for one ratio l, that which the curve implies."""
    rng = np.random.default_rng(4)
    values, seen = rng.normal(size=(12, 1)).cumsum(0), np.arange(12) != 5
    curves, _ = smoothed_in_time(values, seen)
    bent = np.diff(np.eye(12), 2, axis=0)
    pull, push = (bent.T @ bent @ curves)[:, 0], np.where(seen, (values - curves)[:, 0], 0.0)
    ratio = pull @ push / (pull @ pull)
    np.testing.assert_allclose(push, ratio * pull, atol=1e-6 * np.abs(push).max() + 1e-9)


@pytest.mark.parametrize("seen", [[True, False, True], [False, True, False]])
def test_too_few_frames_give_a_line_of_unknown_deviation(seen):
    curves, deviation = smoothed_in_time(np.array([[1.0], [50.0], [3.0]]), np.array(seen))
    assert curves[1, 0] == (2.0 if seen[0] else 50.0)
    assert np.isnan(deviation).all()
