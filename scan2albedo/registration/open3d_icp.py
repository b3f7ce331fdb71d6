"""Open3D's robust point-to-plane ICP, the one place of this package that imports Open3D."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
from threadpoolctl import threadpool_limits

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import MissingDependencyError
from scan2albedo.geometry.oriented_points import OrientedPoints


def import_open3d() -> ModuleType:
    """Return open3d, whose import takes seconds; raises `MissingDependencyError` without its libraries."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"Open3D cannot be loaded ({error}); run tools/bootstrap_system.sh, or install open3d-cpu and "
            "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"
        ) from error
    return open3d


class ScanTarget:
    """Scan samples (mm) prepared for many ICP runs."""

    def __init__(self, samples: OrientedPoints) -> None:
        self._open3d = import_open3d()
        self._cloud = self._cloud_of(samples)

    def _cloud_of(self, samples: OrientedPoints):  # type: ignore[no-untyped-def]
        geometry, utility = self._open3d.geometry, self._open3d.utility
        cloud = geometry.PointCloud(utility.Vector3dVector(samples.points))
        cloud.normals = utility.Vector3dVector(samples.normals)
        return cloud

    def refine(
        self,
        model: OrientedPoints,
        scan_from_model: FloatArray,
        *,
        max_distance_mm: float,
        scale_mm: float,
        iterations: int,
    ) -> FloatArray:
        """Return the (4, 4) `scan_from_model` after point-to-plane ICP of the model with Tukey's loss.

        `max_distance_mm` is the greatest distance of a pair, `scale_mm` Tukey's constant: pairs farther apart
        along the normal have no weight. Runs on one thread: Open3D adds up its normal equations in the order
        the threads finish, so more threads would give other bits each time.
        """
        registration = self._open3d.pipelines.registration
        with _one_thread(self._open3d):
            result = registration.registration_icp(
                self._cloud_of(model),
                self._cloud,
                max_distance_mm,
                scan_from_model,
                registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=scale_mm)),
                registration.ICPConvergenceCriteria(1e-6, 1e-6, iterations),
            )
        return np.array(result.transformation)


@contextmanager
def _one_thread(open3d: ModuleType) -> Iterator[None]:
    """Keep Open3D on one thread: from 0.20 on through its own setting (TBB), before that through OpenMP's."""
    if not hasattr(open3d.utility, "set_max_threads"):
        with threadpool_limits(1, "openmp"):
            yield
        return
    threads = open3d.utility.get_max_threads()
    open3d.utility.set_max_threads(1)
    try:
        yield
    finally:
        open3d.utility.set_max_threads(threads)
