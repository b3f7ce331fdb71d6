"""The compiled loop of complex wavelet similarity: one template against a block of others."""

from __future__ import annotations

import numpy as np
from numba import njit

LANES = 64
"""Templates of a block; they lie next to each other, so that every step below is a vector operation."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"})
def add_window_similarities(  # type: ignore[no-untyped-def]
    real, imag, energy, valid, lane_real, lane_imag, lane_energy, lane_valid, window, stabilizer, total
):
    """Add to total (A, LANES) the similarity of one orientation, summed over windows valid in both.

    `real`, `imag` (A, h, w) float32 are the coefficients of A templates, and (h, w, LANES) those of the
    lanes. `energy` is a window's sum of squared magnitudes, float32, and `valid` whether it lies inside the
    mask: (A, h - window + 1, w - window + 1), lanes last. Sums run down columns of `window` coefficients,
    then along rows of these, both by adding what comes in and subtracting what goes out.
    """
    count, height, width = real.shape
    column_real = np.empty((width, LANES), np.float32)
    column_imag = np.empty((width, LANES), np.float32)
    sum_real, sum_imag = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    similarity = np.empty(LANES, np.float32)
    two = np.float32(2.0)
    for n in range(count):
        column_real[:] = 0.0
        column_imag[:] = 0.0
        similarity[:] = 0.0
        for y in range(height):
            gone = y - window
            for x in range(width):
                a, b = real[n, y, x], imag[n, y, x]
                if gone < 0:
                    for k in range(LANES):
                        column_real[x, k] += a * lane_real[y, x, k] + b * lane_imag[y, x, k]
                        column_imag[x, k] += b * lane_real[y, x, k] - a * lane_imag[y, x, k]
                    continue
                c, d = real[n, gone, x], imag[n, gone, x]
                for k in range(LANES):
                    column_real[x, k] += (
                        a * lane_real[y, x, k]
                        + b * lane_imag[y, x, k]
                        - c * lane_real[gone, x, k]
                        - d * lane_imag[gone, x, k]
                    )
                    column_imag[x, k] += (
                        b * lane_real[y, x, k]
                        - a * lane_imag[y, x, k]
                        - d * lane_real[gone, x, k]
                        + c * lane_imag[gone, x, k]
                    )
            if gone < -1:
                continue
            row = gone + 1
            sum_real[:] = 0.0
            sum_imag[:] = 0.0
            for x in range(window - 1):
                for k in range(LANES):
                    sum_real[k] += column_real[x, k]
                    sum_imag[k] += column_imag[x, k]
            for x in range(width - window + 1):
                for k in range(LANES):
                    sum_real[k] += column_real[x + window - 1, k]
                    sum_imag[k] += column_imag[x + window - 1, k]
                if valid[n, row, x]:
                    own = energy[n, row, x] + stabilizer
                    for k in range(LANES):
                        shared = np.sqrt(sum_real[k] * sum_real[k] + sum_imag[k] * sum_imag[k])
                        similarity[k] += (
                            lane_valid[row, x, k]
                            * (two * shared + stabilizer)
                            / (own + lane_energy[row, x, k])
                        )
                for k in range(LANES):
                    sum_real[k] -= column_real[x, k]
                    sum_imag[k] -= column_imag[x, k]
        for k in range(LANES):
            total[n, k] += similarity[k]
