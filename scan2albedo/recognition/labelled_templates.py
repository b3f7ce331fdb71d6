"""Templates with what they were made from: a manifest of results, or a file of templates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.manifest import read_manifest
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.result_templates import CountCallback, result_templates
from scan2albedo.recognition.template_files import read_templates
from scan2albedo.recognition.templates import Templates


@dataclass(frozen=True)
class LabelledTemplates:
    """Templates, and where each comes from.

    Parameters
    ----------
    source : Path
        The file that named them.
    templates : Templates
    labels : tuple of N str
        The results as the manifest names them, or the persons with a number.
    persons : tuple of N str or None
        Who is shown; None where nobody knows.
    notes : tuple of str
        What is odd about them, one sentence each.
    """

    source: Path
    templates: Templates
    labels: tuple[str, ...]
    persons: tuple[str | None, ...]
    notes: tuple[str, ...] = ()


def read_labelled_templates(
    source: str | Path,
    *,
    persons_required: bool = True,
    options: TemplateOptions | None = None,
    on_count: CountCallback | None = None,
) -> LabelledTemplates:
    """Read a file of templates (.npz), or make the templates of the results that a CSV file names.

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

    Returns
    -------
    LabelledTemplates

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
