"""What a surface that shadows itself receives of an `EnvironmentLight`."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.lights import EnvironmentLight
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.interreflection import Patches
from scan2albedo.lighting.shadow_map import ShadowMap, VisibilityTable

_COSINE_LOBE = np.array([1.0, *[2 / 3] * 3, *[1 / 4] * 5])
"""Of the clamped cosine over pi, for each harmonic."""
SKY = 96
"""Rays a point: the occlusion of a face is off by 1 to 2 % with them."""


def open_transfer(normal: FloatArray) -> FloatArray:
    """Return (N, 9) the light on points that nothing hides, by unit `normal` (N, 3), under each Y_k / Y_0.

    .. [1] R. Ramamoorthi, P. Hanrahan, "An efficient representation for irradiance environment maps",
       SIGGRAPH 2001.

    >>> open_transfer(np.array([[0.0, 0.0, 1.0]]))[0, :3].round(3).tolist()
    [1.0, 0.0, 1.155]
    """
    values = harmonics(normal, 2)
    return np.asarray(values / values[:, :1] * _COSINE_LOBE)


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
    share = part[:, :1] / np.maximum(whole[:, :1], 1e-12)
    return np.asarray(part + share * (free - whole))


def environment_light_on(
    environment: EnvironmentLight, shadows: ShadowMap, lamps: FloatArray | None = None
) -> FloatArray:
    """Return (N, 3) the light on the points of `shadows`, 0 or more, of environment and `lamps` (N, 3).

        I = c_0 (t_0 + fill (1 - t_0)) + D + bounce B(D),   D = lamps + sum_(k > 0) c_k t_k

    with the transfer t of each point, and B of `interreflection.Bounce`. What the surface throws back of the
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
