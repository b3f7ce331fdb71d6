import numpy as np
import pytest
from scipy.spatial.distance import cdist

from scan2albedo.statistics.effective_count import effective_count


def test_a_mean_over_an_area_varies_as_that_of_so_many_independent_errors():
    """Of errors whose correlation falls to 1/e in a 40th of the area's side; its border counts a little."""
    places = np.indices((40, 40)).reshape(2, -1).T
    variance = np.exp(-cdist(places, places)).mean()
    assert variance == pytest.approx(1 / effective_count(40**2, 1.0), rel=0.1)


def test_the_count_goes_with_the_area_and_falls_with_the_square_of_the_length():
    assert effective_count(2.0, 3.0) == pytest.approx(2 * effective_count(1.0, 3.0))
    assert effective_count(1.0, 6.0) == pytest.approx(effective_count(1.0, 3.0) / 4)
