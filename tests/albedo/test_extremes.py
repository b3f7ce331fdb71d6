"""Named extremes: nothing travels silently, nothing blows up."""

import math

import numpy as np
import pytest

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.errors import GeometryImageError, LightingError
from scan2albedo.io.geometry_image import GeometryImage

FAR = math.inf


@pytest.fixture(scope="module")
def plain(scenes):
    return scenes.scene("hemisphere", "skin", [(30, 0, 2.0, FAR)], size=64)


def _with(image, **fields):
    names = ("position", "normal", "mask", "texture_linear")
    return GeometryImage(**{name: getattr(image, name) for name in names} | fields)


def test_no_light_at_all(scenes):
    scene = scenes.scene("hemisphere", "skin", [], size=64)
    estimate = estimate_albedo(scene.image, 1)
    assert albedo_error(estimate.albedo_linear, scene.albedo, scene.image.mask).mse_percent < 0.05


@pytest.mark.parametrize("azimuth_deg", [89.9, 100.0], ids=["grazing", "behind"])
def test_light_from_the_rim(scenes, azimuth_deg):
    scene = scenes.scene("hemisphere", "skin", [(azimuth_deg, 0, 2.0, FAR)], size=64)
    estimate = estimate_albedo(scene.image, 1)
    assert np.isfinite(estimate.albedo_linear).all()
    assert albedo_error(estimate.albedo_linear, scene.albedo, scene.image.mask).mse_percent < 0.1


@pytest.mark.parametrize("exponent", [0.1, 1e4])
def test_exponents_beyond_reason(scenes, exponent):
    scene = scenes.scene("hemisphere", "skin", [(30, 0, 2.0, FAR)], size=64, specular=0.1, exponent=exponent)
    estimate = estimate_albedo(scene.image, 1)
    assert np.isfinite(estimate.albedo_linear).all()
    assert albedo_error(estimate.albedo_linear, scene.albedo, scene.image.mask).mse_percent < 0.4


@pytest.mark.parametrize("fill", [0.0, 1.0], ids=["all black", "all saturated"])
def test_textures_that_tell_nothing(plain, fill):
    texture = np.full((64, 64, 3), fill, np.float32)
    with pytest.raises(LightingError, match="texels can be used"):
        estimate_albedo(_with(plain.image, texture_linear=texture))


def test_empty_mask_and_missing_texture(plain):
    with pytest.raises(LightingError, match="empty"):
        estimate_albedo(_with(plain.image, mask=np.zeros((64, 64), bool)))
    with pytest.raises(LightingError, match="no texture"):
        estimate_albedo(_with(plain.image, texture_linear=None))


def test_nan_texels_are_refused_at_the_door(plain):
    texture = plain.image.texture_linear.copy()
    texture[32, 32] = np.nan
    with pytest.raises(GeometryImageError, match="NaN"):
        _with(plain.image, texture_linear=texture)


def test_zero_normals_do_not_vote_and_stay_finite(plain):
    normal = plain.image.normal.copy()
    normal[30:34, 30:34] = 0
    estimate = estimate_albedo(_with(plain.image, normal=normal), 1)
    assert np.isfinite(estimate.albedo_linear).all()
    assert np.all(estimate.confidence[30:34, 30:34] == 0)


def test_one_texel(plain):
    mask = np.zeros((64, 64), bool)
    mask[32, 32] = True
    with pytest.raises(LightingError, match="only 1 of 1 texels"):
        estimate_albedo(_with(plain.image, mask=mask))


def test_a_surface_without_triangles_casts_no_shadow(plain):
    checkers = plain.image.mask & (np.indices((64, 64)).sum(0) % 2 == 0)
    estimate = estimate_albedo(_with(plain.image, mask=checkers), 1)
    assert not estimate.plan.ran("albedo.shadows")


def test_exposure_only_scales_the_albedo(plain):
    dark = _with(plain.image, texture_linear=plain.image.texture_linear * np.float32(1 / 64))
    bright, dim = (estimate_albedo(image, 1) for image in (plain.image, dark))
    assert dim.albedo_linear * 64 == pytest.approx(bright.albedo_linear, rel=1e-3, abs=1e-4)


def test_specular_scale_of_the_annotation_multiplies_the_highlight(plain):
    options = EstimateOptions(specular=True)
    scale = np.where(np.arange(64)[:, None] < 32, 0, 1) * np.ones((64, 64))
    estimate = estimate_albedo(_with(plain.image, specular_scale=scale), 1, options=options)
    assert np.all(estimate.specular[:32] == 0)
