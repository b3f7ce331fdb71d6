"""Presets of quality, and what `process` does with them."""

from dataclasses import replace

import pytest

import scan2albedo as s2a
from scan2albedo.pipeline.quality import PRESETS, Quality, quality_of


def test_standard_is_every_stage_by_its_defaults():
    assert quality_of("standard") == Quality("standard")


def test_presets_carry_their_names():
    assert {name: quality.name for name, quality in PRESETS.items()} == {name: name for name in PRESETS}
    assert list(PRESETS) == ["draft", "standard", "best"]


def test_best_is_standard_with_more_texels():
    assert replace(quality_of("best"), name="standard", size=512) == quality_of("standard")


def test_an_unknown_quality_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match=r"'fine', expected one of draft, standard, best"):
        s2a.process("nobody.obj", quality="fine")


def test_own_qualities_pass_through():
    own = replace(PRESETS["draft"], name="own")
    assert quality_of(own) is own


def test_too_small_an_image_is_refused():
    with pytest.raises(s2a.Scan2AlbedoError, match="size 4"):
        Quality("tiny", size=4)


def test_presets_take_their_own_steps_and_size_unless_a_size_is_asked_for():
    few = s2a.synthetic.Scanner(spacing_mm=6.0, picture_size=48, size=64)
    scan, _ = s2a.synthetic.raw_scan(0, scanner=few)
    draft = s2a.process(scan, quality="draft", skip=["albedo"])
    best = s2a.process(scan, quality="best", size=64, skip=["albedo"])
    assert draft.geometry_image.mask.shape == (256, 256)
    assert best.geometry_image.mask.shape == (64, 64)
    assert draft.options["quality"] == "draft"
    steps = [result.trace.of_stage("fit").rows[-1].evaluations for result in (draft, best)]
    assert steps[0] < steps[1]
