"""How sure landmarks are: more where there is scan near them; what a fit says against a face."""

import numpy as np
import pytest

from scan2albedo.fitting.result import face_log_odds, landmark_deviation_mm


def test_it_is_usual_on_the_scan_and_grows_where_there_is_none_and_where_the_surface_lies_off_it(model):
    vertices, _ = model.surface(2)
    residual = np.zeros(len(vertices))
    usual = landmark_deviation_mm(model.landmarks, vertices, residual)
    assert usual.shape == (68,)
    assert usual[31:36].max() < usual[48:68].min()
    assert (usual[:17] > 4).all()
    assert (landmark_deviation_mm(model.landmarks + 500, vertices, residual) > usual).all()
    left = vertices[:, 0] > 0
    half = landmark_deviation_mm(model.landmarks, vertices, np.where(left, np.nan, residual))
    assert (half[[22, 26, 45, 54]] > usual[[22, 26, 45, 54]] + 1).all()
    np.testing.assert_array_equal(half[[17, 36, 48]], usual[[17, 36, 48]])
    off = landmark_deviation_mm(model.landmarks, vertices, residual + 3)
    np.testing.assert_allclose(off, np.hypot(usual, 3))


@pytest.mark.parametrize(
    "figures",
    [
        (0.1, 0.08, 0.3),
        (0.18, 0.08, 0.7),
        (0.2, 0.07, 0.4),
        (0.15, 0.1, 0.4),
        (0.3, 0.5, 1.5),
        (0.15, 0.85, 4.2),
        (0.0, 0.0, 0.0),
    ],
    ids=[
        "a face",
        "a foam head with a cap",
        "an infant",
        "an old laser scan",
        "noise",
        "raw stereo with 6 mm of it",
        "the model itself",
    ],
)
def test_nothing_speaks_against_what_is_reached_or_hardly_stretched(figures):
    assert face_log_odds(*figures) == 0


def test_steps_that_a_stretched_model_does_not_reach_are_no_face():
    """Figures of a plate with bosses and ribs; the surest of 41 has odds of 5.5 from the search."""
    plate = face_log_odds(0.25, 0.12, 3.3)
    assert plate < -7
    assert plate < face_log_odds(0.25, 0.12, 2.0) < face_log_odds(0.25, 0.12, 1.5)
    assert plate < face_log_odds(0.15, 0.12, 3.3) < face_log_odds(0.12, 0.12, 3.3)
