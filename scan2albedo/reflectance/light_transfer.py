"""Response of vertices to light from everywhere, where the surface shadows itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.geometry.blocks import blocks, each_block
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance.environment_shading import ORDER, LightResponse, diffuse_response, unit_vectors
from scan2albedo.reflectance.vertex_reflectance import BLOCK, EXPONENTS
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM, checked_mesh, checked_normals


def light_transfer(
    vertices: ArrayLike,
    faces: ArrayLike,
    normals: ArrayLike,
    toward_camera: ArrayLike,
    *,
    directions: int = 1024,
    offset_mm: float = RAY_OFFSET_MM,
) -> LightResponse:
    """Return how vertices respond to light when the surface casts shadows on itself.

    With V(w) = 1 where a ray from the vertex along w leaves the surface, and K the diffuse lobe
    max(0, n.w) / pi or a highlight's (s + 2) / (8 pi) max(0, n.h)^s, n.w > 0,

        T_lm = integral over the sphere of V(w) K(w) Y_lm(w) dw.

    Sums Q over directions approximate the integral. Without shadow the diffuse response A is known in closed
    form; with h the hidden share of the lobe, sums therefore enter only as far as shadow reaches:

        T = Q[V K] + (1 - h) (A - Q[K]).

    Raises `ReflectanceError` when vertices are not finite, a vector is not a unit vector, or there are no
    triangles; `ValueError` when shapes disagree, or the number of directions is out of range.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Millimetres.
    faces : (F, 3) array_like of int
        Of everything that casts shadows; vertices beyond the face's own may be appended with normals 0.
    normals, toward_camera : (V, 3) array_like of float
        Unit vectors n and v. A vertex whose normal is 0 receives nothing.
    directions : int
        Of the sums, a Fibonacci spiral over the sphere; 64 to 100,000.
    offset_mm : float
        Rays start this far along the normal, see `lighting.shadow_map.ShadowMap`.

    Notes
    -----
    After Sloan, Kautz, Snyder, "Precomputed radiance transfer", SIGGRAPH 2002. 1,024 directions leave errors
    of 0.5 % in the diffuse light that a face receives and of 1 to 3 % in the highlights, most of it beyond
    order 8; without shadows they are 16 to 25 % (tools/bench_reflectance_model.py). Light that the surface
    reflects onto itself is left out. Cost: V directions / 2 rays, 10 V directions 81 operations.

    Examples
    --------
    >>> floor, wall = [[-9, 0, 9], [9, 0, 9], [0, 0, -9]], [[-99, -1, 0], [99, -1, 0], [0, 200, 0]]
    >>> vertices, faces = np.array([*floor, *wall, [0, 0, 0.1]]), [[0, 1, 6], [1, 2, 6], [2, 0, 6], [3, 4, 5]]
    >>> up = np.tile([0.0, 1.0, 0.0], (7, 1))
    >>> white = np.sqrt(4 * np.pi) * light_transfer(vertices, faces, up, up).diffuse[6, 0]
    >>> print(white.round(1))  # at its foot a wall hides half of what the floor sees
    0.5
    """
    xyz, index = checked_mesh(vertices, faces)
    n, v = normalized(checked_normals(xyz, index, normals)), np.asarray(toward_camera, np.float64)
    if v.shape != n.shape:
        raise ValueError(f"toward_camera is {v.shape}, expected {n.shape} as vertices")
    if not 64 <= directions <= 100_000:
        raise ValueError(f"directions must be 64 to 100000, got {directions}")
    bare = np.asarray(~n.any(1))
    n[bare] = (0.0, 0.0, 1.0)  # placeholders
    v = unit_vectors(np.where(bare[:, None], n, v), "toward_camera")
    toward = distant_directions(directions)
    weighted = harmonics(toward, ORDER) * (4 * np.pi / directions)
    visible = ShadowMap(RayCaster(xyz, index), xyz, n, offset_mm).table(toward).visibility
    diffuse = diffuse_response(n)
    specular = np.zeros((len(xyz), len(EXPONENTS), weighted.shape[1]))

    def sum_up(block: slice) -> None:
        lit, cosine = visible[:, block].T > 0, n[block] @ toward.T
        # Of vertices with shadow, from those without and max(0, n.w) (B, D). The first harmonic is constant,
        # so that its coefficient gives the lit share of the lobe.
        some = np.flatnonzero((~lit & (cosine > 0)).any(1))
        facing = np.maximum(cosine[some], 0)
        whole = facing @ weighted / np.pi
        part = np.where(lit[some], facing, 0.0) @ weighted / np.pi
        rows = block.start + some
        diffuse[rows] = part + part[:, :1] / whole[:, :1] * (diffuse[rows] - whole)
        n_v = np.einsum("vi,vi->v", n[block], v[block])[:, None]
        half = np.sqrt(np.maximum(2 + 2 * (v[block] @ toward.T), 1e-12))
        # A surface that faces away from the camera sends it no highlights.
        n_h = np.where(lit & (cosine > 0) & (n_v > 0), (cosine + n_v) / half, 0.0)
        for k, s in enumerate(EXPONENTS):
            specular[block, k] = (s + 2) / (8 * np.pi) * n_h**s @ weighted

    each_block(sum_up, blocks(len(xyz), BLOCK))
    diffuse[bare], specular[bare] = 0.0, 0.0
    return LightResponse(diffuse, specular)
