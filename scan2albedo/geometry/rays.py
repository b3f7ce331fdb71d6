"""Ray casting with embree: occlusion and first hits, centred before float32, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CHUNK = 8192


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
        TriangleMesh(self._scene, local, index.astype(np.int32))
        # The scene is committed by its first query, which must not happen in two threads at once.
        self._run(np.zeros((1, 3)), np.ones((1, 3)), "OCCLUDED")

    @property
    def size(self) -> float:
        """Longest side of the mesh's bounding box, in the mesh's unit."""
        return self._scale

    def _run(self, origins: FloatArray, directions: FloatArray, query: str):  # type: ignore[no-untyped-def]
        return self._scene.run(self.to_local(origins), _single(directions), query=query)

    def to_local(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return (N, 3) float32: points centred and scaled as embree sees them, for `occluded_local`."""
        xyz = np.ascontiguousarray(points, np.float64)
        return _centered(xyz, self._center, 1 / self._scale)

    def occluded(self, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.bool_]:
        """Return (N,) True where the ray from `origins` (N, 3) along `directions` hits anything.

        Parameters
        ----------
        origins : (N, 3) array_like of float
        directions : (N, 3) or (3,) array_like of float
            Of any length; one for all rays is the faster.
        """
        start = np.asarray(origins, np.float64)
        return self._occluded(len(start), lambda block: self.to_local(start[block]), directions)

    def occluded_local(self, origins: NDArray[np.float32], directions: ArrayLike) -> NDArray[np.bool_]:
        """Return what `occluded` does, for origins that went through `to_local` once and serve many times."""
        return self._occluded(len(origins), lambda block: origins[block], directions)

    def _occluded(
        self, count: int, origins: Callable[[slice], NDArray[np.float32]], directions: ArrayLike
    ) -> NDArray[np.bool_]:
        heading = _single(directions)
        # Embree wants a direction a ray: one block of a common direction serves every block of rays.
        common = np.tile(heading, (min(count, _CHUNK), 1)) if heading.ndim == 1 else None
        result = np.zeros(count, bool)

        def shoot(block: slice) -> None:
            start = origins(block)
            along = heading[block] if common is None else common[: len(start)]
            np.not_equal(self._scene.run(start, along, query="OCCLUDED"), -1, out=result[block])

        _each(shoot, _blocks(count))
        return result

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Return the first hit of each ray; distances in the mesh's unit along unit directions."""
        start, heading = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        heading = np.broadcast_to(heading, start.shape)
        face = np.full(len(start), -1, np.int64)

        def shoot(block: slice) -> None:
            face[block] = self._run(start[block], heading[block], "INTERSECT")

        _each(shoot, _blocks(len(start)))
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


@njit(cache=True, nogil=True)
def _centered(points, center, factor):  # type: ignore[no-untyped-def]
    """Return (points - center) factor as float32, the difference taken in float64, in one pass."""
    result = np.empty(points.shape, np.float32)
    for i in range(points.shape[0]):
        for k in range(3):
            result[i, k] = (points[i, k] - center[k]) * factor
    return result


def _single(values: ArrayLike) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)


def _blocks(count: int) -> list[slice]:
    return [slice(i, min(i + _CHUNK, count)) for i in range(0, count, _CHUNK)]


def _each(work: Callable[[slice], None], blocks: Sequence[slice]) -> None:
    """Run `work` on every block, on all cores (embree releases the GIL).

    The caller's thread takes its share: one that only waits costs a fifth of the throughput on two cores.
    """
    left, lock = iter(blocks), Lock()

    def take() -> None:
        while True:
            with lock:
                block = next(left, None)
            if block is None:
                return
            work(block)

    helpers = min(os.cpu_count() or 1, len(blocks)) - 1
    if helpers < 1:
        take()
        return
    with ThreadPoolExecutor(helpers) as pool:
        futures = [pool.submit(take) for _ in range(helpers)]
        take()
    for future in futures:
        future.result()
