"""Open the model's mouth before it bends: a search over one angle at the jaw's hinge.

Closest points alone let the lips of a closed model slide along the chin of an open mouth; so opened
models are tried, and chosen by the result of a coarse fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting.dynamics import factorized
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import TRIAL_LEVEL, Deformation, coarsely_fitted
from scan2albedo.geometry.loop_subdivision import limit_matrix
from scan2albedo.geometry.operators import laplacian

EARS = (0, 16)
BELOW_EARS = (1, 15)
HINGE_DEPTH = 0.18
"""The jaw's joint is this part of the face's width behind the ends of the jaw line."""
STILL = (*range(17, 48), *range(49, 54), 61, 62, 63, *EARS)
"""iBUG-68 indices of brows, nose, eyes, upper lip and the jaw line's ends, which the jaw leaves in place."""
MOVING = (7, 8, 9, *range(55, 60), 65, 66, 67)
"""Chin and lower lip."""
CHIN = 8
NECK_BELOW_CHIN_MM = 35.0
FILM_WEIGHT = 1e-3
"""Weight of the faces between the lips, which hardly tie them together."""
LIMIT_FREEDOM = 0.05
"""Weight of keeping the control points in place against turning the surface exactly."""
ANGLES_DEG = (4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0)
REACH_MM = 8.0
MIN_GAIN = 0.12
TRIALS = 2
TRIAL_GAIN = 0.25
"""An angle is tried when it gains this much as it is, and chosen when its coarse fit gains MIN_GAIN."""
ABOUT = 0.07
"""Costs this much above the least are as good."""
WITH_JAW, IN_PART = 0.7, 0.4
"""Landmarks that follow the jaw by at least this much, and the middle of a hole between the lips that follows
it by so much, show how far it is open; the corners of the mouth do not."""
JAW_WEIGHT = 0.6
"""Samples that follow the jaw by at least this much measure its distance to the scan."""


def mouth_opened(deformation: Deformation, landmarks: LandmarkPull | None = None) -> Deformation:
    """Return the deformation that starts from the mouth opened as far as the scan's.

    Landmarks that the jaw moves show the angle. Without them each candidate of `MouthSearch` runs through the
    first, stiffest stages; trials count as evaluations but leave no rows in the trace.
    """
    scan, meter = deformation.scan, deformation.meter
    if meter.exhausted:
        return deformation
    search = MouthSearch.of(deformation.model, deformation.reference, scan, TRIAL_LEVEL, landmarks)
    if len(search.candidates) == 1:
        return search.chosen(deformation, 0)
    reached = []
    for reference in search.candidates:
        if meter.exhausted:
            return deformation
        reached.append(coarsely_fitted(deformation, reference))
    return search.chosen(deformation, search.best(scan, reached))


@dataclass(frozen=True)
class JawHinge:
    """How the lower face turns about an axis along x through `center` (3,).

    `weight` (C,), 0 ... 1, is the part of the angle by which the limit surface turns at each control point;
    `limit` (C, C) gives limit positions from control points.
    """

    center: FloatArray
    weight: FloatArray
    limit: sparse.csr_matrix

    @classmethod
    def of(cls, model: AnnotatedFaceModel, control_points: FloatArray) -> JawHinge | None:
        """Return the hinge of an annotated model at `control_points`; None without landmarks.

        The weight is 1 at chin and lower lip, 0 at the upper face and the neck, harmonic in between.
        """
        landmarks = model.landmarks_of(control_points)
        if landmarks is None or model.landmark_points is None:
            return None
        corners = model.control_faces[model.landmark_points.face]
        moving, still = np.zeros((2, len(control_points)), bool)
        moving[corners[list(MOVING)]] = True
        still[corners[list(STILL)]] = True
        still |= control_points[:, 1] < landmarks[CHIN, 1] - NECK_BELOW_CHIN_MM
        # A face across the mouth holds both lips: its corners follow their neighbours.
        fixed = moving ^ still
        film = np.where(model.in_region(MOUTH_REGION), FILM_WEIGHT, 1.0)
        weight = _harmonic(laplacian(control_points, model.control_faces, film), fixed, moving)
        ears = landmarks[list(EARS)]
        center = ears.mean(0) - [0.0, 0.0, HINGE_DEPTH * float(np.linalg.norm(ears[1] - ears[0]))]
        center[1] = landmarks[list(BELOW_EARS), 1].mean()
        return cls(center, weight, limit_matrix(len(control_points), model.control_faces))

    @cached_property
    def _from_limit(self) -> Callable[[FloatArray], FloatArray]:
        near = sparse.identity(len(self.weight))
        return factorized(self.limit.T @ self.limit + LIMIT_FREEDOM * near)

    def opened(self, control_points: FloatArray, angle_deg: float) -> FloatArray:
        """Return the control points (C, 3) whose surface has its jaw turned down by `angle_deg`.

        The surface is turned, not the control points: it averages them, so that turning these would round off
        the lips' edges.
        """
        turned = self._turned(control_points, angle_deg)
        missing = self._turned(self.limit @ control_points, angle_deg) - self.limit @ turned
        return turned + self._from_limit(self.limit.T @ missing)

    def angle_deg(self, rest: FloatArray, moved: FloatArray) -> float:
        """Return the median angle by which the jaw's surface turned from control points `rest` to `moved`."""
        jaw = self.weight > JAW_WEIGHT
        _, y, z = ((self.limit @ rest)[jaw] - self.center).T
        _, v, w = ((self.limit @ moved)[jaw] - self.center).T
        turned = np.arctan2(y * w - z * v, y * v + z * w)
        return float(np.rad2deg(np.median(turned / self.weight[jaw])))

    def _turned(self, points: FloatArray, angle_deg: float) -> FloatArray:
        angle = np.deg2rad(angle_deg) * self.weight
        _, y, z = (points - self.center).T
        turned = points.copy()
        turned[:, 1] = self.center[1] + np.cos(angle) * y - np.sin(angle) * z
        turned[:, 2] = self.center[2] + np.sin(angle) * y + np.cos(angle) * z
        return turned


@dataclass(frozen=True)
class MouthSearch:
    """Opened control points worth a trial, and their cost on the scan.

    `candidates` are (C, 3) each, the first the mouth as it is, or one, as far open as landmarks show, by
    `angles_deg`; `weight` (N,) is the area of the samples that the jaw moves, 0 elsewhere.
    """

    candidates: tuple[FloatArray, ...]
    angles_deg: tuple[float, ...]
    samples: SurfaceSamples
    weight: FloatArray

    @classmethod
    def of(
        cls,
        model: AnnotatedFaceModel,
        control_points: FloatArray,
        scan: ScanSurface,
        level: int,
        landmarks: LandmarkPull | None = None,
    ) -> MouthSearch:
        """Find the TRIALS angles that lie nearest to the scan before any fit; none without a hinge.

        Where there are `landmarks` that the jaw moves, it is the one angle that brings them nearest to their
        targets, if the surface comes nearer to the scan with it as well.
        """
        samples = SurfaceSamples.of(model, control_points, level)
        hinge = JawHinge.of(model, control_points)
        if hinge is None:
            return cls((control_points,), (0.0,), samples, samples.area)
        jaw = samples.area * (samples.matrix @ hinge.weight > JAW_WEIGHT)
        opened = [hinge.opened(control_points, angle) for angle in ANGLES_DEG]
        search = cls((control_points,), (0.0,), samples, jaw)
        costs = [search.cost(scan, points) for points in (control_points, *opened)]
        shown = None if landmarks is None else _of_the_jaw(landmarks, hinge)
        if shown is not None:
            apart = [np.linalg.norm(shown.offsets(p), axis=1).mean() for p in (control_points, *opened)]
            nearest = int(np.argmin(apart))
            best = nearest if costs[nearest] < costs[0] else 0
            return cls(((control_points, *opened)[best],), ((0.0, *ANGLES_DEG)[best],), samples, jaw)
        tried = sorted(np.argsort(costs[1:], kind="stable")[:TRIALS])
        worth = [i for i in tried if costs[1 + i] < (1 - TRIAL_GAIN) * costs[0]]
        candidates = (control_points, *(opened[i] for i in worth))
        return cls(candidates, (0.0, *(ANGLES_DEG[i] for i in worth)), samples, jaw)

    def chosen(self, deformation: Deformation, index: int) -> Deformation:
        """Return the deformation that starts from a candidate, and says its angle."""
        return replace(deformation, reference=self.candidates[index], jaw_deg=self.angles_deg[index])

    def cost(self, scan: ScanSurface, control_points: FloatArray) -> float:
        """Mean distance of the jaw to the scan, cut off at REACH_MM, in full where normals disagree."""
        points, jaw = self.samples.matrix @ control_points, self.weight > 0
        hits = scan.nearest.query(points[jaw])
        normals = surface_normals(points, self.samples.faces)[0][jaw]
        agreement = np.einsum("ij,ij->i", scan.normals_at(hits), normals)
        distance = np.where(agreement > 0, np.minimum(hits.distance, REACH_MM), REACH_MM)
        return float(self.weight[jaw] @ distance / max(self.weight.sum(), 1e-300))

    def best(self, scan: ScanSurface, reached: list[FloatArray]) -> int:
        """Return the index of the least opened candidate whose coarse fit ends about nearest (ABOUT).

        It is the first, the mouth as it is, unless another gains MIN_GAIN.
        """
        costs = np.array([self.cost(scan, points) for points in reached])
        if not costs.min() < (1 - MIN_GAIN) * costs[0]:
            return 0
        return int(np.argmax(costs <= (1 + ABOUT) * costs.min()))


def _of_the_jaw(landmarks: LandmarkPull, hinge: JawHinge) -> LandmarkPull | None:
    """Return the landmarks that show how far the jaw is open; None without any."""
    shown = landmarks.matrix @ hinge.weight > np.where(landmarks.numbers < 0, IN_PART, WITH_JAW)
    return landmarks.only(shown) if shown.any() else None


def _harmonic(matrix: sparse.csr_matrix, fixed: BoolArray, one: BoolArray) -> FloatArray:
    """Solve L w = 0 with w = 1 where `fixed` and `one`, 0 where `fixed` only."""
    weight = (fixed & one).astype(float)
    free = np.flatnonzero(~fixed)
    inner = matrix[free][:, free] + 1e-9 * sparse.identity(len(free))
    weight[free] = factorized(inner)(-(matrix[free] @ weight)[:, None])[:, 0]
    return np.clip(weight, 0.0, 1.0)
