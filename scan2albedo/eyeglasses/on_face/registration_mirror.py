"""Whether left and right of the labels, or of the glasses' key points, are exchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from scan2albedo.core import Meter
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import MIRROR
from scan2albedo.eyeglasses.on_face.registration_descent import ENOUGH, descend
from scan2albedo.eyeglasses.on_face.registration_inputs import RegistrationInputs
from scan2albedo.eyeglasses.on_face.registration_options import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.registration_start import starting_poses
from scan2albedo.eyeglasses.on_face.registration_terms import RegistrationObjective, median_label_px

_MIRRORED = 0.5
"""Part of the labels' error below which exchanging left and right explains them."""


def require_unmirrored(given: RegistrationInputs, options: FaceRegistrationOptions, here_px: float) -> None:
    """Raise where the labels fit far better with left and right exchanged.

    Parameters
    ----------
    given : RegistrationInputs
    options : FaceRegistrationOptions
    here_px : float
        Error of the labels as they are, at the best pose.

    Raises
    ------
    EyeglassesError
        When exchanging them explains the labels.
    """
    views = tuple(replace(view, labels=view.labels[list(MIRROR)]) for view in given.views)
    objective = RegistrationObjective(given.keypoints, views, options)
    rigid = partial(objective.linearize, samples=None, rigid=True)
    try:
        starts = starting_poses(given.keypoints, views, options.label_noise_px, None)
    except EyeglassesError:
        return
    first = min(starts, key=lambda state: rigid(state).cost)
    found = descend(
        rigid, first, Meter("mirrored", "px"), steps=options.steps, enough=ENOUGH, error=median_label_px
    )
    there_px = median_label_px(found.at)
    if there_px < _MIRRORED * here_px:
        raise EyeglassesError(
            "left and right of the labels, or of the glasses' key points, seem to be exchanged: the pose "
            f"fits to {there_px:.1f} px with them swapped, to {here_px:.1f} px as they are"
        )
