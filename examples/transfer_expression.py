"""Give one person's smile to another.

    python examples/transfer_expression.py [NEUTRAL_A SMILING_A NEUTRAL_B] [-o OUT] [--size 256]

The three are folders of scans that were processed with one model and size. Without them synthetic faces stand
in, with their true shapes and albedos instead of fitted ones, which saves the processing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import ProcessedFace, TransferOptions

LIGHT = s2a.PointLight(np.deg2rad(35), np.deg2rad(25), intensity=3.0)


def synthetic_face(seed: int, expression: str, size: int) -> ProcessedFace:
    """Return a synthetic person as if their scan had been processed without error."""
    scene = s2a.synthetic.face(seed, expression=expression, size=size)
    name = f"person-{seed}-{expression}"
    return ProcessedFace.of(name, scene.image, scene.albedo_linear, model_name="default")


def main(arguments: Sequence[str] | None = None) -> None:
    """Write expressions.png and smiling.glb."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", nargs="*", metavar="RESULT")
    parser.add_argument("-o", "--out", type=Path, default=Path("example_out"))
    parser.add_argument("--size", type=int, default=256)
    given = parser.parse_args(arguments)
    if len(given.results) not in (0, 3):
        parser.error("give three results, or none")
    given.out.mkdir(parents=True, exist_ok=True)

    applications = s2a.applications
    if given.results:
        neutral_a, smiling_a, neutral_b = (applications.load_result(result) for result in given.results)
    else:
        neutral_a, smiling_a = (
            synthetic_face(0, expression, given.size) for expression in ("neutral", "smile")
        )
        neutral_b = synthetic_face(1, "neutral", given.size)

    smiling_b = applications.transfer_expression(neutral_a, smiling_a, neutral_b)
    broader = applications.transfer_expression(
        neutral_a, smiling_a, neutral_b, options=TransferOptions(strength=1.5)
    )

    shape = (given.size, given.size)
    pictures = [
        applications.relight(face, [LIGHT]).picture(shape=shape).srgb()
        for face in (neutral_a, smiling_a, neutral_b, smiling_b, broader)
    ]
    Image.fromarray(np.hstack(pictures)).save(given.out / "expressions.png")
    applications.relight(smiling_b, [LIGHT]).write_glb(given.out / "smiling.glb")
    moved = np.linalg.norm(smiling_b.image.position - neutral_b.image.position, axis=-1)[smiling_b.mask]
    print(f"{smiling_b.name}: skin moved by up to {moved.max():.1f} mm; expressions.png in {given.out}")


if __name__ == "__main__":
    main()
