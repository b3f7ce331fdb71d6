"""Commands for glasses run in this process, which keeps its own way to end."""

import pytest

from scan2albedo.cli import common


# Not for the package: a folder without __init__.py is none to pytest, and the patch would stay to the end.
@pytest.fixture(scope="module", autouse=True)
def own_signals():
    """Signals stay those of pytest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(common, "stop_cleanly_on_interrupt", lambda out: None)
        yield
