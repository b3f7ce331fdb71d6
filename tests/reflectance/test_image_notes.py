"""The caveats that a run of `fit-image` writes beside its figures."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scan2albedo.core import Trace
from scan2albedo.reflectance.app.image_run import FittedPhotograph


def notes(relative_rmse, *, beats_mean=True, gamma_given=True):
    """Return the notes on a fit that leaves so much unexplained, of which details hide a part."""
    photograph = SimpleNamespace(
        path=Path("photograph.json"), content=SimpleNamespace(gamma=1.2), gamma_given=gamma_given
    )
    fit = SimpleNamespace(converged=True, relative_rmse=relative_rmse)
    face = SimpleNamespace(beats_mean=beats_mean, relative_rmse=0.1, fit=fit)
    mesh = np.zeros((3, 3)), np.array([[0, 1, 2]])
    return FittedPhotograph(photograph, *mesh, None, face, None, Trace()).notes()


@pytest.mark.parametrize("beats_mean", [False, True])
def test_a_photograph_that_no_light_explains_is_told(beats_mean):
    found = notes(0.38, beats_mean=beats_mean)
    assert any("explain the photograph badly: relative RMSE 38.0 %" in note for note in found)
    assert any("mean face" in note for note in found) != beats_mean


def test_a_photograph_that_is_explained_has_no_note():
    assert notes(0.12) == ()


def test_a_missing_gamma_is_told():
    (note,) = notes(0.12, gamma_given=False)
    assert "photograph.json gives no gamma: light is taken as value^1.2" in note
