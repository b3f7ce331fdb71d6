"""Reflectances of meshes as files."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.npz import cut
from numpy.testing import assert_array_equal
from worlds.flash_captures import head_capture, samples_of

from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance import (
    MeshReflectance,
    MorphableReflectanceModel,
    VertexReflectance,
    fit_reflectance,
    read_reflectance,
    write_reflectance,
)


@pytest.fixture
def mesh():
    rng = np.random.default_rng(0)
    known = np.array([True, True, False, True])
    one = VertexReflectance(rng.random((4, 3)), rng.random((4, 3)), known)
    return MeshReflectance(rng.normal(size=(4, 3)), np.array([[0, 1, 2], [0, 2, 3]]), one)


def test_what_is_written_is_read_again(mesh, tmp_path):
    write_reflectance(tmp_path / "reflectance.npz", mesh)
    for path in (tmp_path / "reflectance.npz", tmp_path):
        read = read_reflectance(path)
        assert_array_equal(read.vertices, mesh.vertices)
        assert_array_equal(read.faces, mesh.faces)
        for name, value in vars(mesh.reflectance).items():
            assert_array_equal(getattr(read.reflectance, name), value)
        assert read.std is read.seen is None
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReflectanceError, match=r"empty.*reflectance\.npz.*folder"):
        read_reflectance(tmp_path / "empty")


def test_a_fit_keeps_its_deviations(tmp_path):
    capture = head_capture(60)
    fit = fit_reflectance(samples_of(capture, noise=0.01))
    mesh = MeshReflectance(capture.vertices, np.array([[0, 1, 2]]), fit.reflectance)
    write_reflectance(tmp_path / "reflectance.npz", mesh, fit=fit)
    assert_array_equal(read_reflectance(tmp_path).std, fit.std)
    with np.load(tmp_path / "reflectance.npz") as arrays:
        assert_array_equal(arrays["tilt"], fit.tilt)
        assert_array_equal(arrays["impossible"], fit.impossible)


def test_what_a_photograph_shows_is_kept_apart_from_what_a_model_adds(mesh, tmp_path):
    seen = np.array([True, False, False, True])
    write_reflectance(tmp_path / "face.npz", replace(mesh, seen=seen))
    assert_array_equal(read_reflectance(tmp_path / "face.npz").seen, seen)
    with pytest.raises(ReflectanceError, match=r"seen is bool \(3,\)"):
        replace(mesh, seen=seen[:3])


def test_damaged_and_other_files_are_refused_by_name(mesh, tmp_path):
    file = tmp_path / "face.npz"
    write_reflectance(file, mesh)
    cut(file)
    MorphableReflectanceModel.from_samples([mesh.reflectance]).save(tmp_path / "model.npz")
    for name in ("face.npz", "model.npz", "none.npz"):
        with pytest.raises(ReflectanceError, match=name.replace(".", r"\.")):
            read_reflectance(tmp_path / name)
    with pytest.raises(ValueError, match=r"\.npz"):
        write_reflectance(tmp_path / "face.bin", mesh)


@pytest.mark.parametrize(
    ("vertices", "faces", "told"),
    [
        (np.zeros((3, 3)), [[0, 1, 2]], "the mesh has 3 vertices, its reflectance 4"),
        (np.zeros((4, 3)), [[0.0, 1.0, 1.5]], "not whole"),
    ],
)
def test_meshes_that_do_not_fit_are_refused(mesh, vertices, faces, told):
    with pytest.raises(ReflectanceError, match=told):
        MeshReflectance(vertices, np.array(faces), mesh.reflectance)
