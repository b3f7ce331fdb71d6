"""Whom of a gallery each probe resembles most, whether or not it is known whom the probe shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.recognition.identification import (
    Combine,
    Identification,
    identify_by_similarity,
    similarities_by_person,
)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ProbeMatches:
    """Persons by similarity to each probe.

    Parameters
    ----------
    persons : tuple of G str
        Of the gallery, in alphabetical order.
    probe_persons : tuple of P str or None
        Who the probes show; None where nobody knows.
    similarities : (P, G) float64
        Of each probe to each person.
    ranks : (P,) int64
        Place of the right person, as in `Identification`; 0 where it is not known.
    order : (P, G) int64
        Indices of persons, the most similar first, in alphabetical order among equals.
    named : Identification or None
        Of the probes whose person is known, in their order; None when there is none.
    """

    persons: tuple[str, ...]
    probe_persons: tuple[str | None, ...]
    similarities: FloatArray
    ranks: NDArray[np.int64]
    order: NDArray[np.int64]
    named: Identification | None

    def predicted(self, place: int = 1) -> tuple[str, ...]:
        """Return (P,) the person at a place, 1 for the most similar."""
        return tuple(self.persons[k] for k in self.order[:, place - 1])

    def similarity(self, place: int = 1) -> FloatArray:
        """Return (P,) the similarity of the person at a place."""
        return np.take_along_axis(self.similarities, self.order[:, place - 1 : place], 1)[:, 0]


def match_probes(
    similarities: ArrayLike,
    gallery_names: Sequence[str],
    probe_persons: Sequence[str | None],
    *,
    combine: Combine = "best",
) -> ProbeMatches:
    """Order the persons of a gallery by similarity to each probe; of named probes, tell the right one's rank.

    A probe gets the most similar person whoever it shows: the set is closed, and that somebody is most
    similar does not mean that it is he or she.

    Parameters
    ----------
    similarities : (P, images)
        Of probes to gallery images, of any kind; larger is more alike.
    gallery_names : sequence of str
        Persons of the gallery's images.
    probe_persons : sequence of P str or None
        Persons of the probes, None where they are not known.
    combine : {"best", "mean"}
        As in `identify`.

    Returns
    -------
    ProbeMatches

    Raises
    ------
    ValueError
        When shapes do not fit or `combine` is something else.
    RecognitionError
        When a set is empty, a similarity is not finite, or a probe's person is not in the gallery.

    Examples
    --------
    >>> import numpy as np
    >>> found = match_probes(np.array([[0.9, 0.2], [0.6, 0.4]]), ["ann", "bob"], [None, "bob"])
    >>> found.predicted(), found.ranks.tolist()
    (('ann', 'ann'), [0, 2])
    """
    persons, scores = similarities_by_person(similarities, gallery_names, probe_persons, combine)
    rows = [k for k, person in enumerate(probe_persons) if person is not None]
    named, ranks = None, np.zeros(len(probe_persons), np.int64)
    if rows:
        names = [person for person in probe_persons if person is not None]
        named = identify_by_similarity(np.asarray(similarities)[rows], gallery_names, names, combine=combine)
        ranks[rows] = named.ranks
    order = np.argsort(-scores, axis=1, kind="stable")
    return ProbeMatches(persons, tuple(probe_persons), scores, ranks, order, named)
