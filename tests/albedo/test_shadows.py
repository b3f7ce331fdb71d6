"""Whether a surface shades itself is decided by rays."""

import re
from dataclasses import replace
from unittest.mock import create_autospec

import numpy as np
import pytest
from helpers.lit_scenes import GEOMETRIES
from helpers.meshes import grid

from scan2albedo.albedo import EstimateOptions, shadows
from scan2albedo.albedo.levels import build_level
from scan2albedo.albedo.light_parameters import LightModel
from scan2albedo.albedo.shaded_image import CONE_RAD
from scan2albedo.albedo.shadows import LEAST_SHADOW, Horizon, ShadowLattice, shadow_caster
from scan2albedo.core import Meter
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.environment_light import SKY
from scan2albedo.lighting.shadow_map import ShadowMap, cone_directions
from scan2albedo.synthetic import face

DIRECTIONS = cone_directions(60, (0, 0, 1), CONE_RAD)


def make_image(shape, size=64):
    return GeometryImage(*GEOMETRIES[shape](size), texture_linear=np.full((size, size, 3), 0.5, np.float32))


def _level(image, where=True):
    return build_level(image, image.mask & where, 32)


def _caster(image):
    return RayCaster(*image.occluder_mesh())


def _lattice(image, where=True):
    return ShadowLattice(_level(image, where), _caster(image))


def _at(model_x, model_y, nearness=0.0):
    """Return parameters of a lamp of unit strength."""
    return np.array([model_x, model_y, 0.0, nearness])


def _decide(image, directions=DIRECTIONS, **options):
    caster, step = shadow_caster(
        image, _level(image), directions, EstimateOptions(**options), Meter("albedo", "")
    )
    assert (caster is not None) == step.ran
    assert step.stage == "albedo.shadows"
    return caster, step


def _percent(step):
    return float(re.search(r"at most ([\d.]+) %", step.evidence)[1])


@pytest.mark.parametrize(
    ("shape", "least", "most"), [("hemisphere", -1, 100 * LEAST_SHADOW), ("bumps", 2, 50)]
)
def test_hills_shade_one_another_and_a_hemisphere_nothing(shape, least, most):
    image = make_image(shape)
    _, step = _decide(image)
    assert step.ran == (shape == "bumps")
    assert least < _percent(step) < most
    _, forced = _decide(image, force=("albedo.shadows",))
    assert (forced.ran, forced.reason, forced.evidence) == (True, "asked for", step.evidence)
    _, without = _decide(image, skip=("albedo.shadows",))
    assert (without.ran, without.reason) == (False, "left out by the caller")


def test_the_figure_is_that_of_the_worst_direction():
    image = make_image("bumps")
    each = [_percent(_decide(image, direction[None])[1]) for direction in DIRECTIONS[:30]]
    assert each[0] == 0
    assert _percent(_decide(image, DIRECTIONS[:30])[1]) == max(each) > 1


def test_the_fraction_that_has_to_lie_in_shadow_decides(monkeypatch):
    image = make_image("bumps")
    largest = _percent(_decide(image)[1]) / 100
    for part in (0.9, 1.1):
        monkeypatch.setattr(shadows, "LEAST_SHADOW", part * largest)
        assert _decide(image)[1].ran == (part < 1)


def test_an_occluder_beyond_the_chart_counts():
    image = make_image("hemisphere")
    corners, square = grid(2, 2)
    roof = corners[:, [2, 0, 1]] * [1, 120, 60] + [60, -60, 60]
    _, step = _decide(replace(image, occluder=join([image.triangulated(), (roof, square)])))
    assert step.ran


def test_a_surface_without_triangles_casts_none():
    image = make_image("hemisphere")
    lone = image.mask & (np.indices(image.shape) % 2 == 0).all(0)
    for force in ((), ("albedo.shadows",)):
        caster, step = _decide(replace(image, mask=lone), force=force)
        assert caster is None
        assert step.evidence == "0 faces"


@pytest.fixture(scope="module")
def lattice():
    return _lattice(make_image("bumps"))


MODEL = LightModel(1, "oren-nayar", (0.0, 0.0, 1.0), 100.0, frozenset({"near"}))


def test_visibility_is_continuous_in_direction_and_nearness(lattice):
    lamps = [[_at(0.7, 0.1, t) for t in np.linspace(0, 0.4, 401)]]
    lamps += [[_at(t, 0.1, 0.1) for t in np.linspace(0.5, 0.9, 401)]]
    # From one node to the next, 0.125 or 0.0625 apart, a cell goes from lit to hidden at most.
    for moved, spacing in zip(lamps, (0.125, 0.0625), strict=True):
        seen = np.array([lattice.visibility(MODEL, lamp)[0] for lamp in moved])
        assert np.abs(np.diff(seen, axis=0)).max() < 1.1 * 0.001 / spacing
        assert np.abs(seen[-1] - seen[0]).max() > 0.9


def test_visibility_has_the_derivatives_by_direction(lattice):
    x = _at(0.71, 0.13, 0.07)
    step = 1e-3
    slopes = lattice.visibility(MODEL, x)[1][0]
    for k, way in enumerate(step * np.eye(4)[:2]):
        ahead, behind = (lattice.visibility(MODEL, moved)[0][0] for moved in (x + way, x - way))
        assert slopes[k] == pytest.approx((ahead - behind) / (2 * step), abs=0.05)
    assert np.abs(slopes).max() > 1


def test_at_a_node_the_rays_of_one_node_serve(monkeypatch):
    lattice = _lattice(make_image("bumps"))
    traced = create_autospec(ShadowMap.reached, side_effect=ShadowMap.reached)
    monkeypatch.setattr(ShadowMap, "reached", traced)
    asked = np.array([[0.71, 0.13], [-0.73, 0.12]])
    nodes = lattice.nearest(asked)
    # Nodes are two of 32 cells apart.
    assert 0 < np.abs(nodes - asked).max() <= 0.5 * 2 / 32
    assert lattice.nearest(nodes) == pytest.approx(nodes, abs=1e-12)
    for number, node in enumerate(nodes, 1):
        seen, slopes = lattice.visibility(MODEL, _at(*node))
        assert traced.call_count == number
        assert traced.call_args.args[1] == pytest.approx(MODEL.direction(*node))
        assert set(np.unique(seen)) == {0, 1}
        assert not slopes.any()
    lattice.visibility(MODEL, _at(*nodes[0]), 0.05)
    assert traced.call_count == 2, "another blur traced again"
    lattice.visibility(MODEL, _at(*asked[0]))
    assert traced.call_count == 5


def test_blurred_outlines_are_means_over_the_cells_that_are_there():
    """Weights are normalised: the rim, beyond which nothing is known, is no darker."""
    blur = 0.05
    disc = np.hypot(*np.indices((64, 64)) - 31.5) < 28
    image = make_image("bumps")
    lattice, level = _lattice(image, disc), _level(image, disc)
    at = _at(*lattice.nearest(np.array([0.71, 0.13])))
    sharp, blurred = (lattice.visibility(MODEL, at, width)[0][0] for width in (0.0, blur))
    apart = np.linalg.norm(level.cell[:, None] - level.cell[None], axis=2)
    weight = np.exp(-0.5 * (apart / (blur * (level.cell.max() + 1))) ** 2)
    assert blurred == pytest.approx(weight @ sharp / weight.sum(1), abs=1e-4)
    assert ((blurred > 0.2) & (blurred < 0.8)).sum() > 10
    open_light = _lattice(make_image("hemisphere")).visibility(MODEL, np.zeros(4), blur)[0]
    assert open_light == pytest.approx(np.ones_like(open_light), abs=1e-5)


def test_nothing_is_hidden_where_nothing_casts_shadows():
    open_sky = ShadowLattice(_level(make_image("hemisphere")), None)
    seen, slopes = open_sky.visibility(MODEL, _at(0.5, 0.1, 0.2))
    assert np.all(seen == 1)
    assert not slopes.any()


@pytest.mark.parametrize("cells", [32, 64])
def test_nothing_is_hidden_above_the_horizon(cells):
    """On a face it spares most rays, and none of those that would have met something."""
    image = face(0, size=128).image
    level = build_level(image, image.mask, cells)
    exact = ShadowMap(_caster(image), level.anchor, level.normal)
    above = Horizon(level, exact.table(distant_directions(SKY))).at(level.center)
    cosine = level.normal @ DIRECTIONS.T
    seen, spared = exact.table(DIRECTIONS).visibility.T, cosine > above[:, None]
    assert seen[spared].all()
    assert spared.sum() > 0.5 * (cosine > 0).sum()
    assert (seen[cosine > 0] == 0).any()


def test_beyond_the_cells_no_horizon_is_known():
    image = make_image("bumps")
    level = _level(image, np.arange(64) < 40)
    exact = ShadowMap(_caster(image), level.anchor, level.normal)
    horizon = Horizon(level, exact.table(distant_directions(24)))
    assert np.isfinite(horizon.at(level.center)).all()
    assert np.isinf(horizon.at(np.array([[32, 60], [63, 63]]))).all()
