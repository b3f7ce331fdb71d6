"""Compiled bounded least squares of many vertices, six unknowns each: R, G, B and three lobe weights.

For channel k with precisions p_jk = 1 / sigma_jk^2 and robust weights u_j,

    a_k = sum u p D^2,  d_k = sum u p D S,  G_k = sum u p S S^T,  b_k = sum u p D y,  g_k = sum u p S y

over the pairs j. With a Gaussian prior N(m, diag(q)^-1) the diffuse albedos are c_k = (b_k - d_k.w) / a_k,
and the rest is 3 x 3, M w = r with M = sum_k (G_k - d_k d_k^T / a_k) + diag(q_w): G_k alone where c_k is 0.
"""

import numpy as np
from numba import njit

UNIT_MEDIAN = 0.888
"""Median of the root mean square of three standard normal numbers."""


@njit(cache=True, nogil=True, error_model="numpy")
def add_normal_equations(observed, precision, lobes, bounce, weight, rows, normal):  # type: ignore[no-untyped-def]
    """Fill normal (N, 3, 14) with a, d (3), G (6: 11 12 13 22 23 33), b, g (3) of the vertices `rows` (N,).

    `observed`, `precision` (0 without observation) and robust `weight` are (J, V, 3), (J, V, 3) and (J, V);
    `lobes` is (J, V, 4), and `bounce` (J, V, 3), or empty, is added to D.
    """
    normal[:] = 0.0
    for j in range(observed.shape[0]):
        for i in range(len(rows)):
            v = rows[i]
            u = weight[j, v]
            direct, s0, s1, s2 = lobes[j, v, 0], lobes[j, v, 1], lobes[j, v, 2], lobes[j, v, 3]
            for k in range(3):
                p = u * precision[j, v, k]
                if p == 0.0:
                    continue
                diffuse = direct + bounce[j, v, k] if len(bounce) else direct
                y = p * observed[j, v, k]
                t, t0, t1, t2 = p * diffuse, p * s0, p * s1, p * s2
                row = normal[i, k]
                row[0] += t * diffuse
                row[1] += t * s0
                row[2] += t * s1
                row[3] += t * s2
                row[4] += t0 * s0
                row[5] += t0 * s1
                row[6] += t0 * s2
                row[7] += t1 * s1
                row[8] += t1 * s2
                row[9] += t2 * s2
                row[10] += y * diffuse
                row[11] += y * s0
                row[12] += y * s1
                row[13] += y * s2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _factor(m00, m01, m02, m11, m12, m22, p0, p1, p2):  # type: ignore[no-untyped-def]
    """Return L and D of M = L D L^T. M is no less than the prior, so no pivot is less than the prior's."""
    d0 = max(m00, p0)
    l1, l2 = m01 / d0, m02 / d0
    d1 = max(m11 - l1 * m01, p1)
    t = m12 - l2 * m01
    l3 = t / d1
    d2 = max(m22 - l2 * m02 - l3 * t, p2)
    return l1, l2, l3, d0, d1, d2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _backward(l1, l2, l3, d0, d1, d2, r0, r1, r2):  # type: ignore[no-untyped-def]
    y1 = r1 - l1 * r0
    y2 = r2 - l2 * r0 - l3 * y1
    x2 = y2 / d2
    x1 = y1 / d1 - l3 * x2
    return r0 / d0 - l1 * x1 - l2 * x2, x1, x2


@njit(cache=True, nogil=True, error_model="numpy")
def _reduce(normal, mean, prior, zero, m, r):  # type: ignore[no-untyped-def]
    """Fill m (6,) and r (3,), albedos eliminated; those in the bit set `zero` are held at 0."""
    m[:] = 0.0
    m[0], m[3], m[5] = prior[3], prior[4], prior[5]
    for n in range(3):
        r[n] = prior[3 + n] * mean[3 + n]
    for k in range(3):
        row = normal[k]
        for n in range(6):
            m[n] += row[4 + n]
        for n in range(3):
            r[n] += row[11 + n]
        if zero >> k & 1:
            continue
        a, b = row[0] + prior[k], row[10] + prior[k] * mean[k]
        d0, d1, d2 = row[1], row[2], row[3]
        m[0] -= d0 * d0 / a
        m[1] -= d0 * d1 / a
        m[2] -= d0 * d2 / a
        m[3] -= d1 * d1 / a
        m[4] -= d1 * d2 / a
        m[5] -= d2 * d2 / a
        r[0] -= d0 * b / a
        r[1] -= d1 * b / a
        r[2] -= d2 * b / a


@njit(cache=True, nogil=True, error_model="numpy")
def _with_fixed(m, r, prior, fixed):  # type: ignore[no-untyped-def]
    """Return w with the weights in the bit set `fixed` held at 0."""
    f0, f1, f2 = fixed & 1, fixed >> 1 & 1, fixed >> 2 & 1
    l1, l2, l3, d0, d1, d2 = _factor(
        1.0 if f0 else m[0],
        0.0 if f0 or f1 else m[1],
        0.0 if f0 or f2 else m[2],
        1.0 if f1 else m[3],
        0.0 if f1 or f2 else m[4],
        1.0 if f2 else m[5],
        0.0 if f0 else prior[3],
        0.0 if f1 else prior[4],
        0.0 if f2 else prior[5],
    )
    return _backward(l1, l2, l3, d0, d1, d2, 0.0 if f0 else r[0], 0.0 if f1 else r[1], 0.0 if f2 else r[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _albedos(normal, mean, prior, zero, w0, w1, w2, c):  # type: ignore[no-untyped-def]
    """Fill c (3,) for the weights and return twice the objective's fall by them."""
    fall = 0.0
    for k in range(3):
        row = normal[k]
        c[k] = 0.0
        if zero >> k & 1 == 0:
            b = row[10] + prior[k] * mean[k]
            c[k] = (b - row[1] * w0 - row[2] * w1 - row[3] * w2) / (row[0] + prior[k])
            fall += b * c[k]
    return fall


@njit(cache=True, nogil=True, error_model="numpy")
def _least(normal, mean, prior, black, m, r, c, best):  # type: ignore[no-untyped-def]
    """Fill best (6,) with the least objective with weights >= 0, of eight sets of weights at 0.

    Where `black`, albedos are bounded too, and all 64 sets of albedos and weights at 0 are tried; else they
    may be negative: if none is, it is the least objective with all six >= 0.
    """
    right = np.empty(3)
    for n in range(3):
        right[n] = prior[3 + n] * mean[3 + n]
        for k in range(3):
            right[n] += normal[k, 11 + n]
    largest = -np.inf
    for zero in range(8 if black else 1):
        _reduce(normal, mean, prior, zero, m, r)
        for fixed in range(8):
            w0, w1, w2 = _with_fixed(m, r, prior, fixed)
            if w0 < 0.0 or w1 < 0.0 or w2 < 0.0:
                continue
            fall = _albedos(normal, mean, prior, zero, w0, w1, w2, c)
            if black and (c[0] < 0.0 or c[1] < 0.0 or c[2] < 0.0):
                continue
            fall += right[0] * w0 + right[1] * w1 + right[2] * w2
            if fall > largest:
                largest = fall
                best[:3] = c
                best[3], best[4], best[5] = w0, w1, w2
            if fixed == 0 and not black:
                break  # the unbounded minimum obeys the bounds


@njit(cache=True, nogil=True, error_model="numpy")
def solve_bounded(normal, mean, prior, estimate):  # type: ignore[no-untyped-def]
    """Fill estimate (N, 6), the least objective with all six >= 0; return how often 64 sets were needed.

    `normal` is (N, 3, 14); `mean` and `prior` (6,) are the prior's means and precisions, > 0 for the weights.
    """
    m, r, c, best = np.empty(6), np.empty(3), np.empty(3), np.empty(6)
    black = 0
    for i in range(len(normal)):
        best[:] = np.nan  # what overflows stays visible
        _least(normal[i], mean, prior, False, m, r, c, best)
        if best[0] < 0.0 or best[1] < 0.0 or best[2] < 0.0:
            _least(normal[i], mean, prior, True, m, r, c, best)
            black += 1
        estimate[i] = best
    return black


@njit(cache=True, nogil=True, error_model="numpy")
def solve_free(normal, mean, prior, center, deviation):  # type: ignore[no-untyped-def]
    """Fill center and deviation (N, 6): mean and standard deviations of the posterior without bounds."""
    m, r, c = np.empty(6), np.empty(3), np.empty(3)
    inverse = np.empty((3, 3))
    for i in range(len(normal)):
        _reduce(normal[i], mean, prior, 0, m, r)
        l1, l2, l3, d0, d1, d2 = _factor(m[0], m[1], m[2], m[3], m[4], m[5], prior[3], prior[4], prior[5])
        w0, w1, w2 = _backward(l1, l2, l3, d0, d1, d2, r[0], r[1], r[2])
        for n in range(3):
            e0, e1, e2 = 1.0 if n == 0 else 0.0, 1.0 if n == 1 else 0.0, 1.0 if n == 2 else 0.0
            inverse[n, 0], inverse[n, 1], inverse[n, 2] = _backward(l1, l2, l3, d0, d1, d2, e0, e1, e2)
        _albedos(normal[i], mean, prior, 0, w0, w1, w2, c)
        center[i, :3] = c
        center[i, 3], center[i, 4], center[i, 5] = w0, w1, w2
        for k in range(3):
            row, spread = normal[i, k], 0.0
            for n in range(3):
                for q in range(3):
                    spread += row[1 + n] * inverse[n, q] * row[1 + q]
            a = row[0] + prior[k]
            deviation[i, k] = np.sqrt(1.0 / a + max(spread, 0.0) / (a * a))
            deviation[i, 3 + k] = np.sqrt(max(inverse[k, k], 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def reweigh(  # type: ignore[no-untyped-def]
    observed, precision, lobes, bounce, estimate, mean, prior, rows, power, width, scale, weight, loss, misfit
):
    """Fill the robust weights of the vertices `rows` (N,), with the residuals of their `estimate` (V, 6).

    The m channels of a pair share a shadow, so they share a weight: with q the mean of their p r^2 and t =
    `width` times the vertex's scale, the pair costs m f(q), f' = 1/2 weight, weight 1 / (1 + q / t^2)^power:
    `power` is 1 (Cauchy), 1/2 (Charbonnier) or 0 (squares). The scale, 1 where residuals are as sigma
    predicts, never grows from call to call, so that the loss never does.

    Filled: `weight` (J, V); `scale` and `loss` (V,), half the robust squares plus the prior's part; `misfit`
    (V, 2), the weighted sum of p r^2 and the sum of the weights of these observations.
    """
    count = observed.shape[0]
    square, size = np.empty((len(rows), count)), np.empty((len(rows), count))
    for j in range(count):
        for i in range(len(rows)):
            v = rows[i]
            direct, total, channels = lobes[j, v, 0], 0.0, 0
            gloss = lobes[j, v, 1] * estimate[v, 3] + lobes[j, v, 2] * estimate[v, 4]
            gloss += lobes[j, v, 3] * estimate[v, 5]
            for k in range(3):
                p = precision[j, v, k]
                if p > 0.0:
                    diffuse = direct + bounce[j, v, k] if len(bounce) else direct
                    residual = observed[j, v, k] - diffuse * estimate[v, k] - gloss
                    total += p * residual * residual
                    channels += 1
            square[i, j] = total / channels if channels else -1.0
            size[i, j] = channels
    for i in range(len(rows)):
        v = rows[i]
        if power > 0:
            seen = square[i][square[i] >= 0.0]
            if len(seen):
                scale[v] = min(scale[v], max(1.0, np.sqrt(np.median(seen)) / UNIT_MEDIAN))
        threshold = (width * scale[v]) ** 2
        total, squares, weights = 0.0, 0.0, 0.0
        for n in range(6):
            total += 0.5 * prior[n] * (estimate[v, n] - mean[n]) ** 2
        for j in range(count):
            q = square[i, j]
            if q < 0.0:
                continue
            t = q / threshold
            if power == 1:
                u, cost = 1.0 / (1.0 + t), 0.5 * threshold * np.log1p(t)
            elif power > 0:
                u = 1.0 / np.sqrt(1.0 + t)
                cost = threshold * t * u / (1.0 + u)
            else:
                u, cost = 1.0, 0.5 * q
            weight[j, v] = u
            total += size[i, j] * cost
            squares += u * size[i, j] * q
            weights += u * size[i, j]
        loss[v] = total
        misfit[v, 0], misfit[v, 1] = squares, weights
