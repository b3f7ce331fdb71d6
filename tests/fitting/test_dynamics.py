from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose
from scipy import sparse

from scan2albedo.errors import FitError
from scan2albedo.fitting.dynamics import ImplicitSystem, conjugate_gradients, factorized


def chain(count, stiffness):
    """Springs between neighbours and a weak one to the ground."""
    ones = np.ones(count)
    matrix = sparse.diags([-ones[1:], 2.01 * ones, -ones[1:]], [-1, 0, 1])
    return (stiffness * matrix).tocsr()


def implicit(stiffness, time_step, *, mass=1.0, damping=0.0, springs=0.0):
    ones = np.ones(stiffness.shape[0])
    held = springs * sparse.diags(ones).tocsr()
    return ImplicitSystem(ones * mass, ones * damping, stiffness, held, time_step)


class State(NamedTuple):
    q: np.ndarray
    velocity: np.ndarray


def states(system, q, steps, force=np.zeros_like, springs=np.zeros_like, **options):
    """Return the states from rest on; the force is one of the place, springs of a displacement."""
    found = [State(q, np.zeros_like(q))]
    for _ in range(steps):
        moved = system.step(*found[-1], force(found[-1].q), springs, **options)
        found.append(State(found[-1].q + moved, moved / system.time_step))
    return found


def energy(state, mass, stiffness):
    """(v^T M v + q^T K q) / 2, which no step without force can raise."""
    kinetic = np.sum(np.reshape(mass, (-1, 1)) * state.velocity**2)
    return (kinetic + np.sum(state.q * (stiffness @ state.q))) / 2


@pytest.mark.parametrize("stiffness", [1e-6, 1e-2, 1.0, 1e4, 1e8])
@pytest.mark.parametrize("time_step", [1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("mass", [1e-3, 1e3, np.where(np.arange(20) % 2, 1e-3, 1e3)])
def test_energy_never_grows_without_force(stiffness, time_step, mass):
    springs = chain(20, stiffness)
    system = implicit(springs, time_step, mass=mass, springs=0.5)
    start = np.random.default_rng(0).normal(size=(20, 3))
    energies = [energy(state, mass, springs) for state in states(system, start, 50)]
    assert (np.diff(energies) <= 1e-9 * energies[0]).all()


def test_small_steps_follow_the_exact_oscillator():
    system = implicit(sparse.csr_matrix([[4.0]]), 1e-4)
    assert_allclose(states(system, np.ones((1, 3)), 5000)[-1].q, np.cos(2 * 0.5), atol=2e-3)


@settings(max_examples=25, deadline=None)
@given(st.floats(-6, 8), st.floats(-3, 3))
def test_the_resting_place_is_where_stiffness_and_force_balance(log_stiffness, log_step):
    stiffness = chain(8, 10.0**log_stiffness)
    goal = np.random.default_rng(2).normal(size=(8, 3))
    system = implicit(stiffness, 10.0**log_step, springs=0.55, mass=1e-9, damping=1e-9)
    state = states(system, 0 * goal, 400, lambda q: goal - q, lambda x: x)[-1]
    expected = np.linalg.solve(stiffness.toarray() + np.eye(8), goal)
    assert_allclose(state.q, expected, atol=1e-3)


def test_springs_far_stiffer_than_the_preconditioner_knows_stay_stable():
    stiff = np.logspace(-3, 5, 30)[:, None]
    system = implicit(chain(30, 1e-6), 1e3, springs=1e-3, mass=1e-9)
    found = states(
        system, np.zeros((30, 3)), 60, lambda q: stiff * (1 - q), lambda x: stiff * x, iterations=2
    )
    energies = [np.sum(stiff * (1 - state.q) ** 2) for state in found[1:]]
    assert (np.diff(energies) <= 1e-9 * energies[0]).all()
    assert energies[-1] < 1e-2 * energies[0]


def test_conjugate_gradients_end_at_the_solution_of_the_coupled_system():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(30, 30))
    matrix, right = root @ root.T + np.eye(30), rng.normal(size=(10, 3))
    solved = conjugate_gradients(
        lambda x: (matrix @ x.ravel()).reshape(10, 3), right, np.ndarray.copy, 200, 1e-12
    )
    assert_allclose(solved.ravel(), np.linalg.solve(matrix, right.ravel()), atol=1e-8)


def test_factorisation_solves_badly_scaled_systems():
    scale = sparse.diags(10.0 ** np.linspace(-6, 6, 30))
    matrix = (scale @ chain(30, 1.0) @ scale).tocsr()
    x = np.random.default_rng(3).normal(size=(30, 3))
    solved = factorized(matrix)(matrix @ x)
    assert_allclose(scale @ solved, scale @ x, rtol=1e-6, atol=1e-9)


def test_what_is_no_system_is_refused_with_the_reason():
    for bad in (np.nan, np.inf, 0.0):
        with pytest.raises(FitError, match="positive definite"):
            factorized(sparse.diags([1.0, bad, 1.0]).tocsr())
    with pytest.raises(FitError, match="cannot be factored"):
        factorized(sparse.csc_matrix(np.ones((2, 2))))
    with pytest.raises(ValueError, match="time_step"):
        implicit(chain(3, 1.0), 0.0)
