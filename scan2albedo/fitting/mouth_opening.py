"""Open the model's mouth, and draw its corners back (a smile) or together (a pout), before it bends.

Closest points alone let closed lips slide along the chin of an open mouth, and slide no corner along a
surface. So models opened at the jaw's hinge are tried, and chosen by a coarse fit and by what lies behind the
film, the part of the surface from lip to lip; then smiling ones, chosen, each side for itself, by whether a
coarse fit reaches into the crease of the cheek.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, dots, norms
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import MOUTH_REGION
from scan2albedo.fitting.dynamics import factorized
from scan2albedo.fitting.landmark_pull import LandmarkPull
from scan2albedo.fitting.samples import SurfaceSamples, surface_normals
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.fitting.stages import TRIAL_LEVEL, Deformation, coarsely_fitted
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.loop_subdivision import limit_matrix
from scan2albedo.geometry.mesh import face_cross_products, lengths, normalized
from scan2albedo.geometry.operators import laplacian

STILL = (*range(17, 48), *range(49, 54), 61, 62, 63, 0, 16)
"""iBUG-68 indices of brows, nose, eyes, upper lip and the jaw line's ends, which the jaw leaves in place."""
MOVING = (7, 8, 9, *range(55, 60), 65, 66, 67)
"""Chin and lower lip."""
CHIN = 8
HINGE_DEPTH = 0.18
"""The jaw's joint is that part of the face's width behind the ends of the jaw line."""
NECK_BELOW_CHIN_MM = 35.0
"""Where the neck begins."""
FILM_WEIGHT = 1e-3
"""Weight of the faces between the lips, which hardly tie them together."""
LIMIT_FREEDOM = 0.05
"""Weight of keeping the control points in place against turning the surface exactly."""
ANGLES_DEG = (4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0)
"""The jaw is turned by two steps while it comes nearer to the scan, then by one."""
REACH_MM = 8.0
"""Distances are cut off here."""
FAR_MM = 2.0
"""A jaw that lies so far from the scan is turned twice as far, too, where that is no nearer: most open ones,
and one in twenty of those that are shut."""
MIN_GAIN = 0.12
"""Least part of the distance that an opening saves: open jaws save 0.18 and more, puffed cheeks and rounded
lips up to 0.5."""
GAP = 0.35
"""Least part of the film behind which nothing is near: 0.5 and more of open jaws, 0.2 of puffed cheeks and
rounded lips."""
BEHIND_MM = 6.0
"""Scan nearer than this, with normals within 60 degrees of the film's, is skin."""
WITH_JAW = 0.7
"""Landmarks that follow the jaw by this and more show how far it is open; the mouth's corners do not."""
JAW_WEIGHT = 0.6
"""Samples that follow the jaw by this and more measure its distance to the scan."""
SURE_MM = 2.0
"""Landmarks of a larger standard deviation, as a network's are, do not show how far it is open."""

CORNERS = (48, 54)
"""iBUG-68 indices of the corners of the mouth, the subject's right side first."""
FIRST_MM = (0.0, -7.0, 10.0)
FURTHER_MM = {-14.0: -7.0, 15.0: 10.0}
"""Pulls in mm, above 0 back and below 0 together: those tried on every scan, and those tried when the pull
that they are mapped to has gained."""
WORTH = 0.2
"""Share of the distance that 10 mm must save for 15 mm to be tried."""
BACK_GAIN = 0.34
"""Share of the distance that the coarse fit of a pull back must save: shut mouths up to 0.32, smiles from
0.35 on."""
NARROWER_GAIN = 0.03
"""The same of a pull together: most puffed cheeks and puckered lips 0.03 to 0.24, other mouths none."""
ZONE_MM = 45.0
"""Scan this near to the middle of the mouth is compared: the mouth, and the cheek that a smile folds."""
MIN_COSINE = 0.2
"""Used is what has normals within 78 degrees of the model's."""


def mouth_opened(deformation: Deformation, landmarks: LandmarkPull | None = None) -> Deformation:
    """Return the deformation that starts from the mouth opened as far as the scan's.

    Placed landmarks that the jaw moves show the angle. Without them opened models run through the first
    stages; an opening is believed where the jaw comes nearer by MIN_GAIN, and GAP of the film has no scan
    behind it.
    """
    hinge = JawHinge.of(deformation.model, deformation.reference)
    if hinge is None or deformation.meter.exhausted:
        return deformation
    search = MouthSearch(deformation, hinge)
    shown = None
    if landmarks is not None:
        sure = (landmarks.numbers >= 0) & (landmarks.sigma_mm <= SURE_MM)
        with_jaw = sure & (landmarks.matrix @ hinge.weight > WITH_JAW)
        shown = landmarks.only(with_jaw) if with_jaw.any() else None
    angle = search.shown_by(shown) if shown is not None else search.tried()
    if angle == 0 or deformation.meter.exhausted:
        return deformation
    return replace(deformation, reference=search.opened(angle), jaw_deg=angle)


@dataclass(frozen=True)
class JawHinge:
    """How the lower face turns about an axis along x through `center` (3,).

    `weight` (C,) is the part of the angle by which the limit surface turns at each control point; `limit` (C,
    C) gives limit positions from control points.
    """

    center: FloatArray
    weight: FloatArray
    limit: sparse.csr_matrix

    @classmethod
    def of(cls, model: AnnotatedSurface, control_points: FloatArray) -> Self | None:
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
        matrix = laplacian(control_points, model.control_faces, film)
        weight = (fixed & moving).astype(float)
        free = np.flatnonzero(~fixed)
        inner = matrix[free][:, free] + 1e-9 * sparse.identity(len(free))
        weight[free] = factorized(inner)(-(matrix[free] @ weight)[:, None])[:, 0]
        weight = np.clip(weight, 0.0, 1.0)
        ears = landmarks[[0, 16]]
        center = ears.mean(0) - [0.0, 0.0, HINGE_DEPTH * float(np.linalg.norm(ears[1] - ears[0]))]
        center[1] = landmarks[[1, 15], 1].mean()
        return cls(center, weight, limit_matrix(len(control_points), model.control_faces))

    @cached_property
    def _from_limit(self) -> Callable[[FloatArray], FloatArray]:
        return factorized(self.limit.T @ self.limit + LIMIT_FREEDOM * sparse.identity(len(self.weight)))

    def opened(self, control_points: FloatArray, angle_deg: float) -> FloatArray:
        """Return the control points (C, 3) whose surface has its jaw turned down by `angle_deg`."""
        turned = self._turned(control_points, angle_deg)
        missing = self._turned(self.limit @ control_points, angle_deg) - self.limit @ turned
        return turned + self._from_limit(self.limit.T @ missing)

    def angle_deg(self, rest: FloatArray, moved: FloatArray) -> float:
        """Return the median angle by which the jaw's surface turned from control points `rest` to `moved`."""
        jaw = self.weight > JAW_WEIGHT
        _, y, z = ((self.limit @ rest)[jaw] - self.center).T
        _, v, w = ((self.limit @ moved)[jaw] - self.center).T
        return float(np.rad2deg(np.median(np.arctan2(y * w - z * v, y * v + z * w) / self.weight[jaw])))

    def _turned(self, points: FloatArray, angle_deg: float) -> FloatArray:
        angle = np.deg2rad(angle_deg) * self.weight
        _, y, z = (points - self.center).T
        turned = points.copy()
        turned[:, 1] = self.center[1] + np.cos(angle) * y - np.sin(angle) * z
        turned[:, 2] = self.center[2] + np.sin(angle) * y + np.cos(angle) * z
        return turned


@dataclass(frozen=True)
class MouthSearch:
    """Angles of the jaw, and how well the mouth opened by each lies on the scan of a deformation."""

    deformation: Deformation
    hinge: JawHinge

    def opened(self, angle_deg: float) -> FloatArray:
        """Return the control points (C, 3) with the jaw turned down."""
        rest = self.deformation.reference
        return self.hinge.opened(rest, angle_deg) if angle_deg else rest

    def shown_by(self, landmarks: LandmarkPull) -> float:
        """Return the angle that brings landmarks nearest to their targets; 0 where that is off the scan."""
        every = (0.0, *ANGLES_DEG)
        apart = [norms(landmarks.offsets(self.opened(angle))).mean() for angle in every]
        nearest = every[np.argmin(apart)]
        still, open_ = (self.cost(self.opened(angle)) for angle in (0.0, nearest))
        return nearest if open_ < still else 0.0

    def tried(self) -> float:
        """Return the angle whose coarse fit ends nearest, 0 unless there is evidence of an opening."""
        costs, reached = dict[float, float](), dict[float, FloatArray]()

        def best_of(angles: Iterable[float]) -> float:
            for angle in angles:
                if self.deformation.meter.exhausted:
                    break
                if angle not in costs and 0 <= angle <= ANGLES_DEG[-1]:
                    reached[angle] = coarsely_fitted(self.deformation, self.opened(angle))
                    costs[angle] = self.cost(reached[angle])
            return min(costs, key=lambda angle: costs[angle], default=0.0)

        fine, coarse = ANGLES_DEG[:2]
        best = best_of((0.0, coarse))
        if best == 0 and costs[best] > FAR_MM:
            best = best_of((2 * coarse,))
        while best == max(costs, default=0.0) and 0 < best < ANGLES_DEG[-1] - coarse:
            if self.deformation.meter.exhausted:
                break
            best = best_of((best + coarse,))
        if best == 0 or costs[best] > (1 - MIN_GAIN) * costs[0.0] or self.gap(reached[best]) < GAP:
            return 0.0
        return best_of((best - fine, best + fine))

    def cost(self, control_points: FloatArray) -> float:
        """Mean distance of the jaw to the scan, cut off at REACH_MM, in full where normals disagree."""
        scan, (samples, _) = self.deformation.scan, self.deformation.sampled(TRIAL_LEVEL)
        weight = samples.area * (samples.matrix @ self.hinge.weight > JAW_WEIGHT)
        points, jaw = samples.matrix @ control_points, weight > 0
        hits = scan.nearest.query(points[jaw])
        normals = surface_normals(points, samples.faces)[0][jaw]
        agreement = dots(scan.normals_at(hits), normals)
        distance = np.where(agreement > 0, np.minimum(hits.distance, REACH_MM), REACH_MM)
        return float(weight[jaw] @ distance / max(weight.sum(), 1e-300))

    def gap(self, control_points: FloatArray) -> float:
        """Return which part of the film between the lips has no scan near; 1 for models without."""
        model, scan = self.deformation.model, self.deformation.scan
        subdivision = model.subdivision(TRIAL_LEVEL)
        film = model.in_region(MOUTH_REGION)[subdivision.parent]
        if not film.any():
            return 1.0
        points, faces = subdivision.matrix @ control_points, subdivision.faces[film]
        across = face_cross_products(points, faces)
        hits = scan.nearest.query(points[faces].mean(axis=1))
        agreement = dots(normalized(scan.normals_at(hits)), normalized(across))
        missing = (hits.distance > BEHIND_MM) | scan.on_boundary(hits) | (agreement < 0.5)
        area = lengths(across)
        return float(area @ missing / max(area.sum(), 1e-300))


def corners_pulled(deformation: Deformation) -> Deformation:
    """Return the deformation that starts from the corners of the mouth drawn back, or together."""
    reference, meter = deformation.reference, deformation.meter
    if meter.exhausted:
        return deformation
    moves, landmarks = corner_moves(deformation.model, reference), deformation.model.landmarks_of(reference)
    if moves is None or landmarks is None:
        return deformation
    mean_mm, saved = dict[float, FloatArray](), dict[float, FloatArray]()
    (samples, _), middle = deformation.sampled(TRIAL_LEVEL), landmarks[list(CORNERS)].mean(0)
    for mm in (*FIRST_MM, *FURTHER_MM):
        if meter.exhausted:
            return deformation
        if mm not in FURTHER_MM or saved[FURTHER_MM[mm]].max() > (WORTH if mm > 0 else 0.0):
            reached = coarsely_fitted(deformation, reference + mm * moves.sum(2) if mm else reference)
            mean_mm[mm] = mouth_distances(samples, deformation.scan, middle, reached)
            still, now = mean_mm[0.0], mean_mm[mm]
            # 0 where either is unknown.
            saved[mm] = np.where((still > 0) & (now >= 0), 1 - now / np.where(still > 0, still, 1.0), 0.0)
    pull = chosen_pulls(saved)
    return replace(deformation, reference=reference + moves @ pull, corners_mm=pull)


def corner_moves(model: AnnotatedSurface, control_points: FloatArray) -> FloatArray | None:
    """Return how control points move (C, 3, 2) when the right or the left corner is drawn back by a mm.

    That is toward the ears; None without landmarks.
    """
    landmarks = model.landmarks_of(control_points)
    if landmarks is None:
        return None
    corners = landmarks[list(CORNERS)]
    middle, half_width = corners.mean(0), max(float(np.linalg.norm(corners[1] - corners[0])), 1e-6) / 2
    across, above = (control_points - middle)[:, :2].T
    beyond = np.maximum(np.abs(across) - half_width, 0)
    # The skin beside and above the corners follows them, with standard deviations of 15 and 14 mm.
    share = np.minimum(np.abs(across) / half_width, 1) * np.exp(-0.5 * (beyond / 15) ** 2)
    share = share * np.exp(-0.5 * (above / 14) ** 2)
    toward = normalized(landmarks[[0, 16]] - corners)
    return (share * [across < 0, across > 0]).T[:, None] * toward.T


def mouth_distances(
    samples: SurfaceSamples, scan: ScanSurface, middle: FloatArray, control_points: FloatArray
) -> FloatArray:
    """Return mean distances (2,), mm, of the scan right and left of a mouth's `middle` (3,) from a face.

    Scan whose normal disagrees is left out, distances are cut off at REACH_MM; NaN on a side without any.
    """
    near = norms(scan.vertices - middle) < ZONE_MM
    surface, faces = samples.matrix @ control_points, samples.faces
    hits = NearestSurface(surface, faces).query(scan.vertices[near])
    across = normalized(hits.interpolated(surface_normals(surface, faces)[0], faces))
    facing = dots(across, scan.normals[near]) > MIN_COSINE
    distance, left = np.minimum(hits.distance, REACH_MM), scan.vertices[near, 0] > middle[0]
    sides = [distance[facing & (left == side)] for side in (False, True)]
    return np.array([side.mean() if len(side) else np.nan for side in sides])


def chosen_pulls(saved: Mapping[float, FloatArray]) -> tuple[float, float]:
    """Return the pulls in mm of the right and the left corner whose coarse fits ended nearest.

    Each of them `saved` a part of the distance (2,), right and left. A side is drawn back only when it gains
    BACK_GAIN; both are drawn together when they gain NARROWER_GAIN on average.
    """
    narrower = max((mm for mm in saved if mm <= 0), key=lambda mm: saved[mm].sum())
    if saved[narrower].mean() > NARROWER_GAIN:
        return narrower, narrower
    right, left = (max(saved, key=lambda mm: saved[mm][side]) for side in (0, 1))
    return (right if saved[right][0] > BACK_GAIN else 0.0, left if saved[left][1] > BACK_GAIN else 0.0)
