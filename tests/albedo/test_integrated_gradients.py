"""Fields are rebuilt from their gradients inside a region."""

import numpy as np
import pytest

from scan2albedo.albedo.inpainting import integrate_gradients

SIZE = 128


def forward_differences(field):
    """f[i, j + 1] - f[i, j] (H, W - 1, ...) and f[i + 1, j] - f[i, j] (H - 1, W, ...)."""
    return np.diff(field, axis=1), np.diff(field, axis=0)


ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE]
DISC = (ROWS - 60) ** 2 + (COLUMNS - 64) ** 2 < 30**2
WAVES = 0.5 + 0.2 * np.sin((9 * ROWS + 4 * COLUMNS) / SIZE) * np.cos(7 * COLUMNS / SIZE)


def test_gradients_integrate_to_the_field_they_came_from():
    """Those of several channels as each alone."""
    color = np.stack([WAVES, WAVES**2, 1 - WAVES], -1)
    broken = np.where(DISC[..., None], 7.0, color)
    together = integrate_gradients(broken, DISC, ~DISC, *forward_differences(color))
    assert together == pytest.approx(color, abs=1e-4)
    for c in range(3):
        alone = integrate_gradients(broken[..., c], DISC, ~DISC, *forward_differences(color[..., c]))
        assert together[..., c] == pytest.approx(alone, abs=1e-9)


def test_a_region_that_touches_nothing_known_keeps_its_level():
    kept = integrate_gradients(WAVES, DISC, np.zeros_like(DISC), *forward_differences(WAVES))
    assert kept == pytest.approx(WAVES, abs=1e-6)


LINE = np.linspace(1, 2, 5)[None]


@pytest.mark.parametrize("field", [LINE, LINE[..., None] * np.ones(3)])
def test_a_region_without_neighbours_along_an_axis_is_integrated_along_the_other(field):
    region = np.array([[False, True, True, False, False]])
    broken = field.copy()
    broken[region] = 7.0
    rebuilt = integrate_gradients(broken, region, LINE == 1, *forward_differences(field))
    assert rebuilt == pytest.approx(field, abs=1e-6)
    one = LINE == 1.25
    alone = integrate_gradients(broken, one, ~np.ones_like(one), *forward_differences(field))
    assert alone == pytest.approx(broken)


def test_the_anchor_keeps_gradients_that_contradict_one_another_from_drifting():
    """Steps that are a little off add up along a strip with one known end, unless old values hold them."""
    region, known, old = np.ones((1, 400), bool), np.zeros((1, 400), bool), np.ones((1, 400))
    region[0, 0], known[0, 0] = False, True
    across, down = np.full((1, 399), 0.01), np.zeros((0, 400))
    free, held = (
        integrate_gradients(old, region, known, across, down, anchor)[0, -1] for anchor in (1e-9, 1e-3)
    )
    assert free == pytest.approx(1 + 3.99, abs=0.01)
    assert held < 1.6
