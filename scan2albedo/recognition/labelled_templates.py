"""Templates of many results by albedo and by shape, with the origin and the person of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import IntArray
from scan2albedo.errors import RecognitionError
from scan2albedo.recognition.manifest import Manifest, read_manifest
from scan2albedo.recognition.options import TemplateOptions
from scan2albedo.recognition.stored_faces import CountCallback, result_templates
from scan2albedo.recognition.template_files import read_templates, write_templates
from scan2albedo.recognition.templates import Kind, Templates

DEFAULT_USE: tuple[Kind, ...] = ("albedo", "shape")
"""Both together recognise best, see docs/recognition.md."""


@dataclass(frozen=True)
class LabelledTemplates:
    """Templates of N results, and the origin of each."""

    source: Path
    """The file or folder that named them."""
    sets: Mapping[Kind, Templates]
    """Of each kind that at least one of them has."""
    rows: Mapping[Kind, IntArray]
    """(M,): which of the N results the templates of a kind belong to; some results may lack a kind."""
    labels: tuple[str, ...]
    """(N,): the results as the manifest names them, or the persons with a number."""
    persons: tuple[str | None, ...]
    """(N,): who is shown; None where that is unknown."""
    notes: tuple[str, ...] = ()
    """What is odd about them, one sentence each."""

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def templates(self) -> Templates:
        """The templates of the first kind."""
        return next(iter(self.sets.values()))

    @property
    def options(self) -> TemplateOptions:
        """How the templates were made."""
        return self.templates.options

    def select(self, indices: ArrayLike) -> LabelledTemplates:
        """Return the results of the given indices, ascending."""
        chosen = np.asarray(indices, np.int64)
        sets, rows = {}, {}
        for kind, templates in self.sets.items():
            kept = np.flatnonzero(np.isin(self.rows[kind], chosen))
            if len(kept):
                sets[kind] = templates.select(kept.tolist())
                rows[kind] = np.searchsorted(chosen, self.rows[kind][kept])
        labels, persons = (tuple(values[k] for k in chosen) for values in (self.labels, self.persons))
        return replace(self, sets=sets, rows=rows, labels=labels, persons=persons)


def checked_use(use: Sequence[Kind]) -> tuple[Kind, ...]:
    """Return the kinds to use; ValueError for none, an unknown one, or one named twice."""
    known = get_args(Kind)
    if isinstance(use, str) or not use or len(set(use)) < len(use) or set(use) - set(known):
        raise ValueError(f"use is {use!r}, expected one or both of {', '.join(known)}, each once")
    return tuple(kind for kind in known if kind in use)


def read_labelled_templates(
    source: str | Path,
    *,
    use: Sequence[Kind] = DEFAULT_USE,
    persons_required: bool = True,
    options: TemplateOptions | None = None,
    on_count: CountCallback | None = None,
) -> LabelledTemplates:
    """Return the templates of a file (.npz), or of the results that a CSV file or a folder names.

    Parameters
    ----------
    source : path
        From `write_labelled_templates` or `write_templates`, or a manifest as `read_manifest` takes it.
    use : sequence of {"albedo", "shape"}
        What templates are made of. Results that lack one of them, or have nothing to compare, go on without,
        and a note says so.
    persons_required : bool
        Whether every line of a manifest has to name a person.
    options : TemplateOptions, optional
        The default ones, or those of the file, when omitted.
    on_count : callable, optional
        Called with the number of results done and their number.

    Raises
    ------
    ValueError
        When a name of `use` is unknown.
    RecognitionError
        When something cannot be read or used, or the file was made with other options; names it.
    """
    file, kinds = Path(source), checked_use(use)
    if file.suffix.lower() != ".npz":
        manifest = read_manifest(file, persons_required=persons_required)
        return _of_manifest(manifest, kinds, options or TemplateOptions(), on_count)
    found = {
        templates.kind: templates
        for templates in map(read_templates, _files(file))
        if templates.kind in kinds
    }
    if not found:
        raise RecognitionError(
            f"{file}: holds no templates of {' or '.join(kinds)}; make the file anew with them"
        )
    first = next(iter(found.values()))
    for templates in found.values():
        if options is not None and options != templates.options:
            raise RecognitionError(
                f"{file} was made with {templates.options}, asked for were {options}; leave the choice out, "
                "or make the file anew"
            )
        if templates.names != first.names or templates.options != first.options:
            raise RecognitionError(
                f"{file} and {shape_file(file).name} come from different runs; make both anew"
            )
    labels = tuple(f"{name} [{k}]" for k, name in enumerate(first.names))
    missing = [f"{file}: holds no {kind}; it is left aside" for kind in kinds if kind not in found]
    rows = {kind: np.arange(len(first)) for kind in found}
    return LabelledTemplates(file, found, rows, labels, first.names, tuple(missing))


def _of_manifest(
    manifest: Manifest, kinds: tuple[Kind, ...], options: TemplateOptions, on_count: CountCallback | None
) -> LabelledTemplates:
    count, total = len(manifest.entries), len(manifest.entries) * len(kinds)
    sets: dict[Kind, Templates] = {}
    rows: dict[Kind, IntArray] = {}
    reasons: dict[int, dict[Kind, str]] = {k: {} for k in range(count)}
    for number, kind in enumerate(kinds):

        def counted(done: int, _: int, before: int = number * count) -> None:
            if on_count is not None and (before + done) % len(kinds) == 0:
                on_count((before + done) // len(kinds), total // len(kinds))

        left: dict[int, str] = {}
        try:
            sets[kind] = result_templates(
                manifest, kind=kind, options=options, on_count=counted, on_left_out=left.__setitem__
            )
        except RecognitionError:
            if len(left) < count or (kind == kinds[-1] and not sets):
                raise
        rows[kind] = np.setdiff1d(np.arange(count), list(left))
        for k, reason in left.items():
            reasons[k][kind] = reason
    labels = tuple(entry.result for entry in manifest.entries)
    persons = tuple(entry.person for entry in manifest.entries)
    whole = LabelledTemplates(manifest.file, sets, {kind: rows[kind] for kind in sets}, labels, persons)
    kept = [k for k in range(count) if len(reasons[k]) < len(kinds)]
    return replace(whole.select(kept), notes=(*manifest.notes, *_left_out(reasons, kinds, manifest.file)))


def _left_out(reasons: Mapping[int, Mapping[Kind, str]], kinds: tuple[Kind, ...], file: Path) -> list[str]:
    """Return notes: a sentence for each result that lacks something, one for all where all lack it."""
    everywhere = {kind for kind in kinds if all(kind in lacking for lacking in reasons.values())}
    notes = [f"{file}: no result has {kind}; they are compared without" for kind in sorted(everywhere)]
    for lacking in reasons.values():
        told = [reason for kind, reason in lacking.items() if kind not in everywhere]
        if len(lacking) == len(kinds):
            notes.append(f"left out: {told[0] if told else next(iter(lacking.values()))}")
        elif told:
            notes.append(f"compared without {next(k for k in lacking if k not in everywhere)}: {told[0]}")
    return notes


def shape_file(file: Path) -> Path:
    """Return the file of the shapes' templates beside that of the albedos'.

    >>> shape_file(Path("out/gallery.npz")).name
    'gallery.shape.npz'
    """
    return file.with_suffix(".shape.npz")


def _files(file: Path) -> list[Path]:
    beside = shape_file(file)
    return [file, beside] if beside.is_file() else [file]


def write_labelled_templates(path: str | Path, labelled: LabelledTemplates) -> tuple[Path, ...]:
    """Write templates as NPZ files, each whole or not at all, and return their names.

    Parameters
    ----------
    path : path
        Ends in .npz.
    labelled : LabelledTemplates

    Returns
    -------
    tuple of Path
        NAME.npz, and NAME.shape.npz where there are both albedo and shape.

    Raises
    ------
    ValueError
        When the name does not end in .npz.
    RecognitionError
        When some results have both albedo and shape and others only one of them.
    OutputError
        When a file cannot be written.
    """
    file = Path(path)
    lacking = {
        labelled.labels[k] for rows in labelled.rows.values() for k in set(range(len(labelled))) - set(rows)
    }
    if lacking:
        raise RecognitionError(
            f"{labelled.source}: {', '.join(sorted(lacking)[:5])} lack albedo or shape, which others have; "
            "use one of the two for all, or leave them out"
        )
    files = [file] if len(labelled.sets) == 1 else [file, shape_file(file)]
    for name, templates in zip(files, labelled.sets.values(), strict=True):
        write_templates(name, templates)
    return tuple(files)
