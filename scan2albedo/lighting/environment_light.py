"""What a surface that shadows itself receives of an `EnvironmentLight`, and what it sends onto itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from scan2albedo.core import EnvironmentLight
from scan2albedo.core.arrays import SMALLEST, FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable, shadow_offset_mm

_COSINE_LOBE = np.array([1.0, *[2 / 3] * 3, *[1 / 4] * 5])
"""Of the clamped cosine over pi, for each harmonic."""
SKY = 96
"""Rays a point: the occlusion of a face is off by 1 to 2 % with them."""
_DIRECTIONS = 128
"""Rays from each patch."""
_CELLS = 24
"""Patches along the longest side of the points, of which they are chosen: some 900 on a face."""
SMALLEST_MM = 0.5
"""Distance below which all points weigh the same that a value is interpolated from."""


def open_transfer(normal: FloatArray) -> FloatArray:
    """Return (N, 9) the light on points that nothing hides, by unit `normal` (N, 3), under each Y_k / Y_0.

    .. [1] R. Ramamoorthi, P. Hanrahan, "An efficient representation for irradiance environment maps",
       SIGGRAPH 2001.

    >>> open_transfer(np.array([[0.0, 0.0, 1.0]]))[0, :3].round(3).tolist()
    [1.0, 0.0, 1.155]
    """
    values = harmonics(normal, 2)
    return values / values[:, :1] * _COSINE_LOBE


def open_shading(environment: EnvironmentLight) -> FloatArray:
    """Return (9, 3) the coefficients, in `harmonics` of the normal, of the light on points nothing hides."""
    return environment.coefficients * (_COSINE_LOBE / harmonics([0.0, 0.0, 1.0], 0))[:, None]


def environment_of_shading(coefficients: FloatArray) -> EnvironmentLight:
    """Return the environment that nothing hides of such coefficients (9, 3): `open_shading` inverted."""
    of_radiance = coefficients * (harmonics([0.0, 0.0, 1.0], 0) / _COSINE_LOBE)[:, None]
    return EnvironmentLight(of_radiance, occluded=False)


def shadowed_transfer(shadows: ShadowMap, sky: VisibilityTable | None = None) -> FloatArray:
    """Return (N, 9) the same for points that the surface partly hides; the first is ambient occlusion.

    `sky` says which directions, spread evenly, each point sees: `SKY` of them, where it is not known already.
    Sums over rays err; only what is hidden is taken from them, and the rest from `open_transfer`.

    .. [1] P.-P. Sloan, J. Kautz, J. Snyder, "Precomputed radiance transfer for real-time rendering in
       dynamic, low-frequency lighting environments", SIGGRAPH 2002.
    """
    free = open_transfer(shadows.normal)
    if shadows.caster is None:
        return free
    sky = shadows.table(distant_directions(SKY)) if sky is None else sky
    values = harmonics(sky.directions, 2)
    weighted = values / values[:, :1] * (4 / len(values))
    cosine = np.maximum(shadows.normal @ sky.directions.T, 0.0)
    whole, part = cosine @ weighted, (cosine * sky.visibility.T) @ weighted
    # The first harmonic is constant, so its coefficient gives the visible share.
    share = part[:, :1] / np.maximum(whole[:, :1], SMALLEST)
    return part + share * (free - whole)


def environment_light_on(
    environment: EnvironmentLight, shadows: ShadowMap, lamps: FloatArray | None = None
) -> FloatArray:
    """Return (N, 3) the light on the points of `shadows`, 0 or more, of environment and `lamps` (N, 3).

        I = c_0 (t_0 + fill (1 - t_0)) + D + bounce B(D),   D = lamps + sum_(k > 0) c_k t_k

    with the transfer t of each point, and B of `Patches`. What the surface throws back of the
    constant light is part of the fill.
    """
    transfer = shadowed_transfer(shadows) if environment.occluded else open_transfer(shadows.normal)
    transfer[:, 0] += environment.fill * (1 - transfer[:, 0])
    light = transfer @ environment.coefficients
    if lamps is not None:
        light += lamps
    if environment.bounce and shadows.caster is not None:
        direct = light - transfer[:, :1] * environment.coefficients[0]
        bounce = Patches.among(shadows).seen_from(shadows.position, shadows.normal)
        light += environment.bounce * bounce(direct)
    return np.maximum(light, 0.0)


def surface_keys(position: FloatArray, normal: FloatArray) -> FloatArray:
    """Return (N, 6) what distances along a surface are taken between: position, and normal times 20 mm."""
    return np.column_stack([position, 20 * normal])


def surface_weights(known: FloatArray, wanted: FloatArray) -> sparse.csr_matrix:
    """Return (N, M) weights, rows summing to 1, at N `surface_keys` of values that are known at M of them.

    Values come from along the surface: none leaks to the other side of a fold.
    """
    count = min(4, len(known))
    far, index = cKDTree(known).query(wanted, range(1, count + 1))
    weight = 1 / (far + SMALLEST_MM) ** 2
    weight /= weight.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(wanted)), count)
    return sparse.csr_matrix((weight.ravel(), (rows, index.ravel())), (len(wanted), len(known)))


Bounce = Callable[[FloatArray], FloatArray]
"""Gives what points of a surface get of the light (N, ...) on them, thrown back once; see `Patches`."""


@dataclass(frozen=True)
class Patches:
    """M patches of a surface, their `surface_keys`, and the form factors (M, M) by which they exchange light.

        B(x) = integral of V_hit(x, w) D(y(x, w)) max(0, n.w) / pi dw

    is one bounce of light D from the surface onto itself, for albedo 1. The rows of `factors` sum to the
    hidden part of the hemisphere.

    .. [1] C. Goral, K. Torrance, D. Greenberg, B. Battaile, "Modeling the interaction of light between
       diffuse surfaces", SIGGRAPH 1984.
    """

    keys: FloatArray
    factors: FloatArray

    @classmethod
    def among(cls, shadows: ShadowMap) -> Self:
        """Return the patches around some of the points of `shadows`, evenly spread; they have a caster."""
        assert shadows.caster is not None
        position, normal = shadows.position, shadows.normal
        low, high = position.min(0), position.max(0)
        edge = max(float((high - low).max()), 1e-9) / _CELLS
        column, row, layer = ((position - low) / edge).astype(int).T
        some = np.unique((column * (_CELLS + 1) + row) * (_CELLS + 1) + layer, return_index=True)[1]
        return cls.of(shadows.caster, position[some], normal[some], shadows.offset_mm)

    @classmethod
    def of(cls, caster: RayCaster, position: FloatArray, normal: FloatArray, offset_mm: float) -> Self:
        """Return the patches around points (M, 3): a ray counts for the patch nearest to where it hits."""
        origin = position + shadow_offset_mm(caster.size, offset_mm) * normal
        nearest, factors = cKDTree(position), np.zeros((len(position), len(position)))
        for direction in distant_directions(_DIRECTIONS):
            cosine = normal @ direction
            rows = np.flatnonzero(cosine > 0)
            hits = caster.first_hit(origin[rows], direction)
            hit = hits.face >= 0
            rows, at = rows[hit], origin[rows[hit]] + hits.distance[hit, None] * direction
            column = nearest.query(at)[1]
            # Light leaves the outer side alone: a ray that meets the inner side passed a hole.
            outer = normal[column] @ direction < 0
            np.add.at(factors, (rows[outer], column[outer]), cosine[rows[outer]] * 4 / _DIRECTIONS)
        return cls(surface_keys(position, normal), factors)

    def seen_from(self, position: FloatArray, normal: FloatArray) -> Bounce:
        """Return the bounce onto and from N points."""
        up = surface_weights(self.keys, surface_keys(position, normal))
        # What averages values at the points around each patch.
        total = np.maximum(np.asarray(up.sum(0)).ravel(), 1e-9)
        factors, down = sparse.csr_matrix(self.factors), sparse.diags(1 / total) @ up.T
        return lambda light: np.asarray(up @ (factors @ (down @ light)))
