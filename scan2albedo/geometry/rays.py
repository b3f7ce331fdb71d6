"""Ray casting with embree: occlusion and first hits, centred before float32, on all cores."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CHUNK = 16384


@dataclass(frozen=True)
class RayHits:
    """First hits: `face` (N,) with -1 for none, `barycentric` (N, 3), `distance` (N,) with inf for none."""

    face: IntArray
    barycentric: FloatArray
    distance: FloatArray


class RayCaster:
    """Shoot rays at one mesh.

    Embree computes in float32, so the mesh is centred on its bounding box and scaled to unit size
    first: what matters is the mesh's size against its detail, not where it lies or in which unit.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
    faces : (F, 3) array_like of int
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        xyz, index = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        self._vertices, self._faces = xyz, index
        low, high = xyz.min(0), xyz.max(0)
        self._center = (low + high) / 2
        self._scale = float(np.max(high - low)) or 1.0
        self._scene = rtcore_scene.EmbreeScene()
        local = ((xyz - self._center) / self._scale).astype(np.float32)
        TriangleMesh(self._scene, local[index])
        # The scene is committed by its first query, which must not happen in two threads at once.
        self._run(np.zeros((1, 3)), np.ones((1, 3)), "OCCLUDED")

    def _run(self, origins: FloatArray, directions: FloatArray, query: str):  # type: ignore[no-untyped-def]
        local = np.ascontiguousarray((origins - self._center) / self._scale, np.float32)
        return self._scene.run(local, np.ascontiguousarray(directions, np.float32), query=query)

    def occluded(self, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.bool_]:
        """Return (N,) True where the ray from `origins` (N, 3) along `directions` (N, 3) hits anything."""
        start, heading = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        heading = np.broadcast_to(heading, start.shape)
        blocks = [slice(i, i + _CHUNK) for i in range(0, len(start), _CHUNK)]
        result = np.zeros(len(start), bool)

        def shoot(block: slice) -> None:
            result[block] = self._run(start[block], heading[block], "OCCLUDED") != -1

        _each(shoot, blocks)
        return result

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Return the first hit of each ray; distances in the mesh's unit along unit directions."""
        start, heading = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        heading = np.broadcast_to(heading, start.shape)
        face = np.full(len(start), -1, np.int64)
        blocks = [slice(i, i + _CHUNK) for i in range(0, len(start), _CHUNK)]

        def shoot(block: slice) -> None:
            face[block] = self._run(start[block], heading[block], "INTERSECT")

        _each(shoot, blocks)
        return self._complete(start, heading, face)

    def _complete(self, start: FloatArray, heading: FloatArray, face: IntArray) -> RayHits:
        """Intersect each ray with its hit triangle again in float64."""
        hit = face >= 0
        distance, barycentric = np.full(len(start), np.inf), np.zeros((len(start), 3))
        corners = self._vertices[self._faces[face[hit]]]
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        p = np.cross(heading[hit], e2)
        determinant = np.einsum("ij,ij->i", e1, p)
        inverse = 1 / np.where(np.abs(determinant) > 0, determinant, np.inf)
        s = start[hit] - corners[:, 0]
        q = np.cross(s, e1)
        u, v = np.einsum("ij,ij->i", s, p) * inverse, np.einsum("ij,ij->i", heading[hit], q) * inverse
        weights = np.clip(np.stack([1 - u - v, u, v], 1), 0, None)
        barycentric[hit] = weights / weights.sum(1, keepdims=True)
        distance[hit] = np.einsum("ij,ij->i", e2, q) * inverse
        return RayHits(face, barycentric, distance)


def _each(work, blocks) -> None:  # type: ignore[no-untyped-def]
    """Run `work` on every block, in threads when there is more than one (embree releases the GIL)."""
    if len(blocks) <= 1:
        for block in blocks:
            work(block)
        return
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(work, blocks))
