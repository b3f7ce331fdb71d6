"""Derivatives of light and highlights by the lamps' parameters against central differences."""

import numpy as np
import pytest

from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.geometry.mesh import normalized
from scan2albedo.lighting.shading import FreeLamps, LitPoints, shade_with_derivatives

RADIUS_MM = 80.0
VIEW = normalized(np.array([0.1, -0.2, 1.0]))
DIRECTIONS = normalized(np.array([[0.5, 0.2, 0.8], [-0.7, 0.4, 0.5], [0.1, -0.9, 0.4]]))
INTENSITIES = np.array([2.0, 0.7, 1.3])
STEP = 1e-5
VALUES = {"near": 0.2, "rough": 0.5, "specular": (0.3, np.log(12.0))}

BRDFS = pytest.mark.parametrize("brdf", ["oren-nayar", "minnaert"])


def _model(lights, brdf, near=True, rough=True, specular=True):
    parts = {"near": near, "rough": rough, "specular": specular}
    model = LightModel(lights, brdf, tuple(VIEW), RADIUS_MM, frozenset(filter(parts.get, parts)))
    x = model.from_lights(DIRECTIONS[:lights], INTENSITIES[:lights])
    for part, place in model.slices.items():
        x[place] = VALUES[part]
    return model, x


def _points():
    count = 400
    rng = np.random.default_rng(3)
    normal = normalized(rng.standard_normal((count, 3)))
    scale = rng.uniform(0.5, 2, count)
    # Every other point is seen from elsewhere.
    view = np.where(np.arange(count)[:, None] % 2, VIEW, normalized(VIEW + [0.6, -0.2, 0.0]))
    return RADIUS_MM * normal, normal, scale, view


def _shade(model, x, points, visible=1, visible_slope=0):
    position, normal, scale, view = points
    count, found = len(position), model.decode(x)
    reached = np.zeros((model.lights, count), np.float32) + np.float32(visible)
    slope = np.zeros((model.lights, 2, count), np.float32) + np.float32(visible_slope)
    lit = LitPoints(position, normal, reached, slope, view, scale)
    lamps = FreeLamps(found.rows, model.tangents(x), model.radius_mm, model.has("near"))
    free = {"rough": model.has("rough"), "glossy": model.has("specular")}
    # One column too many, as for a model with more parameters than the lamps'.
    (parts, gloss), slopes = shade_with_derivatives(lit, lamps, found.reflectance, model.size + 1, **free)
    assert not slopes[..., -1].any()
    return 1 + parts.sum(0), gloss.sum(0), slopes[0, :, :-1].T, slopes[1, :, :-1].T


def _differences(model, x, points, visible_at=lambda x: 1, step_length=STEP):
    """Return (P, N) central differences of I and of I_s."""
    slopes = []
    for step in step_length * np.eye(model.size):
        ahead, behind = (_shade(model, y, points, visible_at(y))[:2] for y in (x + step, x - step))
        slopes.append((np.array(ahead) - behind) / (2 * step_length))
    return np.moveaxis(slopes, 1, 0)


def _away_from_kinks(model, x, points, margin=0.01):
    """Return the points where no maximum or clipping of the reflectance changes sides near x."""
    position, normal, _, view = points
    n_v = np.sum(normal * view, 1)
    smooth = np.abs(n_v) > margin
    for row in model.decode(x).rows:
        toward = normalized(row[:3] - row[3] * position)
        n_l, l_v = np.sum(normal * toward, 1), np.sum(toward * view, 1)
        cos_r = np.maximum(n_v, 0)
        for kink in (n_l, n_l - cos_r, l_v - n_l * cos_r, 2 * n_l * n_v - l_v):
            smooth &= np.abs(kink) > margin
    return tuple(part[smooth] for part in points)


@pytest.mark.parametrize("specular", [False, True])
@pytest.mark.parametrize("rough", [False, True])
@pytest.mark.parametrize("near", [False, True])
@BRDFS
def test_derivatives_equal_central_differences(brdf, near, rough, specular):
    model, x = _model(3, brdf, near, rough, specular)
    points = _away_from_kinks(model, x, _points())
    assert len(points[0]) > 200
    reached = np.random.default_rng(1).integers(0, 2, (3, len(points[0])), np.uint8)
    _, gloss, *slopes = _shade(model, x, points, reached)
    assert (gloss.max() > 0.1) == specular
    # Rounding of a difference over 2e-5 is some 1e-10; tangents are central differences themselves.
    for ours, expected in zip(slopes, _differences(model, x, points, lambda y: reached), strict=True):
        assert ours == pytest.approx(expected, rel=1e-5, abs=1e-7)


@BRDFS
def test_a_shadow_that_moves_with_the_light_enters_the_derivatives_by_direction(brdf):
    model, x = _model(2, brdf)
    points = _away_from_kinks(model, x, _points())
    rng = np.random.default_rng(0)
    # Visibility is float32: sixteenths and 2^-13 of them are exact in it.
    base = rng.integers(4, 12, (2, len(points[0]))) / 16
    base[0, ::5] = 0
    slope = rng.choice([-1, 1], (2, 2, len(points[0]))) / 16

    def visible_at(y):
        moved = (y - x)[:6].reshape(2, 3)[:, :2]
        return base + np.einsum("kq,kqn->kn", moved, slope)

    still, moving = _shade(model, x, points, base), _shade(model, x, points, base, slope)
    light, specular = _differences(model, x, points, visible_at, 2.0**-13)
    directions = [0, 1, 3, 4]
    assert moving[2][directions] == pytest.approx(light[directions], rel=1e-4, abs=1e-5)
    assert moving[3][directions] == pytest.approx(specular[directions], rel=1e-4, abs=1e-5)
    others = [2, *range(5, model.size)]
    assert np.array_equal(moving[2][others], still[2][others])
    assert np.abs(moving[2] - still[2])[directions].max() > 0.05


def test_roughness_and_highlight_have_derivatives_at_none_of_them():
    """Least squares frees these parts where they are nothing: a zero derivative would keep them there."""
    model, x = _model(1, "oren-nayar")
    x[3:6] = 0
    points = _away_from_kinks(model, x, _points())
    found = _shade(model, x, points)
    for j, of in ((3, 0), (4, 0), (5, 1)):
        moved = _shade(model, x + 1e-6 * np.eye(7)[j], points)[of]
        slope = found[2 + of][j]
        assert slope == pytest.approx((moved - found[of]) / 1e-6, rel=1e-4, abs=1e-4)
        assert np.abs(slope).max() > 0.1
    assert np.all(np.isfinite(found[3]))
