import numpy as np
import pytest
from helpers.eyeglasses import angle_deg
from helpers.measures import rms, row_lengths
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.synthetic import Material, hemisphere, light_at, with_normal_error


def test_geometry_is_a_hemisphere_on_an_equal_area_chart():
    scene = hemisphere(size=128, lights=[light_at(40, 10)])
    image, mask = scene.image, scene.image.mask
    assert_allclose(image.position[mask], 80 * image.normal[mask])
    assert_allclose(row_lengths(image.normal[mask]), 1)
    assert mask.mean() == pytest.approx(np.pi / 4, abs=0.003)
    # Equal area: heights are uniform over texels (Archimedes), and u goes with +x, row 0 with +y.
    assert_allclose(np.quantile(image.normal[mask, 2], [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.01)
    assert image.position[64, 127, 0] > 70
    assert image.position[0, 64, 1] > 70
    assert_array_equal(scene.shadow[mask, 0], image.normal[mask] @ scene.lights[0].direction <= 0)


def test_overexposure_clips_and_bits_quantise():
    scene = hemisphere(size=96, exposure=1.6, material=Material(0.3, 0.3, 20.0))
    picture = scene.image.texture_linear[scene.image.mask]
    assert 0.005 < np.mean(picture == 1) < 0.5
    assert len(np.unique(picture)) <= 256


def test_same_seed_same_bits():
    first, again = (hemisphere(size=64, seed=5, noise=0.02) for _ in range(2))
    assert_array_equal(first.image.texture_linear, again.image.texture_linear)
    other = hemisphere(size=64, seed=6, noise=0.02)
    assert not np.array_equal(first.image.texture_linear, other.image.texture_linear)


def test_no_lights_leave_the_albedo():
    scene = hemisphere(size=64, lights=[], bits=None)
    assert_allclose(scene.image.texture_linear, scene.albedo_linear * scene.gain, atol=1e-6)
    assert scene.shadow.shape == (64, 64, 0)


def test_unknown_texture_is_refused():
    with pytest.raises(ValueError, match=r"'marble'.*'skin', 'wood'"):
        hemisphere(size=16, texture="marble")


def test_normal_errors_have_their_size_and_are_smooth():
    image = hemisphere(size=128).image
    tilted = with_normal_error(image, 3.0, np.random.default_rng(0))
    mask = image.mask
    assert_allclose(row_lengths(tilted.normal[mask]), 1)
    assert rms(angle_deg(tilted.normal[mask], image.normal[mask])) == pytest.approx(3.0, rel=0.02)
    change = (tilted.normal - image.normal)[40:90, 40:90]
    assert row_lengths(np.diff(change, axis=1)).mean() < 0.5 * row_lengths(change).mean()
    assert_array_equal(tilted.position, image.position)
