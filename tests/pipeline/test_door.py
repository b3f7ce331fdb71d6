"""What the search takes for a face and the fit does not is refused, and nothing is published."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import scan2albedo as s2a
from scan2albedo.errors import NoFaceError
from scan2albedo.registration import Registration
from scan2albedo.registration.register import judged_with_fit


def machine_part(seed):
    """Return a plate with bosses, ribs and sometimes a knob, in any pose: a scan in mm."""
    rng = np.random.default_rng(seed)
    width, height = rng.uniform(20, 90, 2)
    depth = rng.uniform(4, 12)
    pieces = [trimesh.creation.box((width, height, depth))]

    def place(piece, tall):
        x, y = rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4)
        piece.apply_translation((x * width, y * height, depth / 2 + tall))
        pieces.append(piece)

    for _ in range(rng.integers(2, 7)):
        radius, tall = rng.uniform(2, 10), rng.uniform(5, 30)
        if rng.random() < 0.6:
            boss = trimesh.creation.cylinder(radius, tall, sections=int(rng.integers(12, 48)))
        else:
            boss = trimesh.creation.annulus(0.6 * radius, radius, tall, sections=24)
        place(boss, tall / 2)
    for _ in range(rng.integers(0, 4)):
        place(trimesh.creation.box(rng.uniform(3, 25, 3)), 0.0)
    if rng.random() < 0.5:
        knob = trimesh.creation.icosphere(2, rng.uniform(5, 25))
        knob.apply_translation((0, 0, depth / 2))
        pieces.append(knob)
    mesh = trimesh.util.concatenate(pieces)
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return mesh


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 6, 8))])
def test_a_part_of_a_machine_is_refused_by_what_the_fit_finds(tmp_path, seed):
    """The search takes each of these for a face, at the scale where it resembles one most."""
    file, out = tmp_path / "part.stl", tmp_path / "out"
    machine_part(seed).export(file)
    with pytest.raises(NoFaceError, match=r"no face found.*edges are stretched by") as caught:
        s2a.process(file, out, size=64, skip=["albedo"])
    assert caught.value.confidence < 0.4
    assert not [path for path in out.rglob("*") if path.is_file()]


@pytest.fixture
def found():
    """A search that found a face with a probability of 0.9, and a scan."""
    scan = s2a.RawScan(np.eye(3), np.array([[0, 1, 2]]), name="triangle")
    return Registration(np.eye(4), 1.0, None, True, 0.9, 1, s2a.Trace()), scan


def test_odds_of_search_and_fit_add(found):
    search, scan = found
    assert judged_with_fit(search, scan, 0.0, "") is search
    assert judged_with_fit(search, scan, -np.log(9), "").confidence == pytest.approx(0.5)
    with pytest.raises(
        NoFaceError, match=r"triangle: no face found.*its figures; the scan's box is 1 x 1 x 1 mm"
    ):
        judged_with_fit(search, scan, -3.0, "its figures")


def test_a_search_that_a_budget_ended_refuses_nothing(found):
    search, scan = found
    judged = judged_with_fit(replace(search, converged=False), scan, -30.0, "")
    assert judged.confidence < 1e-9
