"""Coarse multi-start search: thousands of starts, thinned in rounds to a few distinct poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Meter
from scan2albedo.registration.grid_icp import NearestGrid, refine_on_grid
from scan2albedo.registration.normal_relief import normal_relief
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.oriented_points import OrientedPoints
from scan2albedo.registration.starts import Starts, anchored_starts
from scan2albedo.registration.template import Template

FloatArray = NDArray[np.float64]

_BLOCK = 128
_JUDGED = 160
_QUICK_LOOK = 40
_RELIEF_SAMPLES = 400
_CELL_MM = 6.0
_MARGIN_MM = 40.0
_NORMAL_SMOOTHING_MM = 45.0
_SAME_ROTATION_RAD = np.deg2rad(8)
_SAME_POSITION_MM = 10.0


@dataclass(frozen=True)
class CoarsePoses:
    """Distinct poses of the coarse search, nearest surface first, and what tells those with relief."""

    starts: Starts
    grid: NearestGrid
    model: OrientedPoints

    def __len__(self) -> int:
        return len(self.starts)

    def looks(self, candidates: int, more_candidates: int) -> Iterator[Starts]:
        """Yield `candidates` poses in two looks, then `more_candidates` in a third.

        First those whose surface is nearest, then those that show most relief among the nearer ones, at
        last among all: distance alone prefers the whole back of a head to half a face, and relief
        alone is dear.
        """
        first = np.arange(min((candidates + 1) // 2, len(self)))
        yield _taken(self.starts, first)
        nearer = self._by_relief(min(_QUICK_LOOK, len(self)))
        second = nearer[~np.isin(nearer, first)][: candidates - len(first)]
        yield _taken(self.starts, second)
        every = self._by_relief(len(self))
        rest = every[~np.isin(every, np.concatenate([first, second]))]
        yield _taken(self.starts, rest[:more_candidates])

    def _by_relief(self, count: int) -> NDArray[np.int64]:
        """Return the first `count` poses in the order of the relief that the scan's normals show there."""
        relief = [
            normal_relief(self.grid, self.model, self.starts.rotations[i], self.starts.translations[i])
            for i in range(count)
        ]
        return np.argsort(-np.array(relief), kind="stable")


def coarse_poses(
    scan: OrientedPoints, template: Template, options: RegistrationOptions, meter: Meter, seed: int
) -> CoarsePoses:
    """Return distinct poses that lay the model near the scan's surface.

    Round 1 runs `coarse_iterations` (4) on 60 model samples from every start; the best `kept_starts` go on to
    as many (8) on 200 samples with a tighter scale. The meter counts one evaluation a start and round;
    when its budget ends, what has been tried so far is ranked.
    """
    grid = NearestGrid.of(scan, cell_mm=_CELL_MM, margin_mm=_MARGIN_MM)
    starts = anchored_starts(
        scan,
        template.front,
        rotation_count=options.rotation_count,
        anchor_spacing_mm=options.anchor_spacing_mm,
        anchor_limit=options.anchor_limit,
        cone_rad=np.deg2rad(options.cone_deg),
        smoothing_mm=_NORMAL_SMOOTHING_MM,
    )
    # In random order a budget that ends early has still seen starts from all over the scan.
    starts = _taken(starts, np.random.default_rng(seed).permutation(len(starts)))
    first, second = options.coarse_iterations
    starts, _ = _round(grid, template.first(60), starts, first, (20.0, 10.0), meter)
    starts = _taken(starts, np.arange(min(options.kept_starts, len(starts))))
    starts, _ = _round(grid, template.first(200), starts, second, (12.0, 5.0), meter)
    return CoarsePoses(_distinct(starts, _JUDGED), grid, template.first(_RELIEF_SAMPLES))


def _taken(starts: Starts, index: NDArray[np.int64]) -> Starts:
    return Starts(starts.rotations[index], starts.translations[index])


def _round(
    grid: NearestGrid,
    model: OrientedPoints,
    starts: Starts,
    iterations: int,
    sigma_mm: tuple[float, float],
    meter: Meter,
) -> tuple[Starts, FloatArray]:
    """Refine the starts block by block while the budget lasts; return those tried, best first."""
    rotations, translations = starts.rotations.copy(), starts.translations.copy()
    scores: list[FloatArray] = []
    for begin in range(0, len(starts), _BLOCK):
        if begin and meter.exhausted:
            break
        block = slice(begin, begin + _BLOCK)
        scores.append(
            refine_on_grid(
                grid,
                model,
                model.areas,
                rotations[block],
                translations[block],
                iterations=iterations,
                sigma_mm=sigma_mm,
            )
        )
        meter.count(len(scores[-1]))
    score = np.concatenate(scores)
    order = np.argsort(-score, kind="stable")
    return Starts(rotations[order], translations[order]), score[order]


def _distinct(starts: Starts, count: int) -> Starts:
    """Keep the first of every group of like poses, at most `count`."""
    same_trace = 1 + 2 * np.cos(_SAME_ROTATION_RAD)
    kept: list[int] = []
    alike = np.zeros(len(starts), bool)
    for i in range(len(starts)):
        if alike[i]:
            continue
        kept.append(i)
        if len(kept) == count:
            break
        offset = starts.translations[i + 1 :] - starts.translations[i]
        trace = np.einsum("nij,ij->n", starts.rotations[i + 1 :], starts.rotations[i])
        near = np.einsum("ni,ni->n", offset, offset) < _SAME_POSITION_MM**2
        alike[i + 1 :] |= near & (trace > same_trace)
    return _taken(starts, np.array(kept, np.int64))
