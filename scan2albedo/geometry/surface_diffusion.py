"""Smoothing of values on a mesh over a distance in millimetres, whatever the mesh's resolution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.geometry.mesh import vertex_areas
from scan2albedo.geometry.operators import laplacian

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_WIDEST = 1e3


def surface_diffusion(
    vertices: FloatArray, faces: IntArray, deviation_mm: float
) -> Callable[[ArrayLike], FloatArray]:
    """Return a function that spreads values (V, ...) over the surface: one implicit step of heat diffusion.

        (M + t L) y = M x,   t = deviation^2 / 2,

    with M the vertices' areas and L the cotangent Laplacian. A peak spreads to a bump that has this standard
    deviation along each direction of the surface. The integral over the surface stays, constants do too, and
    no value leaves the range of those given.

    Parameters
    ----------
    vertices : (V, 3) float64
        Millimetres.
    faces : (F, 3) int64
        Vertices without area around them keep their values.
    deviation_mm : float
        0 or more; 0 returns the values given.

    Raises
    ------
    ValueError
        When `deviation_mm` is negative or not finite, values have another length than V, or vertices or
        values are not finite.

    References
    ----------
    M. Desbrun, M. Meyer, P. Schroeder, A. Barr, "Implicit fairing of irregular meshes using diffusion and
    curvature flow", SIGGRAPH 1999, section 2.3.

    Examples
    --------
    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    >>> spread = surface_diffusion(corners, np.array([[0, 1, 2], [2, 1, 3]]), 50.0)
    >>> spread([[0.0], [3.0], [0.0], [0.0]]).round(2).ravel().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    if not (np.isfinite(deviation_mm) and deviation_mm >= 0):
        raise ValueError(f"deviation_mm must be finite and 0 or more, got {deviation_mm}")
    if not np.isfinite(vertices).all():
        raise ValueError(f"{int((~np.isfinite(vertices)).any(1).sum())} vertices are NaN or infinite")
    area = vertex_areas(vertices, faces)
    # Far beyond the surface's size everything is its mean already, and L would drown M in rounding.
    deviation = min(float(deviation_mm), _WIDEST * float(np.ptp(vertices, axis=0).max(initial=0.0)))
    mass = np.where(area > 0, area, 1.0)
    system = sparse.diags(mass) + 0.5 * deviation**2 * laplacian(vertices, faces)
    factor = splu(system.tocsc(), permc_spec="COLAMD")

    def spread(values: ArrayLike) -> FloatArray:
        given = np.asarray(values, np.float64)
        if given.ndim == 0 or len(given) != len(vertices):
            raise ValueError(f"values have shape {given.shape}, expected ({len(vertices)}, ...)")
        if not np.isfinite(given).all():
            raise ValueError(
                f"{int((~np.isfinite(given)).sum())} values are NaN or infinite, and would spread"
            )
        flat = given.reshape(len(given), int(np.prod(given.shape[1:])))
        if deviation_mm == 0:
            return given.copy()
        return np.asarray(factor.solve(mass[:, None] * flat)).reshape(given.shape)

    return spread
