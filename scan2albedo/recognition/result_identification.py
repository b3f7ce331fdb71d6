"""`identify_results`: which persons of a gallery of processed scans other processed scans show."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import get_args

import numpy as np
from pydantic import TypeAdapter

from scan2albedo.core.arrays import FloatArray, Texts
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import identification as matching
from scan2albedo.recognition.labelled_templates import (
    DEFAULT_USE,
    LabelledTemplates,
    checked_use,
    read_labelled_templates,
)
from scan2albedo.recognition.similarity import WINDOW, comparable_similarities, has_window
from scan2albedo.recognition.templates import Kind, TemplateOptions, Templates, common_chart


@dataclass(frozen=True)
class Calibration:
    """How similarities of K kinds are distributed over pairs of scans of one person, and of two.

    Both are normal with one covariance C and means m_1 and m_2, so the log odds at even prior odds are
    linear: sum_k a_k (s_k - (m_1k + m_2k) / 2) with slopes a = C^-1 (m_1 - m_2) (Fisher's discriminant).
    Where a kind is missing they are those of the others. How alike the shadings are says nothing of persons
    by itself, but how much of the texture's similarity to expect from the light: its slope is negative.
    How alike all pairs are differs by population, camera and light: the variance of that level is part of C,
    and makes log odds smaller than within one set of people. That of the shape, which a gallery shares, is
    added where pairs are judged one by one.
    """

    kinds: tuple[Kind, ...]
    same: tuple[float, ...]
    other: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    """`kinds`, `same`, `other`, `covariance`: names of the kinds, means (K,) of pairs of one person and of
    two, and their covariance (K, K)."""
    shading_variance: float = 0.0
    """Of the shading's similarity over persons where all pairs have the same two lights."""
    shape_variance: float = 0.0
    """Of the level of the shape's similarity over populations."""


CALIBRATION = TypeAdapter(Calibration).validate_json(
    resources.files(__package__).joinpath("data/calibration.json").read_bytes()
)
"""Of the default templates, by scans and photographs of sixteen heads under rendered lights and three scans
each of twelve synthetic people: `python tools/build recognition_calibration FOLDER`."""


def log_odds_by_kind(
    similarities: Mapping[Kind, FloatArray], calibration: Calibration = CALIBRATION, shape_variance: float = 0
) -> dict[Kind, FloatArray]:
    """Return what each kind adds to the log odds (P, G) that both of a pair are one person; they are summed.

    `similarities` map kinds to (P, G), NaN where a pair lacks the kind; where it lacks all, the sum is NaN.
    `shape_variance` is that of the level of the shape's similarity where pairs are not of one gallery.
    """
    kinds = [kind for kind in calibration.kinds if kind in similarities]
    index = [calibration.kinds.index(kind) for kind in kinds]
    same, other = np.array(calibration.same)[index], np.array(calibration.other)[index]
    levels = np.diag([(kind == "shape") * shape_variance for kind in calibration.kinds])
    covariance = (np.array(calibration.covariance) + levels)[np.ix_(index, index)]
    values = np.stack([similarities[kind] for kind in kinds])
    known = ~np.isnan(values)
    found = np.where(known.any(axis=0), 0.0, np.nan) * np.ones_like(values)
    for pattern in np.unique(known.reshape(len(kinds), -1), axis=1).T:
        there = np.flatnonzero(pattern)
        slopes = np.linalg.solve(covariance[np.ix_(there, there)], (same - other)[there])
        pairs = (known == pattern[:, None, None]).all(axis=0)
        for k, slope in zip(there, slopes, strict=True):
            found[k][pairs] = slope * (values[k][pairs] - (same[k] + other[k]) / 2)
    return dict(zip(kinds, found, strict=True))


def common_similarities(
    similarities: Mapping[Kind, FloatArray], calibration: Calibration = CALIBRATION
) -> dict[Kind, FloatArray]:
    """Return what of (P, G) similarities of probes and gallery compares persons, NaN for the rest.

    A probe is compared by what it and all images of the gallery have, for log odds by one kind and by more
    seldom agree; where nothing is common to all, by what each pair has. How alike the shadings are differs by
    the lights, and by errors of the albedo: what is left of its variance over the gallery beyond that of
    errors is the lights', so that among images in one light it counts for nothing (empirical Bayes).
    """
    values = np.stack(list(similarities.values()))
    known = ~np.isnan(values)
    common = known.all(axis=2, keepdims=True)
    used = np.where(common.any(axis=0), common & known, known)
    found = dict(zip(similarities, np.where(used, values, np.nan), strict=True))
    if "shading" in found and used[list(found).index("shading")].any():
        shading = np.ma.masked_invalid(found["shading"])
        mean, spread = (np.ma.filled(f(axis=1, keepdims=True), 0.0) for f in (shading.mean, shading.var))
        lights = np.maximum(spread - calibration.shading_variance, 0.0)
        share = np.divide(lights, spread, out=np.zeros_like(lights), where=spread > 0)
        found["shading"] = mean + share * (found["shading"] - mean)
    return found


def fused(similarities: Mapping[Kind, FloatArray], calibration: Calibration = CALIBRATION) -> FloatArray:
    """Return the log odds (P, G) that probe and image of the gallery show one person, by all kinds.

    `similarities` map kinds to (P, G), NaN where one lacks the kind (see `common_similarities`); the result
    is NaN where a pair has none in common. The `calibration` is that of the default templates.

    Examples
    --------
    >>> even = Calibration(("albedo", "shape"), (0.8, 0.8), (0.6, 0.6), ((0.01, 0.0), (0.0, 0.01)))
    >>> pairs = {"albedo": np.array([[0.9, np.nan]]), "shape": np.array([[0.5, np.nan]])}
    >>> fused(pairs, even).round(6).tolist()
    [[0.0, nan]]
    """
    parts = log_odds_by_kind(common_similarities(similarities, calibration), calibration)
    return np.asarray(sum(parts.values()))


def same_person_log_odds(a: Mapping[Kind, Templates], b: Mapping[Kind, Templates]) -> FloatArray:
    """Return the log odds (A, B), at even prior odds, that two processed scans show one person.

    Above 0 they rather show one person than two; several scans of one person against one more are judged by
    the mean of their log odds. Calibrated for the default `TemplateOptions`. Raises `RecognitionError` when
    the sets have no kind in common, or cannot be compared.

    Parameters
    ----------
    a, b : mapping of kind to Templates
        A and B templates of each kind, as `albedo_templates` and `shape_templates` or
        `read_labelled_templates(...).sets` give them. Pairs without a common window of a kind go without it;
        log odds are 0 where they have none at all.
    """
    if not (kinds := [kind for kind in a if kind in b]):
        raise RecognitionError(
            f"one set has templates of {' and '.join(a) or 'nothing'}, the other of "
            f"{' and '.join(b) or 'nothing'}; make both of one kind"
        )
    similarities = {kind: comparable_similarities(a[kind], b[kind], WINDOW) for kind in kinds}
    parts = log_odds_by_kind(similarities, shape_variance=CALIBRATION.shape_variance)
    return np.nan_to_num(sum(parts.values()), nan=0.0)


@dataclass(frozen=True)
class ResultIdentification:
    """What `identify_results` found."""

    gallery: LabelledTemplates
    probes: LabelledTemplates
    """`gallery`, `probes`: what was compared."""
    matches: matching.Identification
    """Of the probes, in their order, by log odds."""
    by_kind: Mapping[Kind, FloatArray]
    """(P, G) of each kind that was used: similarities of each probe to each person by it alone, NaN where one
    of them lacks it."""
    decided_by: tuple[Kind, ...]
    """(P,): the kind that adds most to the lead of the predicted person over the next, the shading's part
    being the texture's; combined as the log odds are."""
    notes: Texts
    """What is odd about the input, one sentence each."""


def identify_results(
    gallery: str | Path | LabelledTemplates,
    probes: str | Path | LabelledTemplates,
    *,
    use: Sequence[Kind] = DEFAULT_USE,
    combine: matching.Combine = "mean",
    together: bool = False,
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
    use : sequence of {"albedo", "texture", "shape"}
        What is compared; similarities are taken together as `fused` says. A result that lacks one, as a scan
        without colour lacks the albedo, is compared by the others.
    combine : {"best", "mean"}
        A person's log odds are the best of, or the mean over, the images in the gallery.
    together : bool
        Whether probes that name one person are one probe of several scans, by the mean of their log odds.
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
    both = set(known.sets) & set(shown.sets)
    both -= set() if {"albedo", "texture"} <= both else {"shading"}
    kinds = [kind for kind in get_args(Kind) if kind in both]
    if not kinds:
        raise RecognitionError(
            f"{known.source} can be compared by {' and '.join(known.sets)}, {shown.source} by "
            f"{' and '.join(shown.sets)}; process all scans alike, or choose what to use"
        )
    return _identified(_with_windows(known, kinds), _with_windows(shown, kinds), kinds, combine, together)


def _identified(
    known: LabelledTemplates,
    shown: LabelledTemplates,
    kinds: Sequence[Kind],
    combine: matching.Combine,
    together: bool,
) -> ResultIdentification:
    """Return which persons templates show, by kinds that both sides have."""
    scores = _pair_similarities(known, shown, kinds)
    parts = log_odds_by_kind(common_similarities(scores))
    total = np.asarray(sum(parts.values()))
    # Several scans of one person are one probe: the mean of its rows.
    groups: dict[str | int, list[int]] = {}
    for k, person in enumerate(shown.persons):
        groups.setdefault((together and person) or k, []).append(k)

    def mean(values: FloatArray) -> FloatArray:
        return np.stack([values[group].mean(axis=0) for group in groups.values()])

    labels = tuple(_few([shown.labels[k] for k in group]) for group in groups.values())
    judged = replace(shown.select([group[0] for group in groups.values()]), labels=labels)
    # A pair with nothing in common is as unlike as similarities of 0.
    unlike = sum(log_odds_by_kind({kind: np.zeros((1, 1)) for kind in kinds}).values())
    log_odds = mean(np.where(np.isnan(total), unlike, total))
    names = [person or "" for person in known.persons]
    persons = [person if person in known.persons else None for person in judged.persons]
    matches = matching.identify_by_similarity(log_odds, names, persons, combine=combine)

    def by_person(values: FloatArray) -> FloatArray:
        return matching.similarities_by_person(mean(values), names, combine)[1]

    by_kind = {kind: by_person(values) for kind, values in scores.items()}
    parts = {kind: by_person(np.nan_to_num(part)) for kind, part in parts.items()}
    if "shading" in parts:
        parts["texture"] = parts["texture"] + parts.pop("shading")
    first_two = matches.order[:, :2]
    signs = np.array([1, -1])[: first_two.shape[1]]
    leads = np.stack([np.take_along_axis(part, first_two, axis=1) @ signs for part in parts.values()])
    decided_by = tuple(list(parts)[k] for k in leads.argmax(axis=0))
    notes = (*known.notes, *shown.notes, *_repeated(known, shown))
    return ResultIdentification(known, judged, matches, by_kind, decided_by, notes)


def _pair_similarities(
    known: LabelledTemplates, shown: LabelledTemplates, kinds: Sequence[Kind]
) -> dict[Kind, FloatArray]:
    """Return similarities (P, images) by kind: NaN where one lacks it, 0 without a common window."""
    scores: dict[Kind, FloatArray] = {}
    for kind in kinds:
        scores[kind] = np.full((len(shown), len(known)), np.nan)
        if kind in known.sets and kind in shown.sets:  # otherwise all that have it were left out
            a, b = shown.sets[kind], known.sets[kind]
            common_chart(b.chart, a.chart, str(known.source), str(shown.source))
            here = np.ix_(shown.rows[kind], known.rows[kind])
            scores[kind][here] = np.nan_to_num(comparable_similarities(a, b, WINDOW))
    return scores


def _repeated(known: LabelledTemplates, shown: LabelledTemplates) -> list[str]:
    """Return a sentence for probes whose templates are those of an image of the gallery."""
    kind = next(kind for kind in shown.sets if kind in known.sets)
    stored = {values.tobytes() for values in known.sets[kind].coefficients}
    rows = zip(shown.rows[kind], shown.sets[kind].coefficients, strict=True)
    same = [shown.labels[row] for row, values in rows if values.tobytes() in stored]
    if not same:
        return []
    return [
        f"{len(same)} of {len(shown)} probes are in the gallery themselves ({_few(same)}): that they are "
        "recognised means nothing"
    ]


def _with_windows(labelled: LabelledTemplates, kinds: Sequence[Kind]) -> LabelledTemplates:
    """Return the results that have a window of one of the kinds; a note names the others."""
    usable = np.zeros(len(labelled), bool)
    for kind in kinds:
        usable[labelled.rows[kind]] |= has_window(labelled.sets[kind], WINDOW)
    if usable.all():
        return labelled
    names = _few([labelled.labels[k] for k in np.flatnonzero(~usable)])
    left = f"{labelled.source}: {names}: no window of {WINDOW} x {WINDOW} coefficients lies inside the mask"
    if not usable.any():
        raise RecognitionError(f"{left}, and no result is left; scan more of the faces")
    kept = labelled.select(np.flatnonzero(usable))
    return replace(kept, notes=(*kept.notes, f"left out: {left}"))


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
