"""Lines along shadow outlines are repaired; nothing else is touched."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from scan2albedo.albedo.levels import usable_texels
from scan2albedo.albedo.poisson import forward_differences, integrate_gradients
from scan2albedo.albedo.rectification import rectify, shadow_outline
from scan2albedo.albedo.result import shade_image
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.synthetic import face, light_at

SIZE = 128


@pytest.fixture
def shadowed(scenes):
    """Texture under a shadow whose estimated edge is one texel off the real one, and the same edge exact."""
    albedo = scenes.texture("skin", SIZE)[..., 0]
    rows, columns = np.mgrid[:SIZE, :SIZE]
    shadow = ((rows - 60) ** 2 + (columns - 64) ** 2 < 30**2).astype(float)
    light = 1 + 3 * (1 - shadow)
    moved = 1 + 3 * (1 - np.roll(shadow, 1, 1))
    return albedo, shadow, light, albedo * moved / light


EVERYWHERE = np.ones((SIZE, SIZE), bool)


def test_a_misplaced_outline_is_repaired(shadowed):
    albedo, shadow, light, wrong = shadowed
    repaired, step = rectify(wrong, light, shadow, EVERYWHERE)
    assert step.ran
    assert np.mean((repaired - albedo) ** 2) < 0.1 * np.mean((wrong - albedo) ** 2)


def test_an_exact_outline_is_left_alone(shadowed):
    albedo, shadow, light, _ = shadowed
    same, step = rectify(albedo, light, shadow, EVERYWHERE)
    assert not step.ran
    assert same is albedo
    assert "0 % of their length has lines" in step.evidence


def test_forced_repair_of_an_exact_outline_does_little_harm(shadowed):
    albedo, shadow, light, wrong = shadowed
    forced, _ = rectify(albedo, light, shadow, EVERYWHERE, force=True)
    assert np.mean((forced - albedo) ** 2) < 0.02 * np.mean((wrong - albedo) ** 2)


def test_no_outline_no_change(shadowed):
    albedo, shadow, light, _ = shadowed
    _, step = rectify(albedo, np.ones_like(light), shadow, EVERYWHERE)
    assert not step.ran
    assert step.evidence == "no shadow outline"


def test_gradients_integrate_to_the_field_they_came_from(shadowed):
    albedo, shadow, *_ = shadowed
    region = shadow > 0
    broken = np.where(region, 7.0, albedo)
    rebuilt = integrate_gradients(broken, region, ~region, *forward_differences(albedo))
    assert rebuilt == pytest.approx(albedo, abs=1e-4)


def test_a_region_that_touches_nothing_known_keeps_its_level(shadowed):
    albedo, shadow, *_ = shadowed
    region = shadow > 0
    nothing = np.zeros_like(region)
    kept = integrate_gradients(albedo, region, nothing, *forward_differences(albedo))
    assert kept == pytest.approx(albedo, abs=1e-6)


@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_region_without_neighbours_along_an_axis_is_integrated_along_the_other(channels):
    field = np.linspace(1, 2, 5).reshape(1, 5, *[1] * len(channels)) * np.ones((1, 5, *channels))
    region = np.array([[False, True, True, False, False]])
    known = np.array([[True, False, False, False, False]])
    broken = np.where(region.reshape(1, 5, *[1] * len(channels)), 7.0, field)
    rebuilt = integrate_gradients(broken, region, known, *forward_differences(field))
    assert rebuilt == pytest.approx(field, abs=1e-6)
    one = np.array([[False, True, False, False, False]])
    alone = integrate_gradients(broken, one, ~np.ones_like(one), *forward_differences(field))
    assert alone == pytest.approx(broken)


def test_gradients_of_several_channels_integrate_as_each_alone(shadowed):
    albedo, shadow, *_ = shadowed
    color, region = np.stack([albedo, albedo**2, 1 - albedo], -1), shadow > 0
    broken = np.where(region[..., None], 7.0, color)
    together = integrate_gradients(broken, region, ~region, *forward_differences(color))
    alone = [
        integrate_gradients(broken[..., c], region, ~region, *forward_differences(color[..., c]))
        for c in range(3)
    ]
    assert together == pytest.approx(np.stack(alone, -1), abs=1e-9)


def test_texture_across_an_exact_outline_is_left_alone(shadowed):
    """Stripes as strong as the light's step, but with it as often as against it."""
    _, shadow, light, _ = shadowed
    stripes = np.where(np.arange(SIZE) // 3 % 2, 0.2, 0.7) * np.ones((SIZE, 1))
    _, step = rectify(stripes, light, shadow, EVERYWHERE)
    assert not step.ran


FACE = 192


def _shading(image, lights, offset_mm=0.2):
    """Return (H, W) light and cast shadow."""
    caster = RayCaster(*image.occluder_mesh())
    lit = shade_image(image, lights, Reflectance("oren-nayar", roughness=0.3), (0, 0, 1), caster, offset_mm)
    light, cast = np.zeros((2, *image.shape))
    light[image.mask], cast[image.mask] = lit.shading.light, lit.cast.max(0)
    return light, cast


def _divided(value, light, truth, usable):
    """Return the quotient at the truth's scale."""
    albedo = np.where(usable, value / np.maximum(light, 1e-9), 0.0)
    return albedo * (np.sum((albedo * truth)[usable]) / np.sum((albedo**2)[usable]))


def _near_and_far(albedo, truth, outline, usable):
    near = binary_dilation(outline, iterations=FACE // 40) & usable
    rms = lambda where: float(np.sqrt(np.mean((albedo - truth)[where] ** 2)))  # noqa: E731
    return np.array([rms(near), rms(usable & ~near)])


@pytest.fixture(scope="module", params=[(0, 45, 0), (1, 45, 0), (1, 30, 40)], ids=str)
def lit_face(request):
    seed, azimuth, elevation = request.param
    scene = face(seed, size=FACE, lights=[light_at(azimuth, elevation)])
    value = scene.image.texture_linear.max(-1) / scene.gain
    truth = scene.albedo_linear.max(-1).astype(np.float64)
    return scene.image, value, truth, usable_texels(scene.image), azimuth, elevation


@pytest.mark.parametrize("off", [(1, 0), (0, -1), (2, 0), (0, 2)])
def test_a_light_one_or_two_degrees_off_is_repaired_on_faces(lit_face, off):
    image, value, truth, usable, azimuth, elevation = lit_face
    light, cast = _shading(image, [light_at(azimuth + off[0], elevation + off[1])])
    before = _divided(value, light, truth, usable)
    after, _ = rectify(before, light, cast, usable)
    outline = shadow_outline(light, cast, usable)
    ratio = _near_and_far(after, truth, outline, usable) / _near_and_far(before, truth, outline, usable)
    assert ratio[0] < (0.6 if max(map(abs, off)) == 2 else 1.0)
    assert ratio[1] < 1.02


def test_a_penumbra_is_repaired_on_faces(lit_face):
    """A lamp 6 degrees across, taken for a point."""
    image, _, truth, usable, azimuth, elevation = lit_face
    spread = [(0, 0), (3, 0), (-3, 0), (0, 3), (0, -3), (2, 2), (-2, 2), (2, -2), (-2, -2)]
    soft = np.mean([_shading(image, [light_at(azimuth + a, elevation + e)])[0] for a, e in spread], 0)
    light, cast = _shading(image, [light_at(azimuth, elevation)])
    before = _divided(truth * soft, light, truth, usable)
    after, _ = rectify(before, light, cast, usable)
    outline = shadow_outline(light, cast, usable)
    ratio = _near_and_far(after, truth, outline, usable) / _near_and_far(before, truth, outline, usable)
    assert ratio[0] < 0.8
    assert ratio[1] < 1.02


def test_another_shadow_offset_is_repaired_on_faces(lit_face):
    image, value, truth, usable, azimuth, elevation = lit_face
    light, cast = _shading(image, [light_at(azimuth, elevation)], 1.0)
    before = _divided(value, light, truth, usable)
    after, _ = rectify(before, light, cast, usable)
    outline = shadow_outline(light, cast, usable)
    ratio = _near_and_far(after, truth, outline, usable) / _near_and_far(before, truth, outline, usable)
    assert ratio[0] < 0.85
    assert ratio[1] < 1.02
