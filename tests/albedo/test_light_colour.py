"""Colours of the light on a ball of skin: found where there are any, white where there are none."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import nnls

from scan2albedo.albedo.light_colour import LightColours, solve_colours

SIZE = 64
SKIN = np.array([0.55, 0.33, 0.24])
MELANIN, BLOOD = np.array([0.6, 1.0, 1.5]), np.array([0.15, 1.0, 0.7])
WARM, BLUE, WHITE = np.array([1.35, 1.0, 0.65]), np.array([0.8, 1.0, 1.2]), np.ones(3)


@dataclass(frozen=True)
class Ball:
    """Cells of half a ball: ambient light, light from above, and two lamps; blocks of 16 cells a side."""

    columns: np.ndarray
    blocks: np.ndarray
    albedo: np.ndarray

    @property
    def weight(self):
        return 1 / self.albedo.max(1)

    def texture(self, colors, noise=0.0, seed=0):
        """Return (N, 3) the albedo in light of these intensities (K, 3)."""
        lit = self.albedo * (self.columns @ colors)
        return np.maximum(lit + noise * np.random.default_rng(seed).normal(size=lit.shape), 0)

    def white(self, rgb):
        """Return (K,) the intensities that explain V of a texture, the true albedo's V given."""
        return nnls(self.columns * self.albedo.max(1)[:, None], rgb.max(1))[0]

    def solve(self, rgb, intensities=None, **options) -> LightColours:
        x = self.white(rgb) if intensities is None else intensities
        nothing = np.zeros(len(rgb))
        weight = 1 / np.hypot(rgb.max(1), 0.3 * np.median(rgb))
        return solve_colours(self.columns, x, rgb, nothing, weight, self.blocks, **options)


def ball(seed=0, *, skin=SKIN, pigment=1.0):
    y, x = (np.mgrid[0:SIZE, 0:SIZE] + 0.5) / SIZE * 2 - 1
    inside = x**2 + y**2 < 0.9
    normal = np.stack([x, -y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], -1)[inside]
    toward = np.array([[0.8, 0.2, 0.56], [-0.7, 0.1, 0.7]])
    lamps = np.maximum(normal @ toward.T, 0)
    columns = np.column_stack([np.ones(len(normal)), normal[:, 1], lamps])
    row, column = np.nonzero(inside)
    blocks = [((row + s) // 16) * 100 + (column + t) // 16 for s in (0, 8) for t in (0, 8)]
    blocks = np.stack([1_000_000 * k + block for k, block in enumerate(blocks)])
    rng = np.random.default_rng(seed)
    fields = []
    for _ in range(2):
        patches = sum(gaussian_filter(rng.normal(size=(SIZE, SIZE)), s) * s for s in (1, 3, 8, 16))
        fields.append(0.12 * pigment * (patches / patches.std())[inside])
    albedo = skin * np.exp(-fields[0][:, None] * MELANIN - fields[1][:, None] * BLOOD)
    return Ball(columns, np.unique(blocks, return_inverse=True)[1].reshape(blocks.shape), albedo)


def chroma_error(ball, rgb, light):
    """Return the standard deviation of the log ratios of red and of blue to green of the albedo."""
    ratio = np.log(np.maximum(rgb / light, 1e-6)) - np.log(ball.albedo)
    return float((ratio[:, [0, 2]] - ratio[:, [1]]).std(0).max())


def lights(ambient=WHITE, above=WHITE, left=WHITE, right=WHITE):
    return np.stack([0.6 * ambient, 0.2 * above, 2.0 * left, 0.8 * right])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("pigment", "left"), [(0.3, 0.25), (1.0, 0.5)])
def test_a_warm_lamp_in_a_blue_room_is_told_from_skin(seed, pigment, left):
    scene = ball(seed, pigment=pigment)
    rgb = scene.texture(lights(ambient=BLUE, left=WARM), 0.005, seed)
    found = scene.solve(rgb)
    assert found.step.ran
    assert found.step.stage == "albedo.light_colour"
    white = np.repeat((scene.columns @ scene.white(rgb))[:, None], 3, 1)
    before = chroma_error(scene, rgb, white)
    after = chroma_error(scene, rgb, scene.columns @ found.intensities)
    assert after < left * before


def test_without_pigment_the_colours_are_right_but_for_the_tint_of_all_light():
    scene, true = ball(pigment=0.0), lights(ambient=BLUE, left=WARM)
    found = scene.solve(scene.texture(true))
    ours, truth = found.intensities / found.intensities[0], true / true[0]
    assert ours == pytest.approx(truth, rel=0.03)


def test_coloured_light_on_grey_skin_leaves_it_grey():
    scene = ball(skin=np.full(3, 0.4), pigment=0.0)
    rgb = scene.texture(lights(ambient=BLUE, left=WARM, right=BLUE), 0.002)
    found = scene.solve(rgb)
    assert found.step.ran
    albedo = rgb / (scene.columns @ found.intensities)
    ratio = albedo / albedo.mean(1, keepdims=True)
    assert (ratio.std(0) < 0.02).all()
    assert ((rgb / rgb.mean(1, keepdims=True)).std(0).max()) > 0.08


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.01])
def test_grey_texture_in_white_light_is_left_exactly_white(noise):
    scene = ball(skin=np.full(3, 0.4), pigment=0.0)
    rgb = scene.texture(lights(), noise)
    found = scene.solve(rgb)
    assert not found.step.ran
    assert (found.colors == 1).all()
    assert np.array_equal(found.intensities, np.repeat(scene.white(rgb)[:, None], 3, 1))


def test_white_light_on_pigmented_skin_stays_white():
    steps = [ball(seed).solve(ball(seed).texture(lights(), 0.005, seed)).step for seed in range(40)]
    assert sum(step.ran for step in steps) <= 2


def test_the_mean_light_is_white_and_lamps_do_not_take_light_away():
    scene = ball(1)
    rgb = scene.texture(lights(ambient=BLUE, left=WARM, right=np.array([2.5, 0.5, 0.0])))
    found = scene.solve(rgb)
    mean = (scene.columns @ found.intensities).mean(0)
    assert mean == pytest.approx(np.full(3, (scene.columns @ scene.white(rgb)).mean()), rel=1e-6)
    assert found.intensities[[0, 2, 3]].min() >= 0
    assert found.intensities[2] == pytest.approx(found.colors[2] * scene.white(rgb)[2])


def test_a_white_highlight_that_is_known_does_not_count():
    scene = ball(2)
    rgb = scene.texture(lights(ambient=BLUE, left=WARM))
    gloss = 0.3 * scene.columns[:, 3] ** 30
    weight = 1 / np.hypot(rgb.max(1), 0.1)
    given = scene.columns, scene.white(rgb)
    plain = solve_colours(*given, rgb, 0 * gloss, weight, scene.blocks)
    glossy = solve_colours(*given, rgb + gloss[:, None], gloss, weight, scene.blocks)
    assert glossy.intensities == pytest.approx(plain.intensities, rel=1e-6)


def test_the_unit_of_the_texture_does_not_matter():
    scene = ball(3)
    rgb = scene.texture(lights(ambient=BLUE, left=WARM))
    x, weight, nothing = scene.white(rgb), 1 / np.hypot(rgb.max(1), 0.1), np.zeros(len(rgb))
    one = solve_colours(scene.columns, x, rgb, nothing, weight, scene.blocks)
    other = solve_colours(scene.columns, x, 7 * rgb, nothing, weight / 7, scene.blocks)
    assert other.intensities == pytest.approx(one.intensities, rel=1e-9)


def test_the_caller_decides():
    scene = ball(0)
    colored, white = scene.texture(lights(ambient=BLUE, left=WARM)), scene.texture(lights())
    left_out = scene.solve(colored, choice=False)
    assert (left_out.step.ran, left_out.step.reason) == (False, "left out by the caller")
    assert (left_out.colors == 1).all()
    forced = scene.solve(white, choice=True)
    assert (forced.step.ran, forced.step.reason) == (True, "asked for")
    assert forced.intensities[2] == pytest.approx(scene.white(white)[2] * WHITE, rel=0.15)


@pytest.mark.parametrize("rgb", [np.zeros((4, 3)), np.ones((4, 3))])
def test_too_few_or_black_cells_are_white(rgb):
    columns = np.ones((4, 3))
    found = solve_colours(columns, np.ones(3), rgb, np.zeros(4), np.ones(4), np.zeros((1, 4), np.int32))
    assert not found.step.ran
    assert (found.intensities == 1).all()


def test_a_channel_without_light_stays_finite():
    scene = ball(0)
    rgb = scene.texture(lights()) * [1.0, 1.0, 0.0]
    for choice in (None, True):
        found = scene.solve(rgb, choice=choice)
        assert np.isfinite(found.intensities).all()
        assert np.isfinite(scene.columns @ found.intensities).all()
