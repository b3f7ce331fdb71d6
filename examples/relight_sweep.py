"""Show a face under new light: a portrait, light from all around, and a lamp that moves (GIF and frames).

    python examples/relight_sweep.py [RESULT] [-o OUT] [--frames 12] [--size 192]

RESULT is the folder of a processed scan. Without it a synthetic face stands in, with its true albedo instead
of an estimated one, which saves the processing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import scan2albedo as s2a
from scan2albedo.applications import ProcessedFace


def synthetic_face(size: int) -> ProcessedFace:
    """Return a synthetic person as if their scan had been processed without error."""
    scene = s2a.synthetic.face(0, size=size)
    return ProcessedFace.of("synthetic", scene.image, scene.albedo_linear, model_name="default")


def evening_sky() -> np.ndarray:
    """Return a latitude-longitude map (16, 32, 3), linear: warm low sun to one side, blue above."""
    sky = np.full((16, 32, 3), 0.05)
    sky[:8] += (0.15, 0.25, 0.5)
    sky[7, 22:24] += (30.0, 18.0, 8.0)
    return sky


def main(arguments: Sequence[str] | None = None) -> None:
    """Write portrait.png, sky.png, sweep.gif and frames/."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("result", nargs="?")
    parser.add_argument("-o", "--out", type=Path, default=Path("example_out"))
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--size", type=int, default=192)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    shape = (given.size, given.size)

    applications = s2a.applications
    face = synthetic_face(given.size) if given.result is None else applications.load_result(given.result)

    key = s2a.PointLight(np.deg2rad(40), np.deg2rad(25), intensity=3.0, radius_deg=4.0)
    fill = s2a.PointLight(-1.0, 0.0, radius_deg=4.0)
    portrait = applications.relight(face, [key, fill])
    camera = applications.default_camera(face, shape, azimuth_rad=np.deg2rad(25))
    Image.fromarray(portrait.picture(camera, shape=shape).srgb()).save(given.out / "portrait.png")

    under_sky = applications.relight(face, environment_linear=evening_sky())
    Image.fromarray(under_sky.picture(shape=shape).srgb()).save(given.out / "sky.png")

    places = applications.light_arc(given.frames)
    frames = applications.frames_srgb(list(applications.sweep(face, places, shape=shape)))
    applications.write_gif(given.out / "sweep.gif", frames)
    applications.write_frames(given.out / "frames", frames)
    print(f"{face.name}: portrait.png, sky.png, sweep.gif and frames/ in {given.out}")


if __name__ == "__main__":
    main()
