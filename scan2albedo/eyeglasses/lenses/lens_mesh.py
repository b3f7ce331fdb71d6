"""A lens as a mesh: a fan from its centre to its rim."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.geometry.mesh import face_cross_products

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def lens_mesh(
    center: ArrayLike, rim: ArrayLike, normal: ArrayLike | None = None
) -> tuple[FloatArray, IntArray]:
    """Return vertices (R + 1, 3) and faces (R, 3) of a fan from the centre to the rim.

    Normals point to the side from which the rim runs counterclockwise, the viewer's for
    `LensRim.points`; with `normal` the fan is turned so that they point along it.

    Parameters
    ----------
    center : (3,) array_like of float
        Becomes vertex 0.
    rim : (R, 3) array_like of float
        Points in order around the lens, R >= 3.
    normal : (3,) array_like of float, optional

    Raises
    ------
    EyeglassesError
        When the rim does not go around the centre once, so that the fan would fold.
    ValueError
        When an array has the wrong shape or is not finite.

    Examples
    --------
    >>> vertices, faces = lens_mesh([0, 0, 0], [[1, 0, 0], [0, 1, 0], [-1, -1, 0]])
    >>> vertices.shape, faces.tolist()
    ((4, 3), [[0, 1, 2], [0, 2, 3], [0, 3, 1]])
    """
    middle, outline = np.asarray(center, np.float64), np.asarray(rim, np.float64)
    if middle.shape != (3,) or outline.ndim != 2 or outline.shape[1] != 3 or len(outline) < 3:
        raise ValueError(f"center and rim must be (3,) and (R, 3), got {middle.shape}, {outline.shape}")
    vertices = np.concatenate([middle[None], outline])
    if not np.isfinite(vertices).all():
        raise ValueError("center and rim must be finite")
    numbers = np.arange(1, len(vertices))
    faces = np.stack([np.zeros_like(numbers), numbers, np.roll(numbers, -1)], 1)
    # Taken around the centre: far from the origin the cross products would lose their digits.
    cross = face_cross_products(vertices - middle, faces)
    axis = cross.sum(0)
    if normal is not None and np.asarray(normal, np.float64) @ axis < 0:
        faces, cross, axis = faces[:, [0, 2, 1]], -cross, -axis
    folded = ~(cross @ axis > 0)
    if folded.any():
        raise EyeglassesError(
            f"the rim does not go around the lens centre once: {int(folded.sum())} of {len(faces)} triangles "
            "fold; move the centre inside, or put the points in order"
        )
    return vertices, faces
