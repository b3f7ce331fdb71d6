"""The command `identify`: which persons of a gallery of processed scans other processed scans show."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from scan2albedo.cli.common import JsonOption, echo_json, working


def identify(
    gallery: Annotated[
        Path,
        typer.Option(
            help="A folder of results: of OUT/PERSON/SCAN, PERSON is shown; of OUT/SCAN, whom the column "
            "person of the batch's manifest names, else a person called SCAN. Or a CSV file with the columns "
            "person and result, a result being the folder of a processed scan or an image of an albedo on "
            "the model's chart, relative to the CSV file. Or templates from --save-templates."
        ),
    ],
    probes: Path | None = typer.Option(
        None,
        help="The same; persons may be left empty or unknown to the gallery: such probes are identified, "
        "and count in no rate.",
    ),
    out: Path | None = typer.Option(None, "--out", "-o", help="Folder for table, similarities and curves."),
    use: str = typer.Option(
        "albedo,texture,shape", help="What is compared: albedo, texture, shape, or several of them."
    ),
    combine: Literal["best", "mean"] = typer.Option(
        "mean", help="Of a person's several images in the gallery: best, or mean."
    ),
    together: bool = typer.Option(
        False, "--together", help="Take probes that name one person as one probe of several scans."
    ),
    size: int | None = typer.Option(
        None, help="Side that larger charts are averaged down to; 256, or that of the templates.", min=8
    ),
    save_templates: Path | None = typer.Option(
        None,
        help="Write the gallery's templates, to be given as --gallery: NAME.npz, and NAME.shape.npz "
        "and so on beside it.",
    ),
    json_summary: JsonOption = False,
) -> None:
    """Find the person of a gallery whom each probe resembles most, by albedo, texture and shape.

    Somebody of the gallery is always the most similar: the log odds, and those of the next person, show how
    reliable that is. Where probes name their person, the rate of right answers is printed.
    """
    if save_templates is not None and save_templates.suffix != ".npz":
        raise typer.BadParameter(f"--save-templates is {save_templates}, expected a name that ends in .npz")
    if probes is None and (save_templates is None or out is not None):
        raise typer.BadParameter("there are no probes; give --probes (or --save-templates alone)")
    from scan2albedo.recognition.labelled_templates import checked_use

    try:
        kinds: list[Any] = [name.strip() for name in use.split(",")]
        checked_use(kinds)
    except ValueError as error:
        raise typer.BadParameter(f"--use is {use!r}, expected some of albedo,texture,shape") from error
    from scan2albedo.recognition import (
        TemplateOptions,
        identify_results,
        read_labelled_templates,
        write_labelled_templates,
    )
    from scan2albedo.runs.recognition import FILES, write_identification

    with working("identify", out, FILES) as progress:
        known = read_labelled_templates(
            gallery,
            use=kinds,
            options=None if size is None else TemplateOptions(size=size),
            on_count=lambda done, total: progress.count("gallery", done, total),
        )
        if save_templates is not None:
            written = write_labelled_templates(save_templates, known)
            progress.say(f"identify: {len(known)} templates in {' and '.join(map(str, written))}")
        if probes is None:
            if json_summary:
                people = sorted({person for person in known.persons if person is not None})
                shown = {"templates": str(save_templates), "gallery_images": len(known), "persons": people}
                echo_json(shown)
            return
        found = identify_results(
            known,
            probes,
            use=kinds,
            combine=combine,
            together=together,
            on_count=progress.count,
        )
        for note in found.notes:
            progress.say(f"identify: {note}")
        record = write_identification(found, out)
        decided = Counter(probe.decided_by for probe in record.results)
        text = f"{len(record.results)} probes, {len(record.persons)} persons on {record.gallery_images} "
        text += f"images, decided by {', '.join(f'{kind} ({n})' for kind, n in decided.most_common())}"
        if (rates := record.rates) is not None:
            low, high = rates.rank_1_interval
            text += (
                f"; right at rank 1: {rates.rank_1_rate:.1%} of {rates.probes} named probes "
                f"({low:.1%} to {high:.1%} at {rates.confidence:.0%})"
            )
        progress.say(f"identify: {text}{'' if out is None else f'; files in {out}'}")
    if json_summary:
        echo_json(record.model_dump(mode="json"))
        return
    _print_table(record.results)


def _print_table(results: Sequence[Any]) -> None:
    """Print a line for each probe."""
    rows = [("probe", "person", "predicted", "log odds", "by", "rank", "next", "log odds")]
    for probe in results:
        following = "" if probe.next_log_odds is None else f"{probe.next_log_odds:.1f}"
        own = probe.probe, probe.person or "?", probe.predicted, f"{probe.log_odds:.1f}", probe.decided_by
        rows.append((*own, str(probe.rank or "?"), probe.next_person or "", following))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        typer.echo("  ".join(map(str.ljust, row, widths)).rstrip())
