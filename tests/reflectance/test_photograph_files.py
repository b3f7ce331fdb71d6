"""Photographs as files: what is written is read again, and what is wrong is named."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import ReflectanceError, ScanError
from scan2albedo.io.glb import write_glb
from scan2albedo.reflectance import read_photograph
from scan2albedo.runs.reflectance.demo import write_synthetic_photograph
from scan2albedo.synthetic import Portrait, face_photograph


@pytest.fixture(scope="module")
def taken():
    return face_photograph(
        1, np.ones((4, 8, 3)), azimuth_deg=30, lights=4, portrait=Portrait(picture_size=64)
    )


@pytest.fixture(scope="module")
def written(taken, tmp_path_factory):
    return write_synthetic_photograph(taken, tmp_path_factory.mktemp("photograph"))


def test_what_is_written_is_read_again(taken, written):
    read = read_photograph(written)
    assert np.array_equal(read.image, taken.image)
    assert np.array_equal(read.mask, taken.skin)
    assert np.allclose(read.camera, taken.camera)
    assert np.allclose(read.vertices, taken.vertices, atol=1e-4)
    assert np.allclose(read.landmarks_px, taken.landmarks_px, equal_nan=True)
    assert np.isnan(read.landmarks_px).any()
    marked = write_synthetic_photograph(taken, written.parent / "marked", mesh=False)
    assert read_photograph(marked).vertices is None
    assert not (marked.parent / "face.ply").exists()


def test_camera_and_mesh_follow_the_unit(changed, taken):
    read = read_photograph(changed(lambda content: content.update(unit="cm")))
    assert np.allclose(read.vertices, 10 * taken.vertices, atol=1e-3)
    assert np.allclose(read.camera[:, :3], taken.camera[:, :3] / 10)
    assert np.allclose(read.camera[:, 3], taken.camera[:, 3])


def test_the_folder_of_a_processed_scan_stands_for_its_fitted_mesh(folder, changed):
    uv, grey = np.zeros((4, 2)), np.full((2, 2, 3), 128, np.uint8)
    (folder / "scan").mkdir()
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    write_glb(folder / "scan" / "fitted.glb", 100 * np.eye(4, 3), faces, uv, grey)
    found = []
    for mesh in ("scan", "scan/fitted.glb"):
        file = changed(lambda content, mesh=mesh: content.update(mesh=mesh))
        found.append(read_photograph(file).vertices)
    assert_array_equal(*found)
    assert_allclose(np.ptp(found[0], axis=0), 100, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c.pop("image"), "image: Field required"),
        (lambda c: c.update(mesh=None, landmarks=None), "neither a mesh nor landmarks"),
        (lambda c: c.update(landmarks=[[1, 2]]), "there are 1 landmarks, expected 68"),
        (lambda c: c.update(camera=[[1, 0, 0, 0]]), "camera"),
        (lambda c: c.update(gamma=0), "gamma"),
        (lambda c: c.update(iso=100), "iso"),
    ],
)
def test_files_that_do_not_fit_are_refused_by_name(changed, change, told):
    file = changed(change)
    with pytest.raises(ReflectanceError, match=told) as raised:
        read_photograph(file)
    assert "photograph.json" in str(raised.value)


def test_missing_pictures_and_wrong_masks_are_named(folder):
    cv2.imwrite(str(folder / "skin.png"), np.zeros((8, 9, 3), np.uint8))
    with pytest.raises(ReflectanceError, match=r"skin\.png is 9 x 8 pixels"):
        read_photograph(folder / "photograph.json")
    (folder / "image.png").unlink()
    with pytest.raises(ScanError, match=r"image\.png"):
        read_photograph(folder / "photograph.json")
