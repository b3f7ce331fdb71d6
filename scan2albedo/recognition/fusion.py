"""Similarities by albedo and by shape taken together, weighted by how well each tells persons apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.recognition.templates import Kind


@dataclass(frozen=True)
class Calibration:
    """Log likelihood ratios, one person over two, as linear functions of similarities.

    Of normal similarities with one covariance C and means m_1 and m_2 they are exactly linear: slopes
    C^-1 (m_1 - m_2), and 0 half-way between the means (Fisher's discriminant).
    """

    albedo: tuple[float, float]
    shape: tuple[float, float]
    """`albedo`, `shape`: slope and offset of one similarity alone."""
    both: tuple[float, float, float]
    """Slope of the albedo's, slope of the shape's, and offset, where both are known."""

    @classmethod
    def of(cls, albedo: ArrayLike, shape: ArrayLike, genuine: ArrayLike) -> Calibration:
        """Return the calibration by similarities of pairs.

        Parameters
        ----------
        albedo, shape : (N,) array_like of float
            Similarities by each alone.
        genuine : (N,) array_like of bool
            Whether a pair shows one person.

        Raises
        ------
        ValueError
            When there are fewer than three pairs of one person, or of two.
        """
        scores = np.stack([np.ravel(albedo), np.ravel(shape)]).astype(np.float64)
        same = np.ravel(np.asarray(genuine, bool))
        if min(same.sum(), (~same).sum()) < 3:
            raise ValueError(
                f"{same.sum()} pairs of one person and {(~same).sum()} of two, expected 3 or more"
            )
        (a, b), (c, d) = _discriminant(scores[:1], same), _discriminant(scores[1:], same)
        first, second, offset = _discriminant(scores, same)
        return cls((a, b), (c, d), (first, second, offset))


def _discriminant(scores: FloatArray, same: BoolArray) -> tuple[float, ...]:
    """Return slopes and offset for scores (K, N); pairs of one person weigh as much as those of two."""
    means = [scores[:, chosen].mean(1) for chosen in (same, ~same)]
    spread = np.mean([np.atleast_2d(np.cov(scores[:, chosen])) for chosen in (same, ~same)], axis=0)
    slope = np.linalg.solve(spread, means[0] - means[1])
    return (*map(float, slope), float(-slope @ (means[0] + means[1]) / 2))


CALIBRATION = Calibration((135.0, -97.2), (893.0, -768.0), (94.0, 817.0, -770.0))
"""Of the default templates, from synthetic people: `python tools/experiment_real.py pop/manifest.csv --make
population --persons 8 --seed 7 --calibrate`."""


def fused(similarities: Mapping[Kind, FloatArray], calibration: Calibration = CALIBRATION) -> FloatArray:
    """Return one similarity for each pair: that of the only kind, or the mean of both by their weights.

    Weights are the calibration's slopes. A probe is compared by what it and all images of the gallery have,
    since a likelihood ratio by one kind and one by both seldom agree; where nothing is common to all, by what
    each pair has. Beside probes compared by both, similarities by one kind are brought to where the
    likelihood ratio by both is the same; where one kind compares all probes, they stay as they are.

    Parameters
    ----------
    similarities : mapping of "albedo", "shape" to (P, G)
        NaN where a probe or an image lacks the kind.
    calibration : Calibration

    Returns
    -------
    (P, G) float64
        NaN where a pair has no kind in common.

    Examples
    --------
    >>> even = Calibration((1.0, 0.0), (1.0, 0.0), (2.0, 2.0, 0.0))
    >>> pairs = {"albedo": np.array([[0.9, np.nan]]), "shape": np.array([[0.5, np.nan]])}
    >>> fused(pairs, even).tolist()
    [[0.7, nan]]
    """
    if len(similarities) == 1:
        return next(iter(similarities.values()))
    albedo, shape = similarities["albedo"], similarities["shape"]
    of_albedo, of_shape, offset = calibration.both
    total = of_albedo + of_shape
    found = (of_albedo * albedo + of_shape * shape) / total
    by_both = ~np.isnan(found).any(axis=1, keepdims=True)
    if not by_both.any():
        for one in (albedo, shape):
            if not np.isnan(one).any():
                return one
    for one, (slope, start) in ((albedo, calibration.albedo), (shape, calibration.shape)):
        alone = np.clip((slope * one + start - offset) / total, 0, 1)
        by_one = ~np.isnan(one).any(axis=1, keepdims=True)
        found = np.where((by_one & ~by_both) | np.isnan(found), alone, found)
    return found
