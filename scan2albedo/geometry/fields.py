"""Fields that go on from what is known over the links of a grid or a mesh, and one sparse factorisation."""

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    NDArray,
    all_finite,
)
from scan2albedo.geometry.mesh import edges_with_faces, vertex_areas
from scan2albedo.geometry.operators import laplacian

ANCHOR = 1e-9
"""Pull toward the old values, beside links of weight 1: it decides only where nothing known is touched."""
_FAINT = 1e-4
"""Part of the mean of an albedo below which it counts as none."""


class Field:
    """A field over N linked nodes, of which those `unknown` are free; factored once, solved for any values.

    With the steps g wanted along links of weights w >= 0, and a pull p of each unknown node toward its own
    old value v, it minimises

        sum over links (i, j) of w_ij (u_j - u_i - g_ij)^2  +  sum over unknown i of p_i (u_i - v_i)^2,

    u = v where known: Laplace's equation where g and p are 0, Poisson's [1]_ for any g, a screened one [2]_
    for p > 0, where what is known is felt over 1 / sqrt(p) links.

    Parameters
    ----------
    links : (E, 2) int array
        Both nodes of each link; a link of a node to itself counts nothing.
    unknown : (N,) bool array
    weight : float or (E,) float array
    pull : float or (N,) float array
        Greater than 0 where a part without anything known is to have one solution.

    Raises
    ------
    RuntimeError
        Without pull, when the equations have no single solution.

    References
    ----------
    .. [1] P. Perez, M. Gangnet, A. Blake, "Poisson image editing", SIGGRAPH 2003.
    .. [2] P. Bhat, B. Curless, M. Cohen, C. L. Zitnick, "Fourier analysis of the 2D screened Poisson equation
       for gradient domain problems", ECCV 2008.

    Examples
    --------
    >>> chain = Field(np.array([[0, 1], [1, 2], [2, 3]]), np.array([False, True, True, False]))
    >>> chain.solve(np.array([0.0, 0.0, 0.0, 3.0])).round(6)
    array([0., 1., 2., 3.])
    """

    def __init__(
        self,
        links: IntArray,
        unknown: BoolArray,
        *,
        weight: float | FloatArray = 1.0,
        pull: float | FloatArray = ANCHOR,
    ) -> None:
        self._unknown, self._used = unknown, unknown[links].any(1)
        ends = links[self._used]
        self._root = np.sqrt(np.broadcast_to(weight, len(links))[self._used])[:, None]
        # Row (i, j) of `difference` takes u to sqrt(w_ij) (u_j - u_i).
        signs = (self._root * [-1.0, 1.0]).ravel()
        begins = 2 * np.arange(len(ends) + 1)
        shape = len(ends), len(unknown)
        self._difference = sparse.csr_matrix((signs, ends.ravel(), begins), shape)
        free = self._difference.tocsc()[:, unknown]
        self._divergence = free.T
        pulls = np.broadcast_to(pull, len(unknown))[unknown]
        self._solve = factorized(free.T @ free + sparse.diags(pulls)) if unknown.any() else None

    def solve(self, values: NDArray, steps: FloatArray | None = None) -> FloatArray:
        """Return the field (N, ...) of values (N, ...), finite also where they are not known.

        `steps` (E, ...) are wanted from the first to the second node of each link, none when omitted.
        """
        field = np.array(values, float)
        if self._solve is None:
            return field
        # Only the change is solved for: no rounding where there is none.
        missing = -(self._difference @ field.reshape(len(field), -1))
        if steps is not None:
            missing += self._root * steps[self._used].reshape(missing.shape)
        change = self._solve(self._divergence @ missing)
        field[self._unknown] += change.reshape(field[self._unknown].shape)
        return field


def factorized(matrix: sparse.spmatrix) -> Callable[[FloatArray], FloatArray]:
    """Return the solver of a symmetric positive definite (N, N) matrix for right sides (N,) or (N, C).

    It is factored as L D L^T without pivoting, by SuperLU. Raises RuntimeError when it is singular.
    """
    # Columns on their own, neither relaxed to supernodes nor in panels, are the fastest on grids and meshes.
    return splu(
        sparse.csc_matrix(matrix),
        "MMD_AT_PLUS_A",
        0.0,
        relax=1,
        panel_size=1,
        options={"SymmetricMode": True},
    ).solve


def grid_links(usable: BoolArray) -> IntArray:
    """Return (E, 2) the neighbours in rows, then those in columns, that are both usable (H, W).

    >>> grid_links(np.ones((2, 2), bool)).tolist()
    [[0, 1], [2, 3], [0, 2], [1, 3]]
    """
    number = np.arange(usable.size).reshape(usable.shape)
    rows = np.stack([number[:, :-1], number[:, 1:]], -1)[usable[:, :-1] & usable[:, 1:]]
    columns = np.stack([number[:-1], number[1:]], -1)[usable[:-1] & usable[1:]]
    return np.concatenate([rows, columns])


def filled_over_grid(
    values: NDArray,
    gaps: BoolArray,
    known: BoolArray,
    *,
    across: FloatArray | None = None,
    down: FloatArray | None = None,
    pull: float = ANCHOR,
) -> FloatArray:
    """Return an image (H, W, ...) whose `gaps` (H, W) go on from `known` ones (H, W), see `Field`.

    They follow the forward differences `across` (H, W - 1, ...) and `down` (H - 1, W, ...) where those are
    given, else are smooth. Pixels that are neither stay and count nothing; gaps that touch nothing known keep
    the mean of their finite old values.
    """
    if not gaps.any():
        return np.array(values, float)
    usable = gaps | known
    steps = None
    if across is not None and down is not None:
        rows, columns = usable[:, :-1] & usable[:, 1:], usable[:-1] & usable[1:]
        steps = np.concatenate([across[rows], down[columns]])
    field = Field(grid_links(usable), gaps.ravel(), pull=pull)
    return field.solve(np.reshape(values, (gaps.size, -1)), steps).reshape(np.shape(values))


def continued_smoothly(albedo: NDArray, gaps: BoolArray, known: BoolArray) -> Float32Array:
    """Return an albedo (H, W, 3) whose logarithm goes on from `known` into `gaps` by Laplace's equation."""
    floor = max(_FAINT * float(albedo.mean()), float(np.finfo(np.float32).tiny))
    field = np.log(np.maximum(albedo.astype(float), floor))
    filled = filled_over_grid(field, gaps, known)
    return np.where(gaps[..., None], np.exp(filled), albedo).astype(np.float32)


def surroundings(region: BoolArray, margin: int) -> tuple[slice, slice]:
    """Return the bounding box of `region` (not empty) with `margin` texels around it, as slices."""
    ends = (np.flatnonzero(region.any(axis))[[0, -1]].tolist() for axis in (1, 0))
    rows, columns = (slice(max(0, first - margin), last + margin + 1) for first, last in ends)
    return rows, columns


def filled_over_mesh(values: ArrayLike, known: ArrayLike, faces: IntArray) -> FloatArray:
    """Return values (V, C) where those of unknown vertices are the means of their neighbours.

    Values that are not `known` (V,) may be anything. Parts of the mesh without any known vertex get the mean
    of all known values; ValueError when no vertex is known.

    >>> strip = np.array([[0, 1, 2], [1, 2, 3]])
    >>> ends = [True, False, False, True]
    >>> filled_over_mesh([[0.0], [np.nan], [np.nan], [1.0]], ends, strip).ravel().round(6)
    array([0. , 0.5, 0.5, 1. ])
    """
    old, there = np.asarray(values, float), np.asarray(known, np.bool_)
    if not there.any():
        raise ValueError("no vertex is known: there is nothing to fill from")
    start = np.where(there[:, None], old, old[there].mean(0))
    return Field(edges_with_faces(faces)[0], ~there).solve(start)


def surface_diffusion(
    vertices: FloatArray, faces: IntArray, deviation_mm: float
) -> Callable[[ArrayLike], FloatArray]:
    """Return a function that spreads values (V, ...) over the surface by one implicit step of diffusion [1]_.

        (M + t L) y = M x,   t = deviation_mm^2 / 2,

    with M the vertices' areas and L the cotangent Laplacian: a `Field` that is pulled toward x with M over
    links of weights t L. A peak spreads to a bump of this standard deviation along each direction of the
    surface, 0 or more. The integral over the surface stays, constants do too, and no value leaves the range
    of those given. Vertices without area around them keep their values.

    Raises ValueError when `deviation_mm` is negative or not finite, values have another length than V, or
    vertices or values are not finite.

    .. [1] M. Desbrun, M. Meyer, P. Schroeder, A. Barr, "Implicit fairing of irregular meshes using diffusion
       and curvature flow", SIGGRAPH 1999, section 2.3.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    >>> spread = surface_diffusion(corners, np.array([[0, 1, 2], [2, 1, 3]]), 50.0)
    >>> spread([[0.0], [3.0], [0.0], [0.0]]).round(2).ravel().tolist()
    [1.0, 1.0, 1.0, 1.0]
    """
    if not (np.isfinite(deviation_mm) and deviation_mm >= 0):
        raise ValueError(f"deviation_mm must be finite and 0 or more, got {deviation_mm}")
    if not all_finite(vertices):
        raise ValueError(f"{(~np.isfinite(vertices)).any(1).sum()} vertices are NaN or infinite")
    area = vertex_areas(vertices, faces)
    # Far beyond the surface's size everything is its mean already, and L would drown M in rounding.
    deviation = min(float(deviation_mm), 1e3 * float(np.ptp(vertices, axis=0).max(initial=0.0)))
    start, end, weight = sparse.find(sparse.triu(-laplacian(vertices, faces), 1))
    mass = np.where(area > 0, area, 1.0)
    everywhere = np.ones(len(vertices), bool)
    field = Field(np.stack([start, end], 1), everywhere, weight=deviation**2 / 2 * weight, pull=mass)

    def spread(values: ArrayLike) -> FloatArray:
        old = np.asarray(values, float)
        if old.ndim == 0 or len(old) != len(vertices):
            raise ValueError(f"values have shape {old.shape}, expected ({len(vertices)}, ...)")
        if not all_finite(old):
            raise ValueError(f"{(~np.isfinite(old)).sum()} values are not finite, and would spread")
        return field.solve(old)

    return spread
