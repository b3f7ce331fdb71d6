"""The cameras of textures that are photographs, against those that took them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.patches import patch

from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import compose, invert_rigid, random_rotation, transform_points
from scan2albedo.sampling import geometry_image, geometry_image_of_scan
from scan2albedo.sampling.texture_lookup import texture_cameras

PIXELS = 500
PLACES = np.array([[600.0, 100.0, 800.0], [-550.0, 80.0, 820.0]])


def hill(x, y):
    return 40 * np.exp(-(x**2 + y**2) / 1800) + 3 * np.sin(x / 9) * np.cos(y / 7)


def photographed(noise_px=0.0):
    """A patch that cameras in a row took: the scan, and which camera took a face, that which it turns to."""
    flat = patch(hill)
    toward = PLACES[None] - flat.centres[:, None]
    taken = np.einsum("fkc,fc->fk", toward, face_normals(flat.vertices, flat.faces)).argmax(1)
    cameras = [look_at(place, [0, 0, 0], focal_px=3000, shape=(PIXELS, PIXELS)) for place in PLACES]
    seen = np.stack([project(camera, flat.vertices)[0] for camera in cameras])
    seen += noise_px * np.random.default_rng(0).standard_normal(seen.shape)
    pixels = seen[taken[:, None], flat.faces]
    column, row = np.moveaxis((pixels + 0.5) / PIXELS, -1, 0)
    uv = np.stack([(column + taken[:, None]) / len(PLACES), 1 - row], -1)
    picture = np.full((PIXELS, PIXELS * len(PLACES), 3), 0.4, np.float32)
    return RawScan(flat.vertices, flat.faces, uv=uv, texture_linear=picture), taken


@pytest.mark.parametrize(("noise_px", "off_mm"), [(0.0, 1e-3), (0.3, 20.0)])
def test_two_photographs_side_by_side(noise_px, off_mm):
    scan, taken = photographed(noise_px=noise_px)
    face_camera, positions = texture_cameras(scan)
    order = [int(np.linalg.norm(positions - place, axis=1).argmin()) for place in PLACES]
    assert np.linalg.norm(positions[order] - PLACES, axis=1).max() < off_mm
    assert (face_camera == np.array(order)[taken]).mean() > 0.99
    assert set(face_camera) <= {-1, 0, 1}


def test_small_pieces_belong_to_the_camera_that_projects_them():
    scan, taken = photographed()
    # Every fifth face gets vertices of its own, and so is a piece of the texture by itself.
    loose = np.arange(len(scan.faces)) % 5 == 0
    more = scan.vertices[scan.faces[loose]].reshape(-1, 3)
    faces = scan.faces.copy()
    faces[loose] = len(scan.vertices) + np.arange(len(more)).reshape(-1, 3)
    face_camera, positions = texture_cameras(
        replace(scan, vertices=np.concatenate([scan.vertices, more]), faces=faces)
    )
    assert len(positions) == 2
    assert len(np.unique(np.column_stack([face_camera, taken]), axis=0)) == 2


def test_corners_that_were_moved_afterwards_do_not_lead_it_astray():
    scan, _ = photographed()
    vertices = scan.vertices.copy()
    vertices[::40] += np.random.default_rng(1).normal(0, 8, vertices[::40].shape)
    face_camera, positions = texture_cameras(replace(scan, vertices=vertices))
    distance = np.linalg.norm(positions[:, None] - PLACES, axis=2).min(1)
    assert distance.max() < 1.0
    assert (face_camera >= 0).mean() > 0.97


def chart(scan):
    """The patch's own chart: no photograph, but for its straight sides."""
    stretched = scan.vertices[:, :2] / 100 + 0.5
    stretched[:, 0] += 0.08 * np.sin(scan.vertices[:, 1] / 20)
    return stretched[scan.faces]


@pytest.mark.parametrize(
    "other",
    [
        lambda scan: replace(scan, uv=chart(scan)),
        lambda scan: replace(scan, uv=np.where(scan.uv[..., :1] < 0.5, scan.uv, chart(scan))),
        lambda scan: replace(scan, vertices=scan.vertices * [1, 1, 0]),
        lambda scan: replace(scan, faces=scan.faces[:, ::-1], uv=scan.uv[:, ::-1]),
        lambda scan: replace(scan, faces=scan.faces[:90], uv=scan.uv[:90]),
        lambda scan: replace(scan, uv=None, texture_linear=None),
        lambda scan: replace(scan, uv=np.zeros_like(scan.uv)),
    ],
    ids=["unwrapped", "half unwrapped", "plane", "seen from behind", "few faces", "no texture", "one point"],
)
def test_no_camera_is_found_where_none_can_be(other):
    assert texture_cameras(other(photographed()[0])) is None


@pytest.mark.parametrize("seed", range(2))
def test_texels_know_their_camera_in_the_models_frame(seed):
    rng = np.random.default_rng(seed)
    pose = compose(random_rotation(rng), rng.uniform(-500, 500, 3))
    scan, _ = photographed()
    posed = replace(scan, vertices=transform_points(invert_rigid(pose), scan.vertices))
    image = geometry_image(patch(hill, model_from_scan=pose), posed, size=40)
    assert (image.camera != NO_CAMERA).mean() > 0.99
    toward = image.toward_camera((0, 0, 1))
    nearest = np.linalg.norm(PLACES[:, None] - image.camera_positions, axis=2).argmin(1)
    for place, number in zip(PLACES, nearest, strict=True):
        there = image.camera[image.mask] == number
        away = place - image.position[image.mask][there]
        assert there.mean() > 0.3
        assert toward[there] == pytest.approx(away / np.linalg.norm(away, axis=1)[:, None], abs=1e-4)
    assert image.figures()["cameras"] == 2


def test_without_a_model_too():
    scan, _ = photographed()
    image = geometry_image_of_scan(scan, size=64)
    moved = scan.vertices.mean(0)
    apart = np.linalg.norm(image.camera_positions[:, None] + moved - PLACES, axis=2).min(1)
    assert apart.max() < 0.1
