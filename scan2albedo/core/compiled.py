"""How functions are compiled."""

from functools import partial

from numba import njit

compiled = partial(njit, cache=True, nogil=True)
"""Decorator: compiled by numba at the first call, kept on disk, run without Python's lock."""


@compiled
def triple(rows, i):  # type: ignore[no-untyped-def]
    """Return the three numbers of row i of (N, 3), inside other compiled functions."""
    return rows[i, 0], rows[i, 1], rows[i, 2]
