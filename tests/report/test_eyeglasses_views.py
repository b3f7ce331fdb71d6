"""Pictures of registered frames show what fits and what does not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.eyeglasses import nearest_weights
from helpers.wearers import small_wearer
from PIL.ImageColor import getrgb
from scipy.ndimage import distance_transform_edt

from scan2albedo.eyeglasses import Camera, register_on_face
from scan2albedo.report import eyeglasses_views
from scan2albedo.report.eyeglasses_views import registration_panels

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def person():
    return small_wearer(0)


@pytest.fixture(scope="module")
def views(person):
    shape = person.masks.shape[1:]
    cameras = [Camera(f"c{n}", matrix, shape) for n, matrix in enumerate(person.cameras)]
    return list(zip(cameras, person.masks, person.labels, strict=True))


@pytest.fixture(scope="module")
def frame(person):
    """The true frame, with the report of a registration."""
    glasses = person.glasses
    weights = nearest_weights(glasses.rest_vertices, glasses.rest_keypoints)
    rest = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, weights)
    found = register_on_face(rest, person.labels, None, person.cameras)
    return replace(found, vertices=person.vertices, keypoints=person.keypoints)


def painted(panel, color):
    return (panel.picture == getrgb(color)).all(-1)


def off_mask(panel):
    """How far in pixels nine tenths of the orange outline are from the gray of the mask, at most."""
    shade = panel.picture[:, :, 0].astype(int)
    gray = (panel.picture == panel.picture[:, :, :1]).all(-1)
    light = gray & (shade >= 64)
    outline = painted(panel, "darkorange")
    assert outline.any()
    return float(np.percentile(distance_transform_edt(~light)[outline], 90))


def test_the_outline_of_the_true_frame_is_that_of_its_mask(person, frame, views):
    head = (person.head_vertices, person.head_faces)
    panels = registration_panels(frame, views, head)
    assert len(panels) == 6
    for panel in panels[:3]:
        assert panel.picture.shape == panels[0].picture.shape
        assert off_mask(panel) < 5  # a pixel of the picture
    shifted = replace(frame, vertices=frame.vertices + [0, 8.0, 0])
    assert off_mask(registration_panels(shifted, views, head)[1]) > 8


def test_what_the_head_hides_is_blue(person, frame, views):
    bare = registration_panels(frame, views)
    assert len(bare) == 5
    covered = registration_panels(frame, views, (person.head_vertices, person.head_faces))
    for number in (0, 2):  # from the sides the far temple is behind the head
        assert not painted(bare[number], "cornflowerblue").any()
        assert painted(covered[number], "cornflowerblue").sum() > 50


def test_labels_are_green_and_outliers_red(frame, views):
    labels = views[1][2].copy()
    labels[0] += 90
    errors, inliers = frame.label_errors_px.copy(), frame.inliers.copy()
    errors[1, 0] = 127.0
    inliers[1, 0] = False
    wrong = replace(frame, label_errors_px=errors, inliers=inliers)
    panel = registration_panels(wrong, [views[0], (views[1][0], None, labels), views[2]])[1]
    assert "1 outliers" in panel.title
    assert "no mask" in panel.title
    assert panel.dot_colors == ["crimson", *["lime"] * 19]
    assert (panel.dots >= 0).all()
    assert (panel.dots < panel.picture.shape[0]).all()


def test_what_is_not_observed_is_red(frame, views):
    observed = frame.vertices[:, 0] <= 0
    panel = registration_panels(replace(frame, observed=observed), views)[3]
    assert "not observed" in panel.title
    red = (panel.picture[:, :, 0] > 60) & (panel.picture[:, :, 1] < 0.3 * panel.picture[:, :, 0])
    middle = panel.picture.shape[1] // 2
    # The wearer's left, x > 0, is on the right.
    assert red[:, middle + 20 :].sum() > 1000
    assert not red[:, : middle - 20].any()
    nothing = registration_panels(replace(frame, observed=np.zeros_like(observed)), views)[3]
    assert "nothing is observed" in nothing.title


def test_a_frame_behind_the_camera_and_many_views_are_drawn(frame, views):
    gone = replace(views[0][0], matrix=views[0][0].matrix @ np.diag([1, 1, 1, -1.0]))
    nowhere = (gone, None, np.full((20, 2), np.nan))
    twenty = 20 * [0]
    fields = {"inliers": frame.inliers[twenty], "outline_rms_px": frame.outline_rms_px[twenty]}
    many = replace(frame, label_errors_px=np.full((20, 20), np.nan), **fields)
    panels = registration_panels(many, 20 * [nowhere])
    assert len(panels) == eyeglasses_views.MOST_SHOWN + 2
    assert not painted(panels[0], "darkorange").any()
