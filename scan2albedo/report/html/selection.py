"""Which scans of a batch get a section of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scan2albedo.report.html.rows import DONE, ScanRow

RESIDUAL = "metrics_fit_residual_mean_mm"
COVERAGE = "metrics_fit_coverage"
UNCERTAINTY = "metrics_albedo_uncertainty_albedo_deviation"


@dataclass(frozen=True)
class Selection:
    """Positions of the rows that are shown in full, and why these."""

    rows: tuple[int, ...]
    reason: str


def selected_rows(rows: Sequence[ScanRow], count: int) -> Selection:
    """Return the scans a person wants to see first: the worst, and two to compare them with.

    Of the scans that are done and have files, the worst by fit residual (by the albedo's uncertainty for
    objects without a fit), and the median and the best one. Failed scans have nothing to show; their
    reasons are in the table.
    """
    there = [k for k, row in enumerate(rows) if row.status == DONE and row.folder is not None]
    if count >= len(there):
        return Selection(tuple(there), f"all {len(there)} scans that have results" if len(there) > 1 else "")
    if not count:
        return Selection((), "no scan, as asked for")
    column = RESIDUAL if any(rows[k].number(RESIDUAL) is not None for k in there) else UNCERTAINTY
    what = "fit residual" if column == RESIDUAL else "uncertainty of the albedo"
    known = [k for k in there if rows[k].number(column) is not None]
    ranked = sorted(known, key=lambda k: -(rows[k].number(column) or 0.0))
    ranked += [k for k in there if rows[k].number(column) is None]
    if not known:
        return Selection(tuple(ranked[:count]), f"the first {count} of {len(there)} scans that have results")
    if count < 4 or len(known) < count:
        chosen = ranked[:count]
        return Selection(tuple(chosen), f"the {count} scans of {len(there)} with the greatest {what}")
    compared = (ranked[len(known) // 2], ranked[len(known) - 1])
    worst = [k for k in ranked if k not in compared][: count - 2]
    text = f"the {count - 2} scans of {len(there)} with the greatest {what}, then the median and the best one"
    return Selection((*worst, *compared), text)
