"""Which of a scan's eyes are found, left out as holes or shut, and how far irises are from where they are.

`scans` of ../shared/data: james and fran show their eyes, the heads and most of the path-traced people have
holes between open lids, and james with lids painted over (../shared/repro/shut_eyes.py) is shut. Log odds are
of eyes that are shown, and of holes, against shut lids, the lower of both eyes. `painted` are synthetic
people with painted eyes: how far irises are from their true places, mm. `--pictures` gets each face relit.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from worlds.files import DATA

import scan2albedo as s2a
from bench.runner import Bench, Case
from scan2albedo.applications import ProcessedFace, load_result, relight
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.synthetic import face as synthetic_face
from scan2albedo.synthetic.textures import landmark_uv
from scan2albedo.unlit.eyes import LID_LANDMARKS
from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth

SHUT_EYES = DATA.parent / "repro" / "shut_eyes.py"
SHUT = (("8", ".3", "5"), ("4", ".3", "3"), ("0", "1", "4"))
"""Arguments of `SHUT_EYES`."""
LAMP = s2a.PointLight(azimuth_rad=0.5, elevation_rad=0.4, intensity=3.0, radius_deg=4.0)

Scene = tuple[ProcessedFace, Any]
"""A face, and what its eyes are, or the true middles of its irises (2, 2), x and y in mm."""


def scanned(file: Path, kind: str) -> Scene:
    return load_result(s2a.process(file, quality="draft")), kind


def shut(arguments: tuple[str, ...]) -> Scene:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "shut.ply"
        command = [sys.executable, str(SHUT_EYES), str(file), *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return scanned(file, "shut")


def scans(quick: bool) -> Iterator[Case]:
    for name in ("james", "fran"):
        yield Case(name, partial(scanned, DATA / f"{name}.obj", "shown"), "shown")
    files = [*sorted((DATA / "heads").glob("*.obj")), *sorted((DATA / "real_skin").glob("*.obj"))]
    for file in files[: 1 if quick else None]:
        yield Case(file.stem, partial(scanned, file, "holes"), "holes")
    for number, arguments in enumerate(SHUT[: 1 if quick else None]):
        yield Case(f"shut {number}", partial(shut, arguments), "shut")


def painted(seed: int) -> Scene:
    made = synthetic_face(seed, size=512, bits=None)
    model = s2a.AnnotatedFaceModel.default()
    uv = landmark_uv(model)
    middles = []
    for side in ("right", "left"):
        corners = uv[LID_LANDMARKS[side]]
        middles.append(corners.mean(0) + [0, 0.04 * np.linalg.norm(corners[3] - corners[0])])
    points = bilinear(made.image.position, pixels_from_uv(np.concatenate([uv, middles]), made.image.shape))
    face = ProcessedFace.of(f"person{seed}", made.image, made.albedo_linear, model_name=model.name)
    return replace(face, landmarks=points[:68]), points[68:, :2]


def as_expected(scene: Scene, inside: Any) -> dict[str, float | str]:
    found = "shut" if not inside.eyes else "shown" if inside.eyes[0].painted else "holes"
    shown, holes = inside.log_odds.min(0)
    return {"right %": 100.0 * (found == scene[1]), "shown": shown, "holes": holes, "found": found}


def off_irises(scene: Scene, inside: Any) -> dict[str, float]:
    off = [
        np.linalg.norm((eye.center_mm + eye.radius_mm * eye.gaze)[:2] - place)
        for eye, place in zip(inside.eyes, scene[1], strict=True)
    ]
    return {"right mm": float(off[0]), "left mm": float(off[1])}


def relit(scene: Scene, answers: Mapping[str, Any]) -> NDArray[np.uint8]:
    return relight(scene[0], [LAMP], ambient=0.3).picture(shape=(700, 700)).srgb()


OURS = {"scan2albedo": lambda scene: eyes_and_mouth(scene[0])}
BENCHES = {
    "scans": Bench(scans, OURS, as_expected, picture=relit),
    "painted": Bench(
        lambda quick: (Case(f"person {k}", partial(painted, k)) for k in range(2 if quick else 20)),
        OURS,
        off_irises,
        summaries=("median", "worst"),
    ),
}
