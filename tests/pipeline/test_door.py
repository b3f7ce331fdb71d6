"""What is no face is refused, at any scale, by the search or by the fit, and nothing is published."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import scan2albedo as s2a
from scan2albedo.errors import NoFaceError, RegistrationError, UnitError
from scan2albedo.geometry.rigid import rotation_angle_rad
from scan2albedo.io.obj import write_obj
from scan2albedo.pipeline.scale_search import registered_at_any_scale
from scan2albedo.registration import Registration
from scan2albedo.registration.register import judged_with_fit
from scan2albedo.synthetic import Scanner, raw_scan


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


def test_a_part_of_a_machine_is_refused_by_what_the_fit_finds(tmp_path):
    """The search takes this one for a face, at the scale where it resembles one most."""
    file, out = tmp_path / "part.stl", tmp_path / "out"
    machine_part(8).export(file)
    with pytest.raises(NoFaceError, match=r"no face found.*edges are stretched by") as caught:
        s2a.process(file, out, size=64, skip=["albedo"])
    assert caught.value.confidence < 0.4
    assert caught.value.model_from_scan.shape == (4, 4)
    assert not [path for path in out.rglob("*") if path.is_file()]


def registered(confidence):
    return Registration(np.eye(4), 1.0, None, True, confidence, 1, s2a.Trace())


def test_odds_of_search_and_fit_add():
    search, scan = registered(0.9), s2a.RawScan(np.eye(3), np.array([[0, 1, 2]]), name="triangle")
    assert judged_with_fit(search, scan, 0.0, "") is search
    assert judged_with_fit(search, scan, -np.log(9), "").confidence == pytest.approx(0.5)
    with pytest.raises(
        NoFaceError, match=r"triangle: no face found.*its figures; the scan's box is 1 x 1 x 1 mm"
    ):
        judged_with_fit(search, scan, -3.0, "its figures")
    # A search that a budget ended refuses nothing.
    assert judged_with_fit(replace(search, converged=False), scan, -30.0, "").confidence < 1e-9


@pytest.fixture(scope="module")
def case():
    return raw_scan(0, scanner=Scanner(size=64, picture_size=64, spacing_mm=3.5))


def write(path, scan, factor):
    write_obj(path, factor * scan.vertices, scan.faces)
    return path


@pytest.mark.parametrize("factor", [0.037, 41.0])
def test_the_face_gives_the_scale(case, tmp_path, factor):
    scan, truth = case
    result = s2a.process(write(tmp_path / "any.obj", scan, factor), size=32, quality="draft", skip=["albedo"])
    assert "by the size of the face" in next(n for n in result.notes if n.startswith("unit: "))
    extent = np.ptp(result.scan.vertices, axis=0).max() / np.ptp(scan.vertices, axis=0).max()
    assert extent == pytest.approx(1, abs=0.12)
    rotation = result.registration.model_from_scan[:3, :3]
    assert np.degrees(rotation_angle_rad(rotation @ truth.model_from_scan[:3, :3].T)) < 3


def test_a_unit_that_is_given_stands(case, tmp_path):
    file = write(tmp_path / "any.obj", case[0], 0.037)
    with pytest.raises(RegistrationError):
        s2a.process(file, unit="mm", size=64)
    with pytest.raises(UnitError, match="not a head in mm, cm or m"):
        s2a.load_scan(write(tmp_path / "huge.obj", case[0], 41.0))


def test_a_doubtful_face_of_unknown_size_is_refused(case):
    """At one of many sizes much resembles a face: a pose that would do at a known size does not."""
    extents = []

    def register(of):
        extents.append(np.ptp(of.vertices))
        if len(extents) == 1:
            raise NoFaceError("no face found, as it is")
        return of, registered(0.6)

    with pytest.raises(NoFaceError, match="as it is") as caught:
        registered_at_any_scale(case[0], True, register)
    assert "mm long" in caught.value.__notes__[0]
    assert len(extents) == 4  # as it is, and at three sizes: its own was looked for
    assert np.diff(np.log(np.sort(extents))).min() > np.log(1.1)
    with pytest.raises(NoFaceError, match="at any scale"):  # which a draft of the search has tried
        registered_at_any_scale(case[0], False, pytest.fail, register)


def test_what_fits_is_registered_once(case):
    calls, sure = [], registered(1.0)

    def register(of):
        calls.append(of)
        return of, sure

    assert registered_at_any_scale(case[0], True, register) == (case[0], sure)
    assert calls == [case[0]]
