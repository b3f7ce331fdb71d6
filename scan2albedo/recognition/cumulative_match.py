"""Cumulative match characteristics: how often the right person is among the first k, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scan2albedo.recognition.identification import Identification

FloatArray = NDArray[np.float64]
Interval = Literal["clopper-pearson", "wilson"]


@dataclass(frozen=True)
class CmcCurve:
    """Identification rate by rank.

    Parameters
    ----------
    rank : (G,) int64
        1 to the number of persons.
    rate : (G,) float64
        Share of probes whose person is among the first `rank`.
    low, high : (G,) float64
        Bounds of its interval.
    probes : int
    confidence : float
    interval : {"clopper-pearson", "wilson"}
    """

    rank: NDArray[np.int64]
    rate: FloatArray
    low: FloatArray
    high: FloatArray
    probes: int
    confidence: float
    interval: Interval


def cmc_curve(
    identification: Identification, *, confidence: float = 0.95, interval: Interval = "clopper-pearson"
) -> CmcCurve:
    """Return the cumulative match characteristic of an identification, with an interval at each rank.

    Parameters
    ----------
    identification : Identification
    confidence : float
        Of the two-sided intervals, within (0, 1).
    interval : {"clopper-pearson", "wilson"}
        Exact, which covers the truth at least that often, or Wilson's score interval, which is shorter and
        does so on average.

    Raises
    ------
    ValueError
        When a choice is unknown or out of range.

    Notes
    -----
    Both take probes as independent. Several probes of a person are less than that, so intervals are too
    short then.

    References
    ----------
    Clopper, Pearson, Biometrika 26(4), 1934; Wilson, JASA 22(158), 1927; Phillips et al., "The FERET
    evaluation methodology for face-recognition algorithms", IEEE PAMI 22(10), 2000 (the curve).

    Examples
    --------
    >>> import numpy as np
    >>> from scan2albedo.recognition import identify_by_similarity
    >>> found = identify_by_similarity(np.array([[0.9, 0.2], [0.6, 0.4]]), ["ann", "bob"], ["ann", "bob"])
    >>> cmc_curve(found).rate.tolist()
    [0.5, 1.0]
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected within (0, 1)")
    rank = np.arange(1, len(identification.persons) + 1)
    hits = (identification.ranks[:, None] <= rank).sum(axis=0)
    probes = len(identification.ranks)
    low, high = rate_interval(hits, probes, confidence=confidence, interval=interval)
    return CmcCurve(rank, hits / probes, low, high, probes, confidence, interval)


def rate_interval(
    hits: NDArray[np.int64], trials: int, *, confidence: float, interval: Interval
) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of the rate of `hits` in `trials`, elementwise; see `cmc_curve`.

    Raises
    ------
    ValueError
        When `interval` is unknown.
    """
    from scipy.special import betaincinv, ndtri

    tail = (1 - confidence) / 2
    if interval == "clopper-pearson":
        low = np.where(hits == 0, 0.0, betaincinv(np.maximum(hits, 1), trials - hits + 1, tail))
        high = np.where(hits == trials, 1.0, betaincinv(hits + 1, np.maximum(trials - hits, 1), 1 - tail))
        return low, high
    if interval == "wilson":
        z2 = float(ndtri(1 - tail)) ** 2
        rate = hits / trials
        centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
        half = np.sqrt(z2 * (rate * (1 - rate) + z2 / (4 * trials)) / trials) / (1 + z2 / trials)
        return np.clip(centre - half, 0, 1), np.clip(centre + half, 0, 1)
    raise ValueError(f"interval is {interval!r}, expected 'clopper-pearson' or 'wilson'")
