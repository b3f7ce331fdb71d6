"""The robust residual at one image size, its derivatives, and the descent to where it is least."""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.color_guide import MIN_EXPLAINED, ColorGuide, color_guide
from scan2albedo.albedo.levels import Level, local_mean
from scan2albedo.albedo.light_parameters import LightModel, Solution
from scan2albedo.albedo.normal_equations import block_albedos, cluster_scores, normal_equations
from scan2albedo.albedo.shadows import ShadowLattice
from scan2albedo.albedo.soft_terms import SoftTerms, ridge
from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.kernels import shade_with_derivatives
from scan2albedo.optimization import Damping, NormalEquations, damped_step, minimize

_BLOCK_AREA = 0.06
"""Area of a block, over which the texture's mean is constant, as a part of the chart's: larger than the
texture's grain, which colour helps to divide out."""
_SHIFTS = ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5))
_SOFTNESS = 0.02
"""Residuals, as parts of the local brightness, beyond which they count as outliers do."""
_SWEEPS, _FIRST_SWEEPS = 3, 8
"""Reweighted estimates of the block albedos, from the weights of a point near by and from equal ones: after
5 of the latter the order of the starts was not settled yet."""
_DARK = 0.3
"""Brightness, as a part of the median, below which cells count less: noise, hair and light from the
surroundings matter more there than the texture."""
_BLACK = 0.01
"""Brightness below which relative deviations of the albedo say nothing."""
_AROUND = 0.03
"""Standard deviation of the local mean of the brightness as a part of the chart's side."""
_CLUSTER_AREA = 0.03
"""Area of a cluster of cells, beyond which texture is taken to be independent, as a part of the chart's."""
_DAMPING = Damping(first=1e-3, decrease=0.2, increase=8.0, least=1e-7, after_failure=1e-4, largest=1e4)
_CAUTION = 0.1
"""Damping of the one step by which starts are ranked: far from an optimum the model is hardly linear."""
_LONGEST = 4.0
"""Longest step as a multiple of the model's first steps."""
_SETTLED = 1e-5
"""Part of the cost below which an improvement ends the descent."""


class ResidualProblem:
    """The robust residual sum w |T - I_s - a_b I| / sum w T of one `Level`.

    The weights w are one over the local brightness (and the noise's floor): texture is a part of the
    brightness, so every cell counts about as much. `meter` counts the evaluations.
    """

    def __init__(
        self, level: Level, shadows: ShadowLattice, meter: Meter, soft: SoftTerms | None = None
    ) -> None:
        self.level, self.shadows, self.meter = level, shadows, meter
        self.soft = SoftTerms.unshadowed(level.normal) if soft is None else soft
        self.blocks, self.block_count = level.blocks(_BLOCK_AREA, _SHIFTS)
        around = local_mean(level, level.value, _AROUND * float(level.cell.max() + 1))
        self._trust = level.weight / np.hypot(around, _DARK)
        self._use(ColorGuide.none(len(level.value)))

    def _use(self, guide: ColorGuide) -> None:
        self.guide = guide
        self.value = self.level.value / guide.albedo
        self.scale = self.level.scale / guide.albedo
        self.weight = self._trust * guide.albedo
        self.total = len(_SHIFTS) * float(self.weight @ self.value)

    def guided(
        self,
        specular: FloatArray | None,
        tint: FloatArray | None = None,
        *,
        min_explained: float = MIN_EXPLAINED,
    ) -> ResidualProblem:
        """Return the problem without the texture that colour predicts.

        Before, a highlight (N,) is subtracted from the colours, and they are divided by `tint` (N, 3), what
        the light does to them. A colour guide that explains less than `min_explained` is left out.
        """
        other = copy.copy(self)
        other._use(color_guide(self.level, specular, tint, min_explained=min_explained))
        return other

    def at(self, model: LightModel, x: FloatArray, *, outlines: bool = True) -> Residual:
        """Return the residual at x; see `Residual`."""
        return Residual(self, model, x, outlines=outlines)


class Residual:
    """The residual at x (P,), clipped to the model's bounds: one counted evaluation.

    The block albedos are the reweighted estimate that the weights `robust` (S, N) lead to, or equal ones.
    Without `outlines` the shadows' outlines stay where they are when the light moves. `light`, `specular`
    (N,) are I and I_s of the cells, in the unit of the problem's value, `lamps` (L, N) each lamp's part of I.
    """

    def __init__(
        self,
        problem: ResidualProblem,
        model: LightModel,
        x: FloatArray,
        robust: FloatArray | None = None,
        *,
        outlines: bool = True,
    ) -> None:
        problem.meter.count()
        self.problem, self.model, self.x = problem, model, np.clip(x, *model.bounds)
        found, level, cells = model.decode(self.x), problem.level, len(problem.value)
        visible, visible_slope = problem.shadows.visibility(model, self.x)
        self.light, self.specular = np.empty(cells), np.empty(cells)
        self._slopes = np.zeros((model.size, cells)), np.zeros((model.size, cells))
        shade_with_derivatives(
            level.position,
            level.normal,
            visible,
            visible_slope if outlines else np.zeros_like(visible_slope),
            found.rows,
            model.tangents(self.x),
            model.radius_mm,
            level.toward,
            found.reflectance.kernel_brdf,
            found.reflectance.roughness,
            found.reflectance.specular_strength,
            found.reflectance.exponent,
            problem.scale,
            model.near and model.lights > 0,
            model.rough and model.lights > 0,
            model.specular and model.lights > 0,
            self.light,
            self.specular,
            *self._slopes,
        )
        # The derivative by the logarithm of an intensity is the lamp's own light.
        self.lamps = self._slopes[0][2 : 3 * model.lights : 3].copy()
        self._prior, self._prior_weight = ridge(model, self.x)
        if model.occlusion or model.bounce or model.environment:
            problem.soft.add(model, self.x, self.light, self._slopes[0])
        self._albedo, self._mass = np.empty(problem.block_count), np.empty(problem.block_count)
        self._before = np.repeat(problem.weight[None], len(problem.blocks), 0) if robust is None else robust
        self.cost = self._settle(_FIRST_SWEEPS if robust is None else _SWEEPS)

    def _settle(self, sweeps: int) -> float:
        """Estimate the block albedos from the weights before; return the cost."""
        p, self._robust = self.problem, self._before.copy()
        known = p.value, p.weight, self.light, self.specular, p.blocks, _SOFTNESS
        left = block_albedos(*known, self._robust, self._albedo, self._mass, sweeps)
        return float(left) / p.total + self._prior

    def _arguments(self) -> tuple[NDArray[np.generic], ...]:
        p = self.problem
        fixed = p.value, p.weight, self.light, self.specular, *self._slopes, p.blocks
        return *fixed, self._robust, self._albedo, self._mass

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model of the cost around x, and fix the weights.

        The costs of this point and of the points that steps lead to then come from the same weights.
        """
        self._before = self._robust
        self.cost = self._settle(_SWEEPS)
        return self.quadratic_model()

    def quadratic_model(self) -> NormalEquations:
        """Return the same with the weights as they are."""
        size, (lower, upper) = self.model.size, self.model.bounds
        matrix, gradient = np.empty((size, size)), np.empty(size)
        normal_equations(*self._arguments(), matrix, gradient)
        longest = _LONGEST * self.model.steps()
        return NormalEquations(
            matrix / self.problem.total + np.diag(self._prior_weight),
            gradient / self.problem.total + self._prior_weight * self.x,
            np.maximum(lower - self.x, -longest),
            np.minimum(upper - self.x, longest),
        )

    def moved(self, step: FloatArray) -> Residual:
        """Return the residual at x + `step`."""
        return Residual(self.problem, self.model, self.x + step, self._before)

    def columns(self) -> FloatArray:
        """Return (K, N) the parts of I; see `SoftTerms.columns`."""
        return self.problem.soft.columns(self.model.soft(self.x), self.lamps)

    def highlight(self) -> FloatArray:
        """Return (N,) I_s in the unit of the level's value."""
        return self.specular * self.problem.guide.albedo

    def covariance(self) -> FloatArray:
        """Return (P, P) the covariance of x at an optimum, robust to texture that correlates nearby [1]_.

        H^-1 (sum_c g_c g_c') H^-1 with the gradients g_c of patches of the surface, and H scaled from the
        weights of reweighting to the loss's own curvature. Use it on a residual without `outlines`: where
        exactly they run depends on the mesh's every edge.

        .. [1] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50(1), 1982.
        """
        matrix = self.normal_equations().matrix * self.problem.total
        # Weights are w^2 / s with s = sqrt((w r)^2 + e^2), the loss's curvature w^2 e^2 / s^3.
        spread = self.problem.weight / np.maximum(self._robust, 1e-30)
        matrix *= float(np.sum(_SOFTNESS**2 / spread**3) / np.sum(1 / spread))
        level = self.problem.level
        side = max(2.0, math.sqrt(_CLUSTER_AREA * len(level.value)))
        row, column = (level.cell // side).astype(np.int64).T
        clusters = np.unique(row * 100_000 + column, return_inverse=True)[1].astype(np.int64)
        scores = np.empty((int(clusters.max()) + 1, self.model.size))
        cluster_scores(*self._arguments(), clusters, scores)
        scaling = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        inverse = np.linalg.pinv(matrix * np.outer(scaling, scaling), rcond=1e-10)
        half = inverse @ (scores * scaling).T
        return (half @ half.T) * np.outer(scaling, scaling)

    def albedo_slopes(self) -> FloatArray:
        """Return (P, N) the derivatives of the log of (T - I_s) / I, without their means over the cells."""
        value, (light_slope, specular_slope) = self.problem.value, self._slopes
        below = np.maximum(value - self.specular, 0.05 * np.maximum(value, _BLACK))
        slopes = -light_slope / self.light - specular_slope / below
        result: FloatArray = slopes - np.average(slopes, axis=1, weights=self.problem.level.weight)[:, None]
        return result


def descend(problem: ResidualProblem, model: LightModel, x: FloatArray, evaluations: int) -> Solution:
    """Return a minimum near x by at most `evaluations`; x at infinite cost when the budget had ended."""
    if problem.meter.exhausted:
        return Solution(model, np.clip(x, *model.bounds), math.inf)
    start = problem.at(model, x)
    found = minimize(
        start, trials=evaluations - 1, tolerance=_SETTLED, damping=_DAMPING, meter=problem.meter
    ).best
    return Solution(model, found.x, found.cost)


def one_step(problem: ResidualProblem, model: LightModel, x: FloatArray) -> Solution:
    """Return where one damped step from x leads, with the cost that the quadratic model predicts there."""
    here = problem.at(model, x)
    equations = here.quadratic_model()
    step = damped_step(equations, _CAUTION)
    change = float(step @ equations.gradient) + 0.5 * float(step @ equations.matrix @ step)
    return Solution(model, np.clip(here.x + step, *model.bounds), here.cost + min(change, 0.0))
