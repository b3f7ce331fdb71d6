"""The caveats that a run of `fit-image` writes beside its figures."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

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


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"relative_rmse": 0.38, "beats_mean": False, "badly_explained": True},
            "explain the photograph badly: relative RMSE 38.0 %.*mean face",
        ),
        ({"beats_mean": False}, "nothing found in this photograph predicts"),
        ({"gamma_given": False}, r"photograph\.json gives no gamma: light is taken as value\^1\.2"),
    ],
)
def test_what_limits_a_fit_is_told(given, told):
    (note,) = notes(**given)
    assert re.search(told, note)


def test_a_photograph_that_is_explained_has_no_note():
    assert notes() == ()
