"""Which vertices cameras see and flashes light, away from edges, and what pictures show of them."""

import numpy as np
from scipy import sparse

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    checked_array,
    checked_mesh,
    dots,
    finite_rows,
    norms,
)
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import edges_with_faces, face_cross_products, vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, focal_px, pixel_directions, project
from scan2albedo.geometry.rasterization import within
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.shadow_map import ShadowMap, shadow_offset_mm
from scan2albedo.reflectance.environment_shading import unit_vectors

RAY_OFFSET_MM = 0.2
"""Rays start this far along the normal, see `lighting.shadow_map.ShadowMap`."""


def checked_surface(
    vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike | None
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return vertices, faces, and the normals given or the mesh's (V, 3), 0 where there are none.

    Raises `ReflectanceError` for a mesh that is none, or not finite, and normals that are not unit;
    `ValueError` for another shape of these.
    """
    xyz, index = checked_mesh(vertices, faces, "the mesh", ReflectanceError)
    if len(index) == 0:
        raise ReflectanceError("the mesh has no triangles")
    if normals is None:
        return xyz, index, vertex_normals(xyz, index)
    vectors = np.ascontiguousarray(checked_array(normals, xyz.shape, "normals"))
    unit_vectors(np.where(vectors.any(1, keepdims=True), vectors, (0.0, 0.0, 1.0)), "normals")
    return xyz, index, vectors


class VertexVisibility:
    """Rays between the V vertices of a face (mm) and its cameras and flashes; answers are kept."""

    def __init__(self, vertices: FloatArray, faces: IntArray, normals: FloatArray) -> None:
        self._vertices, self._mesh, self._normals = vertices, (vertices, faces), normals
        # A shadow map takes lights by direction and distance from the origin, which must therefore be near.
        self._center = (vertices.min(0) + vertices.max(0)) / 2
        local = vertices - self._center
        self._caster = RayCaster(local, faces)
        self._map = ShadowMap(self._caster, local, normals, RAY_OFFSET_MM)
        self._edges, _ = edges_with_faces(faces)
        self._reached: dict[bytes, BoolArray] = {}

    def reached(self, position: FloatArray) -> BoolArray:
        """Return (V,) whether nothing stands between a vertex that faces `position` (3,) and it."""
        key = position.tobytes()
        if key not in self._reached:
            toward = position - self._center
            distance = float(np.linalg.norm(toward))
            self._reached[key] = self._map.visible(toward / (distance or 1.0), distance or 1e-9) > 0
        return self._reached[key]

    def form_factors(self) -> sparse.csr_matrix:
        """Return (V, V): times the light on each vertex, what a surface of albedo 1 sends onto each.

            F_uv = sum 4 / K max(0, n_u.d) b_v

        over K rays from u, along d, that first meet the outer side of a triangle of v at barycentric
        coordinates b: the integral of cosines of Goral et al. (SIGGRAPH 1984).
        """
        offset = shadow_offset_mm(self._caster.size, RAY_OFFSET_MM)
        origins, across = self._map.position + offset * self._normals, face_cross_products(*self._mesh)
        factors = sparse.csr_matrix((len(origins), len(origins)))
        rays = distant_directions(128)  # with them bounced light on a face is found to 9 %
        for direction in rays:
            cosine = self._normals @ direction
            rows = np.flatnonzero(cosine > 0)
            hits = self._caster.first_hit(origins[rows], direction)
            # Light leaves the outer side alone: a ray that meets the inner side passed a hole.
            hit = (hits.face >= 0) & (across[hits.face] @ direction < 0)
            weight = 4 / len(rays) * cosine[rows[hit], None] * hits.barycentric[hit]
            places = np.repeat(rows[hit], 3), self._mesh[1][hits.face[hit]].ravel()
            factors += sparse.csr_matrix((weight.ravel(), places), factors.shape)
        return factors

    def illuminated(self, light: FloatArray) -> BoolArray:
        """Return (V,) vertices that the light at (3,) reaches, none of them beside a cast shadow."""
        reached = self.reached(light)
        hidden = (dots(self._normals, light - self._vertices) > 0) & ~reached
        near_shadow = hidden.copy()
        near_shadow[self._edges[hidden[self._edges[:, 1]], 0]] = True
        near_shadow[self._edges[hidden[self._edges[:, 0]], 1]] = True
        return reached & ~near_shadow

    def seen(self, camera: FloatArray, cosine: float, margin_px: float = 1.5) -> BoolArray:
        """Return (V,) vertices that a camera (3, 4) sees, normals at least `cosine` to the line of sight.

        The surface must continue `margin_px` to all four sides, without a hole or a depth step beyond its
        slope.
        """
        position = camera_centers(camera)
        sight = position - self._vertices
        distance = norms(sight)
        n_v = dots(self._normals, sight) / np.maximum(distance, 1e-12)
        result = self.reached(position) & (n_v > cosine)
        if not result.any():
            return result
        rows = np.flatnonzero(result)
        n_v = n_v[rows]
        pixels, depth = project(camera, self._vertices[rows])
        good = finite_rows(pixels)
        pixels = np.where(good[:, None], pixels, 0.0)
        pixel_mm = depth / focal_px(camera)
        # A step in depth above 3 mm, and above what the slope of the surface against the picture plane
        # explains, is an edge; a slope steeper than 5 explains no more.
        slope = np.minimum(np.sqrt(np.maximum(1 - n_v**2, 0)) / n_v, 5)
        allowed = 3 + 2 * margin_px * pixel_mm * slope
        for side in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            along = pixel_directions(camera, pixels + margin_px * np.array(side, float))
            hits = self._caster.first_hit(np.broadcast_to(position - self._center, along.shape), along)
            missed = hits.face < 0
            other = np.where(missed, 0.0, hits.distance) * (along @ camera[2, :3])
            good &= ~missed & (np.abs(other - depth) <= allowed)
        result[rows] = good
        return result


def pixels_around(shape: tuple[int, ...], pixels: FloatArray) -> tuple[tuple[IntArray, IntArray], FloatArray]:
    """Return rows and columns (4, N) of the pixels around each of (N, 2) in an image, and their weights.

    The weights (4, N) are bilinear, all 0 outside the image and for NaN.
    """
    last = np.array(shape[1::-1]) - 1
    inside = within(pixels, shape)
    place = np.where(inside[:, None], pixels, 0.0)
    corner = np.minimum(place.astype(int), np.maximum(last - 1, 0))
    (left, top), (right, below) = corner.T, np.minimum(corner + 1, last).T
    x, y = (place - corner).T
    weights = inside * np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    return (np.stack([top, top, below, below]), np.stack([left, right, left, right])), weights
