"""The coarse-to-fine schedule: which samples, how stiff, how far the forces reach."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.fitting.dynamics import ImplicitSystem, State
from scan2albedo.fitting.folds import FoldFinder, guarded
from scan2albedo.fitting.forces import ForceGates, ScanForces, scan_forces
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import vertex_areas
from scan2albedo.geometry.operators import bending, laplacian

GAIN_WINDOW = 5
SEARCH_EVERY = 10
MUTUAL_EVERY = 4
STIFFENING = 3.0
MENDING_ROUNDS = 14
MENDING_STEPS = 3
FINEST_STEPS = 3
FINEST_MENDING_ROUNDS = 3
"""On the finest samples 5 steps and more rounds cost about an eighth more and end no nearer."""
TRIAL_LEVEL, TRIAL_STAGES, TRIAL_STEPS = 1, 2, 5
"""A trial's samples, stages, and steps in each; longer trials choose no better."""
USUAL_SPRINGS = 0.5
"""Stiffness of the springs, relative to an open gate's, that the preconditioner assumes."""


@dataclass(frozen=True)
class Deformation:
    """The inputs that all stages share, in one frame.

    `reference` (C, 3) are control points without displacement: the model at rest, scaled to the scan's size.
    `landmarks` hold points of the model on points of the scan. Before it bends the jaw was turned down by
    `jaw_deg`, and the right and the left corner of the mouth drawn back by `corners_mm`. Of the scan
    `covered_mm2` before the eyes were left out.
    """

    model: AnnotatedSurface
    reference: FloatArray
    scan: ScanSurface
    options: FitOptions
    meter: Meter
    landmarks: LandmarkPull | None = None
    jaw_deg: float = 0.0
    corners_mm: tuple[float, float] = (0.0, 0.0)
    covered_mm2: float = 0.0
    _sampled: dict[int, tuple[SurfaceSamples, sparse.csr_matrix]] = field(
        init=False, repr=False, default_factory=dict
    )

    def sampled(self, level: int) -> tuple[SurfaceSamples, sparse.csr_matrix]:
        """Return the samples of a level, and the stiffness (C, C) of their usual springs."""
        if level not in self._sampled:
            samples = SurfaceSamples.of(self.model, self.reference, level)
            weight = sparse.diags(USUAL_SPRINGS * samples.area)
            self._sampled[level] = samples, (samples.matrix.T @ weight @ samples.matrix).tocsr()
        return self._sampled[level]

    def scan_is_finer_than(self, level: int) -> bool:
        """Whether the scan's edges near the model are shorter than the spacing of the samples of a level."""
        samples, _ = self.sampled(level)
        return self.scan.edge_mm < float(np.sqrt(np.median(samples.area)))

    @cached_property
    def control_area(self) -> FloatArray:
        """(C,) mm^2 around each control point, above 0."""
        area = vertex_areas(self.reference, self.model.control_faces)
        return np.maximum(area, 1e-6 * area.mean())

    @cached_property
    def coarse_from_rest(self) -> FloatArray:
        """(C, 3) control points after the first stages from `reference`, with which trials are compared."""
        return _coarsely_fitted(self, self.reference)

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
class StagesResult:
    """Displacement `q` (C, 3) reached, and whether the whole schedule ran."""

    q: FloatArray
    converged: bool


def run_stages(deformation: Deformation, count: int | None = None) -> StagesResult:
    """Run all stages, or the first `count`, or as many as the budget allows; at least one step.

    Where the surface has folded over it is made stiffer, in short rounds of the last stage, until no fold is
    left. A scan as fine as the samples of `FitOptions.finest_level` then gets a few steps with these: more of
    its vertices count, and their noise averages out.
    """
    levels, meter = deformation.options.levels, deformation.meter
    q = np.zeros_like(deformation.reference)
    even = np.ones(len(deformation.model.control_faces))
    for index, level in enumerate(levels[:count]):
        if meter.exhausted and (index or not meter.out_of_time):
            return StagesResult(q, False)
        progress = index / max(len(levels) - 1, 1)
        q = _run_stage(deformation, Stage(level, progress, deformation.options.steps, even), q)
    if count is not None:
        return StagesResult(q, not meter.exhausted)
    q, stiffening = _mended(deformation, q, even, levels[-1])
    finest = deformation.options.finest_level
    if finest > levels[-1] and deformation.scan_is_finer_than(finest) and not meter.exhausted:
        finer = _run_stage(deformation, Stage(finest, 1.0, FINEST_STEPS, stiffening), q)
        finer, _ = _mended(deformation, finer, stiffening, finest, FINEST_MENDING_ROUNDS)
        q = _where_unfolded(deformation, finer, q)
    return StagesResult(q, not meter.exhausted)


def coarsely_fitted(deformation: Deformation, reference: FloatArray) -> FloatArray:
    """Return the control points (C, 3) after the first stages from `reference`; counted, but not recorded."""
    if reference is deformation.reference:
        return deformation.coarse_from_rest
    return _coarsely_fitted(deformation, reference)


def _coarsely_fitted(deformation: Deformation, reference: FloatArray) -> FloatArray:
    options = replace(deformation.options, steps=min(deformation.options.steps, TRIAL_STEPS))
    meter = deformation.meter.untraced()
    trial = replace(deformation, reference=reference, options=options, meter=meter)
    result = run_stages(trial, TRIAL_STAGES)
    deformation.meter.count(meter.evaluations)
    return reference + result.q


def _where_unfolded(deformation: Deformation, q: FloatArray, before: FloatArray) -> FloatArray:
    """Return `q`, taken back to `before` around its folds; `before` where that does not end them."""
    back = np.zeros(len(q), bool)
    for _ in range(MENDING_ROUNDS):
        folded = _around_folds(deformation, np.where(back[:, None], before, q))
        if not folded.any():
            return np.where(back[:, None], before, q)
        back |= folded
    return before


def _mended(
    deformation: Deformation, q: FloatArray, stiffening: FloatArray, level: int, rounds: int = MENDING_ROUNDS
) -> tuple[FloatArray, FloatArray]:
    """Return `q` without folds, as far as it goes, and how much stiffer (F_C,) the faces got for it."""
    for _ in range(rounds):
        if deformation.meter.exhausted:
            break
        more = _stiffer(deformation, q)
        if not (more > 1).any():
            break
        stiffening = stiffening * more
        q = _run_stage(deformation, Stage(level, 1.0, MENDING_STEPS, stiffening), q)
    return q, stiffening


def _stiffer(deformation: Deformation, q: FloatArray) -> FloatArray:
    """Return (F_C,) STIFFENING for the control faces around folds of the surface, 1 elsewhere."""
    around = _around_folds(deformation, q)
    return np.where(around[deformation.model.control_faces].any(1), STIFFENING, 1.0)


def _around_folds(deformation: Deformation, q: FloatArray) -> BoolArray:
    """Return (C,) True at the corners of control faces with a fold."""
    model, faces = deformation.model, deformation.model.control_faces
    subdivision = model.subdivision(deformation.options.result_levels)
    folds = deformation.folds.find(subdivision.matrix @ (deformation.reference + q))
    around = np.zeros(len(deformation.reference), bool)
    around[faces[subdivision.parent[folds]]] = True
    return around


def imbalance_mm(deformation: Deformation, q: FloatArray) -> float:
    """Return how far (mean, weighted by area) the surface would still move if nothing slowed it.

    That is |d| with (K + H) d = f - K q: near 0 where stiffness and forces balance, but as much as at the
    start where too small a time step, or too great a mass, has held the surface.
    """
    options, none = deformation.options, np.zeros(len(q))
    samples, usual = deformation.sampled(options.levels[-1])
    stiffness = deformation.elasticity(1.0, np.ones(len(deformation.model.control_faces)))
    system = ImplicitSystem(none, none, stiffness, usual, 1.0)
    points = samples.matrix @ (deformation.reference + q)
    normals, _ = surface_normals(points, samples.faces)
    gates = ForceGates.at(options, 1.0)
    forces = scan_forces(deformation.scan, points, normals, gates, rim=samples.rim)
    force, springs = forces.springs(samples.area, forces.mutual(points, samples.area))
    moved = system.step(State(q, np.zeros_like(q)), samples.matrix.T @ force, samples.product(springs))
    return float(samples.area @ np.linalg.norm(samples.matrix @ (moved.q - q), axis=1) / samples.area.sum())


def _run_stage(deformation: Deformation, stage: Stage, q: FloatArray) -> FloatArray:
    options, meter, reference = deformation.options, deformation.meter, deformation.reference
    samples, usual = deformation.sampled(stage.level)
    system = ImplicitSystem(
        options.mass * deformation.control_area,
        options.damping * deformation.control_area,
        deformation.elasticity(stage.progress, stage.stiffening),
        usual,
        options.time_step,
    )
    gates = ForceGates.at(options, stage.progress)
    state = State(q, np.zeros_like(q))
    errors: list[float] = []
    forces: ScanForces | None = None
    for step in range(stage.steps):
        if meter.exhausted and (step or not meter.out_of_time):
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
        pull, product = samples.matrix.T @ force, samples.product(stiffness)
        if deformation.landmarks is not None:
            pull = pull + deformation.landmarks.force(reference + state.q)
            product = deformation.landmarks.with_springs(product)
        moved = system.step(state, pull, product)
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


def _settled(errors: list[float], tolerance: float) -> bool:
    """Whether the last GAIN_WINDOW steps gained less than `tolerance` of the error before them."""
    if len(errors) <= GAIN_WINDOW:
        return False
    before, now = errors[-1 - GAIN_WINDOW], errors[-1]
    return not before - now > tolerance * before
