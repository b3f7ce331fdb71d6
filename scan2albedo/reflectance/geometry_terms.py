"""The terms of a geometry fit: landmarks and colours as functions of the vertices' positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.operators import vertex_normal_jacobian
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.reflectance.environment_shading import shade_environment, shading_gradient
from scan2albedo.reflectance.picture_samples import SmoothImage
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

_VIEW_COSINE, _MARGIN_PX = 0.2, 2.0
"""Vertices whose normals have less than this cosine to the line of sight do not count, nor do those nearer
than so many pixels to an edge of the surface in the image."""
_LEAST_VERTICES = 20
"""Fewer do not determine a shape."""


@dataclass(frozen=True)
class GeometryFitOptions:
    """How pose and shape are fitted to one image.

    Raises `ValueError` when a value is outside its range.
    """

    landmark_weight: float = 0.2
    """Of the mean squared distance of landmarks, in mm at the face's depth."""
    photometric_weight: float = 2.0
    """Of the mean absolute difference of colours, in units of the image's median colour."""
    prior_weight: float = 1e-3
    """Of the squared coefficients."""
    softness: float = 0.01
    """Differences below this share of the median colour count by their squares (Charbonnier's epsilon)."""
    landmark_softness_mm: float | None = None
    """Errors of landmarks above this enter by their distance, not its square; None for squares alone."""
    contour: bool = True
    """Use landmarks 0 ... 16, along the jaw, which slide over the face where its outline is meant."""
    blur_edges: tuple[float, ...] = (0.3,)
    """The image is smoothed by these standard deviations, one after the other, in mean edges of the mesh: the
    reflectance does not hold what is finer than the spacing of its vertices."""
    rounds: int = 10
    """Most times that the vertices seen are found anew, for each of `blur_edges`."""
    largest_rmse: float = 0.25
    """Photometry is not accepted when the colours' relative rmse stays above this."""

    def __post_init__(self) -> None:
        positive = ["landmark_weight", "photometric_weight", "softness", "largest_rmse"]
        if self.landmark_softness_mm is not None:
            positive.append("landmark_softness_mm")
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, got {getattr(self, name)}")
        if not 0 <= self.prior_weight < math.inf:
            raise ValueError(f"prior_weight must be 0 or more and finite, got {self.prior_weight}")
        if self.rounds < 1:
            raise ValueError(f"rounds must be 1 or more, got {self.rounds}")
        if not self.blur_edges or not all(0 <= blur < math.inf for blur in self.blur_edges):
            raise ValueError(f"blur_edges must hold one or more finite numbers >= 0, got {self.blur_edges}")


@dataclass(frozen=True)
class WeightedResiduals:
    """Residuals r (R,) whose weighted squares replace a term locally: its gradient is J^T (weight r)."""

    residual: FloatArray
    weight: FloatArray
    by_vertices: sparse.bsr_matrix
    """(R, 3V) J, by the coordinates of the vertices in the scene, blocks three columns wide."""


class GeometryTerm(Protocol):
    """A part of the objective that depends on the vertices (V, 3) in the scene."""

    def value(self, vertices: FloatArray) -> float:
        """Return the term; inf where it is not defined."""

    def linearized(self, vertices: FloatArray) -> WeightedResiduals:
        """Return the term as weighted squares around `vertices`."""


@dataclass(frozen=True)
class LandmarkTerm:
    """Mean over landmarks of |p(x_k) - q_k|^2 in mm^2, growing more slowly beyond s = `softness_mm`.

    E = W / n sum 2 s^2 (sqrt(1 + |r|^2 / s^2) - 1),   or W / n sum |r|^2 without s.
    """

    camera: FloatArray
    """(3, 4), normalised."""
    vertex: IntArray
    """(n,) of each landmark seen, n > 0."""
    pixels: FloatArray
    """(n, 2) q."""
    pixel_mm: float
    """Size of a pixel at the face."""
    weight: float
    softness_mm: float | None

    def value(self, vertices: FloatArray) -> float:
        """Return the term; inf where a landmark's vertex lies behind the camera."""
        squared = np.sum(self._off(vertices) ** 2, axis=1)
        if not np.isfinite(squared).all():
            return np.inf
        if self.softness_mm is not None:
            width = self.softness_mm**2
            squared = 2 * width * (np.sqrt(1 + squared / width) - 1)
        return self.weight * float(squared.mean())

    def linearized(self, vertices: FloatArray) -> WeightedResiduals:
        """Return the term as weighted squares around `vertices`."""
        off, count = self._off(vertices), len(self.vertex)
        softer = np.ones(count)
        if self.softness_mm is not None:
            softer = 1 / np.sqrt(1 + np.sum(off**2, axis=1) / self.softness_mm**2)
        blocks = self.pixel_mm * projection_jacobian(self.camera, vertices[self.vertex])
        shape = (2 * count, 3 * len(vertices))
        jacobian = sparse.bsr_matrix((blocks, self.vertex, np.arange(count + 1)), shape=shape)
        weight = np.repeat(2 * self.weight / count * softer, 2)
        return WeightedResiduals(off.ravel(), weight, jacobian)

    def _off(self, vertices: FloatArray) -> FloatArray:
        return self.pixel_mm * (project(self.camera, vertices[self.vertex])[0] - self.pixels)


@dataclass(frozen=True)
class PhotometricTerm:
    """Mean over the vertices U and channels of sqrt(r^2 + eps^2) - eps, r = (I(p(x)) - shading) / unit.

    The vertices are chosen once; those that become hidden during the search still count.
    """

    image: SmoothImage
    camera: FloatArray
    """(3, 4), normalised."""
    faces: IntArray
    used: IntArray
    """(U,), U > 0."""
    reflectance: VertexReflectance
    """Of the U vertices."""
    light: FloatArray
    """(81, 3)."""
    unit: float
    """The colour that differences are relative to."""
    weight: float
    softness: float

    def value(self, vertices: FloatArray) -> float:
        """Return the term; inf where a vertex has no normal or lies behind the camera."""
        off = self.differences(vertices)
        if off is None:
            return np.inf
        return self.weight * float(np.mean(np.hypot(off, self.softness) - self.softness))

    def differences(self, vertices: FloatArray) -> FloatArray | None:
        """Return r (U, 3), or None when a vertex has no normal or lies behind the camera."""
        pixels, _ = project(self.camera, vertices[self.used])
        normals, sight = self._normals(vertices), self._sight(vertices)
        if not (np.isfinite(pixels).all() and normals.any(1).all()):
            return None
        shading = shade_environment(self.reflectance, normals, normalized(sight), self.light)
        return (self.image.look_up(pixels) - shading.radiance_linear) / self.unit

    def relative_rmse(self, vertices: FloatArray) -> float:
        """Return the root mean square of the differences over that of the image; inf where `value` is."""
        off = self.differences(vertices)
        if off is None:
            return np.inf
        observed = self.image.look_up(project(self.camera, vertices[self.used])[0]) / self.unit
        return float(np.linalg.norm(off) / max(float(np.linalg.norm(observed)), 1e-300))

    def linearized(self, vertices: FloatArray) -> WeightedResiduals:
        """Return the term as weighted squares around `vertices`, where its value is finite."""
        off = self.differences(vertices)
        if off is None:
            raise ValueError("the photometric term is not defined here; its value is inf")
        points, sight = vertices[self.used], self._sight(vertices)
        distance = np.linalg.norm(sight, axis=1)
        view = sight / distance[:, None]
        pixels, _ = project(self.camera, points)
        turned = shading_gradient(self.reflectance, self._normals(vertices), view, self.light)
        across = turned.by_view - np.einsum("uji,ui,uk->ujk", turned.by_view, view, view)
        direct = self.image.gradient(pixels) @ projection_jacobian(self.camera, points)
        # The line of sight turns against the vertex: its derivative is -(I - v v^T) / distance.
        direct += across / distance[:, None, None]
        jacobian = _by_vertices(
            vertex_normal_jacobian(vertices, self.faces), self.used, turned.by_normal, direct
        )
        jacobian.data /= self.unit
        weight = self.weight / off.size / np.hypot(off, self.softness)
        return WeightedResiduals(off.ravel(), weight.ravel(), jacobian)

    def _normals(self, vertices: FloatArray) -> FloatArray:
        return vertex_normals(vertices, self.faces)[self.used]

    def _sight(self, vertices: FloatArray) -> FloatArray:
        return np.asarray(camera_centers(self.camera[None])[0] - vertices[self.used])


@dataclass(frozen=True)
class Photometry:
    """An image smoothed at several levels, its camera, and the face's reflectance in a light."""

    images: Sequence[SmoothImage]
    """From smooth to sharp."""
    camera: FloatArray
    """(3, 4), normalised."""
    faces: IntArray
    reflectance: VertexReflectance
    light: FloatArray
    """(81, 3)."""
    options: GeometryFitOptions

    def usable(self, vertices: FloatArray) -> IntArray:
        """Return the vertices (U,) that are seen, known, and lie on valid pixels; none where too few are."""
        none = np.zeros(0, np.int64)
        pixels, depth = project(self.camera, vertices)
        if not (np.isfinite(vertices).all() and (depth > 0).all()):
            return none
        candidates = self.reflectance.known & self.images[0].covers(pixels)
        if candidates.sum() < _LEAST_VERTICES:
            return none
        visibility = VertexVisibility(vertices, self.faces, vertex_normals(vertices, self.faces))
        seen = visibility.seen(self.camera, _VIEW_COSINE, _MARGIN_PX)
        used = np.flatnonzero(candidates & seen)
        return used if len(used) >= _LEAST_VERTICES else none

    def term(self, vertices: FloatArray, used: IntArray, level: int) -> PhotometricTerm | None:
        """Return the term over the `used` of `vertices` at smoothing `level`; None where all is black."""
        image, reflectance = self.images[level], self.reflectance
        if len(used) == 0:
            return None
        grey = np.abs(image.look_up(project(self.camera, vertices[used])[0])).mean(1)
        unit = float(np.median(grey)) or float(grey.mean())
        if not unit > 0:
            return None
        part = VertexReflectance(
            reflectance.diffuse_linear[used], reflectance.weights[used], reflectance.known[used]
        )
        return PhotometricTerm(
            image,
            self.camera,
            self.faces,
            used,
            part,
            self.light,
            unit,
            self.options.photometric_weight,
            self.options.softness,
        )

    def common_term(self, shapes: Sequence[FloatArray]) -> PhotometricTerm | None:
        """Return the term in the last image over the vertices seen in all of the shapes (V, 3), or None."""
        used = self.usable(shapes[0])
        for vertices in shapes[1:]:
            used = np.intersect1d(used, self.usable(vertices))
        if len(used) < _LEAST_VERTICES:
            return None
        return self.term(shapes[0], used, len(self.images) - 1)


def projection_jacobian(camera: FloatArray, points: FloatArray) -> FloatArray:
    """Return (N, 2, 3) derivatives of `project`'s pixels by the points (N, 3), all in front of the camera."""
    image = points @ camera[:, :3].T + camera[:, 3]
    pixels = image[:, :2] / image[:, 2:]
    return np.asarray((camera[:2, :3] - pixels[:, :, None] * camera[2, :3]) / image[:, 2, None, None])


def _by_vertices(
    normals: sparse.bsr_matrix, used: IntArray, by_normal: FloatArray, direct: FloatArray
) -> sparse.bsr_matrix:
    """Return -by_normal dn / dx + direct, rows of the used vertices only."""
    length = np.diff(normals.indptr)[used]
    start = np.concatenate([[0], np.cumsum(length)])
    row = np.repeat(np.arange(len(used)), length)
    taken = normals.indptr[used][row] + np.arange(start[-1]) - start[row]
    column = normals.indices[taken]
    blocks = -by_normal[row] @ normals.data[taken]
    own = column == used[row]
    blocks[own] += direct
    return sparse.bsr_matrix((blocks, column, start), shape=(3 * len(used), normals.shape[1]))
