"""The coarse-to-fine schedule: which samples, how stiff, how far the forces reach."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting.dynamics import ImplicitSystem, State
from scan2albedo.fitting.flip_guard import FoldFinder, guarded
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
STIFFENING = 3.0
MENDING_ROUNDS = 14
MENDING_STEPS = 3
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
    def folds(self) -> FoldFinder:
        """Finds folds of the surface returned."""
        subdivision = self.model.subdivision(self.options.result_levels)
        return FoldFinder(subdivision.matrix @ self.reference, subdivision.faces)

    @cached_property
    def _plain(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        return self._energies(np.ones(len(self.model.control_faces)))

    def _energies(self, stiffening: FloatArray) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        faces = self.model.control_faces
        weight = self.model.region_values("stiffness")[self.model.region] * stiffening
        return laplacian(self.reference, faces, weight), bending(self.reference, faces, weight)

    def elasticity(self, progress: float, stiffening: FloatArray) -> sparse.csr_matrix:
        """Return K (C, C) at `progress` 0 ... 1, each control face stiffer by its `stiffening` (F,)."""
        plain = not (stiffening != 1).any()
        membrane, thin_plate = self._plain if plain else self._energies(stiffening)
        return (
            between(self.options.membrane_mm, progress) ** 2 * membrane
            + between(self.options.bending_mm, progress) ** 4 * thin_plate
        )


@dataclass(frozen=True)
class Stage:
    """Samples at refinement `level`, `progress` 0 ... 1, at most `steps`, `stiffening` (F_C,) of faces."""

    level: int
    progress: float
    steps: int
    stiffening: FloatArray


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
    """Run all stages, or the first `count`, or as many as the budget allows.

    Where the sheet has folded over it is made stiffer, in short rounds of the last stage, until no fold
    is left.
    """
    levels, meter = deformation.options.levels, deformation.meter
    q = np.zeros_like(deformation.reference)
    even = np.ones(len(deformation.model.control_faces))
    for index, level in enumerate(levels[:count]):
        if meter.exhausted:
            return StagesOutcome(q, False)
        progress = index / max(len(levels) - 1, 1)
        q = _run_stage(deformation, Stage(level, progress, deformation.options.steps, even), q)
    if count is None:
        q = _mended(deformation, q, even)
    return StagesOutcome(q, not meter.exhausted)


def _mended(deformation: Deformation, q: FloatArray, stiffening: FloatArray) -> FloatArray:
    for _ in range(MENDING_ROUNDS):
        more = _stiffer(deformation, q)
        if not (more > 1).any() or deformation.meter.exhausted:
            break
        stiffening = stiffening * more
        q = _run_stage(deformation, Stage(deformation.options.levels[-1], 1.0, MENDING_STEPS, stiffening), q)
    return q


def _stiffer(deformation: Deformation, q: FloatArray) -> FloatArray:
    """Return (F_C,) STIFFENING for the control faces around folds of the surface, 1 elsewhere."""
    model, faces = deformation.model, deformation.model.control_faces
    subdivision = model.subdivision(deformation.options.result_levels)
    folds = deformation.folds.find(subdivision.matrix @ (deformation.reference + q))
    around = np.zeros(len(deformation.reference), bool)
    around[faces[subdivision.parent[folds]]] = True
    return np.where(around[faces].any(1), STIFFENING, 1.0)


def _run_stage(deformation: Deformation, stage: Stage, q: FloatArray) -> FloatArray:
    options, meter, reference = deformation.options, deformation.meter, deformation.reference
    samples = SurfaceSamples.of(deformation.model, reference, stage.level)
    system = _system(deformation, samples, stage)
    gates = ForceGates.at(options, stage.progress)
    state = State(q, np.zeros_like(q))
    errors: list[float] = []
    forces: ScanForces | None = None
    for step in range(stage.steps):
        if meter.exhausted:
            break
        points = samples.matrix @ (reference + state.q)
        start = forces if forces is not None and step % SEARCH_EVERY else None
        normals, face_normals = surface_normals(points, samples.faces)
        forces = scan_forces(deformation.scan, points, normals, gates, start, rim=samples.rim)
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


def _system(deformation: Deformation, samples: SurfaceSamples, stage: Stage) -> ImplicitSystem:
    options = deformation.options
    control_area = vertex_areas(deformation.reference, deformation.model.control_faces)
    lumped = np.maximum(control_area, 1e-6 * control_area.mean())
    springs = samples.matrix.T @ sparse.diags(USUAL_SPRINGS * samples.area) @ samples.matrix
    return ImplicitSystem(
        options.mass * lumped,
        options.damping * lumped,
        deformation.elasticity(stage.progress, stage.stiffening),
        springs,
        options.time_step,
    )


def _settled(errors: list[float], tolerance: float) -> bool:
    """Whether the last GAIN_WINDOW steps gained less than `tolerance` of the error before them."""
    if len(errors) <= GAIN_WINDOW:
        return False
    before, now = errors[-1 - GAIN_WINDOW], errors[-1]
    return not before - now > tolerance * before
