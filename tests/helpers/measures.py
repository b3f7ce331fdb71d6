"""Lengths of vectors and sizes of errors."""

import numpy as np


def row_lengths(vectors):
    """Return (...) the lengths of vectors (..., K)."""
    return np.linalg.norm(vectors, axis=-1)


def rms(values):
    """Return the root of the mean square."""
    return np.sqrt(np.mean(np.square(values)))
