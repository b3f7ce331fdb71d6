"""Rigid registration by other libraries: model samples onto a scan."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.rigid import compose

VOXEL_MM = 5.0
FEATURE_RADIUS_MM = 25.0
ICP_DISTANCES_MM = (20.0, 8.0, 4.0)


@dataclass(frozen=True)
class Surface:
    """A mesh, in mm."""

    vertices: FloatArray
    faces: IntArray


Peer = Callable[[Surface, RawScan], FloatArray]
"""From the model's surface and a scan to the (4, 4) `scan_from_model`."""


def centered(model: Surface, scan: RawScan) -> FloatArray:
    """Return the pose that puts the model's centroid on the scan's, unturned."""
    return compose(np.eye(3), scan.vertices.mean(0) - model.vertices.mean(0))


def _cloud(surface: Surface | RawScan):  # type: ignore[no-untyped-def]
    import open3d

    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(surface.vertices), open3d.utility.Vector3iVector(surface.faces)
    )
    mesh.compute_vertex_normals()
    cloud = open3d.geometry.PointCloud(mesh.vertices)
    cloud.normals = mesh.vertex_normals
    down = cloud.voxel_down_sample(VOXEL_MM)
    down.normalize_normals()
    return down


def _point_to_plane(source, target, start: FloatArray) -> FloatArray:  # type: ignore[no-untyped-def]
    import open3d

    registration, pose = open3d.pipelines.registration, start
    for distance in ICP_DISTANCES_MM:
        pose = registration.registration_icp(
            source,
            target,
            distance,
            pose,
            registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=distance / 2)),
            registration.ICPConvergenceCriteria(1e-6, 1e-6, 40),
        ).transformation
    return np.array(pose)


def open3d_icp(model: Surface, scan: RawScan) -> FloatArray:
    """Point-to-plane ICP with Tukey's loss, distances 20, 8, 4 mm."""
    return _point_to_plane(_cloud(model), _cloud(scan), centered(model, scan))


def fpfh_ransac_icp(model: Surface, scan: RawScan) -> FloatArray:
    """Global pipeline of Open3D's tutorial: FPFH features, RANSAC, point-to-plane ICP."""
    import open3d

    registration = open3d.pipelines.registration
    source, target = _cloud(model), _cloud(scan)
    search = open3d.geometry.KDTreeSearchParamHybrid(radius=FEATURE_RADIUS_MM, max_nn=100)
    open3d.utility.random.seed(0)
    start = registration.registration_ransac_based_on_feature_matching(
        source,
        target,
        registration.compute_fpfh_feature(source, search),
        registration.compute_fpfh_feature(target, search),
        True,
        1.5 * VOXEL_MM,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL_MM),
        ],
        registration.RANSACConvergenceCriteria(100_000, 0.999),
    ).transformation
    return _point_to_plane(source, target, np.array(start))


def small_gicp_icp(model: Surface, scan: RawScan) -> FloatArray:
    """GICP on 5 mm voxels."""
    import small_gicp

    result = small_gicp.align(
        scan.vertices,
        model.vertices,
        centered(model, scan),
        downsampling_resolution=VOXEL_MM,
        max_correspondence_distance=ICP_DISTANCES_MM[0],
        max_iterations=100,
    )
    return np.array(result.T_target_source)


PEERS: dict[str, Peer] = {
    "Open3D ICP from centroids": open3d_icp,
    "Open3D FPFH+RANSAC+ICP": fpfh_ransac_icp,
    "small_gicp from centroids": small_gicp_icp,
}
