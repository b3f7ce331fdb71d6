"""Process a raw scan: pose, shape, geometry image, light and albedo, with all files.

    python examples/process_scan.py [SCAN] [-o OUT] [--size 256]

Without SCAN (an OBJ, PLY, GLB, STL or OFF file), a synthetic person is scanned: noise, holes, hair and
shoulders, in a random pose, photographed under a flash. Takes some ten seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import scan2albedo as s2a


def main(arguments: Sequence[str] | None = None) -> None:
    """Process the scan and tell what came of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scan", nargs="?")
    parser.add_argument("-o", "--out", default="example_out")
    parser.add_argument("--size", type=int, default=256)
    given = parser.parse_args(arguments)

    scan = s2a.synthetic.raw_scan(0)[0] if given.scan is None else s2a.load_scan(given.scan)
    result = s2a.process(scan, out=given.out, size=given.size, seed=0)

    print(result.summary())
    for step in result.plan:
        print(f"  {step.stage:26}{'ran' if step.ran else 'left out':10}{step.reason}")
    nose_tip = result.fitted.landmarks[30]  # iBUG-68 order, mm in the model's frame
    print(f"nose tip at {nose_tip.round(1)} mm, albedo {result.albedo.albedo_linear.shape}")


if __name__ == "__main__":
    main()
