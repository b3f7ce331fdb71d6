"""Response of vertices to light from everywhere, where the surface shadows itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rays import RayCaster, blocks, each_block
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.reflectance.environment_shading import LightResponse, diffuse_response, unit_vectors
from scan2albedo.reflectance.lobe_coefficients import ORDER
from scan2albedo.reflectance.picture_samples import checked_mesh, checked_normals
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS
from scan2albedo.reflectance.vertex_visibility import RAY_OFFSET_MM

_BLOCK = 128
_DIRECTIONS = 64, 100_000


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

    Returns
    -------
    LightResponse
        For `ImageObservation.transfer`, or to shade with: `transfer.shade(reflectance, light)`.

    Raises
    ------
    ReflectanceError
        When vertices are not finite, a vector is not a unit vector, or there are no triangles.
    ValueError
        When shapes disagree, or the number of directions is out of range.

    Notes
    -----
    1,024 directions leave errors of 0.5 % in the diffuse light that a face receives and of 1 to 3 % in the
    highlights, most of it beyond order 8; without shadows they are 16 to 25 %
    (tools/bench_reflectance_model.py). Light that the surface reflects onto itself is left out.

    Cost: V directions / 2 rays, 10 V directions 81 operations, V directions bytes.

    References
    ----------
    .. [1] P.-P. Sloan, J. Kautz, J. Snyder, "Precomputed radiance transfer for real-time rendering in
       dynamic, low-frequency lighting environments", SIGGRAPH 2002.

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
    if not _DIRECTIONS[0] <= directions <= _DIRECTIONS[1]:
        raise ValueError(f"directions must be {_DIRECTIONS[0]} to {_DIRECTIONS[1]}, got {directions}")
    n, v, bare = _checked_vectors(checked_normals(xyz, index, normals), toward_camera)
    toward = distant_directions(directions)
    weighted = harmonics(toward, ORDER) * (4 * np.pi / directions)
    visible = ShadowMap(RayCaster(xyz, index), xyz, n, offset_mm).table(toward).visibility
    diffuse = diffuse_response(n)
    specular = np.zeros((len(xyz), len(EXPONENTS), weighted.shape[1]))

    def sum_up(block: slice) -> None:
        lit, cosine = visible[:, block].T > 0, n[block] @ toward.T
        rows = block.start + np.flatnonzero((~lit & (cosine > 0)).any(1))
        diffuse[rows] = _shadowed(
            diffuse[rows], np.maximum(cosine, 0)[rows - block.start], lit[rows - block.start], weighted
        )
        for k, lobe in enumerate(_highlights(np.where(lit, cosine, 0.0), n[block], v[block], toward)):
            specular[block, k] = lobe @ weighted

    each_block(sum_up, blocks(len(xyz), _BLOCK))
    diffuse[bare], specular[bare] = 0.0, 0.0
    return LightResponse(diffuse, specular)


def _checked_vectors(
    normals: FloatArray, toward_camera: ArrayLike
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return n and v (V, 3), and (V,) where there is no surface, whose n and v are placeholders."""
    n, v = normalized(normals), np.asarray(toward_camera, np.float64)
    if v.shape != n.shape:
        raise ValueError(f"toward_camera is {v.shape}, expected {n.shape} as vertices")
    bare = np.asarray(~n.any(1))
    n[bare] = (0.0, 0.0, 1.0)
    return n, unit_vectors(np.where(bare[:, None], n, v), "toward_camera"), bare


def _highlights(lit_cosine: FloatArray, n: FloatArray, v: FloatArray, toward: FloatArray) -> list[FloatArray]:
    """Return the lobes (B, D) at directions w, from n.w, which is 0 and less where no light comes from."""
    n_v = np.einsum("vi,vi->v", n, v)[:, None]
    half = np.sqrt(np.maximum(2 + 2 * (v @ toward.T), 1e-12))
    # A surface that faces away from the camera sends it no highlights.
    n_h = np.where((lit_cosine > 0) & (n_v > 0), (lit_cosine + n_v) / half, 0.0)
    return [(s + 2) / (8 * np.pi) * n_h**s for s in EXPONENTS]


def _shadowed(free: FloatArray, cosine: FloatArray, lit: BoolArray, weighted: FloatArray) -> FloatArray:
    """Return diffuse coefficients (B, 81) with shadows, from those without and max(0, n.w) (B, D)."""
    whole = cosine @ weighted / np.pi
    part = np.where(lit, cosine, 0.0) @ weighted / np.pi
    # The first harmonic is constant, so its coefficient gives the lit share of the lobe.
    share = part[:, :1] / whole[:, :1]
    return np.asarray(part + share * (free - whole))
