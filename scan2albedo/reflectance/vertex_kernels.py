"""Compiled bounded least squares of many vertices, six unknowns each: R, G, B and three lobe weights.

For channel k with precisions p_jk = 1 / sigma_jk^2 and robust weights u_j,

    a_k = sum u p D^2,  d_k = sum u p D S,  G_k = sum u p S S^T,  b_k = sum u p D y,  g_k = sum u p S y

over the pairs j. With a Gaussian prior N(m, diag(q)^-1) the diffuse albedos are c_k = (b_k - d_k.w) / a_k,
and the rest is 3 x 3, M w = r with M = sum_k (G_k - d_k d_k^T / a_k) + diag(q_w): G_k alone where c_k is 0.

Normals may be a little off: two tilts t beside the six unknowns. With unit tangents e_1, e_2 the true normal
is (n + t_1 e_1 + t_2 e_2) / |.|, so that

    n.l -> n.l (1 + t.p) / z,   n.h -> n.h (1 + t.q) / z,   z = sqrt(1 + t.t),

with the slopes p_i = e_i.l / n.l and q_i = e_i.h / n.h of `lobe_slopes`. Lobes turn by these factors and
their powers, so the turned ones need no geometry, whatever the lobes are in units of.
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


@njit(cache=True, nogil=True, error_model="numpy")
def add_tilt_equations(  # type: ignore[no-untyped-def]
    observed, precision, lobes, bounce, slopes, weight, estimate, tilt, rows, equations
):
    """Fill equations (N, 17) of a further step of the tilts, from turned lobes (J, V, 4) and bounced light.

    With g the derivative of a channel's prediction by the tilts: sum u p g g^T (3: 11 12 22), sum u p g r (2)
    of the residuals r, sum u p D g (3 x 2) of each albedo, sum u p S g (3 x 2) of each weight.
    """
    equations[:] = 0.0
    for j in range(observed.shape[0]):
        for i in range(len(rows)):
            v = rows[i]
            t0, t1, u = tilt[v, 0], tilt[v, 1], weight[j, v]
            diffuse, s0, s1, s2 = lobes[j, v, 0], lobes[j, v, 1], lobes[j, v, 2], lobes[j, v, 3]
            inverse = 1.0 / (1.0 + t0 * t0 + t1 * t1)
            near = max(1.0 + t0 * slopes[j, v, 0] + t1 * slopes[j, v, 1], 1e-9)
            half = max(1.0 + t0 * slopes[j, v, 2] + t1 * slopes[j, v, 3], 1e-9)
            d0 = diffuse * (slopes[j, v, 0] / near - t0 * inverse)
            d1 = diffuse * (slopes[j, v, 1] / near - t1 * inverse)
            w0, w1, w2 = s0 * estimate[v, 3], s1 * estimate[v, 4], s2 * estimate[v, 5]
            gloss, steep = w0 + w1 + w2, w0 + 8.0 * w1 + 64.0 * w2
            h0 = steep * (slopes[j, v, 2] / half - t0 * inverse)
            h1 = steep * (slopes[j, v, 3] / half - t1 * inverse)
            row = equations[i]
            sum0, sum1 = 0.0, 0.0
            for k in range(3):
                p = u * precision[j, v, k]
                if p == 0.0:
                    continue
                c = estimate[v, k]
                lit = diffuse + bounce[j, v, k] if len(bounce) else diffuse
                r = observed[j, v, k] - lit * c - gloss
                g0, g1 = c * d0 + h0, c * d1 + h1
                a0, a1 = p * g0, p * g1
                row[0] += a0 * g0
                row[1] += a0 * g1
                row[2] += a1 * g1
                row[3] += a0 * r
                row[4] += a1 * r
                row[5 + 2 * k] += lit * a0
                row[6 + 2 * k] += lit * a1
                sum0 += a0
                sum1 += a1
            row[11] += s0 * sum0
            row[12] += s0 * sum1
            row[13] += s1 * sum0
            row[14] += s1 * sum1
            row[15] += s2 * sum0
            row[16] += s2 * sum1


@njit(cache=True, nogil=True, error_model="numpy")
def _cholesky(m, count):  # type: ignore[no-untyped-def]
    """Replace the lower triangle of m (count, count) by its factor; False where it is not positive."""
    for n in range(count):
        for k in range(n + 1):
            total = m[n, k]
            for q in range(k):
                total -= m[n, q] * m[k, q]
            if n == k:
                if not total > 0.0:
                    return False
                m[n, n] = np.sqrt(total)
            else:
                m[n, k] = total / m[k, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_matrix(normal, equations, prior, tilt_prior, matrix):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of matrix (8, 8) for albedos, weights and tilts, with their priors."""
    matrix[:] = 0.0
    for k in range(3):
        row = normal[k]
        matrix[k, k] = row[0] + prior[k]
        for n in range(3):
            matrix[3 + n, k] = row[1 + n]
        matrix[3, 3] += row[4]
        matrix[4, 3] += row[5]
        matrix[5, 3] += row[6]
        matrix[4, 4] += row[7]
        matrix[5, 4] += row[8]
        matrix[5, 5] += row[9]
    for n in range(3, 6):
        matrix[n, n] += prior[n]
    for n in range(6):
        matrix[6, n], matrix[7, n] = equations[5 + 2 * n], equations[6 + 2 * n]
    matrix[6, 6] = equations[0] + tilt_prior
    matrix[7, 6] = equations[1]
    matrix[7, 7] = equations[2] + tilt_prior


@njit(cache=True, nogil=True, error_model="numpy")
def step_tilts(normal, equations, prior, tilt_prior, damping, rows, estimate, tilt):  # type: ignore[no-untyped-def]
    """Move the tilts (V, 2) of the vertices `rows` (N,), and their `estimate` (V, 6) along.

    The step is that of all unknowns together, albedos and weights at 0 held there, from estimates that are
    best for the tilts as they are. `tilt_prior` is (V,) the precision of each tilt; `damping` (V,) shortens.
    """
    matrix, right = np.empty((8, 8)), np.empty(8)
    for i in range(len(rows)):
        v = rows[i]
        _fill_matrix(normal[i], equations[i], prior, tilt_prior[v], matrix)
        matrix[6, 6] *= 1.0 + damping[v]
        matrix[7, 7] *= 1.0 + damping[v]
        for n in range(6):
            if estimate[v, n] == 0.0:
                matrix[n, :] = 0.0
                matrix[:, n] = 0.0
                matrix[n, n] = 1.0
        right[:6] = 0.0
        right[6] = equations[i, 3] - tilt_prior[v] * tilt[v, 0]
        right[7] = equations[i, 4] - tilt_prior[v] * tilt[v, 1]
        if not _cholesky(matrix, 8):
            continue
        for n in range(8):
            for k in range(n):
                right[n] -= matrix[n, k] * right[k]
            right[n] /= matrix[n, n]
        for n in range(7, -1, -1):
            for k in range(n + 1, 8):
                right[n] -= matrix[k, n] * right[k]
            right[n] /= matrix[n, n]
        for n in range(6):
            if estimate[v, n] > 0.0:
                estimate[v, n] = max(estimate[v, n] + right[n], 0.0)
        tilt[v, 0] += right[6]
        tilt[v, 1] += right[7]


@njit(cache=True, nogil=True, error_model="numpy")
def deviations_with_tilts(normal, equations, prior, tilt_prior, rows, deviation, tilt_variance):  # type: ignore[no-untyped-def]
    """Fill deviation (N, 6) of albedos and weights without bounds, and tilt_variance (N,), mean of the two.

    Nothing is filled where the equations are not positive by rounding.
    """
    matrix, column = np.empty((8, 8)), np.empty(8)
    for i in range(len(rows)):
        _fill_matrix(normal[i], equations[i], prior, tilt_prior[rows[i]], matrix)
        if not _cholesky(matrix, 8):
            continue
        tilt_variance[i] = 0.0
        for n in range(8):  # the inverse's diagonal: squares of the columns of the factor's inverse
            total = 0.0
            for k in range(n, 8):
                column[k] = 1.0 if k == n else 0.0
                for q in range(n, k):
                    column[k] -= matrix[k, q] * column[q]
                column[k] /= matrix[k, k]
                total += column[k] * column[k]
            if n < 6:
                deviation[i, n] = np.sqrt(total)
            else:
                tilt_variance[i] += 0.5 * total
