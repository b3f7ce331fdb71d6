"""Shared fixtures: the real scans (beside the repository, optional), the default model, a face-like mask."""

import os
import pickle
import signal
from pathlib import Path

import numpy as np
import pytest

from scan2albedo import AnnotatedFaceModel
from scan2albedo.synthetic import Scanner, raw_scan

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real scans; the test is skipped, visibly, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"real scans are not here: {DATA.name} beside the repository is absent")
    return DATA


@pytest.fixture(scope="session")
def model():
    """The default model."""
    return AnnotatedFaceModel.default()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Return what a function makes: called once for all workers of a run, and kept in a file."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent

    def made(name, make):
        import fcntl

        with (base / f"{name}.pickle").open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if os.fstat(file.fileno()).st_size == 0:
                file.write(pickle.dumps(make()))
                file.flush()
            file.seek(0)
            return pickle.load(file)

    return made


@pytest.fixture(scope="session")
def coarse_scan(made_once):
    """A synthetic raw scan with its truth, quick to make and to process, of images with 128 texels a side."""
    scanner = Scanner(size=128, picture_size=500, spacing_mm=3.0)
    return made_once("coarse_scan", lambda: raw_scan(0, scanner=scanner))


@pytest.fixture(scope="session")
def fine_scan(made_once):
    """A synthetic raw scan as dense as real ones, with its truth."""
    return made_once("fine_scan", lambda: raw_scan(41))


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
