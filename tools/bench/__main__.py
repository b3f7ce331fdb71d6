"""Run benches: `python tools/bench`, described in `bench.command`."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # Its own folder would hide other modules behind the names of benches.
    sys.path[0] = str(Path(__file__).resolve().parent.parent)
    from bench.command import main

    sys.exit(main())
