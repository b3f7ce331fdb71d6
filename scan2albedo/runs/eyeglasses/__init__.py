"""Runs and files of the `glasses` commands."""
