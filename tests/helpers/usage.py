"""Wrong uses of the command line, and the command line as a process of its own."""

import subprocess
import sys

COMMAND = (sys.executable, "-m", "scan2albedo")


def usage_error(result):
    """Return what a command that has to end with 2 tells, in one line and without the frame around it."""
    assert result.exit_code == 2, result.output
    return " ".join(result.output.replace("│", " ").split())


def run_process(*arguments, **options):
    """Run `scan2albedo` with arguments of any type in a process of its own; `options` are of `subprocess`."""
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **options)
