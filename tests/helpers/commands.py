"""What a command of the command line ended with."""

import json


def succeeded(result):
    """Return Typer's result of a command that has to end well."""
    assert result.exit_code == 0, result.output
    return result


def refusal(result):
    """Return the one line that a command which has to end with 2 writes about its error."""
    assert result.exit_code == 2, result.output
    (line,) = (line for line in result.stderr.splitlines() if "error:" in line)
    return line


def printed(result):
    """Return what a command that has to end well prints as JSON."""
    return json.loads(succeeded(result).stdout)
