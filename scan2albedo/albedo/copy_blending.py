"""Copies of texture joined without seams: their gradients, not their values, are kept."""

from __future__ import annotations

import numpy as np
from numba import njit

_OWN_STEP = np.float32(0.6)
"""Weight of two copies' own difference where copies from different places meet."""
_HOLD = np.float32(1e-4)
"""Weight by which a copy keeps its own level: felt from 100 texels on, where gradients add up to drift."""
_SETTLED = np.float32(1e-3)
"""Blending ends when no log albedo moves by more than this."""


@njit(cache=True, nogil=True)
def blend_copies(filled, field, order, came_from, context, diameter):  # type: ignore[no-untyped-def]
    """Integrate the copies' gradients over the texels of `order`, in place, by successive over-relaxation.

    Minimises sum |u_q - u_p - g_pq|^2 over neighbours p, q, of which one at least was copied, plus a little
    of |u_p - its copy|^2, so that nothing drifts away where the border is far. Across the
    border g is the step beside the place the copy came from. Where two copies from different places meet it
    is a mean of that and of their own difference: the one alone takes a quarter of the texture's
    variance away, the other adds some.
    """
    pull, links, degree, share = _equations(filled, field, order, came_from, context)
    # The best factor for a square of this side; the error falls by e in diameter / (2 pi) sweeps.
    relaxation = np.float32(2.0 / (1.0 + np.sin(np.pi / (diameter + 1))))
    for _ in range(10 * diameter):
        moved = np.float32(0)
        for t in range(len(order)):
            if degree[t] == 0:
                continue
            row, column, missing = order[t, 0], order[t, 1], np.float32(4 - degree[t])
            a, b, c, d = links[t]
            for channel in range(3):
                old = filled[row, column, channel]
                total = pull[t, channel] - missing * old
                total += filled[a[0], a[1], channel] + filled[b[0], b[1], channel]
                total += filled[c[0], c[1], channel] + filled[d[0], d[1], channel]
                change = relaxation * (total * share[t] - old)
                filled[row, column, channel] = old + change
                moved = max(moved, abs(change))
        if moved < _SETTLED:
            break


@njit(cache=True, nogil=True)
def _equations(filled, field, order, came_from, context):  # type: ignore[no-untyped-def]
    """Return what u_p = share (pull + sum over neighbours u_q) needs for texels p (T), all g_pq in the pull.

    These are pull (T, 3), links (T, 4, 2), degree (T,) and share (T,): the first `degree` of the links are
    neighbours, the texel itself stands in for missing ones.
    """
    count = order.shape[0]
    pull, links = np.zeros((count, 3), np.float32), np.zeros((count, 4, 2), np.int64)
    degree, share = np.zeros(count, np.int64), np.zeros(count, np.float32)
    for t in range(count):
        row, column = order[t, 0], order[t, 1]
        for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            a, b = row + i, column + j
            inner = came_from[a, b, 0] >= 0
            if not (context[a, b] or inner):
                continue
            k = degree[t]
            degree[t] += 1
            links[t, k, 0], links[t, k, 1] = a, b
            # The left or upper texel of a pair is asked first, so that both ends want the same step.
            for end in range(2):
                here = (end == 0) == (i + j > 0)
                p, q, sign = (row, column, 1) if here else (a, b, -1)
                m, n = came_from[p, q, 0], came_from[p, q, 1]
                if m >= 0 and context[m + sign * i, n + sign * j]:
                    for c in range(3):
                        step = sign * (field[m + sign * i, n + sign * j, c] - field[m, n, c])
                        if inner:
                            own = filled[a, b, c] - filled[row, column, c]
                            step = _OWN_STEP * own + (np.float32(1) - _OWN_STEP) * step
                        pull[t, c] -= step
                    break
        for k in range(degree[t], 4):
            links[t, k, 0], links[t, k, 1] = row, column
        for c in range(3):
            pull[t, c] += _HOLD * filled[row, column, c]
        share[t] = np.float32(1) / (np.float32(degree[t]) + _HOLD)
    return pull, links, degree, share
