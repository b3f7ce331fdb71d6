"""Ray casting with embree: occlusion and first hits, centred before float32, on all cores."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import numpy as np

from scan2albedo.core.arrays import ArrayLike, BoolArray, Float32Array, checked_mesh
from scan2albedo.geometry.mesh import RayHits

_CHUNK = 2**16


class RayCaster:
    """Shoot rays at one mesh.

    Embree computes in float32, so the mesh is centred on its bounding box and scaled to unit size first:
    accuracy depends on the mesh's size against its detail, not on its place or unit. Raises ValueError for a
    mesh without a vertex, vertices that are not finite, or faces that refer to none.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        # Embree would read past the end of bad arrays: it checks nothing.
        xyz, index = checked_mesh(vertices, faces, "the mesh to shoot rays at")
        if not len(xyz):
            raise ValueError("the mesh has no vertex to shoot rays at; give one with a surface")
        self._vertices, self._faces = xyz, index
        low, high = xyz.min(0), xyz.max(0)
        self._center = (low + high) / 2
        self._scale = float(np.max(high - low)) or 1.0
        self._scene = rtcore_scene.EmbreeScene()
        local = ((xyz - self._center) / self._scale).astype(np.float32)
        TriangleMesh(self._scene, local, index.astype(np.int32))
        # The scene is committed by its first query, which must not happen in two threads at once.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")

    @property
    def size(self) -> float:
        """Longest side of the mesh's bounding box, in the mesh's unit."""
        return self._scale

    def to_local(self, points: ArrayLike) -> Float32Array:
        """Return (N, 3) float32: points centred and scaled as embree sees them, for `occluded`."""
        return ((np.asarray(points, float) - self._center) * (1 / self._scale)).astype(np.float32)

    def occluded(self, origins: ArrayLike, directions: ArrayLike, *, local: bool = False) -> BoolArray:
        """Return (N,) True where the ray from `origins` (N, 3) along `directions` hits anything.

        Directions (N, 3) are of any length; one direction (3,) for all rays is faster. Origins that serve
        many times may be `local`, that is from `to_local`.
        """
        start = np.asarray(origins, np.float32 if local else float)
        heading = np.ascontiguousarray(directions, np.float32)
        # Embree wants a direction a ray: one block of a common direction serves every block of rays.
        common = np.tile(heading, (min(len(start), _CHUNK), 1)) if heading.ndim == 1 else None
        result = np.zeros(len(start), bool)

        def shoot(block: slice) -> None:
            near = start[block] if local else self.to_local(start[block])
            along = heading[block] if common is None else common[: len(near)]
            np.not_equal(self._scene.run(near, along, query="OCCLUDED"), -1, out=result[block])

        each_block(shoot, blocks(len(start), _CHUNK))
        return result

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Return the first hit of each ray; distances in the mesh's unit along unit directions."""
        start, heading = np.asarray(origins, float), np.asarray(directions, float)
        heading = np.array(np.broadcast_to(heading, start.shape), order="C")
        face = np.full(len(start), -1, int)

        def shoot(block: slice) -> None:
            local = self.to_local(start[block])
            face[block] = self._scene.run(local, heading[block].astype(np.float32), query="INTERSECT")

        each_block(shoot, blocks(len(start), _CHUNK))
        # Each ray meets its triangle again in float64, by Moeller and Trumbore.
        distance, barycentric = np.full(len(start), np.inf), np.zeros((len(start), 3))
        hit = np.flatnonzero(face >= 0)
        origin, *ends = np.moveaxis(self._vertices[self._faces[face[hit]]], 1, 0)
        (e1, e2), s = (end - origin for end in ends), start[hit] - origin
        p, q = np.cross(heading[hit], e2), np.cross(s, e1)
        determinant, *solved = ((a * b).sum(1) for a, b in ((e1, p), (s, p), (heading[hit], q), (e2, q)))
        inverse = np.divide(1.0, determinant, where=determinant != 0, out=np.zeros(len(hit)))
        u, v, distance[hit] = solved * inverse
        # Embree's float32 takes rays that pass a hair beside the face.
        weights = np.maximum(np.stack([1 - u - v, u, v], 1), 0.0)
        barycentric[hit] = weights / weights.sum(1, keepdims=True)
        return RayHits(face, barycentric, distance)


def blocks(count: int, size: int) -> list[slice]:
    """Return slices of `size` rows, the last one shorter, that cover `count` rows."""
    return [slice(i, min(i + size, count)) for i in range(0, count, size)]


def each_block(work: Callable[[slice], None], parts: Sequence[slice]) -> None:
    """Run `work`, which should release the GIL, on every block, on all cores.

    The caller's thread works too: if it only waited, throughput on two cores would fall by a fifth.
    """
    left, lock = iter(parts), Lock()

    def take() -> None:
        while True:
            with lock:
                block = next(left, None)
            if block is None:
                return
            work(block)

    helpers = min(os.cpu_count() or 1, len(parts)) - 1
    if helpers < 1:
        take()
        return
    with ThreadPoolExecutor(helpers) as pool:
        futures = [pool.submit(take) for _ in range(helpers)]
        take()
    for future in futures:
        future.result()
