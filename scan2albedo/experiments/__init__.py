"""Experiments of the paper, reproducible by one call."""
