"""Points of the model that shall lie on points of the scan: soft constraints of the fit."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, norms
from scan2albedo.core.landmarks import PlacedLandmarks
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.face_model.annotation import LANDMARK_LEVELS
from scan2albedo.fitting.dynamics import Springs, factorized
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import edges_with_faces, vertex_areas
from scan2albedo.geometry.operators import bending
from scan2albedo.geometry.rigid import transform_points

WRONG_MM = 15.0
"""A landmark this far from where the scan's shape and the other landmarks put it is left out."""
STILL = (*range(17, 48),)
"""iBUG-68: brows, nose and eyes, which no expression moves far."""
SHOWN_BY_HOLE = -1
"""Number of a target that a hole of the scan shows."""
SHOWN_BY_COLOR = -2
"""Number of a landmark that the scan's colours show."""
_FIRST_MM2 = 1200.0
"""Surface that pulls along its normal as strongly as a landmark of 1 mm standard deviation does while pose,
size and proportions are found. More draws the face off the scan."""
_BENT_MM2 = 300.0
"""The same when the model is bent to its landmarks."""
_HELD_MM2 = 30.0
"""The same while landmarks are held there. More draws the face off the scan."""
_ONTO_SCAN_MM = 5.0
"""A landmark is laid onto scan this near."""
_SUREST_MM = 0.1
"""Least standard deviation of a placed point: no scan is finer."""
_PERSON_MM = 4.0
"""Standard deviation of where shape alone puts a landmark."""
_CORRELATION_MM = 20.0
"""Distance over which neighbouring points are misplaced alike."""


@dataclass(frozen=True)
class LandmarkPull:
    """Points of the model that shall lie on points of the scan.

    `numbers` (L,) are those of iBUG-68, below 0 for what the scan itself shows; `matrix` (L, C) gives the
    model's points from control points, `targets` (L, 3) are in mm, `sigma_mm` (L,) their standard deviations;
    `axes` (L, 3) are 1 along those that they are known along. One `wrong_mm` (L,) off is not believed; those
    `still` (L,) whatever the face expresses count while pose, size and proportions are found.
    """

    numbers: IntArray
    matrix: sparse.csr_matrix
    targets: FloatArray
    sigma_mm: FloatArray
    wrong_mm: FloatArray
    axes: FloatArray
    still: BoolArray

    @classmethod
    def of(
        cls, model: AnnotatedSurface, placed: PlacedLandmarks | None, frame_from_scan: FloatArray
    ) -> LandmarkPull | None:
        """Return the pull of placed landmarks, moved into a frame; None without any on scan or model."""
        if placed is None or model.landmark_points is None:
            return None
        numbers = np.flatnonzero(placed.placed)
        ones = np.ones(len(numbers))
        return cls(
            numbers,
            model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)[numbers],
            transform_points(frame_from_scan, placed.points[numbers]),
            sigma_mm=np.maximum(placed.sigma_mm[numbers], _SUREST_MM),
            wrong_mm=WRONG_MM * ones,
            axes=ones[:, None] * np.ones(3),
            still=np.isin(numbers, STILL),
        )

    @property
    def openings(self) -> int:
        """How many holes of the scan there are among the targets: each has a middle and two ends."""
        return int((self.numbers == SHOWN_BY_HOLE).sum()) // 3

    @property
    def painted(self) -> int:
        """How many of the targets are landmarks that the scan's colours show."""
        return int((self.numbers == SHOWN_BY_COLOR).sum())

    def moved(self, transform: FloatArray) -> LandmarkPull:
        """Return the pull to the targets moved by a (4, 4) transform."""
        return replace(self, targets=transform_points(transform, self.targets))

    def offsets(self, control_points: FloatArray) -> FloatArray:
        """Return (L, 3) from the model's points to the targets."""
        return self.seen_offsets(self.matrix @ control_points)

    def seen_offsets(self, points: FloatArray) -> FloatArray:
        """Return (L, 3) from the model's landmarks (L, 3), wherever they are, to the targets."""
        return self.axes * (self.targets - points)

    def person_weight(self, offset: FloatArray) -> FloatArray:
        """Return (L,) mm2 of surface that each counts for at `offset` (L, 3), while shape is a mean one."""
        variance = _PERSON_MM**2 + self.sigma_mm**2
        far = np.sum(offset**2, axis=1) / self.wrong_mm**2
        return np.where(self.still, _FIRST_MM2 * _PERSON_MM**2 / variance / (1 + far) ** 2, 0.0)

    def without_wrong(
        self, model: AnnotatedSurface, control_points: FloatArray
    ) -> tuple[LandmarkPull | None, IntArray]:
        """Return those that agree with each other and the shape, and the numbers of the others.

        The worst is left out while it is `wrong_mm` from where the others, smoothly followed, put it.
        """
        kept, wrong = self, list[int]()
        while True:
            solve, spread = kept._smoother(model, control_points)
            offset = kept.offsets(control_points)
            influence = kept.matrix @ solve(spread.toarray())
            alone = (offset - influence @ offset) / (1 - np.diag(influence))[:, None]
            distance = norms(alone) / kept.wrong_mm
            worst = int(np.argmax(distance))
            if distance[worst] < 1:
                return kept, np.array(sorted(wrong), int)
            wrong.append(int(kept.numbers[worst]))
            if len(kept.numbers) == 1:
                return None, np.array(sorted(wrong), int)
            kept = kept.only(np.arange(len(kept.numbers)) != worst)

    def only(self, used: BoolArray) -> LandmarkPull:
        """Return the pull of some of the landmarks (L,)."""
        return LandmarkPull(*(getattr(self, part.name)[used] for part in fields(self)))

    def followed(self, model: AnnotatedSurface, control_points: FloatArray) -> FloatArray:
        """Return the control points (C, 3), bent so that the landmarks come near their targets.

        The displacement u has the least sum |B u - d|^2 / sigma^2 + int m |u|^2 + D |laplacian u|^2.
        """
        solve, spread = self._smoother(model, control_points)
        return control_points + solve(spread @ self.offsets(control_points))

    def held(self, control_points: FloatArray, scan: ScanSurface) -> LandmarkPull:
        """Return the pull that holds landmarks where they are now along the scan, but lays them onto it."""
        points = self.matrix @ control_points
        hits = scan.nearest.query(points)
        # Holes have nothing to lay it on, and colours show places of the front view alone.
        near = (hits.distance < _ONTO_SCAN_MM) & ~scan.on_boundary(hits) & (self.numbers >= 0)
        return replace(self, targets=np.where(near[:, None], hits.points, points))

    def force(self, control_points: FloatArray) -> FloatArray:
        """Return (C, 3) forces on control points toward the targets."""
        return self.matrix.T @ (self._springs[:, None] * self.offsets(control_points))

    def with_springs(self, product: Springs) -> Springs:
        """Return x -> H x with the stiffness of these springs added."""
        springs = self._springs[:, None] * self.axes
        return lambda x: product(x) + self.matrix.T @ (springs * (self.matrix @ x))

    @property
    def _springs(self) -> FloatArray:
        return _HELD_MM2 / self.sigma_mm**2

    def _smoother(
        self, model: AnnotatedSurface, control_points: FloatArray
    ) -> tuple[Springs, sparse.csr_matrix]:
        """Return the solver of the system, and (C, L) what takes offsets to its right-hand side."""
        faces = model.control_faces
        # A point load on a plate of stiffness D on a foundation m meets 8 sqrt(D m), and dents it over
        # (D / m)^(1/4).
        product = _BENT_MM2 / _PERSON_MM**2 / 8
        plate, foundation = product * _CORRELATION_MM**2, product / _CORRELATION_MM**2
        area = np.maximum(vertex_areas(control_points, faces), 1e-6)
        spread = (self.matrix.T @ sparse.diags(_BENT_MM2 / self.sigma_mm**2)).tocsr()
        smooth = plate * bending(control_points, faces, np.ones(len(faces)))
        return factorized(smooth + foundation * sparse.diags(area) + spread @ self.matrix), spread


EYES = (tuple(range(36, 42)), tuple(range(42, 48)))
"""iBUG-68, the subject's right eye first."""
INNER_LIPS = tuple(range(60, 68))
_REACH_MM = 25.0
"""Eyes and the middle of the lips of a registered face are this near to the model's."""
_ASIDE_MM = 4.0
"""The middle between both eyes, or between a mouth's ends, is this near to the model's midline."""
_LEVEL_MM = 5.0
"""Both eyes, and both ends of a mouth, differ in height by at most this."""
_EYE_MM = ((16.0, 36.0), (4.0, 25.0))
"""Ranges of width and height of holes that may be an eye, with what a scanner loses around it."""
_MOUTH_MM = ((20.0, 75.0), (4.0, 50.0))
"""The same of an open mouth."""
_APART_MM = (50.0, 78.0)
"""Range of the distance between the middles of people's eyes."""
_SIZE_RATIO = (1.3, 1.8)
"""One eye's hole is at most so much wider and higher than the other's: else more is missing than an eye."""
_MIDDLE_MM = 1.5
"""Standard deviation of the middle of a hole from that of the opening."""
_END_MM = 3.0
"""Standard deviation of an end of a hole from that of the opening."""


@dataclass(frozen=True)
class _Holes:
    """Holes of a scan: `middle` (H, 3), `ends` (H, 2, 3), right before left, `size` (H, 2): width and height.

    mm, in the model's frame.
    """

    middle: FloatArray
    ends: FloatArray
    size: FloatArray

    @classmethod
    def of(cls, scan: ScanSurface) -> _Holes:
        """Find the holes: edges of the border that hang together.

        Where a border touches itself, loops would cut a mouth in two.
        """
        edges, faces_around = edges_with_faces(scan.faces)
        # Those with an odd number of faces close, even where lips grew together in an edge of three.
        edges = edges[faces_around % 2 == 1]
        links = sparse.coo_matrix((np.ones(len(edges)), edges.T), (len(scan.vertices),) * 2)
        label = connected_components(links, directed=False)[1][edges[:, 0]]
        middles, ends, sizes = [], [], []
        for one in np.unique(label):
            border = scan.vertices[edges[label == one]]
            lengths = norms(border[:, 1] - border[:, 0])
            points = border.reshape(-1, 3)
            middles.append(lengths @ border.mean(1) / max(float(lengths.sum()), 1e-12))
            ends.append(points[[np.argmin(points[:, 0]), np.argmax(points[:, 0])]])
            sizes.append(np.ptp(points, axis=0)[:2])
        return cls(np.reshape(middles, (-1, 3)), np.reshape(ends, (-1, 2, 3)), np.reshape(sizes, (-1, 2)))

    def near(self, place: FloatArray, ranges: tuple[tuple[float, float], tuple[float, float]]) -> list[int]:
        """Return the holes near a place whose width and height lie in their ranges."""
        low, high = np.array(ranges).T
        close = norms(self.middle - place) < _REACH_MM
        return np.flatnonzero(close & ((low < self.size) & (self.size < high)).all(1)).tolist()

    def eyes(self, landmarks: FloatArray) -> tuple[int, int] | None:
        """Return the right and left eye: level, as far apart as people's, and nearest to the model's."""
        right_eye, left_eye = (landmarks[list(eye)].mean(0) for eye in EYES)
        pairs = []
        for right, left in product(self.near(right_eye, _EYE_MM), self.near(left_eye, _EYE_MM)):
            apart, up, _ = self.middle[left] - self.middle[right]
            aside = (self.middle[right] + self.middle[left])[0] / 2 - (right_eye + left_eye)[0] / 2
            one, other = self.size[[right, left]]
            similar = np.maximum(one, other) < _SIZE_RATIO * np.minimum(one, other)
            level = np.hypot(up / _LEVEL_MM, aside / _ASIDE_MM) < 1
            if _APART_MM[0] < apart < _APART_MM[1] and level and similar.all():
                off = norms([self.middle[right] - right_eye, self.middle[left] - left_eye])
                pairs.append((float(off.sum()), right, left))
        return min(pairs, key=lambda pair: pair[0])[1:] if pairs else None

    def mouth(self, landmarks: FloatArray) -> int | None:
        """Return the open mouth: level, on the midline near the model's, the widest of such."""
        lips = landmarks[list(INNER_LIPS)].mean(0)
        aside = np.abs(self.ends[:, :, 0].mean(1) - lips[0])
        tilt = np.abs(np.ptp(self.ends[:, :, 1], axis=1))
        found = [k for k in self.near(lips, _MOUTH_MM) if aside[k] < _ASIDE_MM and tilt[k] < _LEVEL_MM]
        return max(found, key=lambda hole: self.size[hole, 0], default=None)


def joined(*pulls: LandmarkPull | None) -> LandmarkPull | None:
    """Return the pull to the targets of all; None without any."""
    known = [pull for pull in pulls if pull is not None]
    if not known:
        return None
    columns = ([getattr(pull, part.name) for pull in known] for part in fields(LandmarkPull))
    return LandmarkPull(
        *(sparse.vstack(c).tocsr() if sparse.issparse(c[0]) else np.concatenate(c) for c in columns)
    )


def openings(scan: ScanSurface, model: AnnotatedSurface) -> LandmarkPull | None:
    """Return the pull of lids and lips to the holes that they surround; None where the scan has none.

    The scan lies in the model's frame, registered. Two holes of the size of eyes, level and as far apart as
    people's, near the model's, are eyes; one of the size of a mouth, on the midline near the model's, is one.
    Each pulls the mean of the landmarks around it, and two of them to its ends.
    """
    landmarks = model.landmarks
    if landmarks is None or model.landmark_points is None or not scan.boundary.any():
        return None
    holes = _Holes.of(scan)
    around, hole = list[tuple[int, ...]](), list[int]()
    if eyes := holes.eyes(landmarks):
        around += EYES
        hole += eyes
    if (mouth := holes.mouth(landmarks)) is not None:
        around.append(INNER_LIPS)
        hole.append(mouth)
    if not around:
        return None
    weights = np.zeros((3 * len(around), 68))
    for row, numbers in enumerate(around):
        weights[3 * row, list(numbers)] = 1 / len(numbers)
        weights[3 * row + 1, numbers[0]] = 1.0
        # The other end lies opposite: the fourth of an eye's six, the fifth of the inner lips' eight.
        weights[3 * row + 2, numbers[len(numbers) // 2]] = 1.0
    every = model.subdivision(LANDMARK_LEVELS).points_matrix(model.landmark_points)
    return LandmarkPull(
        numbers=np.full(len(weights), SHOWN_BY_HOLE),
        matrix=(sparse.csr_matrix(weights) @ every).tocsr(),
        targets=np.concatenate([holes.middle[hole][:, None], holes.ends[hole]], axis=1).reshape(-1, 3),
        sigma_mm=np.tile([_MIDDLE_MM, _END_MM, _END_MM], len(around)),
        wrong_mm=np.full(len(weights), 2 * _REACH_MM),
        # The border of a hole may lie deep between lids or lips.
        axes=np.ones((len(weights), 3)) * (1.0, 1.0, 0.0),
        still=np.repeat([numbers != INNER_LIPS for numbers in around], 3),
    )
