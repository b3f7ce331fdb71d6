"""What ran, what was left out, and the evidence: the rows of a plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class PlanStep:
    """One decision: a step that ran or was left out."""

    stage: str
    """Stage and step, for example "albedo.shadows"."""
    ran: bool
    """Whether the step was carried out."""
    reason: str
    """Why, in words."""
    evidence: str = ""
    """The measured figure behind the reason, with its unit; empty when the caller decided."""


@dataclass(frozen=True)
class Plan:
    """Decisions in the order they were taken.

    >>> plan = Plan((PlanStep("albedo.shadows", False, "the surface casts none", "0.0 % of lit texels"),))
    >>> plan.ran("albedo.shadows")
    False
    """

    steps: tuple[PlanStep, ...] = ()
    """In the order they were decided."""

    def __iter__(self) -> Iterator[PlanStep]:
        return iter(self.steps)

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> PlanStep:
        return self.steps[index]

    def __add__(self, other: Plan) -> Plan:
        return Plan(self.steps + other.steps)

    def of_stage(self, stage: str) -> Plan:
        """Return the steps of one stage: those named `stage` or below it ("albedo", "albedo.shadows")."""
        return Plan(
            tuple(step for step in self.steps if step.stage == stage or step.stage.startswith(stage + "."))
        )

    def ran(self, stage: str) -> bool:
        """Return whether any step named `stage` or below it was carried out."""
        return any(step.ran for step in self.of_stage(stage))
