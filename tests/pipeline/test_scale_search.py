"""Scans of any scale: the face gives it, a given unit stands, and what is not a face is refused at any."""

import numpy as np
import pytest

import scan2albedo as s2a
from scan2albedo.errors import NoFaceError, RegistrationError, UnitError
from scan2albedo.geometry.rigid import rotation_angle_rad
from scan2albedo.io.obj import write_obj
from scan2albedo.pipeline.scale_search import registered_at_any_scale
from scan2albedo.registration import Registration
from scan2albedo.synthetic import Scanner, raw_scan


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


def registered(confidence):
    return Registration(np.eye(4), 1.0, None, True, confidence, 1, s2a.Trace())


def test_a_unit_that_is_given_stands(case, tmp_path):
    file = write(tmp_path / "any.obj", case[0], 0.037)
    with pytest.raises(RegistrationError):
        s2a.process(file, unit="mm", size=64)
    with pytest.raises(UnitError, match="not a head in mm, cm or m"):
        s2a.load_scan(write(tmp_path / "huge.obj", case[0], 41.0))


def test_a_doubtful_face_of_unknown_size_is_refused(case):
    """At one of many sizes much resembles a face: a pose that would do at a known size does not."""
    tried = []

    def register(of):
        tried.append(of)
        if len(tried) == 1:
            raise NoFaceError("no face found, as it is")
        return of, registered(0.6)

    with pytest.raises(NoFaceError, match="as it is"):
        registered_at_any_scale(case[0], True, register)
    extents = [float(np.ptp(each.vertices)) for each in tried]
    assert len(tried) == 4  # as it is, and at three sizes: its own was looked for
    assert np.abs(np.diff(np.log(np.sort(extents)))).min() > np.log(1.1)
    with pytest.raises(NoFaceError, match="at any scale"):
        registered_at_any_scale(case[0], False, register)


def test_what_fits_is_registered_once(case):
    calls, sure = [], registered(1.0)

    def register(of):
        calls.append(of)
        return of, sure

    assert registered_at_any_scale(case[0], True, register) == (case[0], sure)
    assert calls == [case[0]]
