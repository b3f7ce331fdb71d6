"""Types of arrays in annotations, whose shapes stand in docstrings; checked arrays; texels; a smooth step."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
RealArray = NDArray[np.floating]
IntArray = NDArray[np.int64]

Values = dict[str, Any]
"""By name: figures, options, arrays, what becomes an object of JSON."""

Texts = tuple[str, ...]
"""Names, notes and the like, in an order that does not change."""
GridShape = tuple[int, int]
"""Of a picture or chart: height and width."""

EPSILON = np.finfo(float).eps
"""Relative rounding error of float64."""
SMALLEST = np.finfo(float).tiny
"""Smallest number that float64 holds at full precision: keeps quotients finite."""


def checked_array(
    values: ArrayLike,
    shape: tuple[Any, ...],
    name: str,
    error: type[Exception] = ValueError,
    *,
    kind: type = float,
    finite: type[Exception] | None = None,
) -> NDArray:
    """Return values of a shape, where letters stand for any number; an `error` that names them for others.

    It may begin with any axes, `...`. Numbers become float64; of the `kind` bool or int no others are taken.
    NaN and infinity raise `finite`.

    >>> checked_array([[1, 2]], ("N", 3), "points")
    Traceback (most recent call last):
        ...
    ValueError: points is (1, 2), expected (N, 3)
    """
    array = np.asarray(values, float if kind is float else None)
    whole = (*array.shape[: array.ndim - len(shape) + 1], *shape[1:]) if shape[0] is ... else shape
    sizes = [got if isinstance(want, str) else want for want, got in zip(whole, array.shape, strict=False)]
    fitting = len(whole) == array.ndim and tuple(sizes) == array.shape
    if not (fitting and np.issubdtype(array.dtype, np.integer if kind is int else kind)):
        found, wanted = ("", "") if kind is float else (f"{array.dtype} ", f"{kind.__name__} ")
        said = str(shape).replace("'", "").replace("Ellipsis", "...")
        raise error(f"{name} is {found}{array.shape}, expected {wanted}{said}")
    if finite is not None and not (good := np.isfinite(array)).all():
        first = np.argwhere(~good)[0].tolist()
        raise finite(f"{name}: {(~good).sum()} values are NaN or infinite, first at {first}")
    return array.astype(int) if kind is int else array


def checked_mesh(
    vertices: ArrayLike, faces: ArrayLike, name: str, error: type[Exception] = ValueError
) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a mesh; an `error` that begins with its name for others."""
    xyz, index = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces)
    for what, array in (("vertices", xyz), ("faces", index)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise error(f"{name}: its {what} have shape {array.shape}, expected (N, 3); triangulate it")
    if bad := int((~np.isfinite(xyz)).any(1).sum()):
        raise error(f"{name}: {bad} of {len(xyz)} vertices are NaN or infinite; repair it first")
    whole = index.astype(int)
    if (whole != index).any():
        raise error(f"{name}: its faces hold numbers that are not whole")
    if len(whole) and not (whole.min() >= 0 and whole.max() < len(xyz)):
        raise error(f"{name}: its faces refer to vertices {whole.min()} to {whole.max()} of {len(xyz)}")
    return xyz, whole


def attributes(owner: object, *names: str) -> Values:
    """Return attributes of an object by their names."""
    return {name: getattr(owner, name) for name in names}


def all_finite(values: ArrayLike) -> bool:
    """Return whether no number is NaN or infinite."""
    return bool(np.isfinite(values).all())


def norms(vectors: ArrayLike) -> FloatArray:
    """Return the Euclidean norms (...) of vectors (..., C)."""
    return np.linalg.norm(vectors, axis=-1)


def rms(values: ArrayLike) -> float:
    """Return the root mean square of values of any shape; NaN of none."""
    array = np.asarray(values)
    return float(np.sqrt(np.mean(array**2))) if array.size else np.nan


def brightest(colors: ArrayLike) -> NDArray:
    """Return V (...), the largest channel of colours (..., 3); a reduction over so short an axis is slow."""
    return np.maximum.reduce([*np.moveaxis(np.asarray(colors), -1, 0)])


def dots(one: NDArray, other: NDArray) -> NDArray:
    """Return the scalar products (...) of vectors (..., C) and (..., C)."""
    return np.einsum("...c,...c->...", one, other)


def triangle_sides(corners: NDArray) -> tuple[NDArray, NDArray]:
    """Return the vectors (F, C) from the first of triangles' corners (F, 3, C) to the second and third."""
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def arc_lengths(points: FloatArray) -> FloatArray:
    """Return the way (N,) along a line of points (N, C) to each of them, from 0."""
    return np.append(0.0, np.cumsum(norms(np.diff(points, axis=0))))


def identities(count: int, size: int) -> FloatArray:
    """Return `count` unit matrices (count, size, size)."""
    return np.tile(np.eye(size), (count, 1, 1))


def row_sums(matrix: Any) -> FloatArray:
    """Return the sums (R,) of a sparse matrix's rows."""
    return np.asarray(matrix.sum(1)).ravel()


def finite_rows(values: RealArray) -> BoolArray:
    """Return (...) where all C numbers of values (..., C) are finite."""
    return np.asarray(np.isfinite(values).all(-1))


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> IntArray:
    """Return (F, 3) triangles of a rows x columns vertex grid; `wrap` joins the last column to the first."""
    index = np.arange(rows * columns).reshape(rows, columns)
    if wrap:
        index = np.concatenate([index, index[:, :1]], 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])


def smoothstep(x: ArrayLike) -> FloatArray:
    """Return 3 x^2 - 2 x^3 of x clipped to [0, 1]."""
    t = np.clip(np.asarray(x, float), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def on_grid(mask: BoolArray, values: NDArray, elsewhere: float = 0) -> NDArray:
    """Return (H, W, ...) with values (N, ...) on the N texels of a mask (H, W), `elsewhere` on the others."""
    grid = np.full((*mask.shape, *values.shape[1:]), elsewhere, values.dtype)
    grid[mask] = values
    return grid
