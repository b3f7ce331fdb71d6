"""First hits and occlusion through Open3D, apart from the ray engine the estimators use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import MissingDependencyError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class SceneHits:
    """First hits: `face` (N,) with -1 for none, `barycentric` (N, 3), `distance` (N,) with inf for none."""

    face: IntArray
    barycentric: FloatArray
    distance: FloatArray


class RayScene:
    """Shoot rays at one mesh with Open3D's `RaycastingScene` (float32, so the mesh is centred first).

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        Millimetres.
    faces : (F, 3) array_like of int

    Raises
    ------
    MissingDependencyError
        When Open3D or a system library it needs is not there.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        o3d = _open3d()
        xyz = np.asarray(vertices, np.float64)
        self._center = (xyz.min(0) + xyz.max(0)) / 2
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor((xyz - self._center).astype(np.float32)),
            self._tensor(np.ascontiguousarray(faces, np.uint32)),
        )

    def _rays(self, origins: ArrayLike, directions: ArrayLike):  # type: ignore[no-untyped-def]
        start = np.asarray(origins, np.float64) - self._center
        heading = np.broadcast_to(np.asarray(directions, np.float64), start.shape)
        return self._tensor(np.concatenate([start, heading], 1).astype(np.float32))

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> SceneHits:
        """Return the first hit of each ray from `origins` (N, 3) along unit `directions` (N, 3)."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        distance = answer["t_hit"].numpy().astype(np.float64)
        face = answer["primitive_ids"].numpy().astype(np.int64)
        u, v = answer["primitive_uvs"].numpy().astype(np.float64).T
        face[~np.isfinite(distance)] = -1
        barycentric = np.stack([1 - u - v, u, v], 1)
        barycentric[face < 0] = 0
        return SceneHits(face, barycentric, distance)

    def occluded(
        self, origins: ArrayLike, directions: ArrayLike, reach: ArrayLike = np.inf
    ) -> NDArray[np.bool_]:
        """Return (N,) True where the ray hits the mesh nearer than `reach` ((N,) or scalar, mm)."""
        rays = self._rays(origins, directions)
        limit = np.asarray(reach, np.float64)
        if limit.ndim == 0:
            return self._scene.test_occlusions(rays, 0.0, float(limit)).numpy().astype(bool)
        nearest = self._scene.cast_rays(rays)["t_hit"].numpy()
        return nearest < limit


def _open3d():  # type: ignore[no-untyped-def]
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"Open3D cannot be loaded ({error}); run `scan2albedo doctor` for the command that mends it"
        ) from error
    return open3d
