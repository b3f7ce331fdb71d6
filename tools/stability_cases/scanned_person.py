"""A synthetic person's raw scan, whose truth is known, and what extremes make of it: shared by the stages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from scan2albedo import AnnotatedFaceModel, RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import without_unreferenced
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.synthetic import Scanner, raw_scan

SEED = 0


@dataclass(frozen=True)
class Scanned:
    """A scan, its true pose `model_from_scan` (4, 4), and true landmarks and surface in the model's frame."""

    scan: RawScan
    model_from_scan: FloatArray
    landmarks: FloatArray
    surface: FloatArray

    @property
    def in_model_frame(self) -> FloatArray:
        """(V, 3) the scan's vertices in the model's frame."""
        return transform_points(self.model_from_scan, self.scan.vertices)

    @property
    def centres(self) -> FloatArray:
        """(F, 3) centres of the scan's faces in the model's frame."""
        return self.in_model_frame[self.scan.faces].mean(1)

    def moved(self, target_from_scan: FloatArray) -> Scanned:
        """Return the same scan in another pose."""
        scan = replace(self.scan, vertices=transform_points(target_from_scan, self.scan.vertices))
        return replace(self, scan=scan, model_from_scan=self.model_from_scan @ invert_rigid(target_from_scan))

    def shifted(self, distance_mm: float) -> Scanned:
        """Return the same scan far from its origin."""
        return self.moved(compose(np.eye(3), distance_mm * np.array([1.0, -1.0, 1.0])))

    def with_vertices(self, vertices: FloatArray) -> Scanned:
        """Return the scan with other vertices."""
        return replace(self, scan=replace(self.scan, vertices=vertices))

    def with_faces(self, faces: IntArray) -> Scanned:
        """Return the scan with other faces, without colour."""
        return replace(self, scan=RawScan(self.scan.vertices, faces, name=self.scan.name))

    def kept(self, mask: BoolArray) -> Scanned:
        """Return what is left of the scan where `mask` (F,) is True."""
        used, faces = without_unreferenced(self.scan.vertices, self.scan.faces[mask])
        return replace(self, scan=RawScan(self.scan.vertices[used], faces, name=self.scan.name))

    def scaled(self, factor: float) -> Scanned:
        """Return the scan, and the truth, larger about the model's origin."""
        grown = transform_points(invert_rigid(self.model_from_scan), factor * self.in_model_frame)
        larger = self.with_vertices(grown)
        return replace(larger, landmarks=factor * self.landmarks, surface=factor * self.surface)

    def pose_error(self, model_from_scan: FloatArray) -> tuple[float, float]:
        """Return how far a pose is off: degrees, and the mean of the landmarks in mm."""
        change = model_from_scan @ invert_rigid(self.model_from_scan)
        off = np.linalg.norm(transform_points(change, self.landmarks) - self.landmarks, axis=1)
        return float(np.degrees(rotation_angle_rad(change[:3, :3]))), float(off.mean())

    def surface_error_mm(self, fitted: FittedFace) -> float:
        """Return the mean distance of the true, noise-free surface to a fitted one."""
        change = fitted.model_from_scan @ invert_rigid(self.model_from_scan)
        query = ClosestPointQuery(fitted.vertices, fitted.faces)
        return float(query.query(transform_points(change, self.surface)).distance.mean())


@cache
def model() -> AnnotatedFaceModel:
    """Return the default model."""
    return AnnotatedFaceModel.default()


@cache
def person(seed: int = SEED) -> Scanned:
    """Return a raw scan of 17,000 vertices in a random pose: noise, holes, spikes, loose patches."""
    scan, truth = raw_scan(seed, scanner=Scanner(spacing_mm=3.0, picture_size=300, size=64))
    return Scanned(scan, truth.model_from_scan, truth.landmarks, truth.image.position[truth.image.mask])


def noisy(scene: Scanned, sigma_mm: float) -> Scanned:
    """Return the scan with Gaussian noise on its vertices."""
    noise = np.random.default_rng(1).normal(scale=sigma_mm, size=scene.scan.vertices.shape)
    return scene.with_vertices(scene.scan.vertices + noise)


def shredded(scene: Scanned, share: float) -> Scanned:
    """Return the scan with this share of its triangles left, at random."""
    return scene.kept(np.random.default_rng(0).random(len(scene.scan.faces)) < share)


def stray(scene: Scanned, count: int, distance_mm: float) -> Scanned:
    """Return the scan with some vertices thrown far away."""
    rng, vertices = np.random.default_rng(0), scene.scan.vertices.copy()
    used = np.unique(scene.scan.faces)
    vertices[rng.choice(used, count, replace=False)] += rng.normal(scale=distance_mm, size=(count, 3))
    return scene.with_vertices(vertices)


def with_outlier_triangles(scene: Scanned) -> Scanned:
    """Return the scan with as many loose vertices again, thrown about it in small triangles."""
    rng, vertices = np.random.default_rng(0), scene.scan.vertices
    low, high, count = vertices.min(0) - 100, vertices.max(0) + 100, len(vertices) // 3
    loose = rng.uniform(low, high, (count, 1, 3)) + rng.normal(0, 2, (count, 3, 3))
    extra = len(vertices) + np.arange(3 * count).reshape(-1, 3)
    scan = RawScan(
        np.concatenate([vertices, loose.reshape(-1, 3)]), np.concatenate([scene.scan.faces, extra])
    )
    return replace(scene, scan=scan)


def spoilt(scene: Scanned) -> Scanned:
    """Return the scan with coincident vertices, slivers (1e6), zero-area, double and non-manifold faces."""
    rng, vertices, faces = np.random.default_rng(0), scene.scan.vertices, scene.scan.faces
    picked = faces[rng.choice(len(faces), 1000, replace=False)]
    first = len(vertices)
    beside = vertices[picked[:, 0]] + 1e-6 * (vertices[picked[:, 1]] - vertices[picked[:, 0]])
    copies = np.arange(1000) + first
    more = [
        np.stack([picked[:, 0], picked[:, 1], copies], 1),
        np.stack([picked[:, 0], picked[:, 1], picked[:, 0]], 1),
        picked,
        np.stack([picked[:200, 0], picked[:200, 1], rng.integers(0, first, 200)], 1),
    ]
    scan = RawScan(np.concatenate([vertices, beside]), np.concatenate([faces, *more]))
    return replace(scene, scan=scan)
