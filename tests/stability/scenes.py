"""A synthetic person's raw scan, whose truth is known, and what extremes make of it: shared by the stages."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from helpers.meshes import grid

from scan2albedo import AnnotatedFaceModel, RawScan
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import without_unreferenced
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    rotation_angle_rad,
    rotation_from_vector,
    transform_points,
)
from scan2albedo.synthetic import Scanner, raw_scan


@dataclass(frozen=True)
class Scanned:
    """A scan, its true pose `model_from_scan` (4, 4), and true landmarks and surface in the model's frame."""

    scan: RawScan
    model_from_scan: np.ndarray
    landmarks: np.ndarray
    surface: np.ndarray

    @property
    def in_model_frame(self):
        """(V, 3) the scan's vertices in the model's frame."""
        return transform_points(self.model_from_scan, self.scan.vertices)

    @property
    def centres(self):
        """(F, 3) centres of the scan's faces in the model's frame."""
        return self.in_model_frame[self.scan.faces].mean(1)

    def moved(self, target_from_scan):
        """Return the same scan in another pose."""
        placed = self.with_vertices(transform_points(target_from_scan, self.scan.vertices))
        return replace(placed, model_from_scan=self.model_from_scan @ invert_rigid(target_from_scan))

    def shifted(self, distance_mm):
        """Return the same scan far from its origin."""
        return self.moved(compose(np.eye(3), distance_mm * np.array([1.0, -1.0, 1.0])))

    def turned(self, axis_angle):
        """Return the same scan as the model stands, turned."""
        turn = compose(rotation_from_vector(axis_angle), np.zeros(3))
        return self.moved(turn @ self.model_from_scan)

    def with_vertices(self, vertices):
        """Return the scan with other vertices."""
        return replace(self, scan=replace(self.scan, vertices=vertices))

    def with_mesh(self, faces, more_vertices=np.zeros((0, 3))):
        """Return the scan with other faces, and more vertices, without colour."""
        return replace(self, scan=RawScan(np.vstack([self.scan.vertices, more_vertices]), faces, name="scan"))

    def painted(self, value):
        """Return the scan with vertex colours of one value in place of its texture."""
        colour = np.full(self.scan.vertices.shape, value, np.float32)
        return RawScan(self.scan.vertices, self.scan.faces, vertex_color_linear=colour, name="scan")

    def wound(self, turned):
        """Return the scan, without colour, with the winding of some faces (F,) turned."""
        faces = self.scan.faces
        return self.with_mesh(np.where(turned[:, None], faces[:, ::-1], faces))

    def kept(self, mask):
        """Return what is left of the scan where `mask` (F,) is True."""
        used, faces = without_unreferenced(self.scan.vertices, self.scan.faces[mask])
        return replace(self, scan=RawScan(self.scan.vertices[used], faces, name=self.scan.name))

    def scaled(self, factor):
        """Return the scan, and the truth, larger about the model's origin."""
        grown = transform_points(invert_rigid(self.model_from_scan), factor * self.in_model_frame)
        larger = self.with_vertices(grown)
        return replace(larger, landmarks=factor * self.landmarks, surface=factor * self.surface)

    def pose_error(self, model_from_scan):
        """Return how far a pose is off: degrees, and the mean of the landmarks in mm."""
        change = model_from_scan @ invert_rigid(self.model_from_scan)
        off = np.linalg.norm(transform_points(change, self.landmarks) - self.landmarks, axis=1)
        return float(np.degrees(rotation_angle_rad(change[:3, :3]))), float(off.mean())

    def surface_error_mm(self, fitted):
        """Return the mean distance of the true, noise-free surface to a fitted one."""
        change = fitted.model_from_scan @ invert_rigid(self.model_from_scan)
        query = ClosestPointQuery(fitted.vertices, fitted.faces)
        return float(query.query(transform_points(change, self.surface)).distance.mean())


TEXTURE_SHAPES = {"1 x 1": (1, 1), "1 x 10000": (1, 10000), "10000 x 1": (10000, 1)}


@cache
def model():
    """Return the default model."""
    return AnnotatedFaceModel.default()


@cache
def person(seed=0):
    """Return a raw scan of 17,000 vertices in a random pose: noise, holes, spikes, loose patches."""
    scan, truth = raw_scan(seed, scanner=Scanner(spacing_mm=3.0, picture_size=300, size=64))
    return Scanned(scan, truth.model_from_scan, truth.landmarks, truth.image.position[truth.image.mask])


def plane(cells, side_mm):
    """Return vertices and faces of a flat square about the origin."""
    vertices, faces = grid(cells, cells)
    return side_mm * (vertices - [0.5, 0.5, 0]), faces


def line():
    """Return vertices and faces of a line of 200 points."""
    return np.linspace(0, 200, 200)[:, None] * [1, 0, 0], np.arange(198)[:, None] + np.arange(3)


def moebius():
    """Return vertices and faces of a Moebius strip: a band whose last row is the first one, turned over."""
    band, faces = grid(5, 81)
    across, angle = 60 * band[:400, 0] - 30, 2 * np.pi * band[:400, 1]
    radius = 100 + across * np.cos(angle / 2)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), across * np.sin(angle / 2)])
    return points, np.where(faces < 400, faces, 404 - faces)


def with_one(array, value, at=3):
    """Return an array with another value at one place."""
    changed = array.copy()
    changed[at] = value
    return changed


def mixed(faces, every=2):
    """Return faces of which the first of so many alone is wound as before."""
    return np.where((np.arange(len(faces)) % every == 0)[:, None], faces, faces[:, ::-1])


def noisy(scene, sigma_mm):
    """Return the scan with Gaussian noise on its vertices."""
    noise = np.random.default_rng(1).normal(scale=sigma_mm, size=scene.scan.vertices.shape)
    return scene.with_vertices(scene.scan.vertices + noise)


def at_random(scene, share):
    """Return a mask (F,) of this share of the scan's triangles."""
    return np.random.default_rng(0).random(len(scene.scan.faces)) < share


def stray(scene, count, distance_mm):
    """Return the scan with some vertices thrown far away."""
    rng, vertices = np.random.default_rng(0), scene.scan.vertices.copy()
    used = np.unique(scene.scan.faces)
    vertices[rng.choice(used, count, replace=False)] += rng.normal(scale=distance_mm, size=(count, 3))
    return scene.with_vertices(vertices)


def with_outlier_triangles(scene):
    """Return the scan with as many loose vertices again, thrown about it in small triangles."""
    rng, vertices = np.random.default_rng(0), scene.scan.vertices
    low, high, count = vertices.min(0) - 100, vertices.max(0) + 100, len(vertices) // 3
    loose = rng.uniform(low, high, (count, 1, 3)) + rng.normal(0, 2, (count, 3, 3))
    extra = len(vertices) + np.arange(3 * count).reshape(-1, 3)
    return scene.with_mesh(np.concatenate([scene.scan.faces, extra]), loose.reshape(-1, 3))


def spoilt(scene):
    """Return the scan with coincident vertices, slivers (1e6), zero-area, double and non-manifold faces."""
    rng, vertices, faces = np.random.default_rng(0), scene.scan.vertices, scene.scan.faces
    picked = faces[rng.choice(len(faces), 1000, replace=False)]
    first, second, _ = picked.T
    copies = vertices[first] + 1e-6 * (vertices[second] - vertices[first])
    more = [
        np.stack([first, second, len(vertices) + np.arange(1000)], 1),
        np.stack([first, second, first], 1),
        picked,
        np.stack([first[:200], second[:200], rng.integers(0, len(vertices), 200)], 1),
    ]
    return scene.with_mesh(np.concatenate([faces, *more]), copies)
