"""The files of an identification, all of them or none: table, similarities, record, and curves as figures."""

import csv
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from textwrap import fill
from typing import Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from pydantic import Field

from scan2albedo.core.arrays import Texts
from scan2albedo.core.version import VERSION
from scan2albedo.io.atomic import write_text
from scan2albedo.io.npz import write_npz
from scan2albedo.io.records import Figures, Number, OptionalNumber, OwnFileNames, PositiveCount, Record, Share
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.recognition import CmcCurve, ResultIdentification, RocCurve, cmc_curve, roc_curve
from scan2albedo.recognition.templates import Kind

Interval = tuple[Number, Number]


class ProbeRecord(Record):
    """One probe."""

    probe: str = Field(description="The result, as the file of probes names it.")
    person: str | None = Field(description="Who it shows; null where nobody knows.")
    predicted: str = Field(description="The most similar person of the gallery.")
    log_odds: Number = Field(description="That the probe shows that person rather than another, natural log.")
    decided_by: Kind = Field(description="What adds most to that person's lead over the next.")
    rank: int | None = Field(ge=1, description="Place of the right person; null where nobody knows.")
    next_person: str | None = Field(description="The second; null in a gallery of one person.")
    next_log_odds: OptionalNumber
    albedo: OptionalNumber = Field(description="Of the predicted person by albedo alone: CW-SSIM, 0 to 1.")
    texture: OptionalNumber = Field(description="Of the predicted person by texture alone: CW-SSIM, 0 to 1.")
    shape: OptionalNumber = Field(
        description="Of the predicted person by shape alone: CW-SSIM of normals, 0 to 1."
    )


class RatesRecord(Record):
    """Of the probes whose person is known."""

    probes: PositiveCount
    confidence: float = Field(gt=0, lt=1, description="Of the intervals.")
    rank_1_rate: Share
    rank_1_interval: Interval = Field(description="Clopper and Pearson's.")
    equal_error_rate: OptionalNumber = Field(
        description="Of claims to be a person; null where nobody could be an impostor."
    )
    equal_error_interval: Interval | None = Field(description="By a bootstrap over persons.")


class IdentificationRecord(Record):
    """The content of `identification.json`."""

    format_version: Literal[2] = 2
    scan2albedo_version: str
    gallery: str = Field(description="The file or folder that names it, as given.")
    probes: str = Field(description="The file or folder that names them, as given.")
    use: tuple[Kind, ...] = Field(min_length=1, description="What was compared.")
    gallery_images: PositiveCount
    persons: Texts = Field(min_length=1, description="Of the gallery.")
    combine: Literal["best", "mean"] = Field(description="What is taken of a person's several images.")
    template_options: Figures
    model: str | None = Field(description="Name of the face model on whose chart the albedos lie.")
    rates: RatesRecord | None = Field(description="Null when no probe's person is known.")
    results: tuple[ProbeRecord, ...] = Field(min_length=1, description="In the order of the probes.")
    notes: Texts = ()
    files: OwnFileNames = ()


FILES = OwnFiles(
    "identification.json",
    IdentificationRecord,
    ("identification.csv", "similarities.npz", "cmc.png", "roc.png"),
    command="scan2albedo identify",
)
"""Every file an identification may have."""


def write_identification(
    found: ResultIdentification, folder: str | Path | None = None
) -> IdentificationRecord:
    """Write identification.csv, similarities.npz, cmc.png, roc.png and identification.json, all or none.

    Return the record; without a folder nothing is written. Curves are of the probes whose person is known.
    Raises OutputError when the folder cannot be written, or holds a file of somebody else under such a name.
    """
    # With a gallery of one person nobody is an impostor: no ROC.
    matches = found.matches
    cmc = cmc_curve(matches) if matches.known.any() else None
    roc = roc_curve(matches) if cmc is not None and len(matches.persons) > 1 else None
    templates = found.gallery.templates
    record = IdentificationRecord(
        scan2albedo_version=VERSION,
        gallery=str(found.gallery.source),
        probes=str(found.probes.source),
        use=tuple(kind for kind in found.by_kind if kind != "shading"),
        gallery_images=len(found.gallery),
        persons=matches.persons,
        combine=matches.combine,
        template_options=asdict(templates.options),
        model=None if templates.chart is None else templates.chart.model,
        rates=None if cmc is None else _rates(cmc, roc),
        results=_results(found),
        notes=found.notes,
        files=(),
    )
    if folder is None:
        return record
    name = ", ".join(record.use)
    with RunFolder(folder, FILES).publishing() as staging:
        table = StringIO()
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(ProbeRecord.model_fields)
        formula = ("=", "+", "-", "@")  # that a spreadsheet would run, of a text that begins so
        for result in record.results:
            cells = result.model_dump().values()
            writer.writerow(f"'{c}" if isinstance(c, str) and c.startswith(formula) else c for c in cells)
        write_text(staging.folder / "identification.csv", table.getvalue())
        similarities = {
            "log_odds": matches.similarities,
            **{f"{kind}_similarities": values for kind, values in found.by_kind.items()},
            "persons": np.array(matches.persons),
            "probes": np.array(found.probes.labels),
            "probe_persons": np.array([person or "" for person in found.probes.persons]),
        }
        write_npz(staging.folder / "similarities.npz", similarities, what="similarities")
        if cmc is not None:
            curve_figure(name, cmc).savefig(staging.folder / "cmc.png")
        if roc is not None:
            curve_figure(name, roc).savefig(staging.folder / "roc.png")
        return staging.write_record(**dict(record))


def _rates(cmc: CmcCurve, roc: RocCurve | None) -> RatesRecord:
    return RatesRecord(
        probes=cmc.probes,
        confidence=cmc.confidence,
        rank_1_rate=cmc.rate[0],
        rank_1_interval=(cmc.low[0], cmc.high[0]),
        equal_error_rate=None if roc is None else roc.equal_error_rate,
        equal_error_interval=None if roc is None else roc.equal_error_interval,
    )


def _results(found: ResultIdentification) -> tuple[ProbeRecord, ...]:
    matches, results = found.matches, []
    # Similarities with the digits that sums in float32 hold.
    alone = {kind: np.minimum(values, 1).round(6) for kind, values in found.by_kind.items()}
    for k, (first, *others) in enumerate(matches.order.tolist()):
        similar = {kind: values[k, first] for kind, values in alone.items()}
        kinds: tuple[Kind, ...] = ("albedo", "texture", "shape")
        results.append(
            ProbeRecord(
                probe=found.probes.labels[k],
                person=found.probes.persons[k],
                predicted=matches.persons[first],
                log_odds=round(float(matches.similarities[k, first]), 3),
                decided_by=found.decided_by[k],
                rank=int(matches.ranks[k]) or None,
                next_person=matches.persons[others[0]] if others else None,
                next_log_odds=round(float(matches.similarities[k, others[0]]), 3) if others else None,
                **{kind: None if np.isnan(similar.get(kind, np.nan)) else similar[kind] for kind in kinds},
            )
        )
    return tuple(results)


def curve_figure(name: str, curve: CmcCurve | RocCurve) -> Figure:
    """Return identification rate against the first 20 ranks, or true over logarithmic false accept rate.

    The intervals are bars. False accept rates of less than one impostor's claim are left out.
    """
    figure = Figure(figsize=(6.5, 5), dpi=110, layout="constrained")
    axis = figure.subplots()
    if isinstance(curve, CmcCurve):
        title, marker = "CMC", "o"
        axis.set(xlabel="rank", ylabel="probes whose person is among the first")
        x, y, low, high = np.stack([curve.rank, curve.rate, curve.low, curve.high])[:, :20]
        text = f"{name}, {curve.probes} probes: rank 1 {y[0]:.1%} ({low[0]:.1%} to {high[0]:.1%})"
    else:
        title, marker = "ROC", ""
        axis.set(xlabel="false accept rate", ylabel="true accept rate")
        rows = np.stack([curve.false_accept_rate, curve.true_accept_rate, curve.low, curve.high])
        x, y, low, high = rows[:, curve.supported]
        least, most = curve.equal_error_interval
        equal = f"{curve.equal_error_rate:.2%} ({least:.2%} to {most:.2%})"
        text = f"{name}, {curve.genuine} genuine claims: equal error {equal}"
    axis.set_title(f"{title}, {curve.confidence:.0%} intervals", fontsize=11)
    axis.grid(color="lightgray")
    label = fill(text, 88, break_on_hyphens=False)
    (line,) = axis.plot(x, y, label=label, marker=marker, markersize=3.5)
    axis.vlines(x, low, high, color=line.get_color(), linewidth=1)
    axis.set_ylim(bottom=0)
    if title == "CMC":
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    else:
        axis.set_xscale("log")
    figure.legend(loc="outside lower center", fontsize=9)
    return figure
