"""Lights of the traced scenes: what shines from where, and how the rigs are put together."""

import numpy as np
import pytest
from worlds.lamps import ENVIRONMENTS, HARD_DEG, Lamp, environment_map, overcast, rigs

UP, DOWN, FORWARD = np.eye(3)[[1]], -np.eye(3)[[1]], np.eye(3)[[2]]


def test_an_overcast_sky_is_bright_above_and_dark_below():
    assert (overcast(UP) > 2 * overcast(FORWARD + [0, 0.1, 0])).all()
    assert (overcast(DOWN) < 0.5 * overcast(FORWARD + [0, 0.1, 0])).all()
    assert np.ptp(overcast(UP)) > 0.1


@pytest.mark.parametrize("kind", ENVIRONMENTS)
def test_environments_shine_everywhere_and_are_smooth(kind):
    picture = environment_map(kind, 64)
    assert picture.shape == (64, 128, 3)
    assert (picture > 0).all()
    assert np.abs(np.diff(picture, axis=0)).max() < 0.8
    np.testing.assert_allclose(picture[:, 0], picture[:, -1], atol=1e-9)


def test_the_rows_of_a_map_run_from_above_to_below_and_its_columns_from_behind():
    picture = environment_map("dim_room", 65)
    # The warm wall is at +x, a quarter in: red over blue.
    warmth = picture[32, :, 0] / picture[32, :, 2]
    warm = np.flatnonzero(warmth > 0.99 * warmth.max())
    assert warm[0] < 32 < warm[-1] < 65
    assert picture[0].mean() > picture[-1].mean()


def test_a_lamp_tells_its_direction_and_how_large_it_looks():
    lamp = Lamp(90.0, 0.0, 1000.0, (np.tan(np.deg2rad(10)) * 1000,))
    np.testing.assert_allclose(lamp.direction, [1, 0, 0], atol=1e-12)
    assert lamp.radius_deg == pytest.approx(10)
    square = Lamp(0.0, 0.0, 1000.0, (100.0, 50.0))
    assert square.area_mm2 == pytest.approx(20_000)


def test_lights_have_names_of_their_own():
    every = rigs()
    assert len({rig.name for rig in every}) == len(every)
    assert all(part.strength > 0 for rig in every for part in rig.parts)
    # Emitters are keys of a table, so that rigs share what is traced once.
    assert len({part.emitter for rig in every for part in rig.parts}) < sum(len(rig.parts) for rig in every)


def test_the_truth_names_lamps_and_not_the_environment():
    by_name = {rig.name: rig for rig in rigs()}
    assert by_name["dome"].lamps() == by_name["window"].lamps() == []
    (flash,) = by_name["flash_near"].lamps()
    assert flash["hard"]
    assert flash["distance_mm"] == 600
    assert flash["radius_deg"] < HARD_DEG
    assert not any(lamp["hard"] for lamp in by_name["softboxes6"].lamps())
    assert np.linalg.norm(flash["direction"]) == pytest.approx(1, abs=1e-5)
