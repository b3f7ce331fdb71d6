"""Which of a scan's eyes are found, left out as holes or shut, and how far irises are from where they are.

    python tools/bench_eyes.py [--pictures FOLDER]

The scans of ../shared/data: james and fran show their eyes, the heads and most of the path-traced people have
holes between open lids, and james with lids painted over (../shared/repro/shut_eyes.py) is shut. Printed are
log odds of eyes that are shown, and of holes, against shut lids, of the right and the left eye. Synthetic
people with painted eyes: how far irises are from their true places, mm. `--pictures` gets each face relit.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import scan2albedo as s2a
from scan2albedo.applications import ProcessedFace, load_result, relight
from scan2albedo.applications.eyes import LID_LANDMARKS
from scan2albedo.applications.eyes_and_mouth import eyes_and_mouth
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.io.images import write_png
from scan2albedo.synthetic import face as synthetic_face
from scan2albedo.synthetic.textures import landmark_uv

SHARED = Path(__file__).resolve().parents[2] / "shared"
SHUT = (("8", ".3", "5"), ("4", ".3", "3"), ("0", "1", "4"))
LAMP = s2a.PointLight(azimuth_rad=0.5, elevation_rad=0.4, intensity=3.0, radius_deg=4.0)


def scans(folder: Path) -> list[tuple[str, Path]]:
    """Return files with what their eyes are; those with painted lids are made in `folder`."""
    data = SHARED / "data"
    found = [("shown", data / f"{name}.obj") for name in ("james", "fran")]
    found += [("holes", file) for file in sorted((data / "heads").glob("*.obj"))]
    found += [("holes", file) for file in sorted((data / "real_skin").glob("*.obj"))]
    for number, given in enumerate(SHUT):
        file = folder / f"shut_{number}.ply"
        made = [sys.executable, str(SHARED / "repro/shut_eyes.py"), str(file), *given]
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
        found.append(("shut", file))
    return found


def painted(seed: int) -> tuple[ProcessedFace, np.ndarray]:
    """Return a synthetic person, and the true middles of the irises (2, 2), x and y in mm."""
    made, model = synthetic_face(seed, size=512, bits=None), s2a.AnnotatedFaceModel.default()
    uv, middles = landmark_uv(model), []
    for corners in (uv[LID_LANDMARKS[side]] for side in ("right", "left")):
        middles.append(corners.mean(0) + [0, 0.04 * np.linalg.norm(corners[3] - corners[0])])
    places = pixels_from_uv(np.concatenate([uv, middles]), made.image.shape)
    points = bilinear(made.image.position, places)
    face = ProcessedFace.of(f"person{seed}", made.image, made.albedo_linear, model_name=model.name)
    return replace(face, landmarks=points[:68]), points[68:, :2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", type=Path, default=None)
    arguments = parser.parse_args()
    print(f"{'scan':16}{'eyes':7}{'found':8}{'shown':>12}{'holes':>12}{'CPU s':>7}")
    with tempfile.TemporaryDirectory() as folder:
        for kind, file in scans(Path(folder)):
            face = load_result(s2a.process(file, quality="draft"))
            begin = time.process_time()
            inside = eyes_and_mouth(face)
            spent = time.process_time() - begin
            found = "shut" if not inside.eyes else "shown" if inside.eyes[0].painted else "holes"
            shown, holes = (f"{right:.0f} {left:.0f}" for right, left in inside.log_odds.T)
            print(f"{file.stem:16}{kind:7}{found:8}{shown:>12}{holes:>12}{spent:7.2f}", flush=True)
            if arguments.pictures is not None:
                arguments.pictures.mkdir(parents=True, exist_ok=True)
                made = relight(face, [LAMP], ambient=0.3).picture(shape=(700, 700)).srgb()
                write_png(arguments.pictures / f"{file.stem}.png", made)
    off = []
    for seed in range(20):
        face, truth = painted(seed)
        eyes = eyes_and_mouth(face).eyes
        off += [
            float(np.linalg.norm((eye.center_mm + eye.radius_mm * eye.gaze)[:2] - place))
            for eye, place in zip(eyes, truth, strict=True)
        ]
    print(f"irises of 20 synthetic people: {np.median(off):.2f} mm off, at most {max(off):.2f}")


if __name__ == "__main__":
    main()
