"""Runs and files of the `reflectance` commands."""
