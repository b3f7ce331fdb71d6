"""`identify_results`: which persons of a gallery of processed scans other processed scans show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.identification import (
    Combine,
    Identification,
    identify_by_similarity,
    similarities_by_person,
)
from scan2albedo.recognition.labelled_templates import (
    DEFAULT_USE,
    LabelledTemplates,
    checked_use,
    read_labelled_templates,
)
from scan2albedo.recognition.similarity import WINDOW, comparable_similarities, has_window
from scan2albedo.recognition.templates import Kind, TemplateOptions, common_chart


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


CALIBRATION = Calibration((135.0, -97.2), (893.0, -768.0), (94.0, 817.0, -770.0))
"""Of the default templates, from synthetic people: `python tools/experiment_real.py pop/manifest.csv --make
population --persons 8 --seed 7 --calibrate`."""


def fused(similarities: Mapping[Kind, FloatArray], calibration: Calibration = CALIBRATION) -> FloatArray:
    """Return one similarity for each pair: that of the only kind, or the mean of both by their weights.

    Weights are the calibration's slopes. A probe is compared by what it and all images of the gallery have,
    since a likelihood ratio by one kind and one by both seldom agree; where nothing is common to all, by what
    each pair has. Beside probes compared by both, similarities by one kind are brought to where the
    likelihood ratio by both is the same; where one kind compares all probes, they stay as they are.
    `similarities` map "albedo" and "shape" to (P, G), NaN where a probe or an image lacks the kind; (P, G)
    is returned, NaN where a pair has no kind in common. The `calibration` is that of the default templates.

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


@dataclass(frozen=True)
class ResultIdentification:
    """What `identify_results` found."""

    gallery: LabelledTemplates
    probes: LabelledTemplates
    """`gallery`, `probes`: what was compared."""
    matches: Identification
    """Of the probes, in their order."""
    by_kind: Mapping[Kind, FloatArray]
    """(P, G) of each kind that was used: similarities of each probe to each person by it alone, NaN where one
    of them lacks it."""
    notes: tuple[str, ...]
    """What is odd about the input, one sentence each."""


def identify_results(
    gallery: str | Path | LabelledTemplates,
    probes: str | Path | LabelledTemplates,
    *,
    use: Sequence[Kind] = DEFAULT_USE,
    combine: Combine = "best",
    options: TemplateOptions | None = None,
    on_count: Callable[[str, int, int], None] | None = None,
) -> ResultIdentification:
    """Return which persons of a gallery of processed scans other processed scans show.

    A probe whose person is not known, or not in the gallery, is identified, but counts in no rate. Results
    that have nothing to compare are left out; `notes` name them. Raises `ValueError` when `combine` or a name
    of `use` is unknown; `RecognitionError` when a file cannot be read or used, sizes or models differ, or
    nothing is left to compare.

    Parameters
    ----------
    gallery, probes : path or LabelledTemplates
        A CSV file with the columns person and result, each result the folder of a processed scan (see
        `read_face`); the folder of a batch (see `read_manifest`); or a file of templates. Several results may
        show one person; of the probes a cell of person may be empty.
    use : sequence of {"albedo", "shape"}
        What is compared; similarities by both are taken together as `fused` says. A result that lacks one of
        them, as a scan without colour lacks the albedo, is compared by the other.
    combine : {"best", "mean"}
        A person's similarity is the best of, or the mean over, the images in the gallery.
    options : TemplateOptions, optional
        Those of a file of templates, otherwise the default ones, when omitted.
    on_count : callable, optional
        Called after each result with "gallery" or "probes", how many are read, and of how many.
    """
    if combine not in ("best", "mean"):
        raise ValueError(f"combine is {combine!r}, expected 'best' or 'mean'")

    def read(
        source: str | Path | LabelledTemplates, stage: str, like: TemplateOptions | None
    ) -> LabelledTemplates:
        if isinstance(source, LabelledTemplates):
            checked_use(use)
            return source
        count = None if on_count is None else lambda done, total: on_count(stage, done, total)
        return read_labelled_templates(
            source, use=use, persons_required=stage == "gallery", options=like, on_count=count
        )

    known = read(gallery, "gallery", options)
    shown = read(probes, "probes", known.templates.options)
    kinds = [kind for kind in get_args(Kind) if kind in known.sets and kind in shown.sets]
    if not kinds:
        raise RecognitionError(
            f"{known.source} can be compared by {' and '.join(known.sets)}, {shown.source} by "
            f"{' and '.join(shown.sets)}; process all scans alike, or choose what to use"
        )
    known, shown = _with_windows(known, kinds), _with_windows(shown, kinds)
    # Similarities (P, images) of each kind, NaN where one of a pair lacks it, and pairs without a common
    # window, which have similarity 0.
    scores = {kind: np.full((len(shown), len(known)), np.nan) for kind in kinds}
    apart = np.zeros((len(shown), len(known)), bool)
    for kind in kinds:
        if kind in known.sets and kind in shown.sets:
            a, b = shown.sets[kind], known.sets[kind]
            common_chart(b.chart, a.chart, str(known.source), str(shown.source))
            here = np.ix_(shown.rows[kind], known.rows[kind])
            found = comparable_similarities(a, b, WINDOW)
            scores[kind][here], apart[here] = np.nan_to_num(found), apart[here] | np.isnan(found)
    total, names = fused(scores), [person or "" for person in known.persons]
    persons = [person if person in known.persons else None for person in shown.persons]
    matches = identify_by_similarity(np.nan_to_num(total, nan=0.0), names, persons, combine=combine)
    by_kind = {kind: similarities_by_person(values, names, combine)[1] for kind, values in scores.items()}
    # What limits the comparison. First probes that are compared by one of two kinds alone, see `fused`.
    notes = [*known.notes, *shown.notes]
    for kind, other in zip(kinds, reversed(kinds), strict=True):
        alone = np.isfinite(scores[other]).all(1) & ~np.isfinite(scores[kind]).all(1)
        if alone.any():
            lacking = sorted(set(range(len(known))) - set(known.rows.get(kind, ())))
            images = _few([known.labels[k] for k in lacking])
            reason = f"; of the gallery {images} lack{'s' if len(lacking) == 1 else ''} it" if lacking else ""
            notes.append(
                f"{alone.sum()} of {alone.size} probes are compared by {other} alone, for {kind} counts "
                f"where the probe and all images of the gallery have it{reason}"
            )
    people = zip(shown.labels, shown.persons, strict=True)
    if strangers := [f"{label} ({one})" for label, one in people if one not in (None, *known.persons)]:
        notes.append(
            f"{known.source} has no image of the persons on {len(strangers)} probes: {_few(strangers)}; "
            "they are identified, but count in no rate"
        )
    for pairs, lack in ((np.isnan(total), "have neither albedo nor shape"), (apart, "have no window")):
        if pairs.any():
            notes.append(
                f"{pairs.sum()} of {pairs.size} pairs of a probe and an image {lack} in common: they count "
                "as similarity 0"
            )
    kind = next(kind for kind in shown.sets if kind in known.sets)
    stored = {values.tobytes() for values in known.sets[kind].coefficients}
    rows = zip(shown.rows[kind], shown.sets[kind].coefficients, strict=True)
    if same := [shown.labels[row] for row, values in rows if values.tobytes() in stored]:
        notes.append(
            f"{len(same)} of {len(shown)} probes are in the gallery themselves ({_few(same)}): that they are "
            "recognised means nothing"
        )
    return ResultIdentification(known, shown, matches, by_kind, tuple(notes))


def _with_windows(labelled: LabelledTemplates, kinds: Sequence[Kind]) -> LabelledTemplates:
    usable, lacking = np.zeros(len(labelled), bool), np.ones(len(labelled), bool)
    for kind in kinds:
        usable[labelled.rows[kind]] |= has_window(labelled.sets[kind], WINDOW)
        lacking[labelled.rows[kind]] = False
    if usable.all():
        return labelled
    reasons = (
        (lacking, f"no {' or '.join(kinds)}, which is all that both sides can be compared by"),
        (~usable & ~lacking, f"no window of {WINDOW} x {WINDOW} coefficients lies inside the mask"),
    )
    left = [
        f"{labelled.source}: {_few([labelled.labels[k] for k in np.flatnonzero(which)])}: {reason}"
        for which, reason in reasons
        if which.any()
    ]
    if not usable.any():
        raise RecognitionError(f"{'; '.join(left)}, and no result is left; scan more of the faces")
    kept = labelled.select(np.flatnonzero(usable))
    return replace(kept, notes=(*kept.notes, *(f"left out: {one}" for one in left)))


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
