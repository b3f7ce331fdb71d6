"""Makers of the files that ship with the package; `python tools/build` lists them."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from worlds.files import DATA
from worlds.fits import fitted_face

import scan2albedo as s2a
from scan2albedo.fitting import FittedFace

PACKAGE = Path(__file__).resolve().parents[2] / "scan2albedo"


def output(arguments: list[str], shipped: str) -> Path:
    """Return the file to write: that of -o, else the one that ships with the package."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path, default=PACKAGE / shipped)
    return parser.parse_args(arguments).output


def fitted_heads() -> Iterator[tuple[str, s2a.RawScan, FittedFace]]:
    """Yield the name of each head of ../shared/data/heads, its scan and the model fitted to it."""
    for path in sorted((DATA / "heads").glob("*.obj")):
        scan = s2a.load_scan(path)
        yield path.stem, scan, fitted_face(scan)
        print(path.stem, flush=True)
