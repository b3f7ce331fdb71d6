"""The compiled normal equations against a dense NumPy reference of the same reweighted problem."""

import numpy as np
import pytest

from scan2albedo.albedo.normal_equations import block_albedos, cluster_scores, normal_equations

CELLS, PARAMETERS, BLOCKS, SOFTNESS = 300, 4, 13, 0.02


class Case:
    """A problem, smooth in the parameters x: I and I_s are quadratic in them."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        self.blocks = np.stack([rng.integers(0, 8, CELLS), rng.integers(8, BLOCKS, CELLS)]).astype(np.int32)
        self.base = rng.uniform(1.5, 3, CELLS)
        self.linear = rng.uniform(-1, 1, (PARAMETERS, CELLS))
        self.square = rng.uniform(-0.3, 0.3, (PARAMETERS, CELLS))
        self.gloss = rng.uniform(0, 0.1, (PARAMETERS, CELLS))
        self.x = rng.uniform(0.1, 0.4, PARAMETERS)
        albedo = rng.uniform(0.9, 1.1, CELLS)
        light, specular = self.shade(self.x + 0.05)
        self.value = albedo * light + specular
        self.weight = rng.uniform(0.2, 1, CELLS) / self.value
        self.robust = np.repeat(self.weight[None], 2, 0)
        self.albedo, self.mass = np.empty(BLOCKS), np.empty(BLOCKS)

    def shade(self, x):
        return self.base + x @ self.linear + x**2 @ self.square, x @ self.gloss

    def arguments(self, x):
        slope = self.linear + 2 * x[:, None] * self.square
        # The problem's buffers may have more rows than there are parameters.
        padded = [np.vstack([rows, np.full(CELLS, np.nan)]) for rows in (slope, self.gloss)]
        return (
            *(self.value, self.weight, *self.shade(x), *padded, self.blocks),
            *(self.robust, self.albedo, self.mass),
        )

    def converge(self, x):
        """Iterate the reweighting to its fixed point."""
        arguments = self.arguments(x)
        for _ in range(40):
            self.cost = block_albedos(*arguments[:4], arguments[6], SOFTNESS, *arguments[7:], 3)

    def equations(self, x):
        matrix, gradient = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
        self.converge(x)
        normal_equations(*self.arguments(x), matrix, gradient)
        return self.cost, matrix, gradient

    def reduced_cost(self, x):
        self.converge(x)
        return self.equations(x)[0]


@pytest.fixture
def case():
    case = Case()
    case.converge(case.x)
    return case


def _dense(case):
    """Return cost, weights (S N,), residuals, and the Jacobian (S N, P + B) of the prediction."""
    light, specular = case.shade(case.x)
    slope = case.linear + 2 * case.x[:, None] * case.square
    blocks = case.blocks.ravel()
    albedo = case.albedo[blocks]
    light, specular, value, weight = (
        np.tile(field, 2) for field in (light, specular, case.value, case.weight)
    )
    rest = value - specular - albedo * light
    spread = np.sqrt((weight * rest) ** 2 + SOFTNESS**2)
    by_light = np.tile(case.gloss, 2) + albedo * np.tile(slope, 2)
    by_albedo = light * (np.arange(BLOCKS)[:, None] == blocks)
    return np.sum(spread - SOFTNESS), weight**2 / spread, rest, np.vstack([by_light, by_albedo]).T


def test_cost_and_gradient_equal_the_dense_ones(case):
    cost, _, gradient = case.equations(case.x)
    expected, weights, rest, jacobian = _dense(case)
    assert cost == pytest.approx(expected, rel=1e-12)
    assert gradient == pytest.approx(-(jacobian.T @ (weights * rest))[:PARAMETERS], rel=1e-8)


def test_block_albedos_are_where_the_cost_is_least(case):
    _, weights, rest, jacobian = _dense(case)
    by_albedo = jacobian.T @ (weights * rest)
    scale = np.abs(jacobian).T @ (weights * np.abs(rest))
    assert np.abs(by_albedo / scale)[PARAMETERS:].max() < 1e-9


def test_matrix_is_the_schur_complement_of_the_full_one(case):
    matrix = case.equations(case.x)[1]
    _, weights, _, jacobian = _dense(case)
    full = jacobian.T @ (weights[:, None] * jacobian)
    p = PARAMETERS
    expected = full[:p, :p] - full[:p, p:] @ np.linalg.solve(full[p:, p:], full[p:, :p])
    assert matrix == pytest.approx(expected, rel=1e-7)
    assert np.array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0
    # The albedos' following takes away curvature, or the elimination did nothing.
    assert np.trace(matrix) < 0.98 * np.trace(full[:p, :p])


def test_gradient_is_the_slope_of_the_cost_with_the_albedos_following(case):
    gradient = case.equations(case.x)[2]
    step, slopes = 1e-5, []
    for j in range(PARAMETERS):
        ahead, behind = case.x.copy(), case.x.copy()
        ahead[j] += step
        behind[j] -= step
        slopes.append((case.reduced_cost(ahead) - case.reduced_cost(behind)) / (2 * step))
    assert np.abs(slopes).min() > 1
    assert gradient == pytest.approx(np.array(slopes), rel=1e-5)


def test_a_newton_step_lessens_the_cost(case):
    before, matrix, gradient = case.equations(case.x)
    after = case.reduced_cost(case.x - np.linalg.solve(matrix, gradient))
    assert after < 0.95 * before


def test_a_few_outliers_hardly_move_the_block_albedos(case):
    before = case.albedo.copy()
    light, specular = case.shade(case.x)
    plain = _mean_albedos(case, light, specular)
    case.value[::30] *= 4
    case.converge(case.x)
    robust = np.abs(case.albedo / before - 1).max()
    least_squares = np.abs(_mean_albedos(case, light, specular) / plain - 1).max()
    # One cell of 30 is four times as bright: the mean moves by 10 % and more, the robust one by its rank.
    assert least_squares > 0.1
    assert robust < 0.03
    assert robust < 0.2 * least_squares


def _mean_albedos(case, light, specular):
    means = []
    for b in range(BLOCKS):
        inside = np.any(case.blocks == b, 0)
        w = case.weight[inside] ** 2
        i = light[inside]
        means.append(np.sum(w * (case.value - specular)[inside] * i) / np.sum(w * i**2))
    return np.array(means)


def test_cells_without_weight_have_no_say(case):
    case.weight[::3] = 0
    before = case.reduced_cost(case.x), *case.equations(case.x)[1:]
    case.value[::3] = 50
    after = case.reduced_cost(case.x), *case.equations(case.x)[1:]
    for first, second in zip(before, after, strict=True):
        assert second == pytest.approx(first, rel=1e-9)


def test_blocks_without_weight_leave_everything_finite(case):
    case.weight[case.blocks[0] == 2] = 0
    case.converge(case.x)
    cost, matrix, gradient = case.equations(case.x)
    assert case.albedo[2] == 0
    assert np.isfinite(cost)
    assert np.isfinite(matrix).all()
    assert np.isfinite(gradient).all()


def test_albedos_are_never_negative(case):
    case.value[case.blocks[0] == 2] = 0
    case.gloss += 0.1
    case.converge(case.x)
    assert case.albedo.min() == case.albedo[2] == 0


def test_patches_share_out_the_gradient(case):
    gradient = case.equations(case.x)[2]
    clusters = np.arange(CELLS) // 40
    scores = np.empty((8, PARAMETERS))
    cluster_scores(*case.arguments(case.x), clusters, scores)
    assert scores.sum(0) == pytest.approx(gradient, rel=1e-6)
    _, weights, rest, jacobian = _dense(case)
    full = jacobian.T @ (weights[:, None] * jacobian)
    p = PARAMETERS
    follow = np.linalg.solve(full[p:, p:], full[p:, :p])
    each = (jacobian[:, :p] - jacobian[:, p:] @ follow) * (-weights * rest)[:, None]
    expected = np.stack([each[np.tile(clusters, 2) == c].sum(0) for c in range(8)])
    assert scores == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())
