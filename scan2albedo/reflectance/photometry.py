"""Which vertices an image tells of, and the photometric term over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.pinhole import project
from scan2albedo.reflectance.geometry_options import GeometryFitOptions
from scan2albedo.reflectance.geometry_terms import PhotometricTerm
from scan2albedo.reflectance.smooth_image import SmoothImage
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance
from scan2albedo.reflectance.vertex_visibility import VertexVisibility

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_OFFSET_MM = 0.2
_DEPTH_STEP_MM = 3.0
_LEAST_VERTICES = 20
"""Fewer tell nothing of a shape."""


class Photometry:
    """An image, its camera, and the face's reflectance in a light.

    Parameters
    ----------
    images : sequence of SmoothImage
        The same one, from smooth to sharp.
    camera : (3, 4) float64
        Normalised.
    faces : (F, 3) int64
    reflectance : VertexReflectance
        Of V vertices.
    light : (81, 3) float64
    options : GeometryFitOptions
    """

    def __init__(
        self,
        images: Sequence[SmoothImage],
        camera: FloatArray,
        faces: IntArray,
        reflectance: VertexReflectance,
        light: FloatArray,
        options: GeometryFitOptions,
    ) -> None:
        self._images = images
        self._camera, self._faces = camera, faces
        self._reflectance, self._light, self._options = reflectance, light, options

    @property
    def levels(self) -> int:
        """Number of images, from smooth to sharp."""
        return len(self._images)

    def usable(self, vertices: FloatArray) -> IntArray:
        """Return the vertices (U,) that are seen, known, and lie on valid pixels; none where too few are."""
        options, none = self._options, np.zeros(0, np.int64)
        pixels, depth = project(self._camera, vertices)
        if not (np.isfinite(vertices).all() and (depth > 0).all()):
            return none
        candidates = self._reflectance.known & self._images[0].covers(pixels)
        if candidates.sum() < _LEAST_VERTICES:
            return none
        visibility = VertexVisibility(
            vertices, self._faces, vertex_normals(vertices, self._faces), _OFFSET_MM
        )
        seen = visibility.seen(self._camera, options.view_cosine, options.margin_px, _DEPTH_STEP_MM)
        used = np.flatnonzero(candidates & seen)
        return used if len(used) >= _LEAST_VERTICES else none

    def term(self, vertices: FloatArray, used: IntArray, level: int) -> PhotometricTerm | None:
        """Return the term over the `used` of `vertices` in the image smoothed for `level`.

        None where the image is black there.
        """
        image, reflectance = self._images[level], self._reflectance
        if len(used) == 0:
            return None
        grey = np.abs(image.look_up(project(self._camera, vertices[used])[0])).mean(1)
        unit = float(np.median(grey)) or float(grey.mean())
        if not unit > 0:
            return None
        part = VertexReflectance(
            reflectance.diffuse_linear[used], reflectance.weights[used], reflectance.known[used]
        )
        return PhotometricTerm(
            image,
            self._camera,
            self._faces,
            used,
            part,
            self._light,
            unit,
            self._options.photometric_weight,
            self._options.softness,
        )

    def common_term(self, shapes: Sequence[FloatArray]) -> PhotometricTerm | None:
        """Return the term in the last image over what all of the shapes (V, 3) show, or None."""
        used = self.usable(shapes[0])
        for vertices in shapes[1:]:
            used = np.intersect1d(used, self.usable(vertices))
        if len(used) < _LEAST_VERTICES:
            return None
        return self.term(shapes[0], used, self.levels - 1)
