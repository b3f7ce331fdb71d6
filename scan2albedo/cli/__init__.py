"""The command line: thin wrappers around the library's calls."""

from scan2albedo.cli.commands import app, main

__all__ = ["app", "main"]
