"""The robust residual at one image size with its derivatives: what least squares needs to find the light."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo.color_guide import ColorGuide, color_guide
from scan2albedo.albedo.levels import Level, local_mean, partitions
from scan2albedo.albedo.light_model import LightModel
from scan2albedo.albedo.normal_equations import cluster_scores, normal_equations
from scan2albedo.core import Meter
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.kernels import shade_with_derivatives
from scan2albedo.lighting.shadow_map import ShadowMap

FloatArray = NDArray[np.float64]

_SHIFTS = ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5))
_SOFTNESS = 0.02
"""Residuals, as parts of the local brightness, beyond which they count as outliers do."""
_DARK = 0.3
"""Brightness, as a part of the median, below which cells count less: noise, hair and light from the
surroundings matter more there than the texture."""
_BLACK = 0.01
"""Brightness below which relative deviations of the albedo are not told."""
_AROUND = 0.03
"""Standard deviation of the local mean of the brightness as a part of the chart's side."""
_LATTICE = 2.0
"""Shadows are computed for directions this many cells apart (of the unit sphere's image) and blended."""
_CLUSTER_AREA = 0.03
"""Area of a cluster of cells, beyond which texture is taken to be independent, as a part of the chart's."""


@dataclass(frozen=True)
class Linearization:
    """Cost at x, the Gauss-Newton matrix (P, P), and the right side (P,) of the step that lessens it."""

    cost: float
    matrix: FloatArray
    gradient: FloatArray


class ResidualProblem:
    """The robust residual sum w |T - I_s - a_b I| / sum w T of one `Level`.

    The weights w are one over the local brightness (and the noise's floor): texture is a part of the
    brightness, so every cell tells about as much. Shadows are rays blended bilinearly between the nodes of
    a lattice of directions, so the residual is continuous in the light.

    Parameters
    ----------
    level : Level
    caster : RayCaster, optional
        Casts shadows; None leaves them out.
    view : (3,) float64
        Unit direction to the viewer.
    offset_mm : float
        Of shadow rays.
    block_area : float
        Of a block as a part of `level`'s own, in which area the texture's mean is constant.
    meter : Meter
        Counts the evaluations.
    """

    def __init__(
        self,
        level: Level,
        caster: RayCaster | None,
        view: FloatArray,
        offset_mm: float,
        block_area: float,
        meter: Meter,
    ) -> None:
        self.level, self.meter = level, meter
        self._view = view
        self._shadows = None if caster is None else ShadowMap(caster, level.anchor, level.normal, offset_mm)
        self._known: dict[tuple[int, int, int], NDArray[np.float32]] = {}
        rows, columns = level.cell.max(0) + 1
        self._step = _LATTICE / max(rows, columns)
        self._blocks, count = partitions(level.center, level.block_side * math.sqrt(block_area), _SHIFTS)
        self._albedo, self._mass = np.empty(count), np.empty(count)
        self._clusters = _clusters(level)
        around = local_mean(level, level.value, _AROUND * max(rows, columns))
        self._trust = level.weight / np.hypot(around, _DARK)
        size = len(level.value)
        self._light, self._specular = np.empty(size), np.empty(size)
        self._slopes = np.empty((0, size)), np.empty((0, size))
        self._seen = np.ones((4, size), np.float32), np.zeros((4, 2, size), np.float32)
        self._use(ColorGuide.none(size))

    def _use(self, guide: ColorGuide) -> None:
        level = self.level
        self.guide = guide
        self._value = level.value / guide.albedo
        self._scale = level.scale / guide.albedo
        self._weight = self._trust * guide.albedo
        self._total = len(_SHIFTS) * float(self._weight @ self._value)
        self._robust = np.repeat(self._weight[None], len(_SHIFTS), 0)

    def guided(self, specular: FloatArray | None) -> ResidualProblem:
        """Return the problem with the texture that colour predicts divided out.

        `specular` (N,), a highlight, is taken off the colours first.
        """
        other = copy.copy(self)
        other._use(color_guide(self.level, specular))
        return other

    def highlight(self, model: LightModel, x: FloatArray) -> FloatArray:
        """Return (N,) I_s of x in the unit of the level's value."""
        self.linearize(model, x)
        return self._specular * self.guide.albedo

    def light(self, model: LightModel, x: FloatArray) -> FloatArray:
        """Return (N,) I of x."""
        self.linearize(model, x)
        return self._light.copy()

    def linearize(self, model: LightModel, x: FloatArray, *, outlines: bool = True) -> Linearization:
        """Return the cost at x and its normal equations; one counted evaluation.

        Without `outlines` the shadows' outlines stay where they are when the light moves.
        """
        self.meter.count()
        hypothesis, size = model.decode(x), model.size
        visible, visible_slope = self._visibility(model, x)
        if not outlines:
            visible_slope = np.zeros_like(visible_slope)
        reflectance = hypothesis.reflectance
        if len(self._slopes[0]) < size:
            self._slopes = np.empty((size, len(self._value))), np.empty((size, len(self._value)))
        shade_with_derivatives(
            self.level.position,
            self.level.normal,
            visible,
            visible_slope,
            hypothesis.rows,
            model.tangents(np.clip(x, *model.bounds)),
            model.radius_mm,
            self._view,
            reflectance.kernel_brdf,
            reflectance.roughness,
            reflectance.specular_strength,
            reflectance.exponent,
            self._scale,
            model.near,
            model.rough,
            model.specular,
            self._light,
            self._specular,
            *self._slopes,
        )
        matrix, gradient = np.empty((size, size)), np.empty(size)
        cost = normal_equations(*self._arguments(), matrix, gradient)
        return Linearization(cost / self._total, matrix / self._total, gradient / self._total)

    def _arguments(self) -> tuple[object, ...]:
        return (
            self._value,
            self._weight,
            self._light,
            self._specular,
            *self._slopes,
            self._blocks,
            _SOFTNESS,
            self._robust,
            self._albedo,
            self._mass,
        )

    def covariance(self, model: LightModel, x: FloatArray) -> FloatArray:
        """Return (P, P) the covariance of x at an optimum, robust to texture that correlates nearby.

        H^-1 (sum_c g_c g_c') H^-1 with the gradients g_c of patches of the surface, and H scaled from the
        weights of reweighting to the loss's own curvature. Shadow outlines are left out: where exactly they
        run depends on the mesh's every edge.

        References
        ----------
        .. [1] H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50(1), 1982.
        """
        matrix = self.linearize(model, x, outlines=False).matrix * self._total
        # Weights are w^2 / s with s = sqrt((w r)^2 + e^2), the loss's curvature w^2 e^2 / s^3.
        scale = self._weight / np.maximum(self._robust, 1e-30)
        matrix *= float(np.sum(_SOFTNESS**2 / scale**3) / np.sum(1 / scale))
        scores = np.empty((int(self._clusters.max()) + 1, model.size))
        costs = np.empty(len(scores))
        cluster_scores(*self._arguments(), self._clusters, scores, costs)
        scaling = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        inverse = np.linalg.pinv(matrix * np.outer(scaling, scaling), rcond=1e-10)
        half = inverse @ (scores * scaling).T
        return (half @ half.T) * np.outer(scaling, scaling)

    def albedo_slopes(self, model: LightModel, x: FloatArray) -> FloatArray:
        """Return (P, N) the derivatives of the log of (T - I_s) / I, without their means over the cells."""
        self.linearize(model, x)
        light_slope, specular_slope = (slope[: model.size] for slope in self._slopes)
        below = np.maximum(self._value - self._specular, 0.05 * np.maximum(self._value, _BLACK))
        slopes = -light_slope / self._light - specular_slope / below
        result: FloatArray = slopes - np.average(slopes, axis=1, weights=self.level.weight)[:, None]
        return result

    def _visibility(
        self, model: LightModel, x: FloatArray
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (L, N) visibility and (L, 2, N) its derivatives by the directions' coordinates."""
        seen, slope = self._seen
        if self._shadows is None:
            return seen[: model.lights], slope[: model.lights]
        rows = model.decode(x).rows
        for k in range(model.lights):
            across, along = x[3 * k] / self._step, x[3 * k + 1] / self._step
            column, row = math.floor(across), math.floor(along)
            t, u = np.float32(across - column), np.float32(along - row)
            nearness = round(rows[k, 3] * model.radius_mm / self._step)
            v00, v01, v10, v11 = (
                self._node(model, column + i, row + j, nearness) for i in (0, 1) for j in (0, 1)
            )
            low, high = (1 - u) * v00 + u * v01, (1 - u) * v10 + u * v11
            seen[k] = (1 - t) * low + t * high
            slope[k, 0] = (high - low) / np.float32(self._step)
            slope[k, 1] = ((1 - t) * (v01 - v00) + t * (v11 - v10)) / np.float32(self._step)
        return seen[: model.lights], slope[: model.lights]

    def _node(self, model: LightModel, column: int, row: int, nearness: int) -> NDArray[np.float32]:
        """Return (N,) the visibility at a node of the lattice."""
        assert self._shadows is not None
        key = column, row, nearness
        if key not in self._known:
            direction = model.direction(column * self._step, row * self._step)
            distance = model.radius_mm / (nearness * self._step) if nearness > 0 else math.inf
            visible = self._shadows.visible(direction, distance).astype(np.float32)
            # Turned away at the node, a cell may face the light itself: no outline of a cast shadow there.
            rays = direction if math.isinf(distance) else distance * direction - self.level.position
            visible[np.sum(self.level.normal * rays, 1) <= 0] = 1
            self._known[key] = visible
        return self._known[key]


def _clusters(level: Level) -> NDArray[np.int64]:
    """Return (N,) the patch of the surface that each cell belongs to."""
    side = max(2.0, math.sqrt(_CLUSTER_AREA * len(level.value)))
    row, column = (level.cell // side).astype(np.int64).T
    _, index = np.unique(row * 100_000 + column, return_inverse=True)
    return np.asarray(index, np.int64)
