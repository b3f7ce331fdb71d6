"""Sparse Cholesky factors whose pattern is worked out once and refilled with numbers many times."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray

_SPARE = 0.2
"""Part of a supernode's entries that may be zeros for the sake of larger dense blocks."""


class SparseCholesky:
    """L L^T = A for a symmetric positive definite (N, N) A, and for A with rows and columns taken out.

    The multifrontal method [1]_: columns with one pattern form a supernode, a small dense matrix that hands
    its remainder to its parent in the elimination tree. `refill` repeats only the dense work, where cholespy
    works out everything anew (four to five times as slow for 20 key points). `matrix` holds both triangles.

    .. [1] J. W. H. Liu, "The multifrontal method for sparse matrix solution: theory and practice",
       SIAM Review 34(1), 1992.
    """

    def __init__(self, matrix: sparse.csr_matrix) -> None:
        # The rows of A (N,) as they are eliminated, and A in that order.
        self.order, lower = _elimination(matrix)
        self.matrix = _permuted(matrix, self.order)
        starts, rows = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
        self._first = _supernodes(starts, rows)
        self._rows, self._row_start, self._children, self._room = _fronts(self._first, starts, rows)
        sizes = np.diff(self._row_start) * np.diff(self._first)
        self._block_start = np.concatenate([[0], np.cumsum(sizes)])
        self._blocks = np.empty(self._block_start[-1])

    def refill(self, held: BoolArray) -> None:
        """Factor A with the rows and columns of `held` (N,), in elimination order, replaced by the identity.

        Raises numpy.linalg.LinAlgError when the remaining A is not positive definite.
        """
        given = self.matrix.indptr, self.matrix.indices, self.matrix.data, held
        fronts = self._first, self._rows, self._row_start, self._children, self._block_start, self._blocks
        widest = int(np.diff(self._row_start).max(initial=1))
        if not _factor(*given, *fronts, np.empty((widest, widest)), np.empty(self._room)):
            raise np.linalg.LinAlgError("the matrix is not positive definite")

    def solve(self, right: FloatArray) -> FloatArray:
        """Return A^-1 b for one right-hand side (N,) in elimination order, A as of the last `refill`."""
        x = np.array(right, np.float64)
        _substitute(x, self._first, self._rows, self._row_start, self._block_start, self._blocks)
        return x


def _elimination(matrix: sparse.csr_matrix) -> tuple[IntArray, sparse.csc_matrix]:
    """Return the elimination order (N,), and L's pattern below the diagonal in that order.

    SuperLU's minimum degree order, sorted so that each subtree of the elimination tree is one run.
    """
    # In the factor of a dominant matrix with negative links no fill cancels: it shows all of L's pattern.
    links = sparse.csc_matrix(matrix, copy=True)
    links.data[:] = -1.0
    dominant = links + sparse.diags(1e-3 - np.asarray(links.sum(0)).ravel())
    factor = splu(dominant.tocsc(), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True})
    lower = sparse.tril(factor.L, -1, "csc")
    lower.sort_indices()
    count = lower.shape[0]
    parent = np.full(count, count)
    filled = np.flatnonzero(np.diff(lower.indptr))
    parent[filled] = lower.indices[lower.indptr[filled]]
    # Numbered backwards: the walk from the root takes last children first, and reversed it is a postorder.
    ends = count - parent, count - np.arange(count)
    tree = sparse.csr_matrix((np.ones(count), ends), shape=(count + 1, count + 1))
    run = np.asarray(count - depth_first_order(tree, 0, return_predecessors=False)[:0:-1], np.int64)
    order = np.argsort(factor.perm_c)[run]
    return order.astype(np.int64), sparse.csc_matrix(_permuted(lower.tocsr(), run))


def _permuted(matrix: sparse.csr_matrix, order: IntArray) -> sparse.csr_matrix:
    result = matrix[order][:, order].tocsr()
    result.sort_indices()
    return result


@njit(cache=True)
def _supernodes(starts, rows):  # type: ignore[no-untyped-def]
    """Return (S + 1,) first columns of the supernodes, and N: runs of parents that add few zeros."""
    count = len(starts) - 1
    first = np.zeros(count + 1, np.int64)
    found, true_entries = 1, starts[1] + 1
    for j in range(1, count):
        below = starts[j + 1] - starts[j]
        width = j + 1 - first[found - 1]
        stored = width * below + width * (width + 1) // 2
        child = starts[j] > starts[j - 1] and rows[starts[j - 1]] == j
        if child and stored - true_entries - below - 1 <= _SPARE * stored:
            true_entries += below + 1
        else:
            first[found] = j
            found += 1
            true_entries = below + 1
    first[found] = count
    return first[: found + 1].copy()


@njit(cache=True)
def _fronts(first, starts, column_rows):  # type: ignore[no-untyped-def]
    """Return each supernode's rows and where they begin, its number of children, the stack's size."""
    nodes = len(first) - 1
    row_start = np.zeros(nodes + 1, np.int64)
    for s in range(nodes):
        last = first[s + 1] - 1
        row_start[s + 1] = row_start[s] + first[s + 1] - first[s] + starts[last + 1] - starts[last]
    rows, home = np.empty(row_start[-1], np.int64), np.empty(first[-1], np.int64)
    for s in range(nodes):
        width, last = first[s + 1] - first[s], first[s + 1] - 1
        for k in range(width):
            rows[row_start[s] + k] = first[s] + k
            home[first[s] + k] = s
        rows[row_start[s] + width : row_start[s + 1]] = column_rows[starts[last] : starts[last + 1]]
    children, owed = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64)
    held, room = 0, 0
    for s in range(nodes):
        size = row_start[s + 1] - row_start[s] - first[s + 1] + first[s]
        held += size * size - owed[s]
        room = max(room, held + owed[s])
        if size:
            above = home[rows[row_start[s + 1] - size]]
            children[above] += 1
            owed[above] += size * size
    return rows, row_start, children, room


@njit(cache=True, nogil=True)
def _factor(  # type: ignore[no-untyped-def]
    starts, columns, values, held, first, rows, row_start, children, block_start, blocks, work, stack
):
    """Fill `blocks`; return False where a pivot is not positive. Remainders wait on `stack` for parents."""
    nodes, top, depth = len(first) - 1, 0, 0
    place, local = np.empty(first[-1], np.int64), np.empty(len(work), np.int64)
    waiting = np.empty(nodes, np.int64)
    for s in range(nodes):
        own = rows[row_start[s] : row_start[s + 1]]
        size, width = len(own), first[s + 1] - first[s]
        for i in range(size):
            place[own[i]] = i
            for j in range(i, size):
                work[i, j] = 0.0
        for k in range(width):
            c = first[s] + k
            if held[c]:
                work[k, k] = 1.0
                continue
            for p in range(starts[c], starts[c + 1]):
                i = columns[p]
                if i >= c and not held[i]:
                    work[k, place[i]] = values[p]
        for _ in range(children[s]):
            depth -= 1
            child = waiting[depth]
            handed = rows[row_start[child] + first[child + 1] - first[child] : row_start[child + 1]]
            left = len(handed)
            top -= left * left
            for j in range(left):
                local[j] = place[handed[j]]
            for j in range(left):
                target, entry = work[local[j]], top + j * left
                for i in range(j, left):
                    target[local[i]] += stack[entry + i]
        if not _eliminate(work, width, size):
            return False
        for k in range(width):
            at = block_start[s] + k * size
            for i in range(k, size):
                blocks[at + i] = work[k, i]
        left = size - width
        if left:
            for j in range(left):
                column, entry = work[width + j], top + j * left
                for i in range(j, left):
                    stack[entry + i] = column[width + i]
            top += left * left
            waiting[depth] = s
            depth += 1
    return True


@njit(cache=True, nogil=True, fastmath={"contract"})
def _eliminate(work, width, size):  # type: ignore[no-untyped-def]
    """Factor the first `width` columns of a front in place (row j of `work` is column j of the front)."""
    begin = 0
    while begin < width:
        end = begin + (8 if width - begin >= 8 else 1)
        for k in range(begin, end):
            here = work[k]
            for q in range(begin, k):
                before = work[q]
                factor = before[k]
                for i in range(k, size):
                    here[i] -= factor * before[i]
            if not here[k] > 0:
                return False
            scale = 1 / np.sqrt(here[k])
            for i in range(k, size):
                here[i] *= scale
        if end - begin == 8:
            _subtract_eight(work, begin, size)
        else:
            column = work[begin]
            for j in range(end, size):
                here, factor = work[j], column[j]
                for i in range(j, size):
                    here[i] -= factor * column[i]
        begin = end
    return True


@njit(cache=True, nogil=True, fastmath={"contract"})
def _subtract_eight(work, begin, size):  # type: ignore[no-untyped-def]
    a, b, c, d = work[begin], work[begin + 1], work[begin + 2], work[begin + 3]
    e, f, g, h = work[begin + 4], work[begin + 5], work[begin + 6], work[begin + 7]
    for j in range(begin + 8, size):
        here = work[j]
        s, t, u, v, w, x, y, z = a[j], b[j], c[j], d[j], e[j], f[j], g[j], h[j]
        for i in range(j, size):
            first = s * a[i] + t * b[i] + u * c[i] + v * d[i]
            here[i] -= first + w * e[i] + x * f[i] + y * g[i] + z * h[i]


@njit(cache=True, nogil=True)
def _substitute(x, first, rows, row_start, block_start, blocks):  # type: ignore[no-untyped-def]
    """Overwrite x with the solution of L L^T x = b."""
    nodes = len(first) - 1
    for s in range(nodes):
        own = rows[row_start[s] : row_start[s + 1]]
        size = len(own)
        for k in range(first[s + 1] - first[s]):
            column = blocks[block_start[s] + k * size : block_start[s] + (k + 1) * size]
            value = x[own[k]] / column[k]
            x[own[k]] = value
            for i in range(k + 1, size):
                x[own[i]] -= column[i] * value
    for s in range(nodes - 1, -1, -1):
        own = rows[row_start[s] : row_start[s + 1]]
        size = len(own)
        for k in range(first[s + 1] - first[s] - 1, -1, -1):
            column = blocks[block_start[s] + k * size : block_start[s] + (k + 1) * size]
            value = x[own[k]]
            for i in range(k + 1, size):
                value -= column[i] * x[own[i]]
            x[own[k]] = value / column[k]
