import numpy as np
import pytest
from helpers.meshes import sphere
from hypothesis import given, settings, strategies as st

from scan2albedo.errors import ScanError
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io.units import MM_PER_UNIT, largest_extent, millimetres_per_unit

HEAD, _ = sphere(3, 1.0)


def extent_of(*pieces):
    """Return the largest extent of pieces (V, 3) that hang together within themselves alone."""
    return largest_extent(np.concatenate(pieces), np.repeat(range(len(pieces)), [len(p) for p in pieces]))


def decide(extent, unit="auto"):
    return millimetres_per_unit(HEAD * extent / 2, np.zeros(len(HEAD), int), unit, "x.obj")


@settings(max_examples=40, deadline=None)
@given(st.floats(90, 750), st.sampled_from(["mm", "cm", "m"]))
def test_every_size_from_a_face_to_shoulders_is_read_in_every_unit(extent_mm, unit):
    factor, note = decide(extent_mm / MM_PER_UNIT[unit])
    assert factor == MM_PER_UNIT[unit]
    assert note.startswith(f"unit: {unit} ")


@pytest.mark.parametrize("extent", [0.9, 4.0, 1500.0])
def test_an_implausible_size_is_shown_and_a_given_unit_ends_the_matter(extent):
    told = rf"x\.obj: the scan is {extent_of(HEAD * extent / 2):.4g} units long.*unit='mm', 'cm' or 'm'"
    with pytest.raises(ScanError, match=told):
        decide(extent)
    factor, note = decide(extent, "cm")
    assert factor == 10
    assert "as given" in note


def test_an_unknown_unit_is_a_wrong_call():
    with pytest.raises(ValueError, match="unit is 'inch', expected 'auto', 'mm', 'cm' or 'm'"):
        decide(150, "inch")


def test_spikes_far_crumbs_and_patches_that_hang_on_the_face_do_not_change_the_unit():
    spiky = HEAD * 90
    spiky[:2] *= 400
    assert extent_of(spiky) < 200
    assert extent_of(HEAD * 90, HEAD[:200] * 9 + 1e5) < 200
    # The near patch stands out only where the far one is left out before.
    near, far = HEAD[:80] * 9 + 250, HEAD[:200] * 9 + 900
    assert extent_of(np.concatenate([HEAD * 90, near, far])) < 200


def test_a_scan_in_two_halves_counts_both():
    halves = HEAD * 30, HEAD * 30 + (100, 0, 0)
    assert extent_of(*halves) == pytest.approx(60, rel=0.05)
    assert extent_of(*halves, halves[0][:10] + 50) == pytest.approx(160, rel=0.05)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.floats(-1e6, 1e6))
@settings(max_examples=20, deadline=None)
def test_the_extent_does_not_depend_on_the_pose(turn, far):
    vertices = HEAD * (100, 130, 90)
    moved = vertices @ rotation_from_vector(list(turn)).T + far
    assert extent_of(moved) == pytest.approx(extent_of(vertices), rel=1e-3)
