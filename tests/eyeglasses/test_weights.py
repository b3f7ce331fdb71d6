import numpy as np
import pytest
from helpers.eyeglasses import volume
from helpers.measures import rms, row_lengths

import scan2albedo as s2a
from scan2albedo.eyeglasses import bounded_biharmonic_weights, solve_weights


def moved(weights, glasses):
    """Vertices with the temples spread and drooping and the bridge pushed back."""
    shift = np.zeros((7, 3))
    shift[:2] = [[-8, -3, 0], [-4, -1, 0]]
    shift[3] = [0, 0, -2]
    shift[:4:-1] = shift[:2] * [-1, 1, 1]
    return glasses.vertices + weights @ shift


def test_the_solver_says_how_it_ended(solved, glasses):
    assert solved.converged
    assert np.abs(solved.weights.sum(1) - 1).max() <= 1e-12
    assert solved.weights.min() >= 0
    assert solved.residual.max() <= 1e-7
    assert solved.spacing == 3.0
    assert solved.iterations.shape == (len(glasses.handles),)
    assert len(solved.trace) >= solved.iterations.sum()
    assert solved.trace.rows[-1].error <= 1e-7
    assert {row.stage for row in solved.trace} == {"eyeglasses.weights"}
    stages = [step.stage.removeprefix("eyeglasses.weights.") for step in solved.plan]
    assert stages == ["spacing", "rigid_parts", "shared_handles"]


def test_key_points_hold_what_lies_at_them(glasses):
    """A vertex at a key point follows it alone, wherever in its cell it lies."""
    chosen = np.linspace(0, len(glasses.vertices) - 1, 9).astype(int)[1:-1]
    weights = bounded_biharmonic_weights(glasses.vertices, glasses.faces, glasses.vertices[chosen], 2.5)
    np.testing.assert_allclose(weights[chosen], np.eye(7), atol=1e-15)


@pytest.mark.parametrize("automatic", [True, False])
@pytest.mark.parametrize("scale", [1e-3, 1e3], ids=["m", "um"])
def test_units_do_not_matter(glasses, scale, automatic):
    def weights(factor):
        spacing = "auto" if automatic else 2.5 * factor
        return bounded_biharmonic_weights(
            factor * glasses.vertices, glasses.faces, factor * glasses.handles, spacing
        )

    assert np.abs(weights(scale) - weights(1.0)).max() <= 1e-9


def test_the_order_does_not_matter(glasses, solved):
    rng = np.random.default_rng(0)
    points, faces = rng.permutation(len(glasses.handles)), rng.permutation(glasses.faces)
    weights = bounded_biharmonic_weights(glasses.vertices, faces, glasses.handles[points], 3.0)
    assert np.abs(weights - solved.weights[:, points]).max() <= 1e-12


def test_weights_fall_from_one_key_point_to_the_next(glasses, solved):
    """Along the temple, between the first two key points, everything belongs to these and their next."""
    temple = (glasses.vertices[:, 0] < -60) & (np.abs(glasses.vertices[:, 2] + 90) < 25)
    own = solved.weights[temple][:, :2]
    assert own.sum(1).min() > 0.8
    fall = own[np.argsort(glasses.vertices[temple, 2]), 0]
    assert np.corrcoef(fall, np.arange(len(fall)))[0, 1] < -0.95


def test_deformations_agree_across_spacings(glasses, solved):
    """Weights change with the lattice; what they do to the frame hardly does."""
    coarse, fine = (bounded_biharmonic_weights(**vars(glasses), spacing=spacing) for spacing in (3.3, 1.7))
    for weights in (coarse, solved.weights):
        apart = row_lengths(moved(weights, glasses) - moved(fine, glasses))
        assert apart.max() <= 0.6
        assert rms(apart) <= 0.25


def test_nothing_tears_and_nothing_collapses(glasses, solved):
    after = moved(solved.weights, glasses)
    corners = (vertices[glasses.faces] for vertices in (glasses.vertices, after))
    short, long = (row_lengths(corner - np.roll(corner, 1, 1)) for corner in corners)
    assert (long / short).max() < 1.35
    assert (long / short).min() > 0.75
    assert volume(after, glasses.faces) == pytest.approx(volume(glasses.vertices, glasses.faces), rel=0.02)


def test_a_budget_ends_with_usable_weights(glasses, solved):
    seen = []
    limits = {"budget": s2a.Budget(evaluations=3), "on_progress": seen.append}
    cut = solve_weights(**vars(glasses), spacing=3.0, **limits)
    assert not cut.converged
    assert len(seen) == len(cut.trace) <= 5
    assert np.abs(cut.weights.sum(1) - 1).max() <= 1e-12
    assert row_lengths(moved(cut.weights - solved.weights, glasses) - glasses.vertices).max() < 3


def test_the_automatic_spacing_is_said_aloud(glasses):
    found = solve_weights(**vars(glasses))
    step = found.plan[0]
    assert step.reason.startswith("the mesh's thin parts measure 3.")
    assert float(step.evidence) == pytest.approx(found.spacing, rel=1e-4)
    close = np.vstack([glasses.handles, [0, 0, 3.0]])
    found = solve_weights(glasses.vertices, glasses.faces, close)
    assert found.plan[0].reason == "two key points are close together"
    assert found.spacing <= 1.5
    few = solve_weights(**vars(glasses), max_nodes=600)
    assert few.plan[0].reason == "finer ones have more than 600 nodes"
    assert few.node_count <= 600
