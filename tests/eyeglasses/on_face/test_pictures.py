"""Frames found in pictures: edges by colour, the frame put on a head, what is proposed, and what is not."""

import numpy as np
import pytest
from helpers.measures import row_lengths
from helpers.wearers import small_wearer
from helpers.worn_frames import front_error_mm, photographs, register

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.on_face.outline import color_odds, grouped_colors, search_colors


def person():
    return small_wearer(1, 384)


def found_in_pictures(**changes):
    worn = person()
    given = {"keypoints_2d": np.full_like(worn.labels, np.nan), "masks": None, "shapes": [(384, 384)] * 3}
    return register(worn, **{**given, "pictures": photographs(worn), **changes})


@pytest.fixture(scope="module")
def seen():
    return found_in_pictures()


def test_a_bar_is_found_where_it_is_and_missed_where_it_is_not():
    frame, picture = np.zeros((80, 120), bool), np.full((80, 120, 3), 200.0)
    frame[:, 50:58] = True
    picture[:, 52:60] = 30.0  # two pixels farther on
    colors = grouped_colors(picture, np.array([[0.0, 0], [119, 79]]))
    odds = color_odds(colors, frame)
    where = np.array([[57.0, 40]]), np.array([[1.0, 0]]), np.array([15.0])
    way, noise, chance = search_colors(odds, frame, *where)
    assert way[0] == pytest.approx(2, abs=0.5)
    assert noise[0] < 1.5
    assert chance[0] > 0.8
    hidden = np.where(colors == colors[0, 57], odds.min(), odds)
    assert search_colors(hidden, frame, *where)[2][0] < 0.5


@pytest.mark.slow
def test_pictures_place_a_frame_that_nobody_labelled(seen):
    guessed = found_in_pictures(pictures=None)
    error, before = (front_error_mm(found.vertices, person()) for found in (seen, guessed))
    assert error < 0.8
    assert before > 2 * error
    assert any(step.stage == "glasses.pictures" and step.ran for step in seen.plan)


def test_proposals_are_as_good_as_they_say(seen):
    off = row_lengths(seen.proposed_labels - person().labels)
    judged = np.isfinite(off)
    assert judged.sum() > 20
    stated = np.sqrt(2) * seen.proposed_deviation_px[judged]
    assert np.median(off[judged]) < 1
    assert (off[judged] <= 3 * stated).mean() > 0.9
    for mask, true in zip(seen.proposed_masks, person().masks, strict=True):
        assert (mask & true).sum() / (mask | true).sum() > 0.75
    said = " ".join(step.evidence for step in seen.plan if step.stage == "glasses.proposed")
    assert "left_rim_top" in said


def test_labels_and_masks_that_somebody_made_go_first():
    worn = person()
    found = found_in_pictures(keypoints_2d=worn.labels)
    assert not np.isfinite(found.proposed_labels + worn.labels).any()
    both = found_in_pictures(keypoints_2d=worn.labels, masks=worn.masks)
    assert both.proposed_masks == (None, None, None)


def test_nothing_is_proposed_where_there_is_no_frame():
    found = found_in_pictures(pictures=photographs(person(), shown=False))
    assert np.isnan(found.proposed_labels).all()
    assert found.proposed_masks == (None, None, None)
    assert any("not found in the pictures" in step.reason for step in found.plan.doubts())


@pytest.mark.parametrize(
    ("changes", "kind", "words"),
    [
        ({"head": None}, EyeglassesError, "no head to put the frame on"),
        (
            {"head": (person().head_vertices + [0.0, 500, 0], person().head_faces)},
            EyeglassesError,
            "not in the face model's frame",
        ),
        ({"pictures": [np.zeros((5, 5, 3))] * 3}, ValueError, "picture 0 has shape"),
        ({"pictures": [np.full((384, 384, 3), np.nan)] * 3}, EyeglassesError, "picture 0 holds numbers"),
    ],
)
def test_without_labels_pictures_and_a_head_in_the_face_models_frame_are_needed(changes, kind, words):
    with pytest.raises(kind, match=words):
        found_in_pictures(**changes)
