"""Shared fixtures: the real scans (beside the repository, optional), the default model, a face-like mask."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel

# Tests share the cores already: no test has kernels compiled beside it but those that ask for it.
os.environ.setdefault("SCAN2ALBEDO_COMPILE", "serial")
DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real scans; the test is skipped, visibly, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"real scans are not here: {DATA.name} beside the repository is absent")
    return DATA


@pytest.fixture(scope="session")
def model() -> AnnotatedFaceModel:
    """The default model."""
    return AnnotatedFaceModel.default()


@pytest.fixture(scope="session")
def face_like_mask():
    """A disc (128, 128) with a hole."""
    rows, columns = np.mgrid[:128, :128] - 63.5
    return (np.hypot(rows, columns) < 58) & (np.hypot(rows + 20, columns - 15) > 6)


@pytest.fixture
def no_endless_reading():
    """Fails a test that waits for a pipe or reads a device for more than 60 seconds."""

    def too_long(signum, frame):
        raise TimeoutError("it reads without end")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
