"""Path-trace geometry images and raw scans of synthetic people, with known albedo, under real-room light.

    python tools/worlds OUT [--set images|scans] [--small] [--only NAME ...] [--threads 1]
    python tools/worlds OUT --heads FOLDER [...]

`images` writes OUT/geometry_PERSON.npz and OUT/soft_LIGHT_PERSON.npz, `scans` OUT/pNNN_*.obj with .mtl, .png,
_albedo.png and _truth.npz; both by default. `--heads` makes two scans each of four people instead, in other
light and expression, whose faces have the colours of every fourth scan in FOLDER: evenly lit heads, such as
../shared/data/heads. Shapes and albedo are the package's otherwise; light, gloss, shadows and
interreflection are Mitsuba's (variant `llvm_ad_rgb`; DRJIT_LIBLLVM_PATH names a libLLVM, 19 works). What
exists is not made again. `--small` halves resolution and quarters the paths, to try the tool.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from worlds.lamps import rigs
from worlds.traced_charts import PEOPLE, ChartSet
from worlds.traced_scans import build_scan, pairs, recipes


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="a folder outside the repository")
    parser.add_argument("--set", choices=("images", "scans"), help="both when omitted")
    parser.add_argument("--heads", type=Path, help="folder with scans of evenly lit heads")
    parser.add_argument("--small", action="store_true", help="half the resolution, a quarter of the paths")
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    out, small, threads = arguments.out, arguments.small, arguments.threads
    out.mkdir(parents=True, exist_ok=True)

    def is_wanted(file: Path) -> bool:
        return not file.exists() and (not arguments.only or file.stem in arguments.only)

    if arguments.set != "scans" and not arguments.heads:
        for person in PEOPLE:
            files = {rig: out / f"soft_{rig.name}_{person.name}.npz" for rig in rigs()}
            wanted = [rig for rig, file in files.items() if is_wanted(file)]
            if wanted:
                images = ChartSet(
                    person, size=128 if small else 256, paths=64 if small else 256, threads=threads
                )
                images.write_geometry(out)
            for rig in wanted:
                images.write(rig, out)
                print(files[rig].stem, flush=True)
    if arguments.set != "images" or arguments.heads:
        for recipe in pairs(arguments.heads) if arguments.heads else recipes():
            if is_wanted(out / f"{recipe.name}.obj"):
                size, paths = (320, 64) if small else (640, 128)
                build_scan(recipe, out, size=size, paths=paths, threads=threads)
                print(recipe.name, flush=True)


if __name__ == "__main__":
    main()
