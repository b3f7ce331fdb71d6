"""What became of scans at the door: rows, tables by part, and confidence against the share that is right."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from worlds.door import Case

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.registration import Registration, register

BASIN_DEG, BASIN_MM = 10.0, 15.0
"""A pose within these of the truth is right: a fit finds the rest."""
UPSIDE_DOWN_DEG = 120.0
"""A turn in the plane of the picture beyond which a face is upside down."""
UNSURE = 0.5
RIGHT, WRONG, UPSIDE_DOWN, REFUSED, TOLD, SILENT = (
    "right",
    "wrong",
    "upside down",
    "refused",
    "told",
    "silent",
)
FACES, NO_FACES = (RIGHT, WRONG, UPSIDE_DOWN, REFUSED), (REFUSED, TOLD, SILENT)
"""How scans of faces end, and others: told is an accepted scan with a confidence below `UNSURE`."""
BINS, LEAST_IN_BIN = 10, 20

Register = Callable[[RawScan], Registration]


@dataclass(frozen=True)
class Row:
    """What became of one scan.

    `degrees` and `mm`, the turn and the mean displacement of the 68 landmarks from the true pose, are None
    where there is no truth or no pose; `sure` is the confidence, None where a refusal carries none.
    """

    part: str
    number: int
    kinds: tuple[str, ...]
    shows_face: bool
    outcome: str
    sure: float | None
    degrees: float | None
    mm: float | None
    cpu_s: float
    message: str = ""

    @property
    def is_right(self) -> bool:
        """Whether the pose is right; of a face refused without a pose, that there is one."""
        if self.outcome == REFUSED and self.shows_face:
            return self.degrees is None or (self.degrees <= BASIN_DEG and (self.mm or 0) <= BASIN_MM)
        return self.outcome == RIGHT


def plainly(scan: RawScan) -> Registration:
    """Return what `register` finds with the default model."""
    return register(scan, AnnotatedFaceModel.default())


def judged(part: str, number: int, case: Case, found_by: Register = plainly) -> Row:
    """Register a scan and judge the answer."""
    begin = time.process_time()
    message, refused = "", False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer: object = found_by(case.scan)
    except Scan2AlbedoError as error:
        answer, message, refused = error, str(error), True
    cpu_s = time.process_time() - begin
    # An error may say how sure it is, and of what pose.
    sure, pose = getattr(answer, "confidence", None), getattr(answer, "model_from_scan", None)
    off = None if pose is None or case.model_from_scan is None else _apart(pose, case)
    outcome = REFUSED if refused else _outcome(off, sure)
    degrees, mm = (None, None) if off is None else off[:2]
    shows_face = case.model_from_scan is not None
    return Row(part, number, case.kinds, shows_face, outcome, sure, degrees, mm, cpu_s, message)


def _apart(pose: FloatArray, case: Case) -> tuple[float, float, float]:
    """Return how far a pose is from the true one: degrees, mm, and degrees in the plane of the picture."""
    assert case.model_from_scan is not None
    assert case.landmarks is not None
    change = pose @ invert_rigid(case.model_from_scan)
    moved = np.linalg.norm(transform_points(change, case.landmarks) - case.landmarks, axis=1).mean()
    in_plane = np.arctan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1])
    return (
        float(np.degrees(rotation_angle_rad(change[:3, :3]))),
        float(moved),
        float(abs(np.degrees(in_plane))),
    )


def _outcome(off: tuple[float, float, float] | None, sure: float | None) -> str:
    if off is None:
        return SILENT if sure is None or sure >= UNSURE else TOLD
    if off[0] <= BASIN_DEG and off[1] <= BASIN_MM:
        return RIGHT
    return UPSIDE_DOWN if off[2] > UPSIDE_DOWN_DEG else WRONG


def print_part(part: str, rows: Sequence[Row]) -> None:
    """Print how the scans of a part ended, all of them and by kind, and the CPU that they took."""
    outcomes = FACES if rows[0].shows_face else NO_FACES
    print(
        f"\n{part:24}{'scans':>8}"
        + "".join(f"{outcome:>14}" for outcome in outcomes)
        + f"{'sure misses':>14}"
    )
    kinds = Counter(kind for row in rows for kind in row.kinds)
    for name in ("all", *sorted(kind for kind, count in kinds.items() if count > 1)):
        chosen = [row for row in rows if name == "all" or name in row.kinds]
        counts = "".join(f"{sum(row.outcome == outcome for row in chosen):14}" for outcome in outcomes)
        missed = [row for row in chosen if row.outcome in (WRONG, UPSIDE_DOWN, SILENT)]
        sure = sum((row.sure or 0) >= UNSURE for row in missed)
        label = name if name == "all" else f"  {name}"
        print(f"{label:24}{len(chosen):8}{counts}{sure:14}")
    right = np.array([(row.degrees, row.mm) for row in rows if row.outcome == RIGHT])
    if len(right):
        print("right ones: median {:.2f} degrees, {:.2f} mm from the truth".format(*np.median(right, axis=0)))
    cpu_s = np.array([row.cpu_s for row in rows])
    print(f"CPU: median {np.median(cpu_s):.2f} s, mean {cpu_s.mean():.2f} s, most {cpu_s.max():.2f} s")
    for row in rows:
        if row.outcome not in (RIGHT, TOLD) and not (row.outcome == REFUSED and not row.shows_face):
            print(f"  {_line(row)}")


def _line(row: Row) -> str:
    off = "" if row.degrees is None else f", {row.degrees:.0f} degrees / {row.mm:.0f} mm off"
    sure = "" if row.sure is None else f", confidence {row.sure:.2f}"
    return f"{row.part} {row.number} ({', '.join(row.kinds)}): {row.outcome}{sure}{off} {row.message[:170]}"


@dataclass(frozen=True)
class Reliability:
    """By bin of confidence (`BINS`,): scans, mean confidence, share that is right, nan where empty."""

    count: FloatArray
    confidence: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, rows: Sequence[Row]) -> Reliability:
        """Return that of all rows that have a confidence."""
        known = [(row.sure, row.is_right) for row in rows if row.sure is not None]
        sure, right = np.array(known, float).reshape(-1, 2).T
        place = np.minimum((sure * BINS).astype(int), BINS - 1)
        count = np.bincount(place, minlength=BINS).astype(float)
        divisor = np.where(count > 0, count, np.nan)
        return cls(
            count,
            np.bincount(place, sure, minlength=BINS) / divisor,
            np.bincount(place, right, minlength=BINS) / divisor,
        )

    @property
    def largest_gap(self) -> float:
        """Largest difference of confidence and share over bins with enough scans; nan without one."""
        gaps = np.abs(self.confidence - self.share)[self.count >= LEAST_IN_BIN]
        return float(gaps.max()) if len(gaps) else float("nan")

    @property
    def mean_gap(self) -> float:
        """Mean difference of confidence and share over all scans' bins."""
        there = self.count > 0
        return float(np.average(np.abs(self.confidence - self.share)[there], weights=self.count[there]))

    def print(self) -> None:
        """Print the bins."""
        print(f"\n{'confidence':14}{'scans':>8}{'mean':>8}{'right':>8}")
        for k in range(BINS):
            values = f"{self.count[k]:8.0f}{self.confidence[k]:8.2f}{self.share[k]:8.2f}"
            print(f"{k / BINS:.1f} ... {(k + 1) / BINS:.1f}   {values}")
        print(f"largest gap over bins of {LEAST_IN_BIN} scans and more: {self.largest_gap:.2f}")
        print(f"mean gap over all scans: {self.mean_gap:.3f}")

    def draw(self, path: Path) -> None:
        """Draw the bins as a PNG."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.6, 4.6), layout="constrained")
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color="#999999", linewidth=1)
        there = self.count > 0
        spread = np.sqrt(np.maximum(self.share * (1 - self.share), 0) / np.maximum(self.count, 1))
        axes.errorbar(self.confidence[there], self.share[there], spread[there], fmt="o", color="#1f5f9e")
        for x, y, count in zip(self.confidence[there], self.share[there], self.count[there], strict=True):
            axes.annotate(f"{count:.0f}", (x, y), (5, -11), textcoords="offset points", fontsize=8)
        axes.set(xlabel="confidence", ylabel="share that is right", xlim=(-0.03, 1.1), ylim=(-0.03, 1.03))
        figure.savefig(path, dpi=110)
