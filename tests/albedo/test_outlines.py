"""Sharp outlines of the light against a texture that has them, has half of them, or lacks them."""

import numpy as np
import pytest

from scan2albedo.albedo.outlines import seen_outlines

SHAPE = 64, 512
STEP = 0.25
"""Of log light across the outline."""
WIDTH = 13
"""Steps of the band over which a lacking outline is spread, at this size."""


def _light(step=STEP, outline=256):
    """Return light that falls slowly from left to right, and by `step` at the outline."""
    column = np.arange(SHAPE[1])
    return np.exp(0.5 - 0.001 * column - step * (column >= outline)) * np.ones(SHAPE)


def _albedo(seed=0):
    """Return an albedo with grain."""
    return 0.5 * np.exp(0.005 * np.random.default_rng(seed).standard_normal(SHAPE))


USABLE = np.ones(SHAPE, bool)


def test_an_outline_that_the_texture_has_stays_exactly():
    light = _light()
    found, step = seen_outlines(light, _albedo() * light, USABLE)
    assert np.array_equal(found, light)
    assert (step.ran, step.stage) == (False, "albedo.outlines")
    assert "0 %" in step.evidence


def test_light_without_sharp_outlines_stays_exactly():
    light = _light(0.0)
    found, step = seen_outlines(light, _albedo(), USABLE)
    assert np.array_equal(found, light)
    assert not step.ran
    assert step.reason == "the light has no sharp outline"


def test_an_outline_that_the_texture_lacks_leaves_no_line_in_the_albedo():
    light, smooth = _light(), _light(0.0)
    albedo = _albedo()
    found, step = seen_outlines(light, albedo * smooth, USABLE)
    assert step.ran
    assert "lacks 100 %" in step.evidence
    left = np.abs(np.diff(np.log(smooth / found), axis=1))
    assert left.max() < 0.03
    # The light on either side is as it was: the step is spread, not taken away.
    assert np.log(found[:, 230] / found[:, 280]) == pytest.approx(np.log(light[:, 230] / light[:, 280]))


@pytest.mark.parametrize("kept", [0.25, 0.5])
def test_an_outline_half_seen_keeps_half(kept):
    light, value = _light(), _albedo() * _light(kept * STEP)
    found, step = seen_outlines(light, value, USABLE)
    assert step.ran
    across = -np.diff(np.log(found), axis=1)[:, 255]
    assert np.median(across) == pytest.approx(kept * STEP + (1 - kept) * STEP / WIDTH, abs=0.03)


def test_light_outside_the_band_is_the_same_to_the_last_bit():
    light = _light()
    found, _ = seen_outlines(light, _albedo() * _light(0.0), USABLE)
    changed = (found != light).any(0)
    where = np.flatnonzero(changed)
    assert where[0] >= 256 - WIDTH / 2 - 1
    assert where[-1] <= 256 + WIDTH / 2


def test_one_outline_is_seen_and_another_is_not():
    light = _light() * _light(STEP, 400)
    value = _albedo() * _light() * _light(0.0)
    found, step = seen_outlines(light, value, USABLE)
    assert step.ran
    assert np.array_equal(found[:, 200:320], light[:, 200:320])
    assert np.abs(np.diff(np.log(found[:, 380:420]), axis=1)).max() < 0.03


def test_an_outline_along_rows_is_treated_as_one_along_columns():
    light, value = _light(), _albedo() * _light(0.0)
    across, _ = seen_outlines(light, value, USABLE)
    along, _ = seen_outlines(light.T.copy(), value.T.copy(), USABLE.T.copy())
    assert pytest.approx(across, rel=1e-6) == along.T


def test_outlines_beside_unusable_texels_do_not_count():
    light = _light()
    usable = USABLE.copy()
    usable[:, 250:262] = False
    found, step = seen_outlines(light, _albedo(), usable)
    assert np.array_equal(found, light)
    assert not step.ran


def test_black_texture_and_no_light_stay_finite():
    light = np.where(np.arange(SHAPE[1]) < 256, 1.0, 0.0) * np.ones(SHAPE)
    found, _ = seen_outlines(light, np.zeros(SHAPE), USABLE)
    assert np.isfinite(found).all()
    assert found.min() >= 0
