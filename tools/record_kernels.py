"""Record the kernels that a run calls, for helpers to compile beside a first run.

    python tools/record_kernels.py

Processes the built-in synthetic scan with all kernels compiled anew, and writes `first_run_kernels.txt` in
`scan2albedo/core`. To be run when a kernel, or the types it is called with, changed; a slow test tells.
"""

import json
import os
import pickle
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from scan2albedo.core import first_run
from scan2albedo.synthetic.raw_scan import raw_scan

TARGET = Path(first_run.__file__).with_name(first_run.RECORD)
PROCESS = """
import json
import pickle
import sys
from pathlib import Path

from numba.core import event

depth, lines = 0, []


class Calls(event.Listener):
    def on_start(self, compiled):
        global depth
        function = compiled.data["dispatcher"].py_func
        if depth == 0:
            lines.append((function.__module__, function.__qualname__, repr(compiled.data["args"])))
        depth += 1

    def on_end(self, compiled):
        global depth
        depth -= 1


import scan2albedo as s2a

event.register("numba:compile", Calls())
s2a.process(pickle.loads(Path(sys.argv[1]).read_bytes()))
print(json.dumps(lines))
"""


def recorded() -> list[str]:
    """Return the lines of the record: what is compiled for a call from Python, by its first call."""
    with tempfile.TemporaryDirectory() as cache:
        # Made here, so that none of the kernels that make it counts as known in the process that records.
        scan = Path(cache) / "scan"
        scan.write_bytes(pickle.dumps(raw_scan(0)[0]))
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache, first_run.SWITCH: "serial"}
        done = subprocess.run(
            [sys.executable, "-c", PROCESS, scan], env=environment, stdout=subprocess.PIPE, check=True
        )
    # Numba prints its truth values as Python's `bool`, which it does not read.
    calls = [(m, f, re.sub(r"\bbool\b", "boolean", types)) for m, f, types in json.loads(done.stdout)]
    return [" ".join(call) for call in calls if call[0].startswith("scan2albedo.")]


def main() -> None:
    lines = recorded()
    TARGET.write_text("".join(f"{line}\n" for line in lines), "utf-8")
    print(f"{len(lines)} kernels -> {TARGET.name}")


if __name__ == "__main__":
    main()
