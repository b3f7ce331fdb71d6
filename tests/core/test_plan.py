"""Plan rows: order, selection, addition."""

from scan2albedo.core import Plan, PlanStep

SHADOWS = PlanStep("albedo.shadows", False, "the surface casts none", "0.0 %")
LIGHTS = PlanStep("albedo.lights", True, "one light")
FIT = PlanStep("fit", True, "deformed", "0.4 mm")


def test_iterates_in_order_and_adds():
    plan = Plan((SHADOWS,)) + Plan((LIGHTS, FIT))
    assert list(plan) == [SHADOWS, LIGHTS, FIT]
    assert len(plan) == 3
    assert plan[2] is FIT


def test_stage_selects_itself_and_what_lies_below_but_no_namesake():
    other = PlanStep("albedoes", True, "")
    plan = Plan((SHADOWS, LIGHTS, FIT, other))
    assert plan.of_stage("albedo").steps == (SHADOWS, LIGHTS)
    assert plan.of_stage("albedo.shadows").steps == (SHADOWS,)
    assert not plan.ran("albedo.shadows")
    assert plan.ran("albedo")
    assert not plan.ran("register")


def test_level_follows_from_ran_unless_it_is_a_doubt_or_a_fault():
    gap, halves = PlanStep.doubt("fit", "the mouth may be open", "3 mm"), PlanStep.wrong("load", "empty")
    assert [step.level for step in (SHADOWS, LIGHTS, gap, halves)] == ["left out", "did", "doubt", "wrong"]
    assert not gap.ran
    assert gap.text == "the mouth may be open (3 mm)"
    assert halves.text == "empty"
    assert Plan((SHADOWS, gap, LIGHTS, halves)).doubts().steps == (gap, halves)
    assert Plan() + [gap] == Plan((gap,))


def test_evidence_has_no_infinite_threshold_and_no_negative_zero():
    text = "changes it by -0.0 % (inf % asked), -0.04 mm, x-0, 0.5 (2 % asked)"
    shown = "changes it by 0.0 %, -0.04 mm, x-0, 0.5 (2 % asked)"
    assert PlanStep("albedo.specular", True, "it matters", text).evidence == shown
