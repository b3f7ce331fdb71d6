"""The command line in this process: starting Python takes longer than most errors."""

from typer.testing import CliRunner

from scan2albedo.cli import app


def invoke(*arguments):
    """Run `scan2albedo` with arguments of any type; returns Typer's `Result`."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])
