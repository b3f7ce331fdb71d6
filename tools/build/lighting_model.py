"""Build the model of light that comes with the package, of 600 drawn skies, rooms and studios."""

from worlds.environments import generated_lighting

from build import output
from scan2albedo.io.npz import write_npz


def main(arguments: list[str]) -> None:
    """Write the package's file."""
    model, file = generated_lighting(), output(arguments, "reflectance/data/everyday_light.npz")
    write_npz(file, {"mean": model.mean, "basis": model.basis}, what="lighting model", compression=9)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")
