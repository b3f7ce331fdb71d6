"""Presets of quality, and what `process` does with them."""

from dataclasses import replace

import pytest
from helpers.meshes import ball

import scan2albedo as s2a
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.quality import PRESETS, Quality


def test_presets_carry_their_names_and_own_qualities_pass_through():
    assert {name: quality.name for name, quality in PRESETS.items()} == {name: name for name in PRESETS}
    assert list(PRESETS) == ["draft", "standard", "best", "paper"]
    # Standard is every stage by its defaults, best is that with more texels.
    assert ProcessOptions().stages == Quality("standard")
    assert replace(PRESETS["best"], name="standard", size=512) == PRESETS["standard"]
    own = replace(PRESETS["draft"], name="own")
    assert ProcessOptions(quality=own).stages is own
    with pytest.raises(ValueError, match=r"'fine', expected one of draft, standard, best, paper"):
        s2a.process("nobody.obj", quality="fine")
    with pytest.raises(s2a.Scan2AlbedoError, match="size 4"):
        Quality("tiny", size=4)


@pytest.mark.slow
def test_presets_take_their_own_steps_and_size_unless_a_size_is_asked_for(coarse_scan):
    scan = coarse_scan[0]
    draft = s2a.process(scan, quality="draft", skip=["albedo"])
    best = s2a.process(scan, quality="best", size=64, skip=["albedo"])
    assert draft.geometry_image.mask.shape == (256, 256)
    assert best.geometry_image.mask.shape == (64, 64)
    assert draft.options["quality"] == "draft"
    steps = [result.trace.of_stage("fit").rows[-1].evaluations for result in (draft, best)]
    assert steps[0] < steps[1]


def test_the_papers_search_is_chosen_by_name():
    result = s2a.process(ball(), model="none", size=32, quality="paper", lights=1)
    (roughness,) = result.plan.of_stage("albedo.roughness")
    assert (result.options["quality"], roughness.reason) == ("paper", "part of the paper's model")
