"""What goes into a fit, and what comes out of it, without fitting."""

import numpy as np

from scan2albedo.core import Trace
from scan2albedo.fitting import FittedFace
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.mesh import boundary_vertex_mask, vertex_normals


def scan_surface(vertices, faces):
    """Return a scan as the fit sees it, every vertex as it is."""
    boundary = boundary_vertex_mask(len(vertices), faces)
    return ScanSurface(vertices, faces, vertex_normals(vertices, faces), boundary)


def fit_of(model, control_points):
    """Return what a fit that ended at control points (C, 3) would return, everywhere on its scan."""
    subdivision = model.subdivision(1)
    vertices = subdivision.matrix @ control_points
    return FittedFace(
        vertices=vertices,
        faces=subdivision.faces,
        uv=model.refined_uv(1),
        region=model.region[subdivision.parent],
        residual_mm=np.zeros(len(vertices)),
        model_from_scan=np.eye(4),
        levels=1,
        model=model,
        control_points=control_points,
        landmarks=model.landmarks_of(control_points),
        template_vertices=None,
        converged=True,
        iterations=1,
        trace=Trace(),
    )
