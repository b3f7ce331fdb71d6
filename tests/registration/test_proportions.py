"""Proportions and size of faces: people's pass, those of stretched and scaled scans do not."""

from dataclasses import replace

import numpy as np
import pytest

from scan2albedo import RawScan, register
from scan2albedo.registration.acceptance import NAMES, people, proportion_doubts

TOLD = {"register.proportions", "register.size"}


def told(scan, model):
    found = register(scan, model)
    assert found.confidence > 0.9
    return {row.stage for row in found.plan} & TOLD


def flattened(points, model):
    """Return points (N, 3) of the model less deep, with a lower nose: as faces of East Asia are."""
    tip, eyes = model.landmarks[30], model.landmarks[[36, 45]].mean(0)
    off = (points - tip - [0, 6, 0]) / [16, 22, np.inf]
    low = points - np.exp(-(off**2).sum(1) / 2)[:, None] * [0, 0, 0.15 * (tip - eyes)[2]]
    return low * [1, 1, 0.75]


@pytest.fixture(scope="module")
def flat(model):
    """The default model in another person's shape, as that person's template."""
    own = flattened(model.control_vertices, model)
    return replace(model, control_vertices=own, _subdivisions={}, name="flat")


def test_a_flat_face_is_a_face_like_others(model):
    vertices, faces = model.surface(3)
    assert told(RawScan(flattened(vertices, model), faces), model) == set()


def test_a_users_own_face_as_template_finds_others_and_says_nothing_of_them(upright, model, flat):
    assert told(upright, flat) == told(upright, model) == set()


def test_a_flat_template_tells_of_the_scans_that_the_default_model_tells_of(upright, model, flat):
    stretched = replace(upright, vertices=upright.vertices * [1, 1.35, 1])
    assert told(stretched, model) == {"register.proportions"}
    assert "register.proportions" in told(stretched, flat)
    assert told(stretched, replace(flat, landmark_points=None)) == set()


@pytest.mark.parametrize(
    ("axis", "factor"),
    [(axis, factor) for axis in (0, 1) for factor in (1.25, 0.8, 1.5, 1 / 1.5)] + [(2, 1.5), (2, 1 / 1.5)],
)
def test_a_stretched_scan_is_told_by_its_axis(upright, model, axis, factor):
    vertices = upright.vertices * np.where(np.arange(3) == axis, factor, 1)
    rows = [row for row in register(replace(upright, vertices=vertices), model).plan if row.stage in TOLD]
    named = [row.evidence.split()[0] for row in rows if row.stage == "register.proportions"]
    assert named == [NAMES[axis]]


@pytest.mark.parametrize("factor", [0.78, 1.25])
def test_another_scale_is_told(upright, model, factor):
    assert told(upright.scaled(factor), model) == {"register.size"}


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("side", range(2))
def test_the_words_agree_with_the_verdict(number, side):
    learned = people()
    usual = np.linalg.lstsq(learned["weights"], learned["mean"], rcond=None)[0]
    assert list(proportion_doubts(usual)) == []
    end = np.where(np.arange(4) == number, learned["reach"][side], 0)
    inside, outside = (
        usual + part * np.linalg.lstsq(learned["weights"], end, rcond=None)[0] for part in (0.95, 1.05)
    )
    assert list(proportion_doubts(inside)) == []
    (row,) = proportion_doubts(outside)
    low, high = np.exp(learned["reach"][:, number])
    assert row.stage == ("register.size" if number == 3 else "register.proportions")
    assert row.evidence.startswith(f"{NAMES[number]} ")
    assert f"{low:.2f} to {high:.2f} expected" in row.evidence
    assert "21 heads and 164 synthetic people" in row.evidence
