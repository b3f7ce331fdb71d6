"""Which solutions differ, and which of those found on the way explain the image nearly as well."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from scan2albedo.albedo.problem import Solution, cost_removed
from scan2albedo.albedo.uncertainty import Alternative

_NEARLY_AS_GOOD, _ELSEWHERE_RAD = 0.03, 0.2
"""An alternative costs more by less than this part, and its lights are this far away."""


@dataclass(frozen=True)
class Alternatives:
    """Local minima of equal models that were found on the way, and lights that may be two close ones."""

    found: list[list[Solution]] = field(default_factory=list)
    split: list[Alternative] = field(default_factory=list)

    def note(self, minima: list[Solution]) -> None:
        """Keep the minima of one descent from several starts."""
        self.found.append(sorted(minima, key=lambda s: s.cost))

    def of(self, best: Solution) -> list[Alternative]:
        """Return splits, and those with as many lights as `best`, elsewhere, that cost little more."""
        result = list(self.split)
        for minima in self.found:
            for other in minima:
                excess = -cost_removed(other.cost, minima[0].cost)
                same = len(apart([best, other], 2, _ELSEWHERE_RAD)) == 1
                if other.model.lights == best.model.lights and not same and excess < _NEARLY_AS_GOOD:
                    result.append(Alternative(other.hypothesis.lights(), excess))
        return sorted(result, key=lambda a: a.excess)


def apart(solutions: list[Solution], count: int, separation_rad: float = 0.25) -> list[Solution]:
    """Return the first `count` of which no two have all their lights within `separation_rad`."""
    kept: list[Solution] = []
    cosine = math.cos(separation_rad)
    for solution in solutions:
        rows = solution.hypothesis.rows[:, :3]
        if not any((rows @ other.hypothesis.rows[:, :3].T > cosine).any(1).all() for other in kept):
            kept.append(solution)
        if len(kept) == count:
            break
    return kept
