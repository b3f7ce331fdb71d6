"""The processed faces of these tests."""

from tests.applications.conftest import *  # noqa: F403
