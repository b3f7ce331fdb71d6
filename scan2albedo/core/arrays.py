"""Types of arrays in annotations, whose shapes stand in docstrings; checked meshes; texels; a smooth step."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def checked_mesh(
    vertices: ArrayLike, faces: ArrayLike, name: str, error: type[Exception] = ValueError
) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh; an `error` that begins with its name for others."""
    xyz, index = np.asarray(vertices, np.float64), np.asarray(faces)
    for what, array in (("vertices", xyz), ("faces", index)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise error(f"{name}: its {what} have shape {array.shape}, expected (N, 3); triangulate it")
    if bad := int((~np.isfinite(xyz)).any(1).sum()):
        raise error(f"{name}: {bad} of {len(xyz)} vertices are NaN or infinite; repair it first")
    index = index.astype(np.int64)
    if len(index) and not (index.min() >= 0 and index.max() < len(xyz)):
        raise error(f"{name}: its faces refer to vertices {index.min()} to {index.max()} of {len(xyz)}")
    return xyz, index


def smoothstep(x: ArrayLike) -> FloatArray:
    """Return 3 x^2 - 2 x^3 of x clipped to [0, 1]."""
    t = np.clip(np.asarray(x, float), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def on_grid(mask: BoolArray, values: NDArray, elsewhere: float = 0) -> NDArray:
    """Return (H, W, ...) with values (N, ...) on the N texels of a mask (H, W), `elsewhere` on the others."""
    grid = np.full((*mask.shape, *values.shape[1:]), elsewhere, values.dtype)
    grid[mask] = values
    return grid
