"""Levenberg-Marquardt over pose and coefficients of a shape model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.geometry.normal_jacobian import cross_matrices
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.reflectance.geometry_terms import GeometryTerm
from scan2albedo.reflectance.shape_model import MorphableShapeModel

FloatArray = NDArray[np.float64]

_LARGEST_DAMPING = 1e10
_FLAT_STEPS = 3
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


class GeometrySearch:
    """State of the search.

    Minimises the sum of terms and prior_weight |coefficients|^2.

    Parameters
    ----------
    model : MorphableShapeModel
    start : GeometryState
    prior_weight : float
    meter : Meter
        Counts evaluations of the objective and records its value.
    rigid : bool
        Move the pose only.
    """

    def __init__(
        self,
        model: MorphableShapeModel,
        start: GeometryState,
        prior_weight: float,
        meter: Meter,
        *,
        rigid: bool = False,
    ) -> None:
        self.model, self.prior_weight, self.meter = model, prior_weight, meter
        count = 0 if rigid else model.identity_components + model.expression_components
        self._basis = model.basis[:count].reshape(count, 3 * len(model.mean)).T
        self.state, self.vertices = start, start.vertices(model)
        self.terms: Sequence[GeometryTerm] = ()
        self.value = self.first_value = np.inf
        self.damping = 1e-3
        self.iterations, self.converged = 0, False

    def run(self, terms: Sequence[GeometryTerm], steps: int, tolerance: float) -> None:
        """Take up to `steps` steps down the sum of `terms`, until it hardly falls or the budget ends.

        `converged` tells of this run, `first_value` the objective it began with. Where the terms are not
        defined nothing moves.
        """
        self.terms, self.converged = terms, False
        if self.meter.exhausted:
            return
        self.damping = min(self.damping, 1e-1)
        self.value = self._objective(self.state, self.vertices)
        self.first_value = self.value
        self.meter.count()
        if not np.isfinite(self.value):
            return
        self.meter.record(self.value)
        flat = 0
        for _ in range(steps):
            before = self.value
            if self.meter.exhausted:
                return
            if not self._step():
                # No step along the descent direction helps any more, or the budget cut the trials short.
                self.converged = self.damping > _LARGEST_DAMPING
                return
            self.iterations += 1
            self.meter.record(self.value)
            flat = flat + 1 if before - self.value < tolerance * before else 0
            if flat == _FLAT_STEPS:
                self.converged = True
                return

    def _step(self) -> bool:
        """Go down by one damped step, damping more until the objective falls; tell whether it did."""
        hessian, gradient = self._normal_equations()
        diagonal = np.diag(hessian)
        floor = 1e-12 * max(float(diagonal.max()), 1e-300)
        while self.damping <= _LARGEST_DAMPING and not self.meter.exhausted:
            step = -np.linalg.solve(hessian + np.diag(self.damping * diagonal + floor), gradient)
            trial = self._moved(np.asarray(step, np.float64))
            vertices = trial.vertices(self.model)
            value = self._objective(trial, vertices)
            self.meter.count()
            if value < self.value:
                self.state, self.vertices, self.value = trial, vertices, value
                self.damping = max(self.damping / 5, 1e-9)
                return True
            self.damping *= 4
        return False

    def _normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Return the Gauss-Newton matrix and the gradient by pose and coefficients."""
        count = self._basis.shape[1]
        prior = np.concatenate([np.zeros(POSE), np.full(count, 2 * self.prior_weight)])
        hessian = np.diag(prior)
        gradient = prior * np.concatenate([np.zeros(POSE), self.state.coefficients[:count]])
        rotation = self.state.scene_from_model[:3, :3]
        pose_motion = self._pose_motion()
        for term in self.terms:
            linear = term.linearized(self.vertices)
            by = linear.by_vertices
            by_shape = sparse.bsr_matrix((by.data @ rotation, by.indices, by.indptr), shape=by.shape)
            jacobian = np.concatenate([by @ pose_motion, by_shape @ self._basis], axis=1)
            root = np.sqrt(linear.weight)
            scaled = root[:, None] * jacobian
            hessian = hessian + scaled.T @ scaled
            gradient = gradient + scaled.T @ (root * linear.residual)
        return hessian, gradient

    def _pose_motion(self) -> FloatArray:
        """Return (3V, 6) derivatives of the vertices by turn and shift."""
        turn = -cross_matrices(self.vertices - self.vertices.mean(0))
        shift = np.broadcast_to(np.eye(3), turn.shape)
        return np.concatenate([turn, shift], axis=2).reshape(-1, POSE)

    def _moved(self, step: FloatArray) -> GeometryState:
        pivot = compose(np.eye(3), self.vertices.mean(0))
        # A turn of more than a radian in one step is a runaway.
        turn = step[:3] / max(1.0, float(np.linalg.norm(step[:3])))
        away = compose(np.eye(3), -self.vertices.mean(0))
        motion = compose(rotation_from_vector(turn), np.zeros(3))
        pose = compose(np.eye(3), step[3:POSE]) @ pivot @ motion @ away @ self.state.scene_from_model
        moved = self.state.coefficients
        moved[: len(step) - POSE] += step[POSE:]
        split = self.model.identity_components
        return GeometryState(pose, moved[:split], moved[split:])

    def _objective(self, state: GeometryState, vertices: FloatArray) -> float:
        value = self.prior_weight * float(state.coefficients @ state.coefficients)
        for term in self.terms:
            value += term.value(vertices)
        return value
