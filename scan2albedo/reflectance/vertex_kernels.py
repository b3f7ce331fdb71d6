"""Compiled bounded least squares of many vertices, six unknowns each: R, G, B and three lobe weights.

For channel k with precisions p_jk = 1 / sigma_jk^2 and robust weights u_j,

    a_k = sum u p D^2,  d_k = sum u p D S,  G_k = sum u p S S^T,  b_k = sum u p D y,  g_k = sum u p S y

over the pairs j. They and a Gaussian prior N(m, diag(q)^-1) make one 6 x 6 system of albedos and weights.

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


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_matrix(normal, mean, prior, matrix, right):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of matrix, of 6 or more, and the right side for albedos and weights."""
    matrix[:6, :6] = 0.0
    for n in range(6):
        matrix[n, n], right[n] = prior[n], prior[n] * mean[n]
    for k in range(3):
        row = normal[k]
        matrix[k, k] += row[0]
        right[k] += row[10]
        for n in range(3):
            matrix[3 + n, k] = row[1 + n]
            right[3 + n] += row[11 + n]
        matrix[3, 3] += row[4]
        matrix[4, 3] += row[5]
        matrix[5, 3] += row[6]
        matrix[4, 4] += row[7]
        matrix[5, 4] += row[8]
        matrix[5, 5] += row[9]


@njit(cache=True, nogil=True, error_model="numpy")
def _factorize(matrix, held, least, factor):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of factor L, L L^T = matrix, unknowns that are `held` at 0 left out.

    A matrix is no less than its prior, so no pivot is less than the prior's: `least`.
    """
    for n in range(len(matrix)):
        for k in range(n + 1):
            if held[n] or held[k]:
                factor[n, k] = 1.0 if n == k else 0.0
                continue
            total = matrix[n, k]
            for q in range(k):
                total -= factor[n, q] * factor[k, q]
            factor[n, k] = np.sqrt(max(total, least[n])) if n == k else total / factor[k, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(factor, held, right, solution):  # type: ignore[no-untyped-def]
    """Fill the solution of L L^T x = right, 0 for what is `held` there."""
    size = len(right)
    for n in range(size):
        total = 0.0 if held[n] else right[n]
        for k in range(n):
            total -= factor[n, k] * solution[k]
        solution[n] = total / factor[n, n]
    for n in range(size - 1, -1, -1):
        for k in range(n + 1, size):
            solution[n] -= factor[k, n] * solution[k]
        solution[n] /= factor[n, n]


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_variances(factor, column, variance):  # type: ignore[no-untyped-def]
    """Fill the diagonal of (L L^T)^-1: squares of the factor's inverse, each `column` of it in turn."""
    for n in range(len(variance)):
        variance[n] = 0.0
        for k in range(n, len(variance)):
            column[k] = 1.0 if k == n else 0.0
            for q in range(n, k):
                column[k] -= factor[k, q] * column[q]
            column[k] /= factor[k, k]
            variance[n] += column[k] * column[k]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_bounded(normal, mean, prior, estimate):  # type: ignore[no-untyped-def]
    """Fill estimate (N, 6), the least objective with all six >= 0.

    The first unknown that is below 0, or held at 0 where the objective falls, changes sides until none is,
    which ends for every positive matrix (Murty, Mathematical Programming 7, 1974).
    `normal` is (N, 3, 14); `mean` and `prior` (6,) are the prior's means and precisions, > 0 for the weights.
    """
    matrix, factor = np.empty((6, 6)), np.empty((6, 6))
    right, found, held = np.empty(6), np.empty(6), np.empty(6, np.bool_)
    for i in range(len(normal)):
        _fill_matrix(normal[i], mean, prior, matrix, right)
        held[:] = False
        for _ in range(64):
            _factorize(matrix, held, prior, factor)
            _solve(factor, held, right, found)
            wrong = -1
            for n in range(6):
                slope, rounding = right[n], abs(right[n])
                if held[n]:
                    for k in range(6):
                        term = matrix[max(n, k), min(n, k)] * found[k]
                        slope, rounding = slope - term, rounding + abs(term)
                if (held[n] and slope > 4 * np.finfo(np.float64).eps * rounding) or found[n] < 0.0:
                    wrong = n
                    break
            if wrong < 0:
                break
            held[wrong] = not held[wrong]
        estimate[i] = np.maximum(found, 0.0)  # what overflows stays visible


@njit(cache=True, nogil=True, error_model="numpy")
def solve_free(normal, mean, prior, center, deviation):  # type: ignore[no-untyped-def]
    """Fill center and deviation (N, 6): mean and standard deviations of the posterior without bounds."""
    matrix, factor, right, held = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.zeros(6, np.bool_)
    for i in range(len(normal)):
        _fill_matrix(normal[i], mean, prior, matrix, right)
        _factorize(matrix, held, prior, factor)
        _solve(factor, held, right, center[i])
        _fill_variances(factor, right, deviation[i])
        deviation[i] = np.sqrt(deviation[i])


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
def _fill_matrix_with_tilts(normal, equations, prior, tilt_prior, matrix, right, least):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of matrix (8, 8) for albedos, weights and tilts, and its least pivots (8,)."""
    _fill_matrix(normal, prior, prior, matrix, right)
    for n in range(6):
        matrix[6, n], matrix[7, n] = equations[5 + 2 * n], equations[6 + 2 * n]
    matrix[6, 6], matrix[7, 6] = equations[0] + tilt_prior, equations[1]
    matrix[7, 7] = equations[2] + tilt_prior
    least[:6], least[6:] = prior, tilt_prior


@njit(cache=True, nogil=True, error_model="numpy")
def step_tilts(normal, equations, prior, tilt_prior, damping, rows, estimate, tilt):  # type: ignore[no-untyped-def]
    """Move the tilts (V, 2) of the vertices `rows` (N,), and their `estimate` (V, 6) along.

    The step is that of all unknowns together, albedos and weights at 0 held there, from estimates that are
    best for the tilts as they are. `tilt_prior` is (V,) the precision of each tilt; `damping` (V,) shortens.
    """
    matrix, factor, held = np.empty((8, 8)), np.empty((8, 8)), np.zeros(8, np.bool_)
    right, least, step = np.empty(8), np.empty(8), np.empty(8)
    for i in range(len(rows)):
        v = rows[i]
        _fill_matrix_with_tilts(normal[i], equations[i], prior, tilt_prior[v], matrix, right, least)
        right[:6], held[:6] = 0.0, estimate[v] == 0.0
        for k in range(2):
            matrix[6 + k, 6 + k] *= 1.0 + damping[v]
            right[6 + k] = equations[i, 3 + k] - tilt_prior[v] * tilt[v, k]
        _factorize(matrix, held, least, factor)
        _solve(factor, held, right, step)
        estimate[v] = np.maximum(estimate[v] + step[:6], 0.0)
        tilt[v] += step[6:]


@njit(cache=True, nogil=True, error_model="numpy")
def deviations_with_tilts(normal, equations, prior, tilt_prior, rows, deviation, tilt_variance):  # type: ignore[no-untyped-def]
    """Fill deviation (N, 6) of albedos and weights without bounds, and tilt_variance (N,), a mean."""
    matrix, factor, held = np.empty((8, 8)), np.empty((8, 8)), np.zeros(8, np.bool_)
    right, least, variance = np.empty(8), np.empty(8), np.empty(8)
    for i in range(len(rows)):
        _fill_matrix_with_tilts(normal[i], equations[i], prior, tilt_prior[rows[i]], matrix, right, least)
        _factorize(matrix, held, least, factor)
        _fill_variances(factor, right, variance)
        deviation[i], tilt_variance[i] = np.sqrt(variance[:6]), variance[6:].mean()
