"""The terms of a geometry fit: landmarks and colours as functions of the vertices' positions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import (
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    checked_array,
    finite_rows,
    norms,
)
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.operators import cross_matrices, vertex_normal_jacobian
from scan2albedo.geometry.pinhole import camera_centers, project, projected
from scan2albedo.geometry.rasterization import bilinear, bilinear_slopes
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.optimization.least_squares import LocalTerm, NormalEquations, map_equations
from scan2albedo.reflectance.environment_shading import shade_environment, shading_gradient
from scan2albedo.reflectance.image_fit import photometric_penalty, usual_color
from scan2albedo.reflectance.shape_model import MorphableShapeModel
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance
from scan2albedo.reflectance.vertex_visibility import VertexVisibility, pixels_around

LANDMARK_WEIGHT = 0.2
"""Of the mean squared distance of landmarks, in mm at the face's depth."""
PRIOR_WEIGHT = 1e-3
"""Of the squared coefficients."""
_VIEW_COSINE = 0.2
"""Vertices whose normals have less than this cosine to the line of sight do not count."""
_MARGIN_PX = 2.0
"""Nor do those nearer than so many pixels to an edge of the surface in the image."""


class SmoothImage:
    """A linear image (H, W, 3), smoothed by a Gaussian over its valid pixels only, bilinear between pixels.

    Pixels that are not finite, or False in the mask (H, W), are gaps; a standard deviation of 0 smooths
    nothing. Raises `ReflectanceError` when no pixel is left, `ValueError` for other shapes.
    """

    def __init__(self, image_linear: ArrayLike, mask: ArrayLike | None, blur_px: float) -> None:
        from scipy.ndimage import gaussian_filter

        image = checked_array(image_linear, ("H", "W", 3), "image_linear")
        if min(image.shape[:2]) < 2:
            raise ValueError(f"image_linear is {image.shape}, expected H and W of 2 or more")
        self.valid = finite_rows(image)
        if mask is not None:
            self.valid &= checked_array(mask, self.valid.shape, "mask", kind=bool)
        if not self.valid.any():
            raise ReflectanceError("the image has no pixel left: all are NaN or masked; check the mask")
        filled = np.where(self.valid[..., None], image, 0.0)
        if blur_px > 0:
            weight = gaussian_filter(self.valid.astype(float), blur_px, mode="constant")
            blurred = gaussian_filter(filled, (blur_px, blur_px, 0), mode="constant")
            enough = weight > 0
            filled = np.where(enough[..., None], blurred / np.where(enough, weight, 1.0)[..., None], 0.0)
        self._image = filled

    def covers(self, pixels: FloatArray) -> BoolArray:
        """Return (N,) whether all four pixels around each of (N, 2) are valid; NaN is outside."""
        around, share = pixels_around(self.valid.shape, pixels)
        return np.asarray(share.any(0) & self.valid[around].all(0))

    def look_up(self, pixels: FloatArray) -> FloatArray:
        """Return colours (N, 3) at pixels (N, 2); beyond the border the border's."""
        return bilinear(self._image, pixels)

    def gradient(self, pixels: FloatArray) -> FloatArray:
        """Return the derivatives (N, 3, 2) of `look_up` by column and row; 0 beyond the border."""
        inside = (pixels > 0) & (pixels < np.array(self.valid.shape)[::-1] - 1)
        return bilinear_slopes(self._image, pixels) * inside[:, None, :]


@dataclass(frozen=True)
class LandmarkTerm:
    """Mean over landmarks of |p(x_k) - q_k|^2 in mm^2, weighted, of the vertices (V, 3) in the scene."""

    camera: FloatArray
    """(3, 4), normalised."""
    vertex: IntArray
    """(n,) of each landmark seen, n > 0."""
    pixels: FloatArray
    """(n, 2) q."""
    pixel_mm: float
    """Size of a pixel at the face."""

    def value(self, vertices: FloatArray) -> float:
        """Return the term; inf where a landmark's vertex lies behind the camera."""
        squared = np.sum(self._off(vertices) ** 2, axis=1)
        return LANDMARK_WEIGHT * squared.mean() if all_finite(squared) else np.inf

    def linearized(self, vertices: FloatArray) -> LocalTerm:
        """Return the term as weighted squares around `vertices`."""
        off, count = self._off(vertices), len(self.vertex)
        blocks = self.pixel_mm * projected(self.camera[None], vertices[self.vertex])[1]
        shape = (2 * count, 3 * len(vertices))
        jacobian = sparse.bsr_matrix((blocks, self.vertex, np.arange(count + 1)), shape=shape)
        weight = np.full(2 * count, 2 * LANDMARK_WEIGHT / count)
        return LocalTerm(jacobian, weight * off.ravel(), weight)

    def _off(self, vertices: FloatArray) -> FloatArray:
        return self.pixel_mm * (project(self.camera, vertices[self.vertex])[0] - self.pixels)


@dataclass(frozen=True)
class PhotometricTerm:
    """Mean over vertices U and channels of sqrt(r^2 + eps^2) - eps, r = (I(p(x)) - shading) / unit."""

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

    def value(self, vertices: FloatArray) -> float:
        """Return the term; inf where a vertex has no normal or lies behind the camera."""
        off = self.differences(vertices)
        return np.inf if off is None else photometric_penalty(off)[0]

    def differences(self, vertices: FloatArray) -> FloatArray | None:
        """Return r (U, 3), or None when a vertex has no normal or lies behind the camera."""
        pixels, _ = project(self.camera, vertices[self.used])
        normals, sight = vertex_normals(vertices, self.faces)[self.used], self._sight(vertices)
        if not (all_finite(pixels) and normals.any(1).all()):
            return None
        shading = shade_environment(self.reflectance, normals, normalized(sight), self.light)
        return (self.image.look_up(pixels) - shading.radiance_linear) / self.unit

    def relative_rmse(self, vertices: FloatArray) -> float:
        """Return the root mean square of the differences over that of the image; inf where `value` is."""
        off = self.differences(vertices)
        if off is None:
            return np.inf
        observed = self.image.look_up(project(self.camera, vertices[self.used])[0]) / self.unit
        return float(np.linalg.norm(off) / max(float(np.linalg.norm(observed)), SMALLEST))

    def linearized(self, vertices: FloatArray) -> LocalTerm:
        """Return the term as weighted squares around `vertices`, where its value is finite."""
        off = self.differences(vertices)
        if off is None:
            raise ValueError("the photometric term is not defined here; its value is inf")
        points, sight, used = vertices[self.used], self._sight(vertices), self.used
        distance = norms(sight)
        view = sight / distance[:, None]
        pixels, _ = project(self.camera, points)
        normals = vertex_normals(vertices, self.faces)[used]
        by_normal, by_view = shading_gradient(self.reflectance, normals, view, self.light)
        across = by_view - np.einsum("uji,ui,uk->ujk", by_view, view, view)
        direct = self.image.gradient(pixels) @ projected(self.camera[None], points)[1]
        # The line of sight turns against the vertex: its derivative is -(I - v v^T) / distance.
        direct += across / distance[:, None, None]
        # direct - by_normal dn / dx, a block row for each of the used vertices.
        start, shape = np.arange(len(used) + 1), (3 * len(used), vertices.size)
        moved, turned = (sparse.bsr_matrix((one, used, start), shape=shape) for one in (direct, by_normal))
        jacobian = (moved - turned @ vertex_normal_jacobian(vertices, self.faces)) / self.unit
        _, weight = photometric_penalty(off)
        return LocalTerm(jacobian, (weight * off).ravel(), weight.ravel())

    def _sight(self, vertices: FloatArray) -> FloatArray:
        return camera_centers(self.camera) - vertices[self.used]


def photometric_term(
    image: SmoothImage,
    camera: FloatArray,
    faces: IntArray,
    reflectance: VertexReflectance,
    light: FloatArray,
    *shapes: FloatArray,
) -> PhotometricTerm | None:
    """Return the term over what is known, seen and valid in all `shapes` (V, 3); None without any."""
    usable = reflectance.known
    for vertices in shapes:
        pixels, depth = project(camera, vertices)
        if not (all_finite(vertices) and (depth > 0).all()):
            return None
        usable = usable & image.covers(pixels)
        if usable.any():
            visibility = VertexVisibility(vertices, faces, vertex_normals(vertices, faces))
            usable = usable & visibility.seen(camera, _VIEW_COSINE, _MARGIN_PX)
    used = np.flatnonzero(usable)
    if not len(used):
        return None
    unit = usual_color(image.look_up(project(camera, shapes[0][used])[0]))
    if not unit > 0:
        return None
    return PhotometricTerm(image, camera, faces, used, reflectance.chosen(used), light, unit)


@dataclass(frozen=True)
class GeometryPoint:
    """A pose and a shape with the objective there, for `minimize`: of both, or of the pose where `rigid`."""

    model: MorphableShapeModel
    scene_from_model: FloatArray
    """(4, 4), rigid."""
    coefficients: FloatArray
    """(N_S + N_E,), identity first."""
    meter: Meter
    terms: Sequence[LandmarkTerm | PhotometricTerm] = ()
    rigid: bool = False

    @cached_property
    def vertices(self) -> FloatArray:
        """(V, 3) in the scene."""
        return transform_points(self.scene_from_model, self.model.at(self.coefficients))

    @cached_property
    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Precisions and values (6 + N,), 0 for the pose."""
        precision = np.full(self.model.components, 2 * PRIOR_WEIGHT)
        return np.append(np.zeros(6), precision), np.append(np.zeros(6), self.coefficients)

    @cached_property
    def cost(self) -> float:
        """The sum of the terms, and the prior."""
        self.meter.count()
        precision, numbers = self._prior
        data = sum((term.value(self.vertices) for term in self.terms), start=0.0)
        return data + float(precision @ numbers**2) / 2

    def normal_equations(self) -> NormalEquations:
        """Return the quadratic model by turn, shift and the coefficients that move."""
        count = 0 if self.rigid else self.model.components
        basis = self.model.basis[:count].reshape(count, self.vertices.size).T
        turn = -cross_matrices(self.vertices - self.vertices.mean(0))
        shift = np.broadcast_to(np.eye(3), turn.shape)
        pose_motion = np.concatenate([turn, shift], axis=2).reshape(-1, 6)
        rotation, local_terms = self.scene_from_model[:3, :3], []
        for local in (term.linearized(self.vertices) for term in self.terms):
            by = local.jacobian
            by_shape = sparse.bsr_matrix((by.data @ rotation, by.indices, by.indptr), shape=by.shape)
            jacobian = np.concatenate([by @ pose_motion, by_shape @ basis], axis=1)
            local_terms.append(replace(local, jacobian=jacobian))
        return map_equations(local_terms, *self._prior)

    def moved(self, step: FloatArray) -> Self:
        """Return the point after a turn about its middle (rad), a shift (mm) and a change of coefficients."""
        middle = self.vertices.mean(0)
        # A turn of more than a radian in one step is a runaway.
        turn = rotation_from_vector(step[:3] / max(1.0, float(np.linalg.norm(step[:3]))))
        pose = compose(turn, middle - turn @ middle + step[3:6]) @ self.scene_from_model
        coefficients = self.coefficients.copy()
        coefficients[: len(step) - 6] += step[6:]
        return replace(self, scene_from_model=pose, coefficients=coefficients)
