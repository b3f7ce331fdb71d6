"""What several tests of noise and division look at."""

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def lit(rng):
    """Texture, and light that falls from 5 to 1 down the image."""
    albedo = 0.5 + 0.05 * rng.standard_normal((200, 200))
    return albedo, np.linspace(5, 1, 200)[:, None] * np.ones(200)
