"""Templates of many results by albedo and by shape, the origin and person of each, and their files."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2albedo.core.arrays import ArrayLike, IntArray, Texts
from scan2albedo.errors import RecognitionError, errors_of
from scan2albedo.io.npz import read_npz_record, write_npz_record
from scan2albedo.recognition import templates as tpl
from scan2albedo.recognition.manifest import Manifest, read_face, read_manifest

DEFAULT_USE: tuple[tpl.Kind, ...] = ("albedo", "texture", "shape")
"""Together they recognise best, see docs/recognition.md."""


@dataclass(frozen=True)
class LabelledTemplates:
    """Templates of N results, and the origin of each."""

    source: Path
    """The file or folder that named them."""
    sets: Mapping[tpl.Kind, tpl.Templates]
    """Of each kind that at least one of them has."""
    rows: Mapping[tpl.Kind, IntArray]
    """(M,): which of the N results the templates of a kind belong to; some results may lack a kind."""
    labels: Texts
    """(N,): the results as the manifest names them, or the persons with a number."""
    persons: tuple[str | None, ...]
    """(N,): who is shown; None where that is unknown."""
    notes: Texts = ()
    """What is odd about them, one sentence each."""

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def templates(self) -> tpl.Templates:
        """The templates of the first kind; RecognitionError when there are none."""
        if not self.sets:
            raise RecognitionError(f"{self.source}: holds no template; leave it out")
        return next(iter(self.sets.values()))

    def select(self, indices: ArrayLike) -> Self:
        """Return the results of the given indices, ascending."""
        chosen = np.asarray(indices, int)
        sets, rows = {}, {}
        for kind, templates in self.sets.items():
            kept = np.flatnonzero(np.isin(self.rows[kind], chosen))
            if len(kept):
                sets[kind] = templates.select(kept.tolist())
                rows[kind] = np.searchsorted(chosen, self.rows[kind][kept])
        labels, persons = (tuple(values[k] for k in chosen) for values in (self.labels, self.persons))
        return replace(self, sets=sets, rows=rows, labels=labels, persons=persons)


def checked_use(use: Sequence[tpl.Kind]) -> tuple[tpl.Kind, ...]:
    """Return the kinds to use, with albedo and texture the shading; ValueError for none, unknown or twice."""
    if isinstance(use, str) or not use or len(set(use)) < len(use) or set(use) - set(DEFAULT_USE):
        raise ValueError(f"use is {use!r}, expected one or more of {', '.join(DEFAULT_USE)}, each once")
    both = {"albedo", "texture"} <= set(use)
    return tuple(kind for kind in get_args(tpl.Kind) if kind in use or (kind == "shading" and both))


def read_labelled_templates(
    source: str | Path,
    *,
    use: Sequence[tpl.Kind] = DEFAULT_USE,
    persons_required: bool = True,
    options: tpl.TemplateOptions | None = None,
    on_count: Callable[[int, int], None] | None = None,
) -> LabelledTemplates:
    """Return the templates of a file (.npz), or of the results that a CSV file or a folder names.

    Of results the texels that were seen are compared; about 0.1 s a result of 512 texels. Raises `ValueError`
    when a name of `use` is unknown; `RecognitionError` when something cannot be read or used, results differ
    in size or model, nothing is left to compare, or the file was made with other options; names it.

    Parameters
    ----------
    source : path
        From `write_labelled_templates` or `write_templates`, or a manifest as `read_manifest` takes it.
    use : sequence of {"albedo", "texture", "shape"}
        What templates are made of. Results that lack one of them, or have nothing to compare, go on without,
        and a note says so.
    persons_required : bool
        Whether every line of a manifest has to name a person.
    options : TemplateOptions, optional
        The default ones, or those of the file, when omitted.
    on_count : callable, optional
        Called with the number of results done and their number.
    """
    file, kinds = Path(source), checked_use(use)
    if file.suffix.lower() != ".npz":
        manifest = read_manifest(file, persons_required=persons_required)
        return _of_manifest(manifest, kinds, options or tpl.TemplateOptions(), on_count)
    siblings = [
        of_kind for kind in get_args(tpl.Kind) if (of_kind := file.with_suffix(f".{kind}.npz")).is_file()
    ]
    read = {templates.kind: templates for templates in map(read_templates, [file, *siblings])}
    found = {kind: read[kind] for kind in kinds if kind in read}
    if not found:
        raise RecognitionError(
            f"{file}: holds no templates of {' or '.join(kinds)}; make the file anew with them"
        )
    first = next(iter(found.values()))
    for templates in found.values():
        if options not in (None, templates.options):
            raise RecognitionError(
                f"{file} was made with {templates.options}, asked for were {options}; leave the choice out, "
                "or make the file anew"
            )
        if templates.names != first.names or templates.options != first.options:
            raise RecognitionError(f"{file} and those beside it come from different runs; make all anew")
    labels = tuple(f"{name} [{k}]" for k, name in enumerate(first.names))
    missing = tuple(f"{file}: holds no {kind}" for kind in kinds if kind not in (*found, "shading"))
    rows = {kind: np.arange(len(first)) for kind in found}
    return LabelledTemplates(file, found, rows, labels, first.names, missing)


def _of_manifest(
    manifest: Manifest,
    kinds: tuple[tpl.Kind, ...],
    options: tpl.TemplateOptions,
    on_count: Callable[[int, int], None] | None,
) -> LabelledTemplates:
    entries = manifest.entries
    made: dict[tpl.Kind, dict[int, Any]] = {kind: {} for kind in kinds}
    reasons: dict[tpl.Kind, dict[int, str]] = {kind: {} for kind in kinds}
    chart, first = None, ""
    for k, entry in enumerate(entries):
        where = manifest.where(entry)
        for kind in kinds:
            with errors_of(where, RecognitionError):
                try:
                    face = read_face(entry.path, kind)
                    made[kind][k] = tpl.kind_coefficients(
                        kind, face.values, face.certainty, options, entry.result
                    )
                except tpl.NothingToCompareError as error:
                    reasons[kind][k] = str(error) if where in str(error) else f"{where}: {error}"
                    continue
                before, chart = chart, tpl.common_chart(chart, face.chart, first, where)
                first = entry.result if chart != before else first
        if on_count is not None:
            on_count(k + 1, len(entries))
    sets = {
        kind: tpl.Templates(
            np.stack([bands for bands, _ in of_kind.values()]),
            np.stack([weight > 0 for _, weight in of_kind.values()]),
            tuple(entries[k].person or entries[k].result for k in of_kind),
            options,
            chart,
            kind,
            np.stack([weight for _, weight in of_kind.values()]),
        )
        for kind, of_kind in made.items()
        if of_kind
    }
    if not sets:
        raise RecognitionError(
            f"{manifest.file}: no result has {' or '.join(kinds)} to compare; "
            f"the first: {reasons[kinds[-1]][0]}"
        )
    notes = [
        f"{manifest.file}: {len(lacking)} of {len(entries)} results have no {kind}; the first: {why}"
        for kind, lacking in reasons.items()
        for why in list(lacking.values())[:1]
        if kind != "shading"
    ]
    kept = [k for k in range(len(entries)) if any(k in of_kind for of_kind in made.values())]
    left_out = sorted(set(range(len(entries))) - set(kept))
    notes += [f"left out: {reasons[kinds[-1]][k]}" for k in left_out]
    rows = {kind: np.array(list(made[kind])) for kind in sets}
    labels = tuple(entry.result for entry in entries)
    persons = tuple(entry.person for entry in entries)
    whole = LabelledTemplates(manifest.file, sets, rows, labels, persons, (*manifest.notes, *notes))
    return whole.select(kept)


def write_labelled_templates(path: str | Path, labelled: LabelledTemplates) -> tuple[Path, ...]:
    """Return the NPZ files to which templates are written, each whole or not at all.

    The first kind of `labelled` goes to `path`, NAME.npz, others to NAME.shape.npz and so on. ValueError when
    the name does not end in .npz, RecognitionError when some results have a kind that others lack,
    OutputError when a file cannot be written.
    """
    file = Path(path)
    everybody = set(range(len(labelled)))
    if lacking := {labelled.labels[k] for rows in labelled.rows.values() for k in everybody - set(rows)}:
        raise RecognitionError(
            f"{labelled.source}: {', '.join(sorted(lacking)[:5])} lack a kind of templates that others "
            "have; use what all have, or leave them out"
        )
    files = [file, *(file.with_suffix(f".{kind}.npz") for kind in list(labelled.sets)[1:])]
    for name, templates in zip(files, labelled.sets.values(), strict=True):
        write_templates(name, templates)
    return tuple(files)


class TemplateOptionsRecord(BaseModel):
    """How the templates were made; what is the same for all is written, so that other files are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: int | None = Field(ge=1)
    unit_mean: bool
    scales: Literal[3] = tpl.SCALES
    orientations: Literal[10] = tpl.ORIENTATIONS
    channel: Literal["luminance"] = "luminance"
    hole_radius: float = Field(tpl.HOLE_RADIUS, ge=tpl.HOLE_RADIUS, le=tpl.HOLE_RADIUS)


class TemplatesHeader(BaseModel):
    """The text "header" in a file of templates, as JSON."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["scan2albedo templates"] = "scan2albedo templates"
    format_version: Literal[2] = 2
    names: Texts = Field(min_length=1, description="Of the templates' persons, in order.")
    options: TemplateOptionsRecord
    kind: tpl.Kind = Field("albedo", description="What the templates are of.")
    chart: tpl.Chart | None = Field(None, description="Of the images; null where unknown.")


def write_templates(path: str | Path, templates: tpl.Templates) -> None:
    """Write templates as an NPZ file at `path`, whole or not at all.

    330 kB a template of an albedo of 256 pixels, three times that of a shape; not compressed, for the bits of
    coefficients do not repeat. ValueError when the name does not end in .npz, RecognitionError when there is
    no template, OutputError when the file cannot be written.
    """
    if len(templates) == 0:
        raise RecognitionError("there is no template to write; give one or more")
    options = TemplateOptionsRecord(**asdict(templates.options))
    header = TemplatesHeader(
        names=templates.names, options=options, chart=templates.chart, kind=templates.kind
    )
    write_npz_record(path, header, templates.arrays, what="template")


def read_templates(path: str | Path) -> tpl.Templates:
    """Return the templates of the file at `path` that `write_templates` wrote.

    RecognitionError when the file is missing, damaged, something else, or holds templates that cannot be
    used; names it.
    """
    header, arrays = read_npz_record(
        path,
        TemplatesHeader,
        {"coefficients": "c", "mask": "b", "weight": "f"},
        what="templates",
        advice="give a file that write_templates wrote (data_schemas/template_set.schema.json)",
        error=RecognitionError,
    )
    with errors_of(f"templates {path}", RecognitionError, ValueError, advice="write the file again"):
        options = tpl.TemplateOptions(size=header.options.size, unit_mean=header.options.unit_mean)
        held = arrays["coefficients"], arrays["mask"], header.names, options
        return tpl.Templates(*held, header.chart, header.kind, arrays["weight"])
