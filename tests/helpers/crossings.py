"""Surfaces that cut themselves."""


def crossing_triangles(vertices, faces):
    """Count pairs of triangles that share no vertex and cross (Open3D's exact test)."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    return len(mesh.get_self_intersecting_triangles())
