"""Cast shadows in the search for the light: whether there are any, and where, continuous in the light."""

import math
from itertools import product

import numpy as np
from scipy.ndimage import maximum_filter

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.albedo.node_field import TINY
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.core import GeometryImage, Meter, PlanStep
from scan2albedo.core.arrays import Float32Array, FloatArray, IntArray, dots
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment_light import SKY
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable

Visibility = Float32Array

OUTLINE_BLURS = 4 / 256, 0.5 / 256
"""How far a traced outline may lie beside the real one (standard deviations, parts of the chart's side): of a
surface that was measured, some 3 mm of a face, most of it along the surface, where a millimetre of relief
moves a shadow by several; and of one that is exact."""
LEAST_SHADOW = 0.01
"""Part of the cells facing some light that has to lie in cast shadow for shadow rays to be used."""
FEWEST = 0.05
"""Part of the cells that has to face a direction for its figure to mean something."""
_SPACING = 2.0
"""Distance of the lattice's nodes in cells of the image, and how many lie in a lamp's angular radius. Along
nearness they lie as many times farther apart: shadows change little with it."""


def shadow_caster(
    image: GeometryImage, level: Level, directions: FloatArray, options: EstimateOptions, meter: Meter
) -> tuple[RayCaster | None, PlanStep]:
    """Return the shadow caster, or None where the surface hardly shades itself, and the plan's row.

    The cells of `level` are tested under distant lights from `directions` (D, 3). When the meter's budget has
    ended, it casts shadows without that test.
    """
    stage = "albedo.shadows"
    choice = options.choice(stage)
    if choice is False:
        return None, PlanStep(stage, False, "left out by the caller")
    vertices, faces = image.occluder_mesh()
    if not len(faces):
        return None, PlanStep(stage, False, "the surface has no triangle to cast a shadow", "0 faces")
    caster = RayCaster(vertices, faces)
    if choice is None and meter.exhausted:
        return caster, PlanStep(stage, True, "the budget ended before it was judged", "not judged")
    shadows = ShadowMap(caster, level.anchor, level.normal)
    largest = 0.0
    for direction in directions:
        # At the terminator facets shade texels whose smooth normal still faces the light.
        facing = shadows.normal @ direction > 0.2
        if facing.mean() >= FEWEST:
            largest = max(largest, float(np.mean(shadows.visible(direction)[facing] == 0)))
    evidence = f"at most {100 * largest:.1f} % of the texels facing a light lie in cast shadow"
    if choice is None and largest < LEAST_SHADOW:
        return None, PlanStep(stage, False, "the surface casts no shadow on itself", evidence)
    return caster, PlanStep(stage, True, "asked for" if choice else "the surface shades itself", evidence)


class Horizon:
    """Above which cosine to the normal no light is hidden, from the `sky` that the cells of a level see.

    It is the largest at which one of the sky's directions is hidden from the cell or from one beside it, and
    some more: between the directions an occluder may be missed.
    """

    def __init__(self, level: Level, sky: VisibilityTable) -> None:
        row, column = level.cell.T
        hidden, known = np.zeros((2, row.max() + 1, column.max() + 1))
        hidden[row, column] = sky.highest_hidden(level.normal)
        known[row, column] = 1
        above = np.where(known > 0, maximum_filter(hidden, 3) + math.sqrt(2 * math.pi / SKY), np.inf)
        self._above = np.pad(above, (0, 1), constant_values=np.inf)
        self._factor = level.factor

    def at(self, texels: FloatArray | IntArray) -> FloatArray:
        """Return (N,) the cosines at `texels` (N, 2); infinite beyond the cells."""
        cells = np.minimum(texels // self._factor, np.array(self._above.shape) - 1).astype(int)
        return self._above[tuple(cells.T)]


class ShadowLattice:
    """Visibility of N cells, by rays at the nodes of a lattice of lights and blended linearly between them.

    The lattice's axes are the two coordinates of a light's direction and its nearness (see `LightModel`), so
    the visibility is continuous in the parameters of a light and has derivatives. Nodes are kept: a local
    search rarely shoots rays. Without `caster` everything is visible.
    """

    def __init__(self, level: Level, caster: RayCaster | None) -> None:
        self._normal = level.normal
        self._rays = None if caster is None else ShadowMap(caster, level.anchor, level.normal)
        self._side = float(level.cell.max() + 1)
        self._least_step = _SPACING / self._side
        self._sharp: dict[tuple[int, int, int, float], Visibility] = {}
        self._known: dict[tuple[int, int, int, float, float], Visibility] = {}
        self._spread: dict[float, tuple[Visibility, Visibility, Visibility]] = {}
        self._cell = tuple(level.cell.T)
        self._grid = np.zeros(level.cell.max(0) + 1, np.float32)
        self._height = dots(level.normal, level.position)

    def nearest(self, coordinates: FloatArray) -> FloatArray:
        """Return the node's coordinates (..., 2) nearest to those of directions: its rays serve alone."""
        return np.round(coordinates / self._least_step) * self._least_step

    def visibility(
        self, model: LightModel, x: FloatArray, blur: float = 0.0
    ) -> tuple[Visibility, Visibility]:
        """Return (L, N) visibility and (L, 2, N) its derivatives by the directions' coordinates.

        Outlines are blurred by `blur`, a part of the chart's side. At a node the derivatives are 0. The
        derivative by nearness is left out: so small a move of an outline is mostly the mesh's edges.
        """
        lights, cells = model.lights, len(self._normal)
        if self._rays is None or not lights:
            return np.ones((lights, cells), np.float32), np.zeros((lights, 2, cells), np.float32)
        nearness = float(model.part(x, "near")[0])
        visible, slopes = np.zeros((lights, cells), np.float32), np.zeros((lights, 2, cells), np.float32)
        # The lattice's spacing along its axes is wide for lamps whose shadows are soft.
        step = max(self._least_step, math.radians(model.radius_deg) / _SPACING)
        steps = step, step, _SPACING * step
        for k, (px, py, _) in enumerate(x[: 3 * lights].reshape(-1, 3).tolist()):
            ends = list[list[tuple[int, float, float]]]()
            for value, side in zip((px, py, nearness), steps, strict=True):
                low = math.floor(value / side + TINY)
                part = value / side - low
                # On a node, such as that of distant lights, the next one has no share.
                on_node = part < TINY
                both = (low, 1 - part, -1 / side), (low + 1, part, 1 / side)
                ends.append([(low, 1.0, 0.0)] if on_node else list(both))
            nodes, weights = list[Visibility](), list[tuple[float, float, float]]()
            for (column, across, by_x), (row, along, by_y), (layer, near, _) in product(*ends):
                nodes.append(self._node(model, (column, row, layer), steps, blur))
                weights.append((across * along * near, by_x * along * near, across * by_y * near))
            visible[k], *slopes[k] = np.array(weights, np.float32).T @ np.array(nodes)
        return visible, slopes

    def _node(
        self, model: LightModel, node: tuple[int, ...], steps: tuple[float, ...], blur: float
    ) -> Visibility:
        """Return (N,) the visibility at a node."""
        assert self._rays is not None
        column, row, nearness = node
        key = column, row, nearness, model.radius_deg
        known = self._known.get((*key, blur))
        if known is not None:
            return known
        if key not in self._sharp:
            direction = model.direction(column * steps[0], row * steps[1])
            distance = model.radius_mm / (nearness * steps[2]) if nearness > 0 else math.inf
            visible = self._rays.reached(direction, distance, model.radius_deg).astype(np.float32)
            # Turned away at the node, a cell may face the light itself: no cast shadow's outline there.
            visible[self._normal @ direction <= self._height / distance] = 1
            self._sharp[key] = visible
        if blur not in self._spread:
            places, sigma = map(np.arange, self._grid.shape), max(blur * self._side, TINY)
            apart = (np.subtract.outer(at, at) / sigma for at in places)
            down, across = (np.exp(-0.5 * far**2).astype(np.float32) for far in apart)
            self._grid[self._cell] = 1
            self._spread[blur] = down, across, (down @ self._grid @ across.T)[self._cell]
        down, across, whole = self._spread[blur]
        self._grid[self._cell] = self._sharp[key]
        self._known[*key, blur] = (down @ self._grid @ across.T)[self._cell] / whole
        return self._known[*key, blur]
