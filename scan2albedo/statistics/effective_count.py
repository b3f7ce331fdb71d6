"""How many independent observations correlated ones on a surface are worth."""

import math


def effective_count(area_mm2: float, length_mm: float) -> float:
    """Return how many independent observations an area is worth, however finely it is sampled.

    It is A / (2 pi l^2). Errors whose correlation over the distance d is exp(-d / l) have 2 pi l^2 as the
    integral of that over the plane [1]_: a mean over a much larger area A has the variance of one over so
    many independent errors.

    Parameters
    ----------
    area_mm2 : float
        That is observed. The count is less than 1 where the area is smaller than 2 pi l^2: the share of one
        observation.
    length_mm : float
        The correlation length l.

    .. [1] N. Cressie, "Statistics for spatial data", 1993, section 1.3.

    >>> round(effective_count(38_500, 3.4))
    530
    """
    return area_mm2 / (2 * math.pi * length_mm**2)
