"""Files that ship with the package: their checksums, and that their makers make them again."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
from build import albedo_prior, lighting_model, reflectance_model
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo
from scan2albedo.albedo.prior import AlbedoPrior

PACKAGE = Path(scan2albedo.__file__).parent
SHA256 = {
    "albedo/facial_albedo.npz": "5723fe73636aed74936dc16123fdd7cca98bdbe834caf22f855c885ed5198c2b",
    "face_model/afm.json": "91f971f60e81cef07b966a3a363715eee0da85a2e342164576a4476a15ab80ae",
    "face_model/afm.npz": "33223a6ab54242a64758981a23b73d4094aa4e1ebb0ffb46927dceaa07130eac",
    "face_model/appearance.npz": "17549a879650757dd227b83270e3089f48226e6a08cb1e8cf55f095a21a81d3c",
    "reflectance/everyday_light.npz": "6872d2387300c83a30f0df89bd3162a91b786d4fa6a1d3e625f23eda440db00f",
    "reflectance/synthetic_people.npz": "3ee460610c9b253804f09cb46a178f8c340b3e5992b9386b3196864d580318c4",
    "registration/proportions.npz": "4817627f64861ef5df8bccb48d452b8aec1983982ccaa3ffb2e05d178cc144db",
}


def shipped(name: str) -> Path:
    folder, file = name.split("/")
    return PACKAGE / folder / "data" / file


@pytest.mark.parametrize("name", SHA256)
def test_shipped_files_change_with_this_table_alone(name):
    assert hashlib.sha256(shipped(name).read_bytes()).hexdigest() == SHA256[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maker", "name"),
    [
        (lighting_model, "reflectance/everyday_light.npz"),
        (reflectance_model, "reflectance/synthetic_people.npz"),
    ],
)
def test_models_of_reflectance_are_made_again(maker, name, tmp_path):
    maker.main(["-o", str(tmp_path / "made.npz")])
    with np.load(tmp_path / "made.npz") as made, np.load(shipped(name)) as expected:
        assert set(made.files) == set(expected.files)
        for key in expected.files:
            found = made[key].astype(float)
            rounded = 1e-5
            if expected[key].dtype == np.int8:  # principal directions, up to their signs
                rounded = 1
                agreement = (found * expected[key].astype(float)).reshape(len(found), -1).sum(1)
                found.T[...] *= np.sign(agreement)
            assert_allclose(found, expected[key], rtol=1e-4, atol=rounded)


def test_a_prior_of_heads_knows_their_mean_and_colours():
    rng = np.random.default_rng(0)
    plain = np.linspace(-0.3, 0.3, 64)[:, None, None] * np.ones((64, 64, 3))
    medians = rng.normal([-1.0, -0.9, -1.4], 0.1, (6, 3))
    heads = [albedo_prior.Head(plain + 0.01 * rng.normal(size=plain.shape), level) for level in medians]
    prior = albedo_prior.learn(heads)
    assert_allclose(prior.mean, plain, atol=0.04)
    assert_array_equal(prior.mean, prior.mean[:, ::-1])
    assert_allclose(prior.chroma[0], medians[:, 1:].mean(0))
    assert (prior.deviation < AlbedoPrior.stationary().deviation).all()
