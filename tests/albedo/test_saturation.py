"""Saturated texels end to end, divided by their true light: what is decided, and how well it is filled."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lit_scenes import local_variance
from scipy.ndimage import binary_dilation, binary_erosion
from skimage.restoration import inpaint_biharmonic

from scan2albedo.albedo.estimate import estimate_albedo
from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.options import SATURATION_LINEAR, EstimateOptions
from scan2albedo.albedo.saturation import inpainted
from scan2albedo.synthetic import Material, face, hemisphere, light_at

SIZE = 192


def _scene(make, *, texture="skin", grain=1.0, gloss=0.35, exposure=1.5, seed=1):
    return make(
        texture=texture,
        grain=grain,
        size=SIZE,
        seed=seed,
        lights=[light_at(20, 10)],
        material=Material(specular_strength=gloss),
        exposure=exposure,
    )


def _finish(scene, *, known_highlight=1.0, force=(), **changes):
    """Return (left as divided, finished, the plan's row); part of the highlight is hidden from the model."""
    image = replace(scene.image, **changes)
    specular = known_highlight * scene.specular
    light = np.where(image.mask, scene.shading, 1.0)[..., None]
    texture = image.texture_linear / np.float32(scene.gain)
    left = (np.maximum(texture - specular[..., None], 0) / light).astype(np.float32)
    return left, *inpainted(left, image, usable_texels(image), EstimateOptions(force=force), 0)


def _clipped(scene):
    image = scene.image
    allowed = image.mask if image.inpaint is None else image.mask & image.inpaint
    return (image.texture_linear >= SATURATION_LINEAR).any(-1) & allowed


def _error(image, scene, where):
    return float(np.abs(image - scene.albedo_linear)[where].mean())


@pytest.mark.slow
@pytest.mark.parametrize("make", [hemisphere, face])
@pytest.mark.parametrize(("texture", "grain"), [("skin", 1.0), ("skin", 2.5), ("wood", 1.0)])
@pytest.mark.parametrize("gloss", [0.35, 1.0])
def test_highlights_are_filled_with_less_than_half_the_error_of_leaving_them(make, texture, grain, gloss):
    scene = _scene(make, texture=texture, grain=grain, gloss=gloss, exposure=1.8)
    left, finished, step = _finish(scene)
    clipped = _clipped(scene)
    assert step.ran
    assert _error(finished, scene, clipped) < 0.3 * _error(left, scene, clipped)
    target = (binary_dilation(clipped) & scene.image.mask) | clipped
    smooth = inpaint_biharmonic(left.astype(np.float64), target, channel_axis=-1)
    assert _error(finished, scene, clipped) < 0.7 * _error(smooth, scene, clipped)


@pytest.mark.parametrize(("make", "texture"), [(hemisphere, "skin"), (hemisphere, "wood"), (face, "skin")])
def test_local_variance_stays_the_textures(make, texture):
    ratios = []
    for seed in range(3):
        scene = _scene(make, texture=texture, exposure=1.8, seed=seed)
        _, finished, _ = _finish(scene)
        inner = binary_erosion(_clipped(scene), np.ones((5, 5)))
        assert inner.sum() > 200
        found, true = (np.median(local_variance(image)[inner]) for image in (finished, scene.albedo_linear))
        ratios.append(found / true)
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("known_highlight", [0.0, 0.5])
@pytest.mark.parametrize("make", [hemisphere, face])
@pytest.mark.parametrize("gloss", [0.35, 1.0])
def test_a_highlight_the_model_missed_is_found_from_the_input(make, gloss, known_highlight):
    scene = _scene(make, gloss=gloss)
    left, finished, step = _finish(scene, known_highlight=known_highlight)
    clipped = _clipped(scene)
    assert "to resynthesise" in step.evidence
    assert _error(finished, scene, clipped) < 0.6 * _error(left, scene, clipped)
    assert _error(finished, scene, scene.image.mask) < _error(left, scene, scene.image.mask)


@pytest.mark.parametrize("make", [hemisphere, face])
def test_over_exposure_without_a_highlight_is_restored_not_resynthesised(make):
    scene = _scene(make, gloss=0.0, exposure=1.6)
    left, finished, step = _finish(scene)
    clipped = _clipped(scene)
    assert clipped.sum() > 1000
    assert step.ran
    assert " 0 to resynthesise" in step.evidence
    assert _error(finished, scene, clipped) < 0.3 * _error(left, scene, clipped)


def test_white_over_exposure_is_left_unless_asked():
    scene = _scene(hemisphere, gloss=0.0)
    white = np.where(scene.shading[..., None] > 2.0, 1.0, scene.image.texture_linear).astype(np.float32)
    changed = {"texture_linear": white * scene.image.mask[..., None]}
    lost = (white >= 1).all(-1) & scene.image.mask
    assert lost.mean() > 0.25
    left, finished, step = _finish(scene, **changed)
    assert "left" in step.evidence
    assert np.array_equal(finished[lost], left[lost])
    asked = _finish(scene, force=("albedo.inpainting",), **changed)[1]
    assert not np.array_equal(asked[lost], left[lost])


def test_nothing_is_filled_or_copied_where_the_annotation_forbids_it():
    scene = _scene(hemisphere, gloss=1.0, exposure=1.8)
    allowed = np.tile(np.arange(SIZE) >= SIZE // 2, (SIZE, 1))
    left, finished, _ = _finish(scene, inpaint=allowed)
    assert np.array_equal(finished[~allowed], left[~allowed])
    left, finished, step = _finish(scene, inpaint=allowed & False)
    assert finished is left
    assert step.reason == "the annotation forbids it"


def test_nothing_saturated_and_left_out_by_the_caller():
    scene = _scene(hemisphere, gloss=0.0, exposure=1.0)
    left, finished, step = _finish(scene)
    assert finished is left
    assert step.reason == "nothing is saturated"
    options = EstimateOptions(skip=("albedo.inpainting",))
    bare = estimate_albedo(_scene(hemisphere).image, 1, options=options, budget=1e-6)
    assert bare.plan.of_stage("albedo.inpainting")[0].reason == "left out by the caller"
