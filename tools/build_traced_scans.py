"""Path-trace geometry images and raw scans of synthetic people, with known albedo, under real-room light.

    python tools/build_traced_scans.py OUT [--set images|scans] [--small] [--only NAME ...] [--threads 1]
    python tools/build_traced_scans.py OUT --heads FOLDER [...]

`images` writes OUT/geometry_PERSON.npz and OUT/soft_LIGHT_PERSON.npz, `scans` OUT/pNNN_*.obj with .mtl, .png,
_albedo.png and _truth.npz; both by default. `--heads` makes two scans each of four people instead, in other
light and expression, whose faces have the colours of every fourth scan in FOLDER: evenly lit heads, such as
../shared/data/heads. Shapes and albedo are the package's otherwise; light, gloss, shadows and
interreflection are Mitsuba's (variant `llvm_ad_rgb`; DRJIT_LIBLLVM_PATH names a libLLVM, 19 works). What
exists is not made again. `--small` halves resolution and quarters the paths, to try the tool.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.traced_images import ImageSet
from benchmarks.traced_lights import rigs
from benchmarks.traced_people import Person
from benchmarks.traced_scans import build_scan, pairs, recipes

IMAGE_SIZE, IMAGE_PATHS = 256, 256
PICTURE_SIZE, SCAN_PATHS = 640, 128
PEOPLE = (
    Person(name="anna", seed=3, tone=0.12, fringe=0.9, gloss="skin"),
    Person(name="ben", seed=8, tone=0.9, stubble=0.9, mouth_deg=13.0, gloss="oily"),
)


def build_images(folder: Path, only: list[str], *, small: bool, threads: int) -> None:
    """Write every light on every person that is not there yet."""
    size, paths = (IMAGE_SIZE // 2, IMAGE_PATHS // 4) if small else (IMAGE_SIZE, IMAGE_PATHS)
    for person in PEOPLE:
        names = {rig: f"soft_{rig.name}_{person.name}" for rig in rigs()}
        wanted = [rig for rig, name in names.items() if is_wanted(folder / f"{name}.npz", only)]
        if not wanted:
            continue
        images = ImageSet(person, size=size, paths=paths, threads=threads)
        images.write_geometry(folder)
        for rig in wanted:
            with timed(names[rig]):
                images.write(rig, folder)


def build_scans(
    folder: Path, only: list[str], *, small: bool, threads: int, heads: Path | None = None
) -> None:
    """Write every raw scan that is not there yet."""
    size, paths = (PICTURE_SIZE // 2, SCAN_PATHS // 2) if small else (PICTURE_SIZE, SCAN_PATHS)
    for recipe in pairs(heads) if heads else recipes():
        if is_wanted(folder / f"{recipe.name}.obj", only):
            with timed(recipe.name):
                build_scan(recipe, folder, size=size, paths=paths, threads=threads)


def is_wanted(file: Path, only: list[str]) -> bool:
    """Return whether a file is missing, and named by `only` if that names any."""
    return not file.exists() and (not only or file.stem in only)


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Say how long the work took."""
    wall, cpu = time.perf_counter(), time.process_time()
    yield
    print(f"{name}: {time.perf_counter() - wall:.0f} s, {time.process_time() - cpu:.0f} s CPU", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="a folder outside the repository")
    parser.add_argument("--set", choices=("images", "scans"), help="both when omitted")
    parser.add_argument("--heads", type=Path, help="folder with scans of evenly lit heads")
    parser.add_argument("--small", action="store_true", help="half the resolution, a quarter of the paths")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.heads is not None:
        common = {"small": arguments.small, "threads": arguments.threads}
        build_scans(arguments.out, arguments.only, heads=arguments.heads, **common)
        return
    for name, build in (("images", build_images), ("scans", build_scans)):
        if arguments.set in (None, name):
            build(arguments.out, arguments.only, small=arguments.small, threads=arguments.threads)


if __name__ == "__main__":
    main()
