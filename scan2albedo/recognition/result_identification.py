"""`identify_results`: which persons of a gallery of processed scans other processed scans show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.identification import Combine, ProbeMatches, match_probes
from scan2albedo.recognition.manifest import read_manifest
from scan2albedo.recognition.options import IDENTIFICATION, SimilarityOptions, TemplateOptions
from scan2albedo.recognition.similarity import similarity_matrix
from scan2albedo.recognition.stored_albedo import CountCallback, result_templates
from scan2albedo.recognition.template_files import read_templates
from scan2albedo.recognition.templates import Templates, common_chart


@dataclass(frozen=True)
class LabelledTemplates:
    """Templates, and the origin of each."""

    source: Path
    """The file that named them."""
    templates: Templates
    """N of them."""
    labels: tuple[str, ...]
    """(N,): the results as the manifest names them, or the persons with a number."""
    persons: tuple[str | None, ...]
    """(N,): who is shown; None where that is unknown."""
    notes: tuple[str, ...] = ()
    """What is odd about them, one sentence each."""


def read_labelled_templates(
    source: str | Path,
    *,
    persons_required: bool = True,
    options: TemplateOptions | None = None,
    on_count: CountCallback | None = None,
) -> LabelledTemplates:
    """Return the templates of a file (.npz), or of the results that a CSV file names.

    Parameters
    ----------
    source : path
        From `write_templates`, or a manifest as `read_manifest` takes it.
    persons_required : bool
        Whether every line of a manifest has to name a person.
    options : TemplateOptions, optional
        The default ones, or those of the file, when omitted.
    on_count : callable, optional
        Called with the number of results done and their number.

    Raises
    ------
    RecognitionError
        When something cannot be read or used, or the file was made with other options; names it.
    """
    file = Path(source)
    if file.suffix.lower() != ".npz":
        manifest = read_manifest(file, persons_required=persons_required)
        templates = result_templates(manifest, options=options or TemplateOptions(), on_count=on_count)
        labels = tuple(entry.result for entry in manifest.entries)
        persons = tuple(entry.person for entry in manifest.entries)
        return LabelledTemplates(file, templates, labels, persons, manifest.notes)
    templates = read_templates(file)
    if options is not None and options != templates.options:
        raise RecognitionError(
            f"{file} was made with {templates.options}, asked for were {options}; leave the choice out, or "
            "make the file anew"
        )
    labels = tuple(f"{name} [{k}]" for k, name in enumerate(templates.names))
    return LabelledTemplates(file, templates, labels, templates.names)


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
    combine: Combine
    """What is taken of a person's several gallery images."""
    notes: tuple[str, ...]
    """What is odd about the input, one sentence each."""


def identify_results(
    gallery: str | Path | LabelledTemplates,
    probes: str | Path | LabelledTemplates,
    *,
    combine: Combine = "best",
    options: TemplateOptions | None = None,
    similarity: SimilarityOptions = IDENTIFICATION,
    on_count: StageCallback | None = None,
) -> ResultIdentification:
    """Return which persons of a gallery of processed scans other processed scans show.

    Parameters
    ----------
    gallery : path or LabelledTemplates
        A CSV file with the columns person and result, each result the folder of a processed scan (see
        `read_albedo`), or a file of templates. Several results may show one person.
    probes : path or LabelledTemplates
        The same; a cell of person may be empty: such a probe is identified, but counts in no rate.
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
        When `combine` is unknown.
    RecognitionError
        When a file cannot be read or used, sizes or models differ, or a probe's person is not in the gallery.
    """
    if combine not in ("best", "mean"):
        raise ValueError(f"combine is {combine!r}, expected 'best' or 'mean'")
    known = _read(gallery, "gallery", options, on_count)
    shown = _read(probes, "probes", known.templates.options, on_count)
    _check_pair(known, shown)
    scores = similarity_matrix(shown.templates, known.templates, options=similarity)
    matches = match_probes(scores, known.templates.names, shown.persons, combine=combine)
    return ResultIdentification(
        known, shown, matches, combine, (*known.notes, *shown.notes, *_copies(known, shown))
    )


def _read(
    source: str | Path | LabelledTemplates,
    stage: str,
    options: TemplateOptions | None,
    on_count: StageCallback | None,
) -> LabelledTemplates:
    if isinstance(source, LabelledTemplates):
        return source
    count = None if on_count is None else lambda done, total: on_count(stage, done, total)
    return read_labelled_templates(
        source, persons_required=stage == "gallery", options=options, on_count=count
    )


def _check_pair(gallery: LabelledTemplates, probes: LabelledTemplates) -> None:
    common_chart(gallery.templates.chart, probes.templates.chart, str(gallery.source), str(probes.source))
    strangers = [
        f"{label} ({person})"
        for label, person in zip(probes.labels, probes.persons, strict=True)
        if person is not None and person not in gallery.templates.names
    ]
    if strangers:
        more = f" and {len(strangers) - 5} more" if len(strangers) > 5 else ""
        raise RecognitionError(
            f"{gallery.source} has no image of the persons on these probes of {probes.source}: "
            f"{', '.join(strangers[:5])}{more}; add their images to the gallery, or leave their person "
            "empty: then they are identified, and not counted"
        )


def _copies(gallery: LabelledTemplates, probes: LabelledTemplates) -> Iterator[str]:
    """Give a note for probes that are images of the gallery themselves."""
    stored = {values.tobytes() for values in gallery.templates.coefficients}
    same = [
        label
        for label, values in zip(probes.labels, probes.templates.coefficients, strict=True)
        if values.tobytes() in stored
    ]
    if same:
        yield (
            f"{len(same)} of {len(probes.labels)} probes are in the gallery themselves ({', '.join(same[:5])}"
            f"{', ...' if len(same) > 5 else ''}): that they are recognised means nothing"
        )
