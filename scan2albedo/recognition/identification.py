"""Closed-set identification: which person of a gallery each probe resembles most."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, Texts, all_finite
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.similarity import WINDOW, similarity_matrix
from scan2albedo.recognition.templates import Templates

Combine = Literal["best", "mean"]


@dataclass(frozen=True)
class Identification:
    """Persons of a gallery by their similarity to each probe."""

    persons: Texts
    """(G,): of the gallery, in alphabetical order."""
    probe_names: tuple[str | None, ...]
    """(P,): who the probes show; None where that is unknown."""
    similarities: FloatArray
    """(P, G): of each probe to each person."""
    ranks: IntArray
    """(P,): place of the right person, 1 for the most similar; persons as similar as the right one count
    before. 0 where the person is unknown."""
    combine: Combine
    """What is taken of a person's several gallery images."""

    @property
    def known(self) -> BoolArray:
        """(P,): whether the probe's person is known; others count in no rate."""
        return self.ranks > 0

    @property
    def order(self) -> IntArray:
        """(P, G): indices of persons, the most similar first, in alphabetical order among equals."""
        return np.argsort(-self.similarities, axis=1, kind="stable")

    @property
    def predicted(self) -> Texts:
        """(P,): the most similar person, the first in the alphabet of several."""
        return tuple(self.persons[k] for k in self.similarities.argmax(axis=1))

    @property
    def genuine(self) -> BoolArray:
        """(P, G): whether the probe shows the person."""
        return np.array(self.probe_names, object)[:, None] == np.array(self.persons, object)

    def rate(self, rank: int = 1) -> float:
        """Return the share of probes of known persons whose person is among the first `rank`."""
        return float((self.ranks[self.known] <= rank).mean())


def identify(
    gallery: Templates, probes: Templates, *, combine: Combine = "best", window: int = WINDOW
) -> Identification:
    """Return which persons of a gallery the probes show.

    As Toderici et al.: a closed set, compared by CW-SSIM of the coarsest of three scales. Raises `ValueError`
    for another `combine`; `RecognitionError` when a set is empty, a probe's person is not in the gallery, or
    templates cannot be compared.

    Parameters
    ----------
    gallery : Templates
        Of the known persons, one or more each.
    probes : Templates
        Their names only show whether the prediction is right.
    combine : {"best", "mean"}
        A person's similarity is the best of, or the mean over, the images in the gallery.
    window : int
        As in `cw_ssim`.

    Examples
    --------
    >>> from scan2albedo.recognition import albedo_templates, identify
    >>> random = np.random.default_rng(0)
    >>> albedos = random.random((3, 128, 128))
    >>> gallery = albedo_templates(albedos, ["ann", "bob", "cy"])
    >>> probes = albedo_templates(albedos[1:] + 0.2 * random.random((2, 128, 128)), ["bob", "cy"])
    >>> identify(gallery, probes).predicted
    ('bob', 'cy')
    """
    _check_closed(gallery.names, probes.names)
    scores = similarity_matrix(probes, gallery, window=window)
    return identify_by_similarity(scores, gallery.names, probes.names, combine=combine)


def identify_by_similarity(
    similarities: ArrayLike,
    gallery_names: Sequence[str],
    probe_names: Sequence[str | None],
    *,
    combine: Combine = "best",
) -> Identification:
    """Return the identification by given similarities of any kind; larger is more alike.

    The set is closed: a probe whose person is unknown gets the most similar person too. Raises `ValueError`
    when the shape does not fit the names or `combine` is unknown; `RecognitionError` when a set is empty, a
    probe's person is not in the gallery, or a similarity is not finite.

    Parameters
    ----------
    similarities : (P, images) array_like
        Those of probes to gallery images.
    gallery_names, probe_names : sequence of str
        Persons of the gallery's images and of the probes; None for probes whose person is unknown.
    combine : {"best", "mean"}
        As in `identify`.

    Examples
    --------
    >>> found = identify_by_similarity(np.array([[0.9, 0.2], [0.6, 0.4]]), ["ann", "bob"], [None, "bob"])
    >>> found.predicted, found.ranks.tolist(), found.rate(1)
    (('ann', 'ann'), [0, 2], 0.0)
    """
    scores = np.asarray(similarities, float)
    _check_closed(gallery_names, probe_names)
    if scores.shape != (len(probe_names), len(gallery_names)):
        raise ValueError(
            f"similarities have shape {scores.shape}, expected ({len(probe_names)}, {len(gallery_names)}): "
            "probes by gallery images"
        )
    if not all_finite(scores):
        i, j = np.argwhere(~np.isfinite(scores))[0]
        raise RecognitionError(
            f"the similarity of probe {i} ({probe_names[i] or 'nobody named'}) and gallery image {j} "
            f"({gallery_names[j]}) is {scores[i, j]}; leave one of them out"
        )
    persons, scores = similarities_by_person(scores, gallery_names, combine)
    place = {person: k for k, person in enumerate(persons)}
    own = np.array(
        [np.inf if name is None else row[place[name]] for name, row in zip(probe_names, scores, strict=True)]
    )
    ranks = (scores >= own[:, None]).sum(axis=1)
    return Identification(persons, tuple(probe_names), scores, ranks, combine)


def similarities_by_person(
    scores: FloatArray, gallery_names: Sequence[str], combine: Combine
) -> tuple[Texts, FloatArray]:
    """Return the persons of a gallery, in alphabetical order, and the similarities (P, persons) to them.

    NaN in scores (P, images) is not a similarity: a person's best is that of the others, the mean is NaN.
    """
    persons = tuple(sorted(set(gallery_names)))
    if combine not in ("best", "mean"):
        raise ValueError(f"combine is {combine!r}, expected 'best' or 'mean'")
    names, taken = np.array(gallery_names), np.fmax.reduce if combine == "best" else np.mean
    return persons, np.stack([taken(scores[:, names == one], axis=1) for one in persons], axis=1)


def _check_closed(gallery_names: Sequence[str], probe_names: Sequence[str | None]) -> None:
    if len(gallery_names) == 0:
        raise RecognitionError("the gallery is empty; give one image or more of each person")
    if len(probe_names) == 0:
        raise RecognitionError("no probe was given; give one or more")
    known = {None, *gallery_names}
    strangers = [f"{k} ({name})" for k, name in enumerate(probe_names) if name not in known]
    if strangers:
        shown = ", ".join(strangers[:5]) + (f" and {len(strangers) - 5} more" if len(strangers) > 5 else "")
        raise RecognitionError(
            f"the gallery has no image of the person of probe {shown}; identification is among the "
            "persons of the gallery: add their images, or leave these probes out"
        )
