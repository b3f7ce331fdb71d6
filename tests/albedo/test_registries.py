"""What others add from outside: a part of the light, one entry of a table."""

from dataclasses import replace
from types import SimpleNamespace

from helpers.lit_scenes import lit_scene, percent_off

from scan2albedo.albedo import estimate_albedo
from scan2albedo.albedo.light_parameters import PARTS, LightPart
from scan2albedo.lighting.shading import Parameter


def band(shadows):
    """Return (N, 1) light on what faces some way up, with an edge that no harmonic has."""
    return 1.0 * (shadows.normal[:, 1:2] > 0.4)


def test_a_part_of_the_light_is_one_entry(monkeypatch):
    scene = lit_scene((20, 10), size=64, kind="plain")
    image, mask = scene.image, scene.image.mask
    texture = image.texture_linear / 2
    texture[mask] += band(SimpleNamespace(normal=image.normal[mask])) / 7
    banded = replace(scene, image=replace(image, texture_linear=texture))
    without = percent_off(estimate_albedo(banded.image, 1), banded)
    part = LightPart("albedo.band", (Parameter(1, 0, 5, 1, 0, 2),), basis=band)
    monkeypatch.setitem(PARTS, "band", part)
    estimate = estimate_albedo(banded.image, 1)
    assert estimate.plan.ran("albedo.band")
    assert 2 * percent_off(estimate, banded) < without
