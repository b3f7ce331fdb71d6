"""Swap the skins of two faces, and blend them in steps.

    python examples/swap_and_blend.py [A B] [-o OUT] [--size 192]

A and B are folders of scans that were processed with one model and size. Without them two synthetic faces
stand in, with their true albedos instead of estimated ones, which saves the processing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import ProcessedFace

LIGHT = s2a.PointLight(np.deg2rad(35), np.deg2rad(25), intensity=3.0, radius_deg=4.0)


def synthetic_face(seed: int, size: int) -> ProcessedFace:
    """Return a synthetic person as if their scan had been processed without error."""
    scene = s2a.synthetic.face(seed, size=size)
    return ProcessedFace.of(f"person-{seed}", scene.image, scene.albedo_linear, model_name="default")


def portrait(face: ProcessedFace, size: int) -> np.ndarray:
    """Return (size, size, 3) sRGB bytes of a face under one lamp."""
    return s2a.applications.relight(face, [LIGHT]).picture(shape=(size, size)).srgb()


def main(arguments: Sequence[str] | None = None) -> None:
    """Write swaps.png, blends.png and the folder middle/ of the face halfway."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", nargs="*", metavar="RESULT")
    parser.add_argument("-o", "--out", type=Path, default=Path("example_out"))
    parser.add_argument("--size", type=int, default=192)
    given = parser.parse_args(arguments)
    if len(given.results) not in (0, 2):
        parser.error("give two results, or none")
    given.out.mkdir(parents=True, exist_ok=True)

    applications = s2a.applications
    if given.results:
        a, b = (applications.load_result(result) for result in given.results)
    else:
        a, b = synthetic_face(0, given.size), synthetic_face(1, given.size)

    swapped = [a, b, applications.swap_texture(a, b), applications.swap_texture(b, a)]
    blended = [applications.blend_faces(a, b, weight) for weight in (0.0, 0.25, 0.5, 0.75, 1.0)]
    for name, faces in (("swaps", swapped), ("blends", blended)):
        row = np.hstack([portrait(face, given.size) for face in faces])
        Image.fromarray(row).save(given.out / f"{name}.png")
    # What is written can be loaded again, relit and blended further.
    applications.write_face(blended[2], given.out / "middle", application="blend", inputs=(a, b))
    print(f"{a.name} and {b.name}: swaps.png, blends.png and middle/ in {given.out}")


if __name__ == "__main__":
    main()
