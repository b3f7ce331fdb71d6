"""The coarse-to-fine schedule: which samples, how stiff, how far the forces reach."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, dots, norms
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.fitting.dynamics import ImplicitSystem
from scan2albedo.fitting.forces import ForceGates, ScanForces, scan_forces
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.options import FitOptions, between
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import neighbouring_faces, vertex_areas, vertex_mask
from scan2albedo.geometry.operators import bending, laplacian

TIME_STEP = 10.0
"""dt (a unit force is a unit area)."""
MASS = 1.0
"""M as a multiple of the surface's area."""
DAMPING = 0.1
"""D as a multiple of the surface's area."""
MEMBRANE_MM = (6.0, 0.5)
"""Membrane smoothing length in the first and last stage."""
GAIN_TOLERANCE = 0.003
"""A stage ends when five steps gained less than this fraction of the error."""
MENDING_ROUNDS = 14
"""Faces around folds get three times as stiff in up to so many rounds."""
SHORT = 3
"""Steps of such a round, and steps and rounds of the finest samples: more cost an eighth and end no
nearer."""
TRIAL_LEVEL = 1
"""A trial's samples."""
RESULT_LEVELS = 2
"""Loop refinements of the surface returned."""

MIN_STEP_COSINE = 0.2
"""A triangle whose normal turns further than that in one step counts as turning over."""
FOLD_COSINE = -0.866
"""Neighbours more than 150 degrees apart: lips and nostrils crease by less, a fold-over by 180."""
FOLD_CHANGE_RAD = np.pi / 4
"""A fold turns by more than this from rest."""


class FoldFinder:
    """Finds triangles (F, 3) at edges of over 150 degrees, and 45 degrees more than at `rest` (V, 3)."""

    def __init__(self, rest: FloatArray, faces: IntArray) -> None:
        first, second, _ = neighbouring_faces(faces)
        self._faces, self._pairs = faces, np.stack([first, second], 1)
        angle = np.arccos(np.clip(self._cosine(rest), -1, 1))
        self._least = np.minimum(FOLD_COSINE, np.cos(np.minimum(angle + FOLD_CHANGE_RAD, np.pi)))

    def find(self, vertices: FloatArray) -> IntArray:
        """Return the indices of the folded triangles at positions (V, 3)."""
        return np.unique(self._pairs[self._cosine(vertices) < self._least])

    def _cosine(self, vertices: FloatArray) -> FloatArray:
        normals = surface_normals(vertices, self._faces)[1]
        return dots(normals[self._pairs[:, 0]], normals[self._pairs[:, 1]])


@dataclass(frozen=True)
class Deformation:
    """The inputs that all stages share, in one frame.

    `reference` (C, 3) are control points without displacement; `landmarks` hold points of the model on the
    scan. Before it bends the jaw was turned down by `jaw_deg`, and the right and left corner of the mouth
    drawn back by `corners_mm`; of the scan `covered_mm2` before the eyes were left out.
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
    coarse_from_rest: list[FloatArray] = field(init=False, repr=False, default_factory=list)
    """The control points (C, 3) after the first stages from `reference`, once they were asked for."""
    _sampled: dict[int, tuple[SurfaceSamples, sparse.csr_matrix]] = field(
        init=False, repr=False, default_factory=dict
    )

    def sampled(self, level: int) -> tuple[SurfaceSamples, sparse.csr_matrix]:
        """Return the samples of a level, and the stiffness (C, C) of their usual springs."""
        if level not in self._sampled:
            samples = SurfaceSamples.of(self.model, self.reference, level)
            # The preconditioner assumes springs half as stiff as an open gate's.
            weight = sparse.diags(samples.area / 2)
            self._sampled[level] = samples, (samples.matrix.T @ weight @ samples.matrix).tocsr()
        return self._sampled[level]

    @cached_property
    def folds(self) -> FoldFinder:
        """Finds folds of the surface returned."""
        subdivision = self.model.subdivision(RESULT_LEVELS)
        return FoldFinder(subdivision.matrix @ self.reference, subdivision.faces)

    @cached_property
    def _energies(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        return self._stiffened(np.ones(len(self.model.control_faces)))

    def _stiffened(self, stiffening: FloatArray) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        faces = self.model.control_faces
        weight = self.model.region_values("stiffness")[self.model.region] * stiffening
        return laplacian(self.reference, faces, weight), bending(self.reference, faces, weight)

    def elasticity(self, progress: float, stiffening: FloatArray | None = None) -> sparse.csr_matrix:
        """Return K (C, C) at `progress` 0 ... 1, each control face stiffer by its `stiffening` (F,)."""
        membrane, thin_plate = self._energies if stiffening is None else self._stiffened(stiffening)
        return (
            between(MEMBRANE_MM, progress) ** 2 * membrane
            + between(self.options.bending_mm, progress) ** 4 * thin_plate
        )


def run_stages(deformation: Deformation, count: int | None = None) -> tuple[FloatArray, bool]:
    """Return the displacement (C, 3) after all stages, or the first `count`, and whether all of them ran.

    As many run as the budget allows, at least one step. Then folds are made stiffer until none is left, and a
    scan as fine as the samples of `FitOptions.finest_level` gets a few steps with these.
    """
    options, meter = deformation.options, deformation.meter
    levels, finest = options.levels, options.finest_level
    q = np.zeros_like(deformation.reference)
    for index, level in enumerate(levels[:count]):
        if meter.exhausted and (index or not meter.out_of_time):
            return q, False
        q = run_stage(deformation, level, index / max(len(levels) - 1, 1), options.steps, q, None)
    if count is not None:
        return q, not meter.exhausted
    q, stiffening = _mended(deformation, q, None, levels[-1], MENDING_ROUNDS)
    if finest > levels[-1] and not meter.exhausted:
        spacing_mm = float(np.sqrt(np.median(deformation.sampled(finest)[0].area)))
        if deformation.scan.edge_mm < spacing_mm:
            finer = run_stage(deformation, finest, 1.0, SHORT, q, stiffening)
            finer, _ = _mended(deformation, finer, stiffening, finest, SHORT)
            # Around folds that are left the finest steps are taken back; all, where that does not end them.
            back = np.zeros((len(q), 1), bool)
            for _ in range(MENDING_ROUNDS):
                folded = _around_folds(deformation, np.where(back, q, finer))
                if not folded.any():
                    return np.where(back, q, finer), not meter.exhausted
                back |= folded[:, None]
    return q, not meter.exhausted


def coarsely_fitted(deformation: Deformation, reference: FloatArray) -> FloatArray:
    """Return the control points (C, 3) after the first stages from `reference`; counted, but not recorded."""
    if reference is deformation.reference and len(deformation.coarse_from_rest):
        return deformation.coarse_from_rest[0]
    # Longer trials choose no better.
    options = replace(deformation.options, steps=min(deformation.options.steps, 5))
    meter = deformation.meter.untraced()
    q, _ = run_stages(replace(deformation, reference=reference, options=options, meter=meter), 2)
    deformation.meter.count(meter.evaluations)
    if reference is deformation.reference:
        deformation.coarse_from_rest.append(reference + q)
    return reference + q


def _mended(
    deformation: Deformation, q: FloatArray, stiffening: FloatArray | None, level: int, rounds: int
) -> tuple[FloatArray, FloatArray | None]:
    """Return `q` without folds, as far as it goes, and how much stiffer (F_C,) the faces got for it."""
    faces = deformation.model.control_faces
    for _ in range(rounds):
        if deformation.meter.exhausted:
            break
        folded = _around_folds(deformation, q)[faces].any(1)
        if not folded.any():
            break
        more = np.where(folded, 3.0, 1.0)
        stiffening = more if stiffening is None else stiffening * more
        q = run_stage(deformation, level, 1.0, SHORT, q, stiffening)
    return q, stiffening


def _around_folds(deformation: Deformation, q: FloatArray) -> BoolArray:
    """Return (C,) True at the corners of control faces with a fold."""
    model, faces = deformation.model, deformation.model.control_faces
    subdivision = model.subdivision(RESULT_LEVELS)
    folds = deformation.folds.find(subdivision.matrix @ (deformation.reference + q))
    return vertex_mask(len(q), faces[subdivision.parent[folds]])


def imbalance_mm(deformation: Deformation, q: FloatArray) -> float:
    """Return how far (mean, weighted by area) the surface would still move if nothing slowed it.

    That is |d| with (K + H) d = f - K q: near 0 where stiffness and forces balance.
    """
    options, none = deformation.options, np.zeros(len(q))
    samples, force_stiffness = deformation.sampled(options.levels[-1])
    system = ImplicitSystem(none, none, deformation.elasticity(1.0), force_stiffness, 1.0)
    points = samples.matrix @ (deformation.reference + q)
    normals, _ = surface_normals(points, samples.faces)
    forces = scan_forces(deformation.scan, points, normals, ForceGates.at(options, 1.0), rim=samples.rim)
    force, springs = forces.springs(samples.area, forces.mutual(points, samples.area))
    moved = system.step(q, np.zeros_like(q), samples.matrix.T @ force, samples.product(springs))
    return float(samples.area @ norms(samples.matrix @ moved) / samples.area.sum())


def run_stage(
    deformation: Deformation, level: int, progress: float, steps: int, q: FloatArray, stiff: FloatArray | None
) -> FloatArray:
    """Return the displacement (C, 3) after at most `steps` with the samples of a refinement `level`."""
    meter, reference, pull = deformation.meter, deformation.reference, deformation.landmarks
    samples, force_stiffness = deformation.sampled(level)
    gates, faces = ForceGates.at(deformation.options, progress), deformation.model.control_faces
    area, stiffness = vertex_areas(reference, faces), deformation.elasticity(progress, stiff)
    area = np.maximum(area, 1e-6 * area.mean())
    system = ImplicitSystem(MASS * area, DAMPING * area, stiffness, force_stiffness, TIME_STEP)
    velocity, errors = np.zeros_like(q), list[float]()
    forces: ScanForces | None = None
    for step in range(steps):
        if meter.exhausted and (step or not meter.out_of_time):
            break
        points = samples.matrix @ (reference + q)
        start = forces if forces is not None and step % 10 else None
        normals, face_normals = surface_normals(points, samples.faces)
        forces = scan_forces(deformation.scan, points, normals, gates, start, rim=samples.rim)
        meter.count()
        errors.append(forces.mean_distance_mm(samples.area))
        meter.record(errors[-1])
        if step % 4 == 0:
            mutual = forces.mutual(points, samples.area)
        force, springs = forces.springs(samples.area, mutual)
        push, product = samples.matrix.T @ force, samples.product(springs)
        if pull is not None:
            push, product = push + pull.force(reference + q), pull.with_springs(product)
        moved = q + system.step(q, velocity, push, product)
        moved = guarded(reference + q, reference + moved, face_normals, samples, faces) - reference
        q, velocity = moved, (moved - q) / TIME_STEP
        if len(errors) > 5 and not errors[-6] - errors[-1] > GAIN_TOLERANCE * errors[-6]:
            break
    return q


def guarded(
    before: FloatArray, after: FloatArray, normals: FloatArray, samples: SurfaceSamples, faces: IntArray
) -> FloatArray:
    """Return control points (C, 3) between `before` and `after` for which no triangle turns over.

    The step is halved around each offending triangle up to seven times, then dropped there, then everywhere.
    `normals` (F, 3) are unit normals of the sampled triangles at `before`, `faces` those of the control mesh.
    """
    fraction = np.ones((len(before), 1))
    for attempt in range(9):
        trial = before + fraction * (after - before)
        bad = turned_faces(normals, samples.matrix @ trial, samples.faces, MIN_STEP_COSINE)
        if len(bad) == 0:
            return trial
        corners = vertex_mask(len(before), faces[samples.parent[bad]])
        corners[faces[corners[faces].any(1)]] = True
        fraction[corners] *= 0.5 if attempt < 7 else 0.0
    return before


def turned_faces(normals: FloatArray, points: FloatArray, faces: IntArray, min_cosine: float) -> IntArray:
    """Return the faces whose normal, with vertices at `points`, turned too far from unit `normals` (F, 3)."""
    turned = surface_normals(points, faces)[1]
    cosine = dots(normals, turned)
    return np.flatnonzero((cosine < min_cosine) & normals.any(1) & turned.any(1))
