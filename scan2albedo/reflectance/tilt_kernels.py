"""Compiled least squares of vertices whose normals are a little off: two tilts beside the six unknowns.

With unit tangents e_1, e_2 the true normal is (n + t_1 e_1 + t_2 e_2) / |.|, so that

    n.l -> n.l (1 + t.p) / z,   n.h -> n.h (1 + t.q) / z,   z = sqrt(1 + t.t),

with the slopes p_i = e_i.l / n.l and q_i = e_i.h / n.h of `lobe_slopes`. Lobes turn by these factors and
their powers, so the turned ones need no geometry, whatever the lobes are in units of.
"""

import numpy as np
from numba import njit


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
