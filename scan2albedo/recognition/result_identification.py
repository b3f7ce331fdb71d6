"""`identify_results`: which persons of a gallery of processed scans other processed scans show."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.fusion import fused
from scan2albedo.recognition.identification import Combine, ProbeMatches, match_probes, similarities_by_person
from scan2albedo.recognition.labelled_templates import (
    DEFAULT_USE,
    LabelledTemplates,
    checked_use,
    read_labelled_templates,
)
from scan2albedo.recognition.options import SimilarityOptions, TemplateOptions
from scan2albedo.recognition.similarity import comparable_similarities, has_window
from scan2albedo.recognition.templates import Kind, common_chart

StageCallback = Callable[[str, int, int], None]
"""Called with "gallery" or "probes", how many results are read, and of how many."""


@dataclass(frozen=True)
class ResultIdentification:
    """What `identify_results` found."""

    gallery: LabelledTemplates
    probes: LabelledTemplates
    """`gallery`, `probes`: what was compared."""
    matches: ProbeMatches
    """Of the probes, in their order."""
    by_kind: Mapping[Kind, FloatArray]
    """(P, G) of each kind that was used: similarities of each probe to each person by it alone, NaN where one
    of them lacks it."""
    combine: Combine
    """What is taken of a person's several gallery images."""
    notes: tuple[str, ...]
    """What is odd about the input, one sentence each."""


def identify_results(
    gallery: str | Path | LabelledTemplates,
    probes: str | Path | LabelledTemplates,
    *,
    use: Sequence[Kind] = DEFAULT_USE,
    combine: Combine = "best",
    options: TemplateOptions | None = None,
    similarity: SimilarityOptions = SimilarityOptions(),
    on_count: StageCallback | None = None,
) -> ResultIdentification:
    """Return which persons of a gallery of processed scans other processed scans show.

    Parameters
    ----------
    gallery : path or LabelledTemplates
        A CSV file with the columns person and result, each result the folder of a processed scan (see
        `read_albedo`); the folder of a batch (see `read_manifest`); or a file of templates. Several
        results may show one person.
    probes : path or LabelledTemplates
        The same; a cell of person may be empty. A probe whose person is not known, or not in the gallery, is
        identified, but counts in no rate.
    use : sequence of {"albedo", "shape"}
        What is compared; similarities by both are taken together as `fused` says. A result that lacks one of
        them, as a scan without colour lacks the albedo, is compared by the other.
    combine : {"best", "mean"}
        A person's similarity is the best of, or the mean over, the images in the gallery.
    options : TemplateOptions, optional
        Those of a file of templates, otherwise the default ones, when omitted.
    similarity : SimilarityOptions
    on_count : callable, optional
        Called after each result that was read.

    Raises
    ------
    ValueError
        When `combine` or a name of `use` is unknown.
    RecognitionError
        When a file cannot be read or used, sizes or models differ, or nothing is left to compare.

    Notes
    -----
    Results that have nothing to compare are left out, and `notes` name them.
    """
    if combine not in ("best", "mean"):
        raise ValueError(f"combine is {combine!r}, expected 'best' or 'mean'")
    known = _read(gallery, "gallery", use, options, on_count)
    shown = _read(probes, "probes", use, known.options, on_count)
    known, shown, scores, apart = _compared(known, shown, similarity)
    total, gallery_names = fused(scores), [person or "" for person in known.persons]
    unlike = np.isnan(total)
    persons, strangers = _known_persons(known, shown)
    matches = match_probes(np.where(unlike, 0.0, total), gallery_names, persons, combine=combine)
    by_kind = {
        kind: similarities_by_person(values, gallery_names, combine)[1] for kind, values in scores.items()
    }
    notes = (
        *known.notes,
        *shown.notes,
        *_by_one_kind(known, scores),
        *strangers,
        *_zeros(apart, unlike),
        *_copies(known, shown),
    )
    return ResultIdentification(known, shown, matches, by_kind, combine, notes)


def _read(
    source: str | Path | LabelledTemplates,
    stage: str,
    use: Sequence[Kind],
    options: TemplateOptions | None,
    on_count: StageCallback | None,
) -> LabelledTemplates:
    if isinstance(source, LabelledTemplates):
        checked_use(use)
        return source
    count = None if on_count is None else lambda done, total: on_count(stage, done, total)
    return read_labelled_templates(
        source, use=use, persons_required=stage == "gallery", options=options, on_count=count
    )


def _compared(
    known: LabelledTemplates, shown: LabelledTemplates, options: SimilarityOptions
) -> tuple[LabelledTemplates, LabelledTemplates, dict[Kind, FloatArray], BoolArray]:
    """Return gallery, probes, similarities (P, images) of each kind, and which pairs (P, images) lie apart.

    Those share no window and have similarity 0; NaN is where one of a pair lacks the kind. Results whose
    masks hold no window are left out, with a note.
    """
    kinds = [kind for kind in get_args(Kind) if kind in known.sets and kind in shown.sets]
    if not kinds:
        raise RecognitionError(
            f"{known.source} can be compared by {' and '.join(known.sets)}, {shown.source} by "
            f"{' and '.join(shown.sets)}; process all scans alike, or choose what to use"
        )
    known, shown = _with_windows(known, kinds, options), _with_windows(shown, kinds, options)
    scores: dict[Kind, FloatArray] = {}
    apart = np.zeros((len(shown), len(known)), bool)
    for kind in kinds:
        scores[kind] = np.full((len(shown), len(known)), np.nan)
        if kind in known.sets and kind in shown.sets:
            a, b = shown.sets[kind], known.sets[kind]
            common_chart(b.chart, a.chart, str(known.source), str(shown.source))
            here = np.ix_(shown.rows[kind], known.rows[kind])
            found = comparable_similarities(a, b, options)
            scores[kind][here], apart[here] = np.nan_to_num(found), apart[here] | np.isnan(found)
    return known, shown, scores, apart


def _with_windows(
    labelled: LabelledTemplates, kinds: Sequence[Kind], options: SimilarityOptions
) -> LabelledTemplates:
    usable, lacking = np.zeros(len(labelled), bool), np.ones(len(labelled), bool)
    for kind in kinds:
        usable[labelled.rows[kind]] |= has_window(labelled.sets[kind], options)
        lacking[labelled.rows[kind]] = False
    if usable.all():
        return labelled
    window = f"{options.window} x {options.window}"
    reasons = (
        (lacking, f"no {' or '.join(kinds)}, which is all that both sides can be compared by"),
        (~usable & ~lacking, f"no window of {window} coefficients lies inside the mask"),
    )
    told = [
        f"{labelled.source}: {_few([labelled.labels[k] for k in np.flatnonzero(which)])}: {reason}"
        for which, reason in reasons
        if which.any()
    ]
    if not usable.any():
        raise RecognitionError(f"{'; '.join(told)}, and no result is left; scan more of the faces")
    kept = labelled.select(np.flatnonzero(usable))
    return replace(kept, notes=(*kept.notes, *(f"left out: {one}" for one in told)))


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def _by_one_kind(gallery: LabelledTemplates, scores: Mapping[Kind, FloatArray]) -> Iterator[str]:
    """Give a note for probes that are compared by one of two kinds alone, see `fused`."""
    if len(scores) < 2:
        return
    whole = {kind: np.isfinite(values).all(1) for kind, values in scores.items()}
    albedo, shape = get_args(Kind)
    for kind, other in ((albedo, shape), (shape, albedo)):
        alone = np.asarray(whole[other] & ~whole[kind])
        if not alone.any():
            continue
        lacking = sorted(set(range(len(gallery))) - set(gallery.rows[kind].tolist()))
        images = _few([gallery.labels[k] for k in lacking])
        reason = f"; of the gallery {images} lack{'s' if len(lacking) == 1 else ''} it" if lacking else ""
        yield (
            f"{alone.sum()} of {alone.size} probes are compared by {other} alone, for {kind} counts where "
            f"the probe and all images of the gallery have it{reason}"
        )


def _known_persons(
    gallery: LabelledTemplates, probes: LabelledTemplates
) -> tuple[tuple[str | None, ...], list[str]]:
    """Return the probes' persons, None for those of whom the gallery has no image, and notes about these."""
    known = set(gallery.persons)
    strangers = [
        f"{label} ({person})"
        for label, person in zip(probes.labels, probes.persons, strict=True)
        if person is not None and person not in known
    ]
    if not strangers:
        return probes.persons, []
    note = (
        f"{gallery.source} has no image of the persons on {len(strangers)} probes: {_few(strangers)}; "
        "they are identified, but count in no rate"
    )
    return tuple(p if p in known else None for p in probes.persons), [note]


def _zeros(apart: BoolArray, unlike: BoolArray) -> Iterator[str]:
    if unlike.any():
        yield (
            f"{unlike.sum()} of {unlike.size} pairs of a probe and an image have neither albedo nor shape in "
            "common: they count as similarity 0"
        )
    if apart.any():
        yield (
            f"{apart.sum()} of {apart.size} pairs of a probe and an image have no window in common: they "
            "count as similarity 0"
        )


def _copies(gallery: LabelledTemplates, probes: LabelledTemplates) -> Iterator[str]:
    """Give a note for probes that are images of the gallery themselves."""
    kind = next(kind for kind in probes.sets if kind in gallery.sets)
    stored = {values.tobytes() for values in gallery.sets[kind].coefficients}
    same = [
        probes.labels[row]
        for row, values in zip(probes.rows[kind], probes.sets[kind].coefficients, strict=True)
        if values.tobytes() in stored
    ]
    if same:
        yield (
            f"{len(same)} of {len(probes.labels)} probes are in the gallery themselves ({_few(same)}): that "
            "they are recognised means nothing"
        )
