"""Shared fixtures: the real scans live beside the repository and are optional."""

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real scans; the test is skipped, visibly, where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"real scans are not here: {DATA.name} beside the repository is absent")
    return DATA
