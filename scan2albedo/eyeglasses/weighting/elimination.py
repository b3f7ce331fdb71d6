"""The pattern of a sparse Cholesky factor: elimination tree, rows of each column, supernodes.

A symmetric matrix comes as the starts (N + 1,) and columns of its rows (CSR), both triangles.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_SPARE = 0.2
"""Part of a supernode's entries that may be zeros for the sake of larger dense blocks."""


@njit(cache=True)
def elimination_tree(starts, columns):  # type: ignore[no-untyped-def]
    """Return (N,) parents, -1 at roots: the first row below the diagonal in each column of L."""
    count = len(starts) - 1
    parent, ancestor = np.full(count, -1), np.full(count, -1)
    for i in range(count):
        for p in range(starts[i], starts[i + 1]):
            k = columns[p]
            while k != -1 and k < i:
                above = ancestor[k]
                ancestor[k] = i
                if above == -1:
                    parent[k] = i
                k = above
    return parent


@njit(cache=True)
def postorder(parent):  # type: ignore[no-untyped-def]
    """Return (N,) nodes of the forest, children before parents and each subtree in one run."""
    count = len(parent)
    child, sibling = np.full(count, -1), np.full(count, -1)
    for j in range(count - 1, -1, -1):
        if parent[j] >= 0:
            sibling[j] = child[parent[j]]
            child[parent[j]] = j
    order, placed = np.empty(count, np.int64), 0
    stack = np.empty(count, np.int64)
    for root in range(count):
        if parent[root] >= 0:
            continue
        stack[0], height = root, 1
        while height:
            j = stack[height - 1]
            if child[j] >= 0:
                stack[height] = child[j]
                height += 1
                child[j] = sibling[child[j]]
            else:
                order[placed] = j
                placed += 1
                height -= 1
    return order


@njit(cache=True)
def column_counts(starts, columns, parent):  # type: ignore[no-untyped-def]
    """Return (N,) entries of each column of L below the diagonal."""
    count = len(parent)
    counts, seen = np.zeros(count, np.int64), np.full(count, -1)
    for i in range(count):
        seen[i] = i
        for p in range(starts[i], starts[i + 1]):
            k = columns[p]
            while k < i and seen[k] != i:
                counts[k] += 1
                seen[k] = i
                k = parent[k]
    return counts


@njit(cache=True)
def column_rows(starts, columns, parent, pointers):  # type: ignore[no-untyped-def]
    """Return the rows of L's columns below the diagonal, ascending; column j's begin at pointers[j]."""
    count = len(parent)
    rows, seen = np.empty(pointers[-1], np.int64), np.full(count, -1)
    end = pointers[:-1].copy()
    for i in range(count):
        seen[i] = i
        for p in range(starts[i], starts[i + 1]):
            k = columns[p]
            while k < i and seen[k] != i:
                rows[end[k]] = i
                end[k] += 1
                seen[k] = i
                k = parent[k]
    return rows


@njit(cache=True)
def supernodes(parent, counts):  # type: ignore[no-untyped-def]
    """Return (S + 1,) first columns of the supernodes, and N.

    A column joins the one before it when it is its parent and few zeros come in by that: the rows of the
    last column then hold those of all.
    """
    count = len(parent)
    first = np.empty(count + 1, np.int64)
    first[0], found = 0, 1
    true_entries = counts[0] + 1 if count else 0
    for j in range(1, count):
        width = j + 1 - first[found - 1]
        stored = width * counts[j] + width * (width + 1) // 2
        if parent[j - 1] == j and stored - true_entries - counts[j] - 1 <= _SPARE * stored:
            true_entries += counts[j] + 1
        else:
            first[found] = j
            found += 1
            true_entries = counts[j] + 1
    first[found] = count
    return first[: found + 1].copy()


@njit(cache=True)
def fronts(first, pointers, column_rows):  # type: ignore[no-untyped-def]
    """Return each supernode's rows and where they begin, its number of children, the stack's size."""
    nodes = len(first) - 1
    row_start = np.zeros(nodes + 1, np.int64)
    for s in range(nodes):
        last = first[s + 1] - 1
        row_start[s + 1] = row_start[s] + first[s + 1] - first[s] + pointers[last + 1] - pointers[last]
    rows, home = np.empty(row_start[-1], np.int64), np.empty(first[-1], np.int64)
    for s in range(nodes):
        width, last = first[s + 1] - first[s], first[s + 1] - 1
        for k in range(width):
            rows[row_start[s] + k] = first[s] + k
            home[first[s] + k] = s
        below = column_rows[pointers[last] : pointers[last + 1]]
        rows[row_start[s] + width : row_start[s + 1]] = below
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
