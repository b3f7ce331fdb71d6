"""What was done, left out, doubted or found wrong, and the evidence: the rows of a plan."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Level = Literal["did", "left out", "doubt", "wrong"]


@dataclass(frozen=True)
class PlanStep:
    """One row: a step that was carried out or left out, or what a person should know about its result.

    >>> PlanStep("albedo.shadows", False, "the surface casts none", "0 % of lit texels").level
    'left out'
    >>> PlanStep.doubt("fit", "the mouth may be open", "gap 3.1 mm").text
    'the mouth may be open (gap 3.1 mm)'
    """

    stage: str
    """Stage and step, for example "albedo.shadows"."""
    ran: bool
    """Whether the step was carried out; False for doubts and faults."""
    reason: str
    """Why, in words."""
    evidence: str = ""
    """The measured figure behind the reason, with its unit; empty when the caller decided."""
    level: Level = "did"
    """"did" or "left out" by `ran`; "doubt" for what a person should check, "wrong" for a known fault."""

    def __post_init__(self) -> None:
        # No threshold at infinity, no zero with a sign.
        finite = re.sub(r" \(inf[^()]* asked\)", "", self.evidence)
        object.__setattr__(self, "evidence", re.sub(r"(?<![\w.])-(0(?:\.0+)?)(?![\w.])", r"\1", finite))
        if not self.ran and self.level == "did":
            object.__setattr__(self, "level", "left out")

    @classmethod
    def doubt(cls, stage: str, reason: str, evidence: str = "") -> PlanStep:
        """Return a row about something in the stage's result that a person should check.

        Parameters
        ----------
        stage, reason, evidence : str
        """
        return cls(stage, False, reason, evidence, "doubt")

    @classmethod
    def wrong(cls, stage: str, reason: str, evidence: str = "") -> PlanStep:
        """Return a row about a fault of the stage's input or result; see `doubt`.

        Parameters
        ----------
        stage, reason, evidence : str
        """
        return cls(stage, False, reason, evidence, "wrong")

    @property
    def text(self) -> str:
        """The row as one sentence."""
        return f"{self.reason} ({self.evidence})" if self.evidence else self.reason


@dataclass(frozen=True)
class Plan:
    """Decisions, `steps`, in the order they were taken.

    >>> plan = Plan((PlanStep("albedo.shadows", False, "the surface casts none", "0 % of lit texels"),))
    >>> plan.ran("albedo.shadows")
    False
    """

    steps: tuple[PlanStep, ...] = ()

    def __iter__(self) -> Iterator[PlanStep]:
        return iter(self.steps)

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> PlanStep:
        return self.steps[index]

    def __add__(self, other: Iterable[PlanStep]) -> Plan:
        return Plan((*self.steps, *other))

    def of_stage(self, stage: str) -> Plan:
        """Return the steps of one stage: those named `stage` or below it ("albedo", "albedo.shadows")."""
        return Plan(tuple(step for step in self.steps if f"{step.stage}.".startswith(f"{stage}.")))

    def ran(self, stage: str) -> bool:
        """Return whether any step named `stage` or below it was carried out."""
        return any(step.ran for step in self.of_stage(stage))

    def doubts(self) -> Plan:
        """Return the rows that a person should read: doubts and what is wrong."""
        return Plan(tuple(step for step in self.steps if step.level in ("doubt", "wrong")))
