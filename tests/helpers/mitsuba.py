"""Tests that trace paths."""

import os

import pytest

needs_mitsuba = pytest.mark.skipif(
    "DRJIT_LIBLLVM_PATH" not in os.environ, reason="DRJIT_LIBLLVM_PATH names no libLLVM for Mitsuba"
)
