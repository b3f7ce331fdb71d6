"""Which points of (time, error) are worth choosing, and where more time stops to pay."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def pareto_front(cost: ArrayLike, error: ArrayLike) -> NDArray[np.bool_]:
    """Return (N,) True for points to which no other is equal or better in both, and better in one.

    Parameters
    ----------
    cost, error : (N,) array_like of float
        Less is better; points that are not finite are never on the front.

    Notes
    -----
    Of equal points the first is on the front. O(N log N).

    >>> pareto_front([1, 2, 3, 4], [9, 5, 6, 1]).tolist()
    [True, True, False, True]
    """
    spent, wrong = np.asarray(cost, float), np.asarray(error, float)
    if spent.shape != wrong.shape or spent.ndim != 1:
        raise ValueError(f"cost {spent.shape} and error {wrong.shape} must be of one shape (N,)")
    front = np.zeros(len(spent), bool)
    least = np.inf
    for n in np.lexsort((np.arange(len(spent)), wrong, spent)):
        if np.isfinite(spent[n]) and wrong[n] < least:
            front[n], least = True, wrong[n]
    return front


def knee(cost: ArrayLike, error: ArrayLike) -> int | None:
    """Return the index of the knee: the point of the front farthest below its chord in log-log.

    The chord joins the cheapest and the most exact point of the front. Below it a point gains more for its
    time than the whole way does; beyond the farthest one the remaining way gains less than that. Where none
    lies below the chord every factor of time buys as much as the one before, and the knee is the most exact
    point.

    Parameters
    ----------
    cost, error : (N,) array_like of float
        Positive; errors of 0 count as a millionth of the largest.

    Returns
    -------
    int or None
        None without finite points.

    References
    ----------
    .. [1] V. Satopaa, J. Albrecht, D. Irwin, B. Raghavan, "Finding a 'Kneedle' in a Haystack: Detecting Knee
       Points in System Behavior", ICDCS Workshops 2011, section III.

    >>> knee([1, 2, 4, 100], [10, 1, 0.9, 0.8])
    1
    """
    spent, wrong = np.asarray(cost, float), np.asarray(error, float)
    front = np.flatnonzero(pareto_front(spent, wrong))
    if not len(front):
        return None
    order = front[np.argsort(spent[front], kind="stable")]
    x = np.log(np.maximum(spent[order], 1e-9))
    y = np.log(np.maximum(wrong[order], 1e-6 * max(float(wrong[order].max()), 1e-300)))
    if x[-1] == x[0]:
        return int(order[-1])
    below = y[0] + (y[-1] - y[0]) * (x - x[0]) / (x[-1] - x[0]) - y
    best = int(np.argmax(below))
    return int(order[best] if below[best] > 1e-9 else order[-1])
