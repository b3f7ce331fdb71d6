"""Fitted faces without a scan: what a fit that ended at known control points would have returned."""

import numpy as np

from scan2albedo.core import Trace
from scan2albedo.fitting import FittedFace


def fit_of(model, control_points):
    """Return a model deformed to control points (C, 3), on its scan everywhere."""
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
