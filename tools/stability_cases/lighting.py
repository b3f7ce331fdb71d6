"""Named extremes of light and shadow: reflectance functions, shadow maps, the shading of points."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
from brdf_reference import minnaert, oren_nayar, phong

from scan2albedo.core import PointLight
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.harmonics import harmonics, harmonics_gradient, project_environment
from scan2albedo.lighting.shading import Reflectance, light_from_direction, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap
from stability_cases.case import Cases, assert_finite

CASES = Cases()
STAGE = "lighting"
UP = (0.0, 0.0, 1.0)


def _angles(count: int = 2001) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cosines n.l, n.v and l.v of random directions, the last eight at poles and grazing."""
    rng = np.random.default_rng(0)
    n, light, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(3, count, 3)))
    n_l, n_v, l_v = ((a * b).sum(1) for a, b in ((n, light), (n, view), (light, view)))
    grazing = np.cos(np.deg2rad([0, 89.99, 90, 90.01, 180, 89.99, 90, 180]))
    n_l[-8:], n_v[-8:], l_v[-8:] = grazing, grazing[::-1], 0.5
    return n_l, n_v, l_v


@cache
def _sphere(radius_mm: float = 80.0, offset_mm: float = 0.0) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Vertices, normals and faces of a sphere."""
    import trimesh

    ball = trimesh.creation.icosphere(4)
    normal = np.asarray(ball.vertices, np.float64)
    return radius_mm * normal + offset_mm, normal, np.asarray(ball.faces)


@CASES.extreme(STAGE, "roughness 0 and 1e-6")
def _smooth() -> str:
    n_l, n_v, l_v = _angles()
    exact = np.maximum(n_l, 0)
    assert np.array_equal(oren_nayar(n_l, n_v, l_v, 0.0), exact)
    error = np.abs(oren_nayar(n_l, n_v, l_v, 1e-6) - exact).max()
    assert error < 1e-9
    return f"Lambert, bit for bit at 0; within {error:.1e} at 1e-6"


@CASES.extreme(STAGE, "roughness 1 and 1e3")
def _rough() -> str:
    n_l, n_v, l_v = _angles()
    peaks = []
    for sigma in (1.0, 1e3):
        factor = oren_nayar(n_l, n_v, l_v, sigma)
        assert_finite(factor)
        assert factor.min() >= 0
        peaks.append(factor.max())
    assert max(peaks) <= 1.0
    return f"finite, 0 to {max(peaks):.2f}: no more light than falls on it"


@CASES.extreme(STAGE, "Phong exponents 0.1, 1, 1e4")
def _exponents() -> str:
    angle = np.deg2rad(np.linspace(0, 90, 901))
    halves = []
    for exponent in (0.1, 1.0, 1e4):
        lobe = phong(np.ones(901), np.cos(angle), np.cos(angle), exponent)
        assert_finite(lobe)
        assert lobe[0] == 1
        assert np.all(np.diff(lobe) <= 0)
        width = math.degrees(math.acos(0.5 ** (1 / exponent)))
        here = float(np.rad2deg(angle)[lobe >= 0.5].max())
        assert abs(here - width) < 0.11
        halves.append(here)
    return "half width " + ", ".join(f"{h:.1f}" for h in halves) + " degrees, as 0.5^(1/m) has it"


@CASES.extreme(STAGE, "Minnaert exponents 0.1 and 1e4")
def _minnaert() -> str:
    n_l, n_v, _ = _angles()
    for exponent in (0.1, 1e4):
        factor = minnaert(n_l, n_v, exponent)
        assert_finite(factor)
        assert np.all(factor[n_l <= 0] == 0)
    return "finite and dark behind"


@CASES.extreme(STAGE, "light at 89.99, 90 and 90.01 degrees")
def _grazing() -> str:
    light = []
    for angle in (89.99, 90.0, 90.01):
        shading = shade_points(
            [[0, 0, 0]],
            [UP],
            [PointLight(math.radians(angle), 0.0)],
            Reflectance(roughness=0.3, specular_strength=1.0),
        )
        assert_finite(shading.light, shading.specular)
        light.append(shading.light[0] - 1)
    assert 0 < light[0] < 3e-4
    assert light[2] == 0
    assert abs(light[1]) < 1e-15
    return f"diffuse {light[0]:.1e}, {light[1]:.0e}, {light[2]:.0f}"


@CASES.extreme(STAGE, "light at the poles (elevation +-90)")
def _poles() -> str:
    worst = 0.0
    for sign in (1, -1):
        for azimuth in (0.0, 1.0, -3.0):
            light = PointLight(azimuth, sign * math.pi / 2)
            again = light_from_direction(light.direction, math.inf, 1.0)
            worst = max(worst, float(np.abs(again.direction - [0, sign, 0]).max()))
    assert worst < 1e-15
    return f"one direction whatever the azimuth, within {worst:.0e}"


@CASES.extreme(STAGE, "lamp at 1 mm, inside the head")
def _inside() -> str:
    position, normal, _ = _sphere()
    shading = shade_points(position, normal, [PointLight(0.3, 0.2, 1.0, 1.0)], Reflectance(roughness=0.3))
    assert_finite(shading.light)
    assert np.all(shading.light == 1)
    return "every point faces away: ambient light alone"


@CASES.extreme(STAGE, "lamp at 1e9 mm")
def _distant() -> str:
    position, normal, faces = _sphere()
    reflectance = Reflectance(roughness=0.3, specular_strength=0.2)
    far, distant = (
        shade_points(position, normal, [PointLight(0.3, 0.2, distance)], reflectance)
        for distance in (1e9, math.inf)
    )
    shadows = ShadowMap(RayCaster(position, faces), position, normal)
    seen = [shadows.visible(PointLight(0.3, 0.2).direction, distance) for distance in (1e9, math.inf)]
    error = float(np.abs(far.light - distant.light).max())
    assert error < 1e-6
    assert np.mean(seen[0] != seen[1]) < 1e-3
    return (
        f"as a distant one: light within {error:.0e}, shadows differ at {(seen[0] != seen[1]).sum()} points"
    )


@CASES.extreme(STAGE, "lamp on the surface itself")
def _touching() -> str:
    position, normal, _ = _sphere()
    shading = shade_points(
        position,
        normal,
        [PointLight(math.atan2(normal[0, 0], normal[0, 2]), math.asin(normal[0, 1]), 80.0)],
        Reflectance(specular_strength=1.0),
    )
    assert_finite(shading.light, shading.specular)
    return f"finite, at most {shading.light.max():.1e}"


@CASES.extreme(STAGE, "lamp at distance 0", "named error")
def _no_distance() -> str:
    return str(shade_points([[0, 0, 1]], [UP], [PointLight(0.0, 0.0, 0.0)], Reflectance()).light)


@CASES.extreme(STAGE, "lamp at -100 mm", "named error")
def _negative_distance() -> str:
    return str(shade_points([[0, 0, 1]], [UP], [PointLight(0.0, 0.0, -100.0)], Reflectance()).light)


@CASES.extreme(STAGE, "intensity NaN", "named error")
def _no_intensity() -> str:
    return str(shade_points([[0, 0, 1]], [UP], [PointLight(0.0, 0.0, 100.0, math.nan)], Reflectance()).light)


@CASES.extreme(STAGE, "azimuth NaN", "named error")
def _no_azimuth() -> str:
    return str(PointLight(math.nan, 0.0).direction)


@CASES.extreme(STAGE, "intensity -1", "named error")
def _dark_lamp() -> str:
    return str(shade_points([[0, 0, 1]], [UP], [PointLight(0.0, 0.0, 100.0, -1.0)], Reflectance()).light)


@CASES.extreme(STAGE, "intensity 0, 1e-12 and 1e12")
def _intensities() -> str:
    position, normal, _ = _sphere()
    light = PointLight(0.3, 0.2, 500.0, 1.0)
    unit = shade_points(position, normal, [light], Reflectance(roughness=0.3)).light - 1
    worst = 0.0
    for intensity in (0.0, 1e-12, 1e12):
        lit = shade_points(
            position, normal, [replace(light, intensity=intensity)], Reflectance(roughness=0.3)
        )
        worst = max(worst, float(np.abs(lit.light - 1 - intensity * unit).max() / max(intensity, 1)))
    assert worst < 1e-12
    return f"linear within {worst:.0e}"


@CASES.extreme(STAGE, "no lamp")
def _no_lamp() -> str:
    shading = shade_points([[0, 0, 1]], [UP], [], Reflectance(specular_strength=1.0))
    assert shading.light[0] == 1
    assert shading.specular[0] == 0
    return "ambient light alone: 1"


@CASES.extreme(STAGE, "five lamps, two of them at one place")
def _five() -> str:
    position, normal, _ = _sphere()
    lamps = [PointLight(a, 0.1 * a, 400.0, 1 + a) for a in (0.0, 0.5, -0.5, 1.5)]
    lamps.append(lamps[0])
    reflectance = Reflectance(roughness=0.3, specular_strength=0.3)
    together = shade_points(position, normal, lamps, reflectance)
    alone = [shade_points(position, normal, [lamp], reflectance) for lamp in lamps]
    error = np.abs(together.light - 1 - sum(one.light - 1 for one in alone)).max()
    assert error < 1e-12
    return f"the sum of each alone within {error:.0e}"


@CASES.extreme(STAGE, "specular strength 0 and 1e3")
def _strengths() -> str:
    position, normal, _ = _sphere()
    lamp = [PointLight(0.3, 0.2)]
    none, unit, strong = (
        shade_points(position, normal, lamp, Reflectance(specular_strength=s)).specular for s in (0, 1, 1e3)
    )
    assert not none.any()
    error = np.abs(strong - 1e3 * unit).max() / 1e3
    assert error < 1e-12
    return f"0 and 1000 times the highlight, within {error:.0e}"


for _name, _spoilt in (
    ("roughness NaN", {"roughness": math.nan}),
    ("roughness -0.1", {"roughness": -0.1}),
    ("exponent NaN", {"exponent": math.nan}),
    ("exponent -1", {"exponent": -1.0}),
    ("specular strength NaN", {"specular_strength": math.nan}),
    ("specular strength -1", {"specular_strength": -1.0}),
):

    @CASES.extreme(STAGE, _name, "named error")
    def _impossible(spoilt: dict[str, float] = _spoilt) -> str:
        return str(shade_points([[0, 0, 1]], [UP], [PointLight(0.3, 0.0)], Reflectance(**spoilt)).light)


@CASES.extreme(STAGE, "view direction zero", "named error")
def _no_view() -> str:
    shading = shade_points(
        [[0, 0, 1]], [UP], [PointLight(0.3, 0.0)], Reflectance(roughness=0.3), view_direction=(0, 0, 0)
    )
    return str(shading.light)


@CASES.extreme(STAGE, "normals zero")
def _zero_normals() -> str:
    shading = shade_points(
        np.zeros((4, 3)), np.zeros((4, 3)), [PointLight(0.3, 0.0)], Reflectance("minnaert", 0.5, 1.0)
    )
    assert np.all(shading.light == 1)
    assert not shading.specular.any()
    return "ambient light alone"


@CASES.extreme(STAGE, "normals NaN", "named error")
def _nan_normals() -> str:
    normal = np.tile(UP, (4, 1))
    normal[2] = np.nan
    return str(
        shade_points(np.zeros((4, 3)), normal, [PointLight(0.3, 0.0)], Reflectance(roughness=0.3)).light
    )


@CASES.extreme(STAGE, "normals flipped")
def _flipped() -> str:
    position, normal, _ = _sphere()
    lamp = [PointLight(0.3, 0.2)]
    flipped, facing = (shade_points(position, sign * normal, lamp, Reflectance()).light for sign in (-1, 1))
    assert np.array_equal(flipped > 1, normal @ lamp[0].direction < 0)
    return (
        f"the other side is lit, {100 * np.mean((flipped > 1) & (facing > 1)):.0f} % of the points both ways"
    )


@CASES.extreme(STAGE, "no point")
def _no_point() -> str:
    none = np.zeros((0, 3))
    assert shade_points(none, none, [PointLight(0.3, 0.0)], Reflectance()).light.shape == (0,)
    return "no light"


@CASES.extreme(STAGE, "fewer normals than points", "named error")
def _too_few_normals() -> str:
    return str(
        shade_points(np.zeros((500, 3)), np.tile(UP, (4, 1)), [PointLight(0.3, 0.0)], Reflectance()).light
    )


@CASES.extreme(STAGE, "visibility of another number of lamps", "named error")
def _wrong_visibility() -> str:
    visible = np.ones((1, 4), np.uint8)
    lamps = [PointLight(0.3, 0.0), PointLight(0.1, 0.0)]
    return str(
        shade_points(np.zeros((4, 3)), np.tile(UP, (4, 1)), lamps, Reflectance(), visible=visible).light
    )


def _shadow_share(radius_mm: float, offset_mm: float, lamp: PointLight) -> float:
    """Return the part of a sphere's points that are seen wrongly, 6 degrees about the terminator left out."""
    position, normal, faces = _sphere(radius_mm, offset_mm)
    seen = ShadowMap(RayCaster(position, faces), position, normal).visible(lamp.direction)
    cosine = normal @ lamp.direction
    clear = np.abs(cosine) > math.sin(math.radians(6))
    return float(np.mean((seen > 0)[clear] != (cosine > 0)[clear]))


for _name, _radius, _offset in (
    ("head in micrometres", 8e4, 0.0),
    ("head in kilometres", 8e-5, 0.0),
    ("head 1e6 mm off the origin", 80.0, 1e6),
    ("head 1e7 mm off the origin", 80.0, 1e7),
):

    @CASES.extreme(STAGE, f"shadow map, {_name}")
    def _shadow_units(radius: float = _radius, offset: float = _offset) -> str:
        share = _shadow_share(radius, offset, PointLight(0.4, 0.3))
        assert share == 0
        return f"{100 * share:.1f} % of a ball's points wrong, 6 degrees about the terminator left out"


@CASES.extreme(STAGE, "shadow map, the surface itself twice (coincident)")
def _coincident() -> str:
    position, normal, faces = _sphere()
    lamp = PointLight(0.4, 0.3)
    twice = RayCaster(np.vstack([position, position]), np.vstack([faces, faces + len(position)]))
    seen = ShadowMap(twice, position, normal).visible(lamp.direction)
    once = ShadowMap(RayCaster(position, faces), position, normal).visible(lamp.direction)
    assert np.array_equal(seen, once)
    return "as once"


@CASES.extreme(STAGE, "shadow map, light along the surface")
def _along() -> str:
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-50, 50, 41), np.linspace(-50, 50, 41)))
    flat = np.stack([x, y, 0 * x], 1)
    i = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    faces = np.vstack([np.stack([i, i + 1, i + 41], 1), np.stack([i + 1, i + 42, i + 41], 1)])
    shadows = ShadowMap(RayCaster(flat, faces), flat, np.tile(UP, (len(flat), 1)))
    counts = [
        int(shadows.visible(PointLight(math.radians(a), 0.0).direction).sum()) for a in (89.99, 90.01, 180.0)
    ]
    assert counts == [len(flat), 0, 0]
    return f"visible at 89.99, 90.01, 180 degrees: {counts} of {len(flat)}"


@CASES.extreme(STAGE, "shadow map, caster without a vertex", "named error")
def _no_caster() -> str:
    return str(RayCaster(np.zeros((0, 3)), np.zeros((0, 3), int)).size)


@CASES.extreme(STAGE, "shadow map, caster with NaN", "named error")
def _nan_caster() -> str:
    position, normal, faces = _sphere()
    spoilt = position.copy()
    spoilt[3] = np.nan
    return str(ShadowMap(RayCaster(spoilt, faces), position, normal).visible(UP).sum())


@CASES.extreme(STAGE, "shadow map, faces beyond the vertices", "named error")
def _wild_faces() -> str:
    position, normal, faces = _sphere()
    return str(ShadowMap(RayCaster(position, faces + 10**6), position, normal).visible(UP).sum())


@CASES.extreme(STAGE, "shadow map, one point as a mesh")
def _point_mesh() -> str:
    caster = RayCaster(np.ones((3, 3)), [[0, 1, 2]])
    seen = ShadowMap(caster, np.zeros((1, 3)), np.array([UP])).visible(UP)
    assert seen[0] == 1
    return "hides nothing"


@CASES.extreme(STAGE, "environment black")
def _black_environment() -> str:
    weights = np.asarray(DistantLights.from_environment(np.zeros((4, 8, 3))).irradiance_linear)
    assert not weights.any()
    assert not project_environment(np.zeros((4, 8, 3))).any()
    return "no light"


@CASES.extreme(STAGE, "environment of 1 pixel")
def _one_pixel() -> str:
    weights = np.asarray(DistantLights.from_environment(np.ones((1, 1, 3))).irradiance_linear)
    error = abs(weights[:, 0].sum() / (4 * math.pi) - 1)
    assert error < 1e-9
    return f"the whole sphere of light, within {error:.0e}"


@CASES.extreme(STAGE, "environment HDR 1e6 in one texel")
def _sun() -> str:
    sky = np.full((16, 32, 3), 0.1)
    sky[3, 20] = 1e6
    lights = DistantLights.from_environment(sky, 64)
    weights = np.asarray(lights.irradiance_linear)
    rows = (np.cos(3 * math.pi / 16) - np.cos(4 * math.pi / 16)) * 2 * math.pi / 32
    expected = 1e6 * rows + 0.1 * (4 * math.pi - rows)
    error = abs(weights[:, 0].sum() / expected - 1)
    assert error < 1e-9
    assert_finite(project_environment(sky))
    return f"all of its light kept, within {error:.0e}"


@CASES.extreme(STAGE, "environment with NaN", "named error")
def _nan_environment() -> str:
    sky = np.ones((4, 8, 3))
    sky[2, 2] = np.nan
    return str(DistantLights.from_environment(sky))


@CASES.extreme(STAGE, "environment negative")
def _negative_environment() -> str:
    sky = np.random.default_rng(0).random((4, 8, 3))
    some, none = (
        np.asarray(DistantLights.from_environment(sign * sky).irradiance_linear) for sign in (1, -1)
    )
    assert np.array_equal(some, -none)
    return "linear: minus the light of the map turned round, as models of light need it"


@CASES.extreme(STAGE, "spherical harmonics at the poles")
def _harmonic_poles() -> str:
    poles = np.concatenate([np.eye(3), -np.eye(3)])
    values, slopes = harmonics(poles), harmonics_gradient(poles)
    assert_finite(values, slopes)
    error = np.abs((values**2).sum(1) - 81 / (4 * math.pi)).max()
    assert error < 1e-12
    return f"sum of squares (l+1)^2/4pi within {error:.0e}"
