"""The prior of albedo: what it says of faces, its Gaussian, and its file."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.npz import rewritten

from scan2albedo.albedo.prior import MEANS, NODES, AlbedoPrior
from scan2albedo.errors import LightingError
from scan2albedo.face_model import default_model
from scan2albedo.synthetic.textures import landmark_uv

BROWS = range(17, 27)
LIPS = (50, 52, 57)
CHEEKS = (2, 14)
FOREHEAD = (19, 24)


@pytest.fixture(params=["faces", "stationary"])
def prior(request):
    return getattr(AlbedoPrior, request.param)()


def landmark_places(numbers):
    """Row and column of landmarks on the default chart."""
    u, v = landmark_uv(default_model())[list(numbers)].T
    return np.stack([1 - v, u], 1)


@pytest.mark.parametrize("channel", range(3))
def test_covariances_are_symmetric_and_positive_definite(prior, channel):
    covariance = prior.covariance(channel)
    assert covariance.shape == (NODES**2, NODES**2)
    assert covariance == pytest.approx(covariance.T, abs=1e-15)
    values = np.linalg.eigvalsh(covariance)
    assert values[0] > 1e-7 * values[-1]


def test_the_stationary_covariance_is_the_exponential():
    spread = np.full((3, NODES, NODES), 0.2)
    prior = replace(AlbedoPrior.stationary(), spread=spread, length=0.3)
    covariance = prior.covariance(0).reshape((NODES,) * 4)
    assert covariance[3, 4, 3, 4] == pytest.approx(0.04)
    assert covariance[0, 0, 3, 4] == pytest.approx(0.04 * np.exp(-5 / NODES / 0.3))
    assert not prior.mean.any()
    assert not prior.face


def test_weights_reproduce_what_is_linear_and_hold_the_edges():
    places = np.random.default_rng(0).uniform(0.05, 0.95, (50, 2))
    weights = AlbedoPrior.node_weights(places)
    centres = (np.indices((NODES, NODES)).reshape(2, -1).T + 0.5) / NODES
    plane = np.clip(places, 0.5 / NODES, 1 - 0.5 / NODES)
    assert weights @ centres == pytest.approx(plane, abs=1e-12)
    corners = AlbedoPrior.node_weights([[0, 0], [0, 1], [1, 0], [1, 1]])
    assert corners.sum(1) == pytest.approx(1)
    assert corners.toarray().argmax(1).tolist() == [0, NODES - 1, NODES * (NODES - 1), NODES**2 - 1]


def test_means_and_deviations_at_the_cells_centres_are_the_cells(prior):
    rows, columns = [0, 5, 63], [10, 30, 63]
    places = (np.stack([rows, columns], 1) + 0.5) / MEANS
    assert prior.mean_at(places) == pytest.approx(prior.mean[rows, columns])
    assert prior.deviation_at(places) == pytest.approx(prior.deviation[rows, columns])


def test_brows_are_dark_and_lips_are_red():
    prior = AlbedoPrior.faces()
    brows, lips, cheeks = (prior.mean_at(landmark_places(n)) for n in (BROWS, LIPS, CHEEKS))
    above = prior.mean_at(landmark_places(FOREHEAD) - [0.12, 0])
    assert brows[:, 0].mean() < above[:, 0].mean() - 0.3
    assert lips[:, 0].mean() < above[:, 0].mean() - 0.1
    assert lips[:, 1].max() < cheeks[:, 1].min()
    assert abs(above).max() < 0.3


def test_skin_is_redder_than_it_is_green_and_blue():
    mean, *covariance = AlbedoPrior.faces().chroma
    green, blue = np.sqrt(np.diag(covariance))
    assert -1.5 < mean[1] < mean[0] < -0.7
    # From the palest to the darkest person both vary by a factor of four, together.
    assert (green, blue) == pytest.approx((0.25, 0.4), rel=0.1)
    assert covariance[0][1] > 0.85 * green * blue


def test_faces_are_symmetric():
    prior = AlbedoPrior.faces()
    for grid in (prior.mean, prior.deviation):
        assert grid == pytest.approx(grid[:, ::-1], abs=1e-3)
    for channel in range(3):
        covariance = prior.covariance(channel).reshape((NODES,) * 4)
        assert covariance == pytest.approx(covariance[:, ::-1, :, ::-1], abs=2e-3 * covariance.max())


def test_a_saved_prior_comes_back(prior, tmp_path):
    path = tmp_path / "prior.npz"
    prior.save(path)
    back = AlbedoPrior.load(path)
    for name in ("mean", "deviation", "modes", "spread", "chroma"):
        assert getattr(back, name) == pytest.approx(getattr(prior, name), rel=1e-3, abs=1e-6)
    for name in ("shrinkage", "length", "level", "face"):
        assert getattr(back, name) == getattr(prior, name)
    back.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("mean", np.zeros((3, 3, 3)), r"mean is float64 of shape \(3, 3, 3\).* \(64, 64, 3\); give a file"),
        ("modes", np.zeros((3, 5, 2, 2)), rf"expected finite numbers of shape \(3, R, {NODES}, {NODES}\)"),
        ("spread", np.full((3, NODES, NODES), np.nan), "spread .* expected finite"),
        ("deviation", np.zeros((MEANS, MEANS, 3)), "not above 0"),
        ("level", np.array("high"), "level is <U4"),
        ("chroma", np.zeros((3, 2)), "not above 0"),
    ],
)
def test_a_file_of_other_arrays_is_refused_by_name(name, value, message, tmp_path):
    path = tmp_path / "prior.npz"
    AlbedoPrior.stationary().save(path)
    rewritten(path, **{name: value})
    with pytest.raises(LightingError, match=f"albedo prior .*prior.npz: .*{message}"):
        AlbedoPrior.load(path)


def test_a_file_that_is_none_is_refused_by_name(tmp_path):
    (tmp_path / "prior.npz").write_text("nothing")
    for name in ("prior.npz", "absent.npz"):
        with pytest.raises(LightingError, match=f"{name} cannot be read .*AlbedoPrior.save` wrote"):
            AlbedoPrior.load(tmp_path / name)


def test_an_option_names_the_prior(tmp_path):
    assert AlbedoPrior.by_name("auto", face=True) is AlbedoPrior.faces()
    assert not AlbedoPrior.by_name("auto", face=False).face
    assert not AlbedoPrior.by_name("stationary", face=True).face
    spread = np.full((3, NODES, NODES), 0.5)
    replace(AlbedoPrior.stationary(), spread=spread).save(tmp_path / "mine.npz")
    assert AlbedoPrior.by_name(str(tmp_path / "mine.npz"), face=True).spread[0, 0, 0] == 0.5
    with pytest.raises(LightingError, match="nowhere"):
        AlbedoPrior.by_name(str(tmp_path / "nowhere.npz"), face=True)
