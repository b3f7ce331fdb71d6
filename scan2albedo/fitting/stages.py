"""The coarse-to-fine schedule: which samples, how stiff, how far the forces reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting.dynamics import ImplicitSystem, State
from scan2albedo.fitting.flip_guard import guarded
from scan2albedo.fitting.forces import ForceGates, ScanForces, scan_forces
from scan2albedo.fitting.kernels import surface_normals
from scan2albedo.fitting.mouth_opening import MouthSearch
from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import vertex_areas
from scan2albedo.geometry.operators import bending, laplacian
from scan2albedo.optimization import Meter

FloatArray = NDArray[np.float64]

GAIN_WINDOW = 5
SEARCH_EVERY = 10
MUTUAL_EVERY = 4
MOUTH_LEVEL = 1
MOUTH_STAGES = 2
USUAL_SPRINGS = 0.5
"""Stiffness of the springs, relative to an open gate's, that the preconditioner reckons with."""


@dataclass(frozen=True)
class Deformation:
    """What all stages share.

    Parameters
    ----------
    model : AnnotatedFaceModel
    reference : (C, 3) float64
        Control points without displacement: the model at rest, scaled to the scan's size.
    scan : ScanSurface
        In the same frame.
    options : FitOptions
    meter : Meter
    """

    model: AnnotatedFaceModel
    reference: FloatArray
    scan: ScanSurface
    options: FitOptions
    meter: Meter

    @cached_property
    def _membrane(self) -> sparse.csr_matrix:
        return laplacian(self.reference, self.model.control_faces, self._stiffness)

    @cached_property
    def _thin_plate(self) -> sparse.csr_matrix:
        return bending(self.reference, self.model.control_faces, self._stiffness)

    @property
    def _stiffness(self) -> FloatArray:
        return np.asarray(self.model.region_values("stiffness")[self.model.region])

    def elasticity(self, progress: float) -> sparse.csr_matrix:
        """Return K (C, C) at `progress` 0 ... 1 of the stiffness schedule."""
        membrane = between(self.options.membrane_mm, progress) ** 2
        thin_plate = between(self.options.bending_mm, progress) ** 4
        return membrane * self._membrane + thin_plate * self._thin_plate


@dataclass(frozen=True)
class StagesOutcome:
    """Displacement `q` (C, 3) reached, and whether the whole schedule ran."""

    q: FloatArray
    converged: bool


def mouth_opened(deformation: Deformation) -> Deformation:
    """Return the deformation that starts from the mouth opened as the scan's is.

    Each candidate of `MouthSearch` runs through the first, stiffest stages; trials count as evaluations
    but leave no rows in the trace.
    """
    scan, meter = deformation.scan, deformation.meter
    search = MouthSearch.of(deformation.model, deformation.reference, scan, MOUTH_LEVEL)
    if len(search.candidates) == 1:
        return deformation
    reached = []
    for reference in search.candidates:
        if meter.exhausted:
            return deformation
        trial = replace(deformation, reference=reference, meter=Meter("trial", "mm", meter.budget))
        outcome = run_stages(trial, MOUTH_STAGES)
        reached.append(reference + outcome.q)
        meter.count(trial.meter.evaluations)
    return replace(deformation, reference=search.candidates[search.best(scan, reached)])


def run_stages(deformation: Deformation, count: int | None = None) -> StagesOutcome:
    """Run all stages, or the first `count`, or as many as the budget allows."""
    levels = deformation.options.levels
    q = np.zeros_like(deformation.reference)
    for index, level in enumerate(levels[:count]):
        if deformation.meter.exhausted:
            return StagesOutcome(q, False)
        q = _run_stage(deformation, level, index / max(len(levels) - 1, 1), q)
    return StagesOutcome(q, not deformation.meter.exhausted)


def _run_stage(deformation: Deformation, level: int, progress: float, q: FloatArray) -> FloatArray:
    options, meter, reference = deformation.options, deformation.meter, deformation.reference
    samples = SurfaceSamples.of(deformation.model, reference, level)
    system = _system(deformation, samples, progress)
    gates = ForceGates.at(options, progress)
    state = State(q, np.zeros_like(q))
    errors: list[float] = []
    forces: ScanForces | None = None
    for step in range(options.steps):
        if meter.exhausted:
            break
        points = samples.matrix @ (reference + state.q)
        start = forces if forces is not None and step % SEARCH_EVERY else None
        normals, face_normals = surface_normals(points, samples.faces)
        forces = scan_forces(deformation.scan, points, normals, gates, start)
        meter.count()
        errors.append(forces.mean_distance_mm(samples.area))
        meter.record(errors[-1])
        if step % MUTUAL_EVERY == 0:
            mutual = forces.mutual(points, samples.area)
        force, stiffness = forces.springs(samples.area, mutual)
        moved = system.step(state, samples.matrix.T @ force, samples.product(stiffness))
        safe = guarded(
            reference + state.q,
            reference + moved.q,
            face_normals,
            samples,
            deformation.model.control_faces,
        )
        state = State(safe - reference, (safe - reference - state.q) / system.time_step)
        if _settled(errors, options.gain_tolerance):
            break
    return state.q


def _system(deformation: Deformation, samples: SurfaceSamples, progress: float) -> ImplicitSystem:
    options = deformation.options
    control_area = vertex_areas(deformation.reference, deformation.model.control_faces)
    lumped = np.maximum(control_area, 1e-6 * control_area.mean())
    springs = samples.matrix.T @ sparse.diags(USUAL_SPRINGS * samples.area) @ samples.matrix
    return ImplicitSystem(
        options.mass * lumped,
        options.damping * lumped,
        deformation.elasticity(progress),
        springs,
        options.time_step,
    )


def _settled(errors: list[float], tolerance: float) -> bool:
    """Whether the last GAIN_WINDOW steps gained less than `tolerance` of the error before them."""
    if len(errors) <= GAIN_WINDOW:
        return False
    before, now = errors[-1 - GAIN_WINDOW], errors[-1]
    return not before - now > tolerance * before
