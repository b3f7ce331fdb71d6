"""The colours of the light: the intensities that were found on V, solved once more for each channel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.normal_equations import block_albedos, normal_equations
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.plan import PlanStep
from scan2albedo.optimization import NormalEquations, minimize

STAGE = "albedo.light_colour"
_SOFTNESS = 0.02
"""Residuals, as parts of the brightness, beyond which they count as outliers do."""
_SWEEPS, _FIRST_SWEEPS = 2, 6
"""Reweighted estimates of the block albedos, as in `residual_objective`."""
_RIDGE = 0.1
"""Of the squared deviation of a channel's light from the white light, mean over the cells, beside the mean
robust residual: 30 times as much takes half of what colour gains on path-traced faces, and without it few
dim cells ask for extremes."""
_DIM = 0.1
"""Light, as a part of its median, below which deviations from white count as if there were this much."""
_TRIALS, _SETTLED = 12, 1e-4
_LEAST = (0.08, 0.02), (0.06, 0.05), (0.04, 0.08)
"""Colour has to lower the residual by this part, and to change the ratio of two channels over the face by
this standard deviation; more change needs less gain. Pigment that follows the shading by chance does up to
0.04 and 0.025 on 30 faces in white light, and up to 0.10 and 0.05 (95 of 100 below 0.08) where the
environment is free beside the lamps; coloured lamps, rooms and skies do 0.06 to 0.35 and 0.09 to 0.28."""
_LIMITS = 0.05, 0.95
"""Quantiles over the cells of the ratio to white light, to which what it changes is clipped."""
_LEAST_RESIDUAL = 1e-5
"""A mean residual below it is the rounding of a texture that is grey."""
_BLACK = 1e-6


@dataclass(frozen=True)
class LightColours:
    """What `solve_colours` found."""

    intensities: FloatArray
    """(K, 3) of each column in each channel. In every channel their mean light over the cells is that of the
    white intensities."""
    colors: FloatArray
    """(K, 3): the same as multiples of the white intensities, 1 for columns without any; exactly 1 where
    colour was left out."""
    step: PlanStep
    """The row "albedo.light_colour" of the plan."""


def solve_colours(
    columns: FloatArray,
    intensities: FloatArray,
    rgb: FloatArray,
    specular: FloatArray,
    weight: FloatArray,
    blocks: NDArray[np.int32],
    *,
    choice: bool | None = None,
) -> LightColours:
    """Return the colours of the lights that the colours of the cells ask for, or white.

    With the white light I = C x found on V, and V' = V - I_s, each channel T' = T - I_s of the texture is

        T' = q_b (V' / I) C x_c,        min over x_c of  sum rho(w |T' - q_b (V' / I) C x_c|) + ridge,

    with the ratio q_b of channel and V in each block's albedo eliminated [1]_ and rho the robust loss of V.
    Brightness, its grain, and what the white light misses are in V' as in T', and so do not count. What is
    left is colour: of pigment, in patches, and of the light, along the surface. The ridge draws C x_c toward
    I. Light of one colour cannot be distinguished from skin of that colour: the mean light is white in every
    channel.

    `columns` C (N, K) is the light on each cell from each part of the model at strength 1; those that are
    nowhere negative get no negative intensity. `intensities` (K,) is x, `rgb` (N, 3) the linear texture of
    the cells in any unit, `specular` (N,) I_s in the same, `weight` (N,) w, about one over the brightness,
    and `blocks` (S, N) int32 the block of each cell in S partitions. `choice` True takes colour as it comes,
    False leaves it out; the evidence decides when None. O(N S K^2) a step: 0.1 s for 10,000 cells and 11
    columns.

    .. [1] G. Golub, V. Pereyra, "Separable nonlinear least squares: the variable projection method and its
       applications", Inverse Problems 19(2), 2003.
    """
    white = np.asarray(intensities, np.float64)
    if choice is False:
        return _white(white, PlanStep(STAGE, False, "left out by the caller"))
    cells = _Cells(np.asarray(columns, np.float64), white, rgb, specular, weight, blocks)
    if not cells.enough:
        count = f"{int(cells.known.sum())} cells"
        return _white(white, PlanStep(STAGE, False, "too few cells are bright enough", count))
    starts = [_Channel.of(cells, channel) for channel in range(3)]
    before = sum(start.residual for start in starts)
    fits = [minimize(start, trials=_TRIALS, tolerance=_SETTLED).best for start in starts]
    found = np.stack([fit.x for fit in fits], 1)
    gain = 1 - sum(fit.residual for fit in fits) / before if before > 0 else 0.0
    ratio = np.maximum(cells.columns @ found, _BLACK) / cells.light[:, None]
    limits = np.quantile(ratio, _LIMITS, axis=0)
    # The largest standard deviation of the log ratio of two channels.
    log_ratio = np.log(np.clip(ratio, *limits))
    effect = float((log_ratio - np.roll(log_ratio, 1, axis=1)).std(0).max())
    limits_text = " or ".join(f"{100 * least:g} and {100 * change:g} %" for least, change in _LEAST)
    evidence = (
        f"colour lowers the residual of the channels by {100 * gain:.1f} % and changes their ratio over the "
        f"face by {100 * effect:.1f} % (limits {limits_text})"
    )
    enough = any(gain >= least and effect >= change for least, change in _LEAST)
    needed = before > _LEAST_RESIDUAL and enough
    if not (needed or choice):
        return _white(white, PlanStep(STAGE, False, "the light has one colour", evidence))
    reason = "the light has several colours" if needed else "asked for"
    colors = np.where(white[:, None] != 0, found / np.where(white != 0, white, 1.0)[:, None], 1.0)
    return LightColours(found, colors, PlanStep(STAGE, True, reason, evidence))


def _white(intensities: FloatArray, step: PlanStep) -> LightColours:
    shape = len(intensities), 3
    return LightColours(np.repeat(intensities[:, None], 3, 1), np.ones(shape), step)


class _Cells:
    """What the three channels share: the cells that show colour, and the ridge."""

    def __init__(
        self,
        columns: FloatArray,
        white: FloatArray,
        rgb: FloatArray,
        specular: FloatArray,
        weight: FloatArray,
        blocks: NDArray[np.int32],
    ) -> None:
        light, below = columns @ white, np.maximum(rgb - np.asarray(specular)[:, None], 0.0)
        value = below.max(1)
        self.known = known = (light > _BLACK) & (value > _BLACK) & (np.asarray(weight) > 0)
        self.white, self.columns, self.light = white, columns[known], light[known]
        self.below, self.value, self.weight = below[known], value[known], np.asarray(weight, float)[known]
        self.enough = int(known.sum()) > 2 * len(white)
        if not self.enough:
            return
        # Light in the unit of the texture's V, whose grain it shares.
        self.answers = np.ascontiguousarray((self.columns * (self.value / self.light)[:, None]).T)
        used, index = np.unique(blocks[:, known], return_inverse=True)
        self.blocks, self.block_count = index.reshape(len(blocks), -1).astype(np.int32), len(used)
        self.total = len(blocks) * float(self.weight @ self.value)
        self.mean = self.columns.mean(0)
        self.signed = self.columns.min(0) < 0
        ratio = self.columns / np.maximum(self.light, _DIM * np.median(self.light))[:, None]
        self.ridge = _RIDGE / len(ratio) * ratio.T @ ratio

    def scaled(self, x: FloatArray) -> FloatArray:
        """Return x (K,), where possible not negative, at the white light's mean."""
        possible = np.where(self.signed, x, np.maximum(x, 0.0))
        mean = float(self.mean @ possible)
        return possible * (float(self.mean @ self.white) / mean if mean > 0 else 1.0)


@dataclass
class _Channel:
    """One channel `value` (N,), of relative `weight`, at intensities `x`: a point for `minimize`."""

    cells: _Cells
    value: FloatArray
    weight: FloatArray
    x: FloatArray
    before: FloatArray
    """(S, N) robust weights that the block albedos start from."""
    sweeps: int = _SWEEPS

    def __post_init__(self) -> None:
        cells = self.cells
        self.light = self.x @ cells.answers
        self._albedo, self._mass = np.empty(cells.block_count), np.empty(cells.block_count)
        self._none = np.zeros_like(self.value)
        self.cost = self._settle(self.sweeps)

    @classmethod
    def of(cls, cells: _Cells, channel: int) -> _Channel:
        """Return a channel in white light, whose residual counts as much as that of a brighter one."""
        value = np.ascontiguousarray(cells.below[:, channel])
        level = float(cells.weight @ value) / float(cells.weight @ cells.value)
        weight = cells.weight / max(level, 1e-3)
        before = np.repeat(weight[None], len(cells.blocks), 0)
        return cls(cells, value, weight, cells.white, before, _FIRST_SWEEPS)

    def _settle(self, sweeps: int) -> float:
        """Estimate the ratios q_b from the weights before; return the cost."""
        self._robust = self.before.copy()
        known = self.value, self.weight, self.light, self._none, self.cells.blocks, _SOFTNESS
        cost = float(block_albedos(*known, self._robust, self._albedo, self._mass, sweeps))
        away = self.x - self.cells.white
        self.residual = cost / self.cells.total
        return self.residual + 0.5 * float(away @ self.cells.ridge @ away)

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model of the cost around x, and fix the weights."""
        self.before = self._robust
        self.cost = self._settle(_SWEEPS)
        cells, size = self.cells, len(self.x)
        matrix, gradient = np.empty((size, size)), np.empty(size)
        normal_equations(
            *(self.value, self.weight, self.light, self._none, cells.answers, np.zeros_like(cells.answers)),
            *(cells.blocks, self._robust, self._albedo, self._mass, matrix, gradient),
        )
        return NormalEquations(
            matrix / cells.total + cells.ridge,
            gradient / cells.total + cells.ridge @ (self.x - cells.white),
            np.where(cells.signed, -np.inf, -self.x),
            np.full(size, np.inf),
        )

    def moved(self, step: FloatArray) -> _Channel:
        """Return the channel at x + `step`, at the white light's mean."""
        x = self.cells.scaled(self.x + step)
        return _Channel(self.cells, self.value, self.weight, x, self.before)
