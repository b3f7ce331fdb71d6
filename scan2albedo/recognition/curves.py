"""Cumulative match and receiver operating characteristics, with their intervals."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, all_finite
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.identification import Identification


@dataclass(frozen=True)
class CmcCurve:
    """Identification rate by rank."""

    rank: IntArray
    """(G,): 1 to the number of persons."""
    rate: FloatArray
    """(G,): share of probes whose person is among the first `rank`."""
    low: FloatArray
    high: FloatArray
    """`low`, `high`: (G,): bounds of its interval."""
    probes: int
    confidence: float
    """`probes`, `confidence`: their number, and that of the intervals."""


def cmc_curve(identification: Identification, *, confidence: float = 0.95) -> CmcCurve:
    """Return the cumulative match characteristic of an identification, with Clopper and Pearson's intervals.

    They take the probes as independent; of several probes of one person they are too short. The curve is that
    of Phillips et al., IEEE PAMI 22(10), 2000; the intervals are from Biometrika 26(4), 1934. Probes of
    unknown persons do not count. `confidence` is that of the two-sided intervals; ValueError outside (0, 1),
    RecognitionError when no probe's person is known.

    Examples
    --------
    >>> from scan2albedo.recognition import identify_by_similarity
    >>> found = identify_by_similarity(np.array([[0.9, 0.2], [0.6, 0.4]]), ["ann", "bob"], ["ann", "bob"])
    >>> cmc_curve(found).rate.tolist()
    [0.5, 1.0]
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected within (0, 1)")
    rank = np.arange(1, len(identification.persons) + 1)
    ranks = identification.ranks[identification.known]
    if len(ranks) == 0:
        raise RecognitionError("no probe's person is known, so there is no rate; name the persons")
    hits, probes = (ranks[:, None] <= rank).sum(axis=0), len(ranks)
    low, high = _rate_interval(hits, probes, confidence)
    return CmcCurve(rank, hits / probes, low, high, probes, confidence)


def _rate_interval(hits: ArrayLike, trials: int, confidence: float) -> tuple[FloatArray, FloatArray]:
    """Return Clopper and Pearson's bounds of the rate of `hits`, also broken ones, in `trials`."""
    from scipy.special import betaincinv

    found, tail = np.clip(hits, 0, trials), (1 - confidence) / 2
    missed = trials - found
    low = np.where(found > 0, betaincinv(np.where(found > 0, found, 1), missed + 1, tail), 0.0)
    high = np.where(missed > 0, betaincinv(found + 1, np.where(missed > 0, missed, 1), 1 - tail), 1.0)
    return low, high


@dataclass(frozen=True)
class RocCurve:
    """Verification rates, with intervals by a bootstrap over persons."""

    false_accept_rate: FloatArray
    """(F,): ascending; bounds on the share of impostors' claims accepted."""
    true_accept_rate: FloatArray
    """(F,): largest share of genuine claims accepted within that bound."""
    low: FloatArray
    high: FloatArray
    """`low`, `high`: (F,): bounds of its interval."""
    area: float
    """Under the curve."""
    area_interval: tuple[float, float]
    equal_error_rate: float
    """Where the rates of false accepts and of false rejects are equal."""
    equal_error_interval: tuple[float, float]
    """`area_interval`, `equal_error_interval`: low and high."""
    genuine: int
    impostors: int
    """`genuine`, `impostors`: claims."""
    persons: int
    resamples: int
    confidence: float
    """`persons`, `resamples`, `confidence`: numbers behind the intervals, and their confidence."""

    @property
    def supported(self) -> BoolArray:
        """(F,): false accept rates of one impostor's claim or more; no claim tells what is below."""
        return self.false_accept_rate * self.impostors >= 1 - 1e-9


def roc_curve(
    identification: Identification,
    *,
    false_accept_rates: ArrayLike | None = None,
    confidence: float = 0.95,
    resamples: int = 500,
    seed: int | np.random.Generator = 0,
) -> RocCurve:
    """Return the receiver operating characteristic of claims: every probe claims to be every person.

    The intervals are percentiles over resamples of the persons, with replacement: person p drawn c_p times, a
    genuine claim counts c_p times, one of p to be q c_p c_q times. Bolle, Ratha and Pankanti (CVIU 93, 2004)
    say why persons are resampled and not claims. Claims that never err do not err in resamples either, and
    the few that do err much alike: intervals of true accept rates and of the equal error rate are never
    shorter than Clopper and Pearson's for as many independent genuine claims. Where no claim errs the area's
    interval has no width. Raises `ValueError` when an option is out of range; `RecognitionError` when no
    probe's person is known, or the gallery has one person only: then nobody is an impostor.

    Parameters
    ----------
    identification : Identification
    false_accept_rates : (F,)
        Ascending, within [0, 1]; when omitted, 61 of evenly spaced logarithms from that of one impostor's
        claim.
    confidence : float
        Of the two-sided intervals, within (0, 1).
    resamples : int
        With 0 the bounds of the intervals are the values themselves.
    seed : int or numpy.random.Generator

    Examples
    --------
    >>> from scan2albedo.recognition import identify_by_similarity
    >>> found = identify_by_similarity(np.array([[0.9, 0.2], [0.3, 0.4]]), ["ann", "bob"], ["ann", "bob"])
    >>> roc_curve(found).area
    1.0
    """
    if len(identification.persons) < 2:
        raise RecognitionError("the gallery has one person only, so nobody is an impostor; add persons")
    persons, genuine = len(identification.persons), int(identification.known.sum())
    if genuine == 0:
        raise RecognitionError("no probe's person is known, so there is no rate; name the persons")
    impostors = genuine * (persons - 1)
    if false_accept_rates is None:
        false_accept_rates = np.geomspace(1 / impostors, 1.0, 61)
    rates = np.asarray(false_accept_rates, float)
    inside = rates.ndim == 1 and len(rates) > 0 and ((rates >= 0) & (rates <= 1)).all()
    if not inside or (np.diff(rates) < 0).any():
        raise ValueError("false_accept_rates are expected to be (F,), ascending, within [0, 1]")
    if not 0 < confidence < 1 or resamples < 0:
        raise ValueError(f"confidence is {confidence} and resamples {resamples}, expected in (0, 1) and >= 0")
    rates_of_draw = _rates_of_draw(identification)
    found = rates_of_draw(np.ones(persons), rates)
    random, drawn = np.random.default_rng(seed), list[FloatArray]()
    while len(drawn) < resamples:
        times = np.bincount(random.integers(persons, size=persons), minlength=persons)
        values = rates_of_draw(times.astype(float), rates)
        if all_finite(values):  # draws that leave claims of both kinds
            drawn.append(values)
    tail = 50 * (1 - confidence)
    low, high = np.percentile(drawn or [found], [tail, 100 - tail], axis=0)
    if resamples > 0:
        least, most = _rate_interval(found[1:] * genuine, genuine, confidence)
        low[1:], high[1:] = np.minimum(low[1:], least), np.maximum(high[1:], most)
    area, equal_error = ((float(found[k]), (float(low[k]), float(high[k]))) for k in (0, 1))
    curve = rates, found[2:], low[2:], high[2:], *area, *equal_error
    return RocCurve(*curve, genuine, impostors, persons, resamples, confidence)


def _rates_of_draw(identification: Identification) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return what gives area, equal error rate and true rates (2 + F,) of draws (G,), NaN if undefined."""
    # All claims in order of falling similarity: the probe's person and the claimed one, by index.
    known = identification.known
    scores, own = identification.similarities[known], identification.genuine[known].argmax(axis=1)
    probe, claimed = np.unravel_index(np.argsort(-scores, axis=None, kind="stable"), scores.shape)
    falling, prober = scores[probe, claimed], own[probe]
    genuine = prober == claimed
    # The last of each run of equal similarities, which a threshold takes whole.
    last = np.flatnonzero(np.append(falling[1:] != falling[:-1], True))

    def rates(times: FloatArray, false_accept_rates: FloatArray) -> FloatArray:
        drawn = times[prober]
        weight = np.where(genuine, drawn, drawn * times[claimed])
        accepted = np.cumsum(np.where(genuine, weight, 0.0))[last]
        fooled = np.cumsum(np.where(genuine, 0.0, weight))[last]
        if not (accepted[-1] > 0 and fooled[-1] > 0):
            return np.full(2 + len(false_accept_rates), np.nan)
        true_rate = np.concatenate([[0.0], accepted / accepted[-1]])
        false_rate = np.concatenate([[0.0], fooled / fooled[-1]])
        within = np.searchsorted(false_rate, false_accept_rates, side="right") - 1
        area = np.trapezoid(true_rate, false_rate)
        # Where false accepts cross false refusals, on straight lines between thresholds.
        gap = false_rate + true_rate - 1.0
        after = int(np.argmax(gap >= 0))
        share = -gap[after - 1] / (gap[after] - gap[after - 1])
        equal = false_rate[after - 1] + share * (false_rate[after] - false_rate[after - 1])
        return np.concatenate([[area, equal], true_rate[within]])

    return rates
