"""Build the model of light that comes with the package, of 600 drawn skies, rooms and studios.

    python tools/build_lighting_model.py

Takes a second.
"""

from __future__ import annotations

from benchmarks.everyday_light import generated_lighting

from scan2albedo.io.npz import write_npz
from scan2albedo.reflectance.lighting_model import LIGHTING_FILE


def main() -> None:
    """Write the package's file."""
    model = generated_lighting()
    write_npz(LIGHTING_FILE, {"mean": model.mean, "basis": model.basis}, what="lighting model", compression=9)
    print(f"{LIGHTING_FILE}: {LIGHTING_FILE.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
