"""Real spherical harmonics of any order, with gradients, as polynomials without poles; and light in them."""

import numpy as np

from scan2albedo.core.arrays import ArrayLike, FloatArray, GridShape, IntArray, checked_array
from scan2albedo.lighting.environment import checked_map, map_directions

_NODES = 160
"""Least number of quadrature nodes from pole to pole: degree 8 is then integrated to 1e-7."""


def harmonic_degrees(order: int) -> IntArray:
    """Return the degree l of each of the (order + 1)^2 harmonics.

    >>> harmonic_degrees(2).tolist()
    [0, 1, 1, 1, 2, 2, 2, 2, 2]
    """
    return np.sqrt(np.arange(_count(order))).astype(int)


def harmonics(direction: ArrayLike, order: int = 8) -> FloatArray:
    """Return the real harmonics Y_lm of unit vectors (..., 3) up to degree `order`, (..., (order + 1)^2).

    With N_lm the Legendre functions divided by sin^m (polynomials in z), normalised over the sphere,

        Y_lm = N_l|m|(z) * (sqrt(2) Re, 1, sqrt(2) Im) (x + i y)^|m|   for m > 0, = 0, < 0,

    so that nothing is divided by sin and the poles are points like all others. They are orthonormal over the
    sphere. Y_lm stands at l (l + 1) + m; Y_1 = (y, z, x), no Condon-Shortley phase. ValueError for another
    shape, or values that are not finite.

    .. [1] P.-P. Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2(2), 2013.

    >>> harmonics([0.0, 0.0, 1.0], order=2).round(3).tolist()
    [0.282, 0.0, 0.489, 0.0, 0.0, 0.0, 0.631, 0.0, 0.0]
    """
    x, y, z = np.moveaxis(checked_array(direction, (..., 3), "direction", finite=ValueError), -1, 0)
    values = np.empty((_count(order), *x.shape))
    cosine, sine = np.ones_like(x), np.zeros_like(x)
    for m in range(order + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        # With m = 0 both are the same place, and the cosine, which is 1, comes last.
        for degree, legendre in enumerate(_legendre_column(z, m, order), start=m):
            values[degree * (degree + 1) - m] = legendre * sine
            values[degree * (degree + 1) + m] = legendre * cosine
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def harmonics_gradient(direction: ArrayLike, order: int = 8) -> FloatArray:
    """Return the gradients of the harmonics along the sphere, (..., (order + 1)^2, 3).

    Each row is orthogonal to the unit vector n of `direction` (..., 3): Y(n + d) = Y(n) + gradient . d for
    small d along the sphere. ValueError for another shape, or values that are not finite.

    >>> (harmonics_gradient([0.0, 0.0, 1.0], order=1) + 0.0).round(3)[[1, 3]].tolist()
    [[0.0, 0.489, 0.0], [0.489, 0.0, 0.0]]
    """
    x, y, z = np.moveaxis(checked_array(direction, (..., 3), "direction", finite=ValueError), -1, 0)
    gradient = np.zeros((_count(order), 3, *x.shape))
    before, power = (np.zeros_like(x), np.zeros_like(x)), (np.ones_like(x), np.zeros_like(x))
    columns = [_legendre_column(z, m, order) for m in range(order + 2)]
    for m in range(order + 1):
        if m > 0:
            before, power = power, (x * power[0] - y * power[1], x * power[1] + y * power[0])
        # Each is a derivative of a Legendre polynomial by z, the next one that of it.
        for degree in range(m, order + 1):
            legendre, along_z = columns[m][degree - m], np.zeros_like(z)
            if degree > m:
                steep = np.sqrt((degree - m) * (degree + m + 1) / (1 if m else 2))
                along_z = steep * columns[m + 1][degree - m - 1]
            centre = degree * (degree + 1)
            gradient[centre + m] = m * legendre * before[0], -m * legendre * before[1], along_z * power[0]
            if m > 0:
                gradient[centre - m] = m * legendre * before[1], m * legendre * before[0], along_z * power[1]
    radial = gradient[:, 0] * x + gradient[:, 1] * y + gradient[:, 2] * z
    gradient -= radial[:, None] * np.stack([x, y, z])
    return np.ascontiguousarray(np.moveaxis(gradient, (0, 1), (-2, -1)))


def _legendre_column(z: FloatArray, m: int, order: int) -> list[FloatArray]:
    """Return N_mm(z), N_(m+1)m(z), ... N_order,m(z); sqrt(2) of the real pair included for m > 0."""
    steps = np.arange(1, m + 1)
    first = np.sqrt(np.prod((2 * steps + 1) / (2 * steps)) / (4 * np.pi)) * (np.sqrt(2) if m else 1.0)
    column = [np.full_like(z, first)]
    for degree in range(m + 1, order + 1):
        up, last = np.sqrt((4 * degree**2 - 1) / (degree**2 - m**2)), degree - 1
        back = np.sqrt((last**2 - m**2) / (4 * last**2 - 1)) * column[-2] if last > m else 0.0
        column.append(up * (z * column[-1] - back))
    return column


def _count(order: int) -> int:
    if order < 0:
        raise ValueError(f"order must be 0 or more, got {order}")
    return (order + 1) ** 2


def project_environment(environment_linear: ArrayLike, order: int = 8) -> FloatArray:
    """Return the coefficients (..., (order + 1)^2, 3) of environment maps (..., H, W, 3), texels constant.

        L_lm = integral over the sphere of L(d) Y_lm(d).

    The radiance's rows run from +y down to -y, columns by azimuth from -pi to pi, from +z toward +x.
    Coefficients are in the order of `harmonics`; light of 1 gives sqrt(4 pi), 0, 0, ... ValueError when the
    map has another shape, is empty or not finite.

    >>> abs(project_environment(np.ones((2, 4, 3)), order=1)[:, 0]).round(6).tolist()
    [3.544908, 0.0, 0.0, 0.0]
    """
    image = checked_map(environment_linear, several=True)
    shape, coefficients = image.shape[-3:-1], np.zeros((*image.shape[:-3], (order + 1) ** 2, 3))
    for row in range(shape[0]):
        coefficients += row_projection(row, shape, order).T @ image[..., row, :, :]
    return coefficients


def row_projection(row: int, shape: GridShape, order: int = 8) -> FloatArray:
    """Return (W, (order + 1)^2) integrals of the harmonics over the texels of a row of maps (H, W)."""
    height, width = shape
    down, down_weight = _nodes(max(2, -(-_NODES // height)))
    across, across_weight = _nodes(max(2, -(-2 * _NODES // width)))
    polar = (row + down) * np.pi / height
    azimuth = ((np.arange(width)[:, None] + across) / width - 0.5) * 2 * np.pi
    values = harmonics(map_directions(polar[:, None, None], azimuth), order)
    share = down_weight * np.sin(polar) * np.pi / height
    return np.einsum("a,c,awcb->wb", share, across_weight * 2 * np.pi / width, values, optimize=True)


def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights on 0 ... 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2
