"""Compiled bounded least squares of many vertices, six unknowns each: R, G, B and three lobe weights.

For channel k of pair j, with precision p_jk = 1 / sigma_jk^2 and robust weight u_j, the row D_j e_k + S_j of
albedos and weights shall be y_jk. The 6 x 6 normal equations of these rows have blocks

    sum u p D^2 (diagonal),   sum u p S D,   sum u p S S^T,   and the right side   sum u p D y,   sum u p S y,

to which a Gaussian prior N(m, diag(q)^-1) adds diag(q) and q m.

Normals may be a little off: two tilts t beside the six unknowns. With unit tangents e_1, e_2 the true normal
is (n + t_1 e_1 + t_2 e_2) / |.|, so that

    n.l -> n.l (1 + t.p) / z,   n.h -> n.h (1 + t.q) / z,   z = sqrt(1 + t.t),

with the slopes p_i = e_i.l / n.l and q_i = e_i.h / n.h of `lobe_slopes`. Lobes turn by these factors and
their powers, so the turned ones need no geometry, whatever the lobes are in units of.
"""

import numpy as np

from scan2albedo.core.compiled import compiled

UNIT_MEDIAN = 0.888
"""Median of the root mean square of three standard normal numbers."""


@compiled(error_model="numpy")
def add_normal_equations(observed, precision, lobes, bounce, weight, rows, normal):  # type: ignore[no-untyped-def]
    """Fill normal (N, 6, 7), lower triangles and right sides of the equations of the vertices `rows` (N,).

    `observed`, `precision` (0 without observation) and robust `weight` are (J, V, 3), (J, V, 3) and (J, V);
    `lobes` is (J, V, 4), and `bounce` (J, V, 3), or empty, is added to D.
    """
    normal[:] = 0.0
    for j in range(observed.shape[0]):
        for i in range(len(rows)):
            v = rows[i]
            one = normal[i]
            precisions = 0.0
            products = 0.0
            for k in range(3):
                p = weight[j, v] * precision[j, v, k]
                if p == 0.0:
                    continue
                diffuse = lobes[j, v, 0] + bounce[j, v, k] if len(bounce) else lobes[j, v, 0]
                t, y = p * diffuse, p * observed[j, v, k]
                one[k, k] += t * diffuse
                one[k, 6] += y * diffuse
                for n in range(3):
                    one[3 + n, k] += t * lobes[j, v, 1 + n]
                precisions += p
                products += y
            if precisions == 0.0:
                continue
            for n in range(3):
                t = precisions * lobes[j, v, 1 + n]
                for q in range(n + 1):
                    one[3 + n, 3 + q] += t * lobes[j, v, 1 + q]
                one[3 + n, 6] += products * lobes[j, v, 1 + n]


@compiled(error_model="numpy")
def _add_prior(normal, mean, prior, matrix, right):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of matrix, of 6 or more, and the right side from equations (6, 7) and prior."""
    for n in range(6):
        for k in range(n + 1):
            matrix[n, k] = normal[n, k]
        matrix[n, n] += prior[n]
        right[n] = normal[n, 6] + prior[n] * mean[n]


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def solve_bounded(normal, mean, prior, estimate):  # type: ignore[no-untyped-def]
    """Fill estimate (N, 6), the least objective with all six >= 0.

    The first unknown that is below 0, or held at 0 where the objective falls, changes sides until none is,
    which ends for every positive matrix (Murty, Mathematical Programming 7, 1974).
    `normal` is (N, 6, 7); `mean` and `prior` (6,) are the prior's means and precisions, > 0 for the weights.
    """
    matrix, factor = np.empty((6, 6)), np.empty((6, 6))
    right, found, held = np.empty(6), np.empty(6), np.empty(6, np.bool_)
    for i in range(len(normal)):
        _add_prior(normal[i], mean, prior, matrix, right)
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
                if (held[n] and slope > 64 * np.finfo(np.float64).eps * rounding) or found[n] < 0.0:
                    wrong = n
                    break
            if wrong < 0:
                break
            held[wrong] = not held[wrong]
        estimate[i] = np.maximum(found, 0.0)  # what overflows stays visible


@compiled(error_model="numpy")
def solve_free(normal, mean, prior, center, deviation):  # type: ignore[no-untyped-def]
    """Fill center and deviation (N, 6): mean and standard deviations of the posterior without bounds."""
    matrix, factor, right, held = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.zeros(6, np.bool_)
    for i in range(len(normal)):
        _add_prior(normal[i], mean, prior, matrix, right)
        _factorize(matrix, held, prior, factor)
        _solve(factor, held, right, center[i])
        _fill_variances(factor, right, deviation[i])
        deviation[i] = np.sqrt(deviation[i])


@compiled(error_model="numpy")
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
            direct = lobes[j, v, 0]
            total = 0.0
            channels = 0
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
        total = 0.0
        squares = 0.0
        weights = 0.0
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
                u = 1.0
                cost = 0.5 * q
            weight[j, v] = u
            total += size[i, j] * cost
            squares += u * size[i, j] * q
            weights += u * size[i, j]
        loss[v] = total
        misfit[v, 0], misfit[v, 1] = squares, weights


@compiled(error_model="numpy")
def add_tilt_equations(  # type: ignore[no-untyped-def]
    observed, precision, lobes, bounce, slopes, weight, estimate, tilt, rows, equations
):
    """Fill equations (N, 2, 9), rows of a further step of the tilts, from turned lobes (J, V, 4) and bounce.

    With g the derivative of a channel's prediction by the tilts: sum u p D g of each albedo, sum u p S g of
    each weight, sum u p g g^T (its lower triangle), and, of the residuals r, the right side sum u p g r.
    """
    equations[:] = 0.0
    for j in range(observed.shape[0]):
        for i in range(len(rows)):
            v = rows[i]
            t0, t1, u = tilt[v, 0], tilt[v, 1], weight[j, v]
            diffuse = lobes[j, v, 0]
            inverse = 1.0 / (1.0 + t0 * t0 + t1 * t1)
            near = max(1.0 + t0 * slopes[j, v, 0] + t1 * slopes[j, v, 1], 1e-9)
            half = max(1.0 + t0 * slopes[j, v, 2] + t1 * slopes[j, v, 3], 1e-9)
            d0 = diffuse * (slopes[j, v, 0] / near - t0 * inverse)
            d1 = diffuse * (slopes[j, v, 1] / near - t1 * inverse)
            w0, w1 = lobes[j, v, 1] * estimate[v, 3], lobes[j, v, 2] * estimate[v, 4]
            w2 = lobes[j, v, 3] * estimate[v, 5]
            gloss, steep = w0 + w1 + w2, w0 + 8.0 * w1 + 64.0 * w2
            h0 = steep * (slopes[j, v, 2] / half - t0 * inverse)
            h1 = steep * (slopes[j, v, 3] / half - t1 * inverse)
            first, second = equations[i, 0], equations[i, 1]
            sum0 = 0.0
            sum1 = 0.0
            for k in range(3):
                p = u * precision[j, v, k]
                if p == 0.0:
                    continue
                c = estimate[v, k]
                received = diffuse + bounce[j, v, k] if len(bounce) else diffuse
                r = observed[j, v, k] - received * c - gloss
                g0, g1 = c * d0 + h0, c * d1 + h1
                a0, a1 = p * g0, p * g1
                first[k] += received * a0
                second[k] += received * a1
                first[6] += a0 * g0
                second[6] += a0 * g1
                second[7] += a1 * g1
                first[8] += a0 * r
                second[8] += a1 * r
                sum0 += a0
                sum1 += a1
            for n in range(3):
                first[3 + n] += lobes[j, v, 1 + n] * sum0
                second[3 + n] += lobes[j, v, 1 + n] * sum1


@compiled(error_model="numpy")
def _add_priors(normal, equations, prior, tilt_prior, matrix, right, least):  # type: ignore[no-untyped-def]
    """Fill the lower triangle of matrix (8, 8) for albedos, weights and tilts, and its least pivots (8,)."""
    _add_prior(normal, prior, prior, matrix, right)
    matrix[6:] = equations[:, :8]
    matrix[6, 6] += tilt_prior
    matrix[7, 7] += tilt_prior
    least[:6], least[6:] = prior, tilt_prior


@compiled(error_model="numpy")
def step_tilts(normal, equations, prior, tilt_prior, damping, rows, estimate, tilt):  # type: ignore[no-untyped-def]
    """Move the tilts (V, 2) of the vertices `rows` (N,), and their `estimate` (V, 6) along.

    The step is that of all unknowns together, albedos and weights at 0 held there, from estimates that are
    best for the tilts as they are. `tilt_prior` is (V,) the precision of each tilt; `damping` (V,) shortens.
    """
    matrix, factor, held = np.empty((8, 8)), np.empty((8, 8)), np.zeros(8, np.bool_)
    right, least, step = np.empty(8), np.empty(8), np.empty(8)
    for i in range(len(rows)):
        v = rows[i]
        _add_priors(normal[i], equations[i], prior, tilt_prior[v], matrix, right, least)
        right[:6] = 0.0
        held[:6] = estimate[v] == 0.0
        for k in range(2):
            matrix[6 + k, 6 + k] *= 1.0 + damping[v]
            right[6 + k] = equations[i, k, 8] - tilt_prior[v] * tilt[v, k]
        _factorize(matrix, held, least, factor)
        _solve(factor, held, right, step)
        estimate[v] = np.maximum(estimate[v] + step[:6], 0.0)
        tilt[v] += step[6:]


@compiled(error_model="numpy")
def deviations_with_tilts(normal, equations, prior, tilt_prior, rows, deviation, tilt_variance):  # type: ignore[no-untyped-def]
    """Fill deviation (N, 6) of albedos and weights without bounds, and tilt_variance (N,), a mean."""
    matrix, factor, held = np.empty((8, 8)), np.empty((8, 8)), np.zeros(8, np.bool_)
    right, least, variance = np.empty(8), np.empty(8), np.empty(8)
    for i in range(len(rows)):
        _add_priors(normal[i], equations[i], prior, tilt_prior[rows[i]], matrix, right, least)
        _factorize(matrix, held, least, factor)
        _fill_variances(factor, right, variance)
        deviation[i], tilt_variance[i] = np.sqrt(variance[:6]), variance[6:].mean()
