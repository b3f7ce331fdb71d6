"""What is known, at the nodes of an albedo's prior, of log albedo and of light that no part stands for."""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, eigh, solve_triangular
from scipy.linalg.blas import dtrsv
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from scan2albedo.albedo.levels import Level
from scan2albedo.albedo.prior import NODES, AlbedoPrior
from scan2albedo.core.arrays import FloatArray, IntArray, norms, row_sums
from scan2albedo.core.compiled import compiled

UNMODELLED = 0.06
"""Standard deviation of light that no part stands for, as a part of the median light."""
_REACH = 0.12
"""Correlation length of that light, as a part of the chart's side."""
TINY = 1e-6
"""Part of the median below which a weight counts as none."""
FAINT = 1e-4
"""Part of the median below which V counts as none."""


class Scales(NamedTuple):
    """By what the image multiplies standard deviations of the prior; 1 is the prior's own."""

    albedo: float = 1.0
    """Of albedo at the nodes."""
    light: float = 1.0
    """Of light that no part stands for."""
    grain: float = 1.0
    """Of single cells."""
    soft: float = 1.0
    """Of the environment's harmonics."""


class NodeField:
    """The prior u ~ N(0, a^2 C_a + l^2 C_l) at M nodes, for scales a of albedo and l of light.

    C_a is that of `AlbedoPrior`, C_l is larger where it is dark. The nodes are those that the cells of
    `level`, at `places` (N, 2) of the prior's chart, touch.
    """

    def __init__(self, prior: AlbedoPrior, level: Level, places: FloatArray) -> None:
        weights = prior.node_weights(places)
        self.prior = prior
        self.used: IntArray = np.flatnonzero(np.asarray(weights.sum(0)).ravel() > TINY)
        self.albedo_covariance = self.of_used(prior.covariance(0))
        # Brightness without the face's own pattern says how dark a place is, whatever the light.
        bright = level.value / np.exp(np.clip(prior.mean_at(places)[:, 0], -1.5, 0.5))
        dark = deviation_of_light(np.maximum(bright, FAINT), float(np.median(bright)))
        self.light_covariance = self.light_error(weights[:, self.used].T.tocsr(), dark)
        # Both covariances are diagonal in one basis, so each pair of scales has its precision at once.
        root = np.linalg.cholesky(self.albedo_covariance)
        half = solve_triangular(root, self.light_covariance, lower=True)
        ratio, turned = eigh(solve_triangular(root, half.T, lower=True), check_finite=False)
        self.ratio = np.maximum(ratio, 0.0)
        """(M,) variance of light beside one of albedo, in the basis."""
        self.basis = solve_triangular(root, turned, trans="T", lower=True)
        self._log_root = 2 * float(np.log(np.diag(root)).sum())
        self._precision: tuple[Scales | None, FloatArray] = None, self.ratio

    def of_used(self, covariance: FloatArray) -> FloatArray:
        """Return (M, M) the part of a covariance of all nodes that belongs to those of this field."""
        return covariance[np.ix_(self.used, self.used)]

    def weights(self, places: FloatArray) -> sparse.csr_matrix:
        """Return (N, M) the nodes' weights at `places` (N, 2)."""
        return self.prior.node_weights(places)[:, self.used].tocsr()

    def own(self, scales: Scales) -> FloatArray:
        """Return (M,) the precision in the basis."""
        return 1 / (scales.albedo**2 + scales.light**2 * self.ratio)

    def precision(self, scales: Scales) -> FloatArray:
        """Return (M, M) the precision; the last is kept."""
        if self._precision[0] is None or self._precision[0][:2] != scales[:2]:
            self._precision = scales, (self.basis * self.own(scales)) @ self.basis.T
        return self._precision[1]

    def log_determinant(self, scales: Scales) -> float:
        """Return that of the covariance."""
        return self._log_root - float(np.log(self.own(scales)).sum())

    def light_error(self, onto_nodes: sparse.csr_matrix, deviation: FloatArray) -> FloatArray:
        """Return (M, M) the covariance of log light, of cells' standard `deviation` (N,)."""
        count = np.maximum(onto_nodes @ np.ones(len(deviation)), TINY)
        size = np.sqrt((onto_nodes @ deviation**2) / count)
        at = np.stack(np.divmod(self.used, NODES), 1) / NODES
        apart = norms(at[:, None] - at[None])
        return np.outer(size, size) * np.exp(-apart / _REACH) + TINY * np.eye(len(at))


def deviation_of_light(light: FloatArray, typical_light: float) -> FloatArray:
    """Return the standard deviation of the log of light that no part stands for, beside (N,) `light`."""
    # Never more: an ambient light of a tenth remains anywhere.
    return np.minimum(UNMODELLED * typical_light / light, 2.0)


def posterior_factor(nodes: sparse.csr_matrix, weight: FloatArray, precision: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor (M, M) of the `precision` of nodes and cells (N, M) of `weight` (N,).

    What stands above the diagonal is no part of it.
    """
    matrix = precision.T.copy(order="F")
    _add_cells(nodes.indptr, nodes.indices, nodes.data, weight, matrix)
    # Without the checks and copies of `cho_factor`: a search does this a thousand times.
    factor, failed = dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise LinAlgError("the precision of the nodes is not positive definite")
    return factor


def solved(factor: FloatArray, values: FloatArray) -> FloatArray:
    """Return the solution (M, ...) of the system with this factor."""
    if values.ndim > 1:
        return dpotrs(factor, values, lower=1)[0]
    return dtrsv(factor, dtrsv(factor, values, lower=1), lower=1, trans=1)


def inverse(factor: FloatArray) -> FloatArray:
    """Return (M, M) the inverse of the matrix with this factor."""
    low = dpotri(factor, lower=1)[0]
    return np.tril(low) + np.tril(low, -1).T


def cell_variances(nodes: sparse.csr_matrix, covariance: FloatArray) -> FloatArray:
    """Return (N,) the variances at cells of `nodes` (N, M), of the `covariance` (M, M) at the nodes."""
    return row_sums(nodes.multiply(nodes @ covariance))


@compiled
def _add_cells(start, node, share, weight, matrix):  # type: ignore[no-untyped-def]
    """Add w_n s_n s_n^T of cells n to the lower half of `matrix` (M, M); s_n are rows of a sparse matrix."""
    for n in range(len(weight)):
        for i in range(start[n], start[n + 1]):
            for j in range(start[n], i + 1):
                low, high = min(node[i], node[j]), max(node[i], node[j])
                matrix[high, low] += weight[n] * share[i] * share[j]
