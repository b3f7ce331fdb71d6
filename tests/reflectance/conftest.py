"""The lighting model that the fits to photographs share."""

import pytest

from scan2albedo.reflectance.lighting_model import LightingModel


@pytest.fixture(scope="session")
def lighting():
    return LightingModel.default()
