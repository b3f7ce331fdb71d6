"""The caveats that a run of `fit-image` writes beside its figures."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from scan2albedo.core import Trace
from scan2albedo.runs.reflectance.image_run import FittedPhotograph


def notes(relative_rmse=0.12, *, beats_mean=True, badly_explained=False, gamma_given=True):
    """Return the notes on a fit."""
    content = SimpleNamespace(gamma=1.2, model_fields_set={"gamma"} if gamma_given else set())
    photograph = SimpleNamespace(path=Path("photograph.json"), content=content)
    fit = SimpleNamespace(converged=True, relative_rmse=relative_rmse)
    face = SimpleNamespace(beats_mean=beats_mean, badly_explained=badly_explained, fit=fit)
    mesh = np.zeros((3, 3)), np.array([[0, 1, 2]])
    return FittedPhotograph(photograph, *mesh, None, face, None, Trace()).notes()


def test_a_photograph_that_no_light_explains_is_told():
    (note,) = notes(0.38, beats_mean=False, badly_explained=True)
    assert "explain the photograph badly: relative RMSE 38.0 %" in note
    assert "mean face" in note


def test_a_mean_face_is_told():
    (note,) = notes(beats_mean=False)
    assert "nothing found in this photograph predicts" in note


def test_a_photograph_that_is_explained_has_no_note():
    assert notes() == ()


def test_a_missing_gamma_is_told():
    (note,) = notes(gamma_given=False)
    assert "photograph.json gives no gamma: light is taken as value^1.2" in note
