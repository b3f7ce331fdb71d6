"""Extremes of light and shadow: reflectance functions, the shading of points, shadow maps, environments."""

import math
from functools import cache, partial

import numpy as np
from helpers import meshes

from scan2albedo.core import PointLight
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance, light_from_direction, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap
from stability.case import below, gap, refuses, right, table

UP = np.array([0.0, 0.0, 1.0])
LAMP = PointLight(0.3, 0.2)
MATT = Reflectance(roughness=0.3)


@cache
def sphere(offset_mm=0.0):
    """Return vertices, normals and faces of a ball of 80 mm."""
    position, faces = meshes.sphere(4, 80.0)
    return position + offset_mm, position / 80, faces


def shaded(*lamps, reflectance=MATT, normal=None, **options):
    """Shade the points of the ball."""
    position, outward, _ = sphere()
    return shade_points(position, outward if normal is None else normal, lamps, reflectance, **options)


def shadows(caster=None, offset_mm=0.0):
    """Return the shadow map of the ball's points, by itself or by another caster."""
    position, normal, faces = sphere(offset_mm)
    return ShadowMap(caster or RayCaster(position, faces), position, normal)


def brightest(reflectance):
    """Return the largest share of the light of one lamp that a point gets; behind it none gets any."""
    light = shaded(LAMP, reflectance=reflectance).light - 1
    assert not light[sphere()[1] @ LAMP.direction < 0].any()
    return light.max()


def pole_error():
    """Return how far a lamp at a pole is from straight above or below, whatever its azimuth."""
    return max(
        gap(light_from_direction(lamp.direction, math.inf, 1.0).direction, [0, sign, 0])
        for sign in (1, -1)
        for lamp in (PointLight(azimuth, sign * math.pi / 2) for azimuth in (0.0, 1.0, -3.0))
    )


def far_lamp():
    """Return how much a lamp at 1e9 mm differs from a distant one: in light, and in points in shadow."""
    lamps = [PointLight(0.3, 0.2, distance) for distance in (1e9, math.inf)]
    far, distant = (shaded(lamp).light for lamp in lamps)
    seen, seen_distant = (shadows().visible(LAMP.direction, lamp.distance_mm) for lamp in lamps)
    assert np.mean(seen != seen_distant) < 1e-3
    return gap(far, distant), int((seen != seen_distant).sum())


def touching():
    """Return the brightest light of a lamp in a vertex."""
    lamp = light_from_direction(sphere()[1][0], 80.0, 1.0)
    found = shaded(lamp, reflectance=Reflectance(specular_strength=1.0))
    return found.light.max(), found


def not_linear():
    """Return how far light is from being linear in the lamp's intensity."""
    unit = shaded(PointLight(0.3, 0.2, 500.0, 1.0)).light - 1
    return max(
        gap(shaded(PointLight(0.3, 0.2, 500.0, strength)).light - 1, strength * unit) / max(strength, 1)
        for strength in (0.0, 1e-12, 1e12)
    )


def dark(position, normal, *lamps):
    """Return how far Minnaert's light is from ambient light alone."""
    found = shade_points(position, normal, lamps, Reflectance("minnaert", 0.5, 1.0))
    return float(max(np.abs(found.light - 1).max(initial=0), found.specular.max(initial=0)))


def wrong_shadows(offset_mm):
    """Return the part of the ball's points seen wrongly, 6 degrees about the terminator left out."""
    lamp = PointLight(0.4, 0.3)
    seen = shadows(offset_mm=offset_mm).visible(lamp.direction) > 0
    cosine = sphere()[1] @ lamp.direction
    clear = np.abs(cosine) > math.sin(math.radians(6))
    return float(np.mean((seen != (cosine > 0))[clear]))


def twice():
    """Return at how many points a surface that is there twice casts other shadows."""
    position, _, faces = sphere()
    doubled = RayCaster(*join(2 * [(position, faces)]))
    lamp = PointLight(0.4, 0.3).direction
    return int((shadows(doubled).visible(lamp) != shadows().visible(lamp)).sum())


def spoilt_caster(vertex_scale=1.0, face_shift=0):
    """Look up shadows by a damaged ball."""
    position, _, faces = sphere()
    return shadows(RayCaster(vertex_scale * position, faces + face_shift)).visible(UP)


def environment_error(scale):
    """Return how far the lamps of a scaled environment are from scaled lamps."""
    sky = np.random.default_rng(0).random((4, 8, 3))
    plain, scaled = (DistantLights.from_environment(s * sky).irradiance_linear for s in (1.0, scale))
    return gap(scaled, scale * plain)


AMBIENT_ALONE = below(1e-15, "ambient light alone, within {:.0e}")
LINEAR = below(1e-12, "linear within {:.0e}")
NO_SHADOW_ERROR = below(1e-12, "{:.1%} of a ball's points wrong, 6 degrees about the terminator left out")

CASES = table(
    "lighting",
    right(
        below(1.0 + 1e-9, "up to {:.2f} of the light, none behind"),
        "roughness {}",
        lambda sigma: brightest(Reflectance(roughness=sigma)),
        ("1e-6", "1", "1e3"),
    ),
    right(
        below(1e4, "finite, up to {:.0e}, none behind"),
        "Minnaert exponent {}",
        lambda m: brightest(Reflectance("minnaert", m)),
        ("0.1", "1e4"),
    ),
    right(
        below(1e-15, "one direction whatever the azimuth, within {:.0e}"),
        "light at the poles (elevation +-90)",
        pole_error,
    ),
    right(
        below(1e-6, "as a distant one: light within {:.0e}, shadows differ at {} points"),
        "lamp at 1e9 mm",
        far_lamp,
    ),
    right(below(math.inf, "finite, at most {:.1e}"), "lamp on the surface itself", touching),
    right(LINEAR, "intensity 0, 1e-12 and 1e12", not_linear),
    right(
        AMBIENT_ALONE,
        {
            "lamp at 1 mm, inside the head": lambda: dark(*sphere()[:2], PointLight(0.3, 0.2, 1.0, 1.0)),
            "normals zero": lambda: dark(np.zeros((4, 3)), np.zeros((4, 3)), LAMP),
            "no point": lambda: dark(np.zeros((0, 3)), np.zeros((0, 3)), LAMP),
        },
    ),
    refuses(
        "",
        {
            "lamp at distance 0": lambda: PointLight(0.0, 0.0, 0.0),
            "lamp at -100 mm": lambda: PointLight(0.0, 0.0, -100.0),
            "intensity NaN": lambda: PointLight(0.0, 0.0, 100.0, math.nan),
            "azimuth NaN": lambda: PointLight(math.nan, 0.0),
            "intensity -1": lambda: PointLight(0.0, 0.0, 100.0, -1.0),
            **{
                f"{field} {value}": partial(Reflectance, **{field: value})
                for field in ("roughness", "exponent", "specular_strength")
                for value in (math.nan, -1.0)
            },
            "view direction zero": lambda: shaded(LAMP, view_direction=(0, 0, 0)),
            "normals NaN": lambda: shaded(LAMP, normal=math.nan * sphere()[1]),
            "fewer normals than points": lambda: shaded(LAMP, normal=np.tile(UP, (4, 1))),
            "visibility of another number of lamps": lambda: shaded(
                LAMP, LAMP, visible=np.ones((1, len(sphere()[0])), np.uint8)
            ),
            "shadow map, caster without a vertex": lambda: RayCaster(np.zeros((0, 3)), np.zeros((0, 3), int)),
            "shadow map, caster with NaN": lambda: spoilt_caster(vertex_scale=math.nan),
            "shadow map, faces beyond the vertices": lambda: spoilt_caster(face_shift=10**6),
        },
    ),
    right(NO_SHADOW_ERROR, "shadow map, head {} mm off the origin", wrong_shadows, ("1e6", "1e7")),
    right(below(1, "{} points differ"), "shadow map, the surface itself twice (coincident)", twice),
    right(
        below(1, "hides {} points"),
        "shadow map, one point as a mesh",
        lambda: 1 - ShadowMap(RayCaster(np.ones((3, 3)), [[0, 1, 2]]), 0 * UP[None], UP[None]).visible(UP)[0],
    ),
    right(LINEAR, "environment times {}", environment_error, ("0", "-1")),
)
