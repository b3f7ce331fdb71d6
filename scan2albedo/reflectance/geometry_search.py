"""Search over pose and coefficients of a shape model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.operators import cross_matrices
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.optimization import Damping, NormalEquations, minimize
from scan2albedo.reflectance.geometry_terms import GeometryTerm
from scan2albedo.reflectance.shape_model import MorphableShapeModel

_TOLERANCE, _FLAT_STEPS = 1e-4, 3
"""Converged when the objective falls by less than this part, so many steps running."""
_LARGEST_FIRST_DAMPING = 0.1
"""A search goes on with the damping that the one before ended with, but never with more than this."""
POSE = 6
"""Parameters of a step's pose: turn around the face's middle in rad, and shift in mm."""


@dataclass(frozen=True)
class GeometryState:
    """A pose and a shape."""

    scene_from_model: FloatArray
    """(4, 4), rigid."""
    identity: FloatArray
    expression: FloatArray

    @property
    def coefficients(self) -> FloatArray:
        """(N_S + N_E,), identity first."""
        return np.concatenate([self.identity, self.expression])

    def vertices(self, model: MorphableShapeModel) -> FloatArray:
        """Return (V, 3) in the scene."""
        return transform_points(self.scene_from_model, model.shape(self.identity, self.expression))


@dataclass(frozen=True)
class GeometryObjective:
    """The sum of terms and prior_weight |coefficients|^2."""

    model: MorphableShapeModel
    basis: FloatArray
    """(3V, P - 6) directions of the coefficients that move."""
    prior_weight: float
    terms: Sequence[GeometryTerm]
    meter: Meter

    @classmethod
    def of(
        cls,
        model: MorphableShapeModel,
        prior_weight: float,
        terms: Sequence[GeometryTerm],
        meter: Meter,
        *,
        rigid: bool = False,
    ) -> GeometryObjective:
        """Return the objective over pose and all coefficients, or over the pose only."""
        count = 0 if rigid else model.identity_components + model.expression_components
        return cls(
            model, model.basis[:count].reshape(count, 3 * len(model.mean)).T, prior_weight, terms, meter
        )

    def at(self, state: GeometryState) -> GeometryPoint:
        """Evaluate the objective."""
        self.meter.count()
        vertices = state.vertices(self.model)
        cost = self.prior_weight * float(state.coefficients @ state.coefficients)
        for term in self.terms:
            cost += term.value(vertices)
        return GeometryPoint(self, state, vertices, cost)


@dataclass(frozen=True)
class GeometryPoint:
    """The objective at a state."""

    objective: GeometryObjective
    state: GeometryState
    vertices: FloatArray
    cost: float
    """Infinite where a term is not defined."""

    def normal_equations(self) -> NormalEquations:
        """Return the Gauss-Newton matrix and the gradient by pose and coefficients."""
        basis, weight = self.objective.basis, self.objective.prior_weight
        count = basis.shape[1]
        prior = np.concatenate([np.zeros(POSE), np.full(count, 2 * weight)])
        hessian = np.diag(prior)
        gradient = prior * np.concatenate([np.zeros(POSE), self.state.coefficients[:count]])
        rotation = self.state.scene_from_model[:3, :3]
        pose_motion = self._pose_motion()
        for term in self.objective.terms:
            linear = term.linearized(self.vertices)
            by = linear.by_vertices
            by_shape = sparse.bsr_matrix((by.data @ rotation, by.indices, by.indptr), shape=by.shape)
            jacobian = np.concatenate([by @ pose_motion, by_shape @ basis], axis=1)
            root = np.sqrt(linear.weight)
            scaled = root[:, None] * jacobian
            hessian = hessian + scaled.T @ scaled
            gradient = gradient + scaled.T @ (root * linear.residual)
        return NormalEquations(hessian, gradient)

    def moved(self, step: FloatArray) -> GeometryPoint:
        """Return the objective after a turn, a shift and a change of coefficients (P,)."""
        middle = self.vertices.mean(0)
        # A turn of more than a radian in one step is a runaway.
        turn = step[:3] / max(1.0, float(np.linalg.norm(step[:3])))
        pivot, away = compose(np.eye(3), middle), compose(np.eye(3), -middle)
        motion = compose(rotation_from_vector(turn), np.zeros(3))
        pose = compose(np.eye(3), step[3:POSE]) @ pivot @ motion @ away @ self.state.scene_from_model
        coefficients = self.state.coefficients
        coefficients[: len(step) - POSE] += step[POSE:]
        split = self.objective.model.identity_components
        return self.objective.at(GeometryState(pose, coefficients[:split], coefficients[split:]))

    def _pose_motion(self) -> FloatArray:
        """Return (3V, 6) derivatives of the vertices by turn and shift."""
        turn = -cross_matrices(self.vertices - self.vertices.mean(0))
        shift = np.broadcast_to(np.eye(3), turn.shape)
        return np.concatenate([turn, shift], axis=2).reshape(-1, POSE)


class GeometrySearch:
    """A state that searches move one after the other; `meter` counts evaluations and records their values."""

    def __init__(self, start: GeometryState, meter: Meter) -> None:
        self.state, self.meter = start, meter
        self.value = self.first_value = np.inf
        self.iterations, self.converged = 0, False
        self._damping = Damping().first

    def run(self, objective: GeometryObjective, steps: int) -> None:
        """Take up to `steps` steps, until the objective hardly falls or the budget ends.

        Sets `converged`, `first_value` and `value` of this run. Where a term is not defined nothing moves.
        """
        self.converged = False
        if self.meter.exhausted:
            return
        start = objective.at(self.state)
        found = minimize(
            start,
            steps=steps,
            tolerance=_TOLERANCE,
            flat_steps=_FLAT_STEPS,
            damping=Damping(first=min(self._damping, _LARGEST_FIRST_DAMPING)),
            meter=self.meter,
            on_better=lambda point: self.meter.record(point.cost),
        )
        self.first_value, self.value = start.cost, found.best.cost
        self.state, self._damping = found.best.state, found.damping
        self.iterations += found.steps
        self.converged = found.converged

    @property
    def hardly_fell(self) -> bool:
        """Whether the last run was not worth another one with the same terms."""
        return self.first_value - self.value <= _TOLERANCE * self.value
