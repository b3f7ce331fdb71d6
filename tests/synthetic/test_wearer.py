"""A synthetic wearer: glasses on the nose, labels and masks that belong to the cameras."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic import GlassesBend, wearer

pytestmark = pytest.mark.slow

CLEAN = {"picture_size": 512, "focal_px": 900, "label_noise_px": 0, "mask_noise_px": 0}


@pytest.fixture(scope="module")
def person():
    return wearer(2, **CLEAN)


def test_the_frame_rests_on_the_nose(person):
    head = RayCaster(person.head_vertices, person.head_faces)
    front = person.glasses.rest_vertices[:, 2] > -14
    behind = head.first_hit(person.vertices[front], np.array([0.0, 0, -1])).distance
    assert 0.1 < behind.min() < 1.0
    front = person.glasses.rest_vertices[:, 2] > -8
    eyes = person.sitter.face.landmarks[36:48].mean(0)
    assert np.abs(person.vertices[front].mean(0) - eyes)[:2].max() < 12


def test_the_temples_pass_the_head(person):
    assert 2 < person.glasses.bend.temple_spread_mm < 19
    head = RayCaster(person.head_vertices, person.head_faces)
    tips = person.keypoints[[10, 19]]
    outward = np.sign(tips[:, :1]) * np.array([1.0, 0, 0])
    assert not head.occluded(tips, outward).any()


def test_labels_are_the_key_points_pictures(person):
    for camera, labels, hidden in zip(person.cameras, person.labels, person.hidden, strict=True):
        pixels, _ = project(camera, person.keypoints)
        gone = hidden[person.glasses.keypoint_vertices]
        assert_array_equal(np.isnan(labels).all(1), gone)
        assert_allclose(labels[~gone], pixels[~gone], atol=1e-9)
    assert person.hidden[0].any()
    assert person.hidden[2].any()


def test_masks_show_what_the_head_does_not_hide(person):
    for camera, mask, hidden in zip(person.cameras, person.masks, person.hidden, strict=True):
        pixels = np.round(project(camera, person.vertices)[0]).astype(int)
        shown = mask[pixels[:, 1].clip(0, 511), pixels[:, 0].clip(0, 511)]
        assert shown[~hidden].mean() > 0.75
        assert 0.005 < mask.mean() < 0.08


def test_noise_is_as_asked():
    person = wearer(2, **(CLEAN | {"label_noise_px": 2.0, "outliers": 2, "missing": 3}))
    pixels = np.stack([project(camera, person.keypoints)[0] for camera in person.cameras])
    off = np.abs(person.labels - pixels)
    assert np.nanmedian(off) == pytest.approx(2.0 * 0.6745, rel=0.35)
    assert np.isnan(person.labels).all((0, 2)).sum() == 3
    assert (np.nanmax(off, axis=(1, 2)) > 15).all()


def test_the_same_seed_gives_the_same_person(person):
    again = wearer(2, **CLEAN)
    assert_array_equal(person.vertices, again.vertices)
    assert_array_equal(person.masks, again.masks)


def test_a_bend_of_ones_own_is_kept():
    bend = GlassesBend(temple_spread_mm=-4, bridge_deg=2)
    assert wearer(1, bend=bend, **CLEAN).glasses.bend == bend
