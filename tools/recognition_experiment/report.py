"""What the recognition experiment found: rates with intervals, curves, files."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from recognition_experiment.options import RecognitionExperimentOptions
from scan2albedo.core import Trace
from scan2albedo.recognition import CmcCurve, Identification, RocCurve

PAPER_RANK_1 = {
    "raw texture": 0.8299,
    "albedo, oren-nayar": 0.934,
    "albedo, lambert": 0.893,
    "albedo, minnaert": 0.888,
    "albedo, spherical-harmonics": 0.886,
}
"""Figure 10 of the paper, on real scans: another population, for orientation."""

RESAMPLES = 2000


@dataclass(frozen=True)
class MethodResult:
    """How well one method identifies.

    Parameters
    ----------
    method : str
    identification : Identification
    cmc : CmcCurve
        With Clopper-Pearson intervals, which take probes as independent.
    roc : RocCurve
    """

    method: str
    identification: Identification
    cmc: CmcCurve
    roc: RocCurve

    @property
    def rank_1(self) -> float:
        """Share of probes identified."""
        return float(self.cmc.rate[0])

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval by Clopper and Pearson."""
        return float(self.cmc.low[0]), float(self.cmc.high[0])

    @property
    def interval_by_persons(self) -> tuple[float, float]:
        """Its 95 % interval by resampling persons, whose probes are alike."""
        hit = self.identification.ranks == 1
        names = np.array(self.identification.probe_names)
        persons = np.unique(names)
        hits = np.array([hit[names == person].sum() for person in persons])
        probes = np.array([(names == person).sum() for person in persons])
        drawn = np.random.default_rng(0).integers(len(persons), size=(RESAMPLES, len(persons)))
        rates = hits[drawn].sum(1) / probes[drawn].sum(1)
        low, high = np.percentile(rates, [2.5, 97.5])
        return float(low), float(high)

    @property
    def separation(self) -> float:
        """How far similarities of one person lie from those of two, in standard deviations: Daugman's d'.

        It still tells methods apart that identify everybody.
        """
        scores, genuine = self.identification.similarities, self.identification.genuine
        same, other = scores[genuine], scores[~genuine]
        spread = max((same.var() + other.var()) / 2, 1e-12)
        return float((same.mean() - other.mean()) / np.sqrt(spread))

    def against(self, other: MethodResult) -> tuple[int, int, float]:
        """Return probes that only this method identifies, that only `other` does, and McNemar's exact p."""
        mine, theirs = self.identification.ranks == 1, other.identification.ranks == 1
        gained, lost = int((mine & ~theirs).sum()), int((theirs & ~mine).sum())
        if gained + lost == 0:
            return 0, 0, 1.0
        return gained, lost, float(binomtest(gained, gained + lost).pvalue)

    def figures(self, raw: MethodResult) -> dict[str, Any]:
        """Return the figures as plain numbers for JSON."""
        gained, lost, p = self.against(raw)
        return {
            "method": self.method,
            "rank_1": self.rank_1,
            "interval": self.interval,
            "interval_by_persons": self.interval_by_persons,
            "rank_5": self.identification.rate(5),
            "equal_error_rate": self.roc.equal_error_rate,
            "separation": self.separation,
            "equal_error_interval": self.roc.equal_error_interval,
            "gained_over_raw": gained,
            "lost_to_raw": lost,
            "p_value": p,
            "paper_rank_1": PAPER_RANK_1.get(self.method),
        }


@dataclass(frozen=True)
class RecognitionReport:
    """What the experiment found.

    Parameters
    ----------
    options : RecognitionExperimentOptions
    results : tuple of MethodResult
        Raw texture first.
    persons : tuple of int
        Who took part.
    failures : tuple of str
        Messages of scans that the pipeline refused; they are left out for every method alike.
    converged : bool
        Whether every scan asked for was made before the budget ended.
    trace : Trace
        Rank-1 errors by the first albedo as persons are added.
    """

    options: RecognitionExperimentOptions
    results: tuple[MethodResult, ...]
    persons: tuple[int, ...]
    failures: tuple[str, ...]
    converged: bool
    trace: Trace

    def result(self, method: str) -> MethodResult:
        """Return the result of a method by name.

        Raises
        ------
        KeyError
            When it was not compared.
        """
        return {result.method: result for result in self.results}[method]

    @property
    def best(self) -> MethodResult:
        """The result with the greatest rank-1 rate, the first of several."""
        return max(self.results, key=lambda result: result.rank_1)

    def figures(self) -> dict[str, Any]:
        """Return the figures as plain numbers for JSON."""
        return {
            "persons": len(self.persons),
            "probes": len(self.results[0].identification.ranks),
            "failures": list(self.failures),
            "converged": self.converged,
            "options": asdict(self.options),
            "methods": [result.figures(self.results[0]) for result in self.results],
            "best": self.best.method,
        }

    def table(self) -> str:
        """Return the figures as text for a terminal."""
        probes = len(self.results[0].identification.ranks)
        lines = [
            f"{len(self.persons)} persons, {probes} probes"
            + ("" if self.converged else ", the budget ended before the rest")
            + (f"; {len(self.failures)} scans failed and are left out" if self.failures else ""),
            f"  {'':35}{'rank 1':>7}  {'95 % interval':15}{'by persons':15}{'equal error':>11}     d'"
            f"{'against raw':>19}{'paper':>8}",
        ]
        for result in self.results:
            gained, lost, p = result.against(self.results[0])
            paper = PAPER_RANK_1.get(result.method)
            lines.append(
                f"  {result.method:35}{result.rank_1:7.1%}  {_span(result.interval):15}"
                f"{_span(result.interval_by_persons):15}{result.roc.equal_error_rate:11.1%}{result.separation:7.2f}"
                + f"{' ' * 19 if result is self.results[0] else f'+{gained} -{lost} p {p:.1g}':>19}"
                + f"{'' if paper is None else f'{paper:.1%}':>8}"
            )
        return "\n".join(lines)


def _span(interval: tuple[float, float]) -> str:
    return f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"
