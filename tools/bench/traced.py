"""Albedo on scenes whose albedo is known, beside simple peers: people's skin before painted heads.

`skin` are raw scans with photographed skin, path-traced; `flashes` photographs of people under single flashes
(Extended Yale B); `scans` and `images` what `python tools/worlds` makes of painted heads. They lie in
../shared/data, or all in the folder that S2A_TRACED names. Errors are in percent, after the best single
scale, on V = max(R, G, B):

- relative RMSE; what half of the texels and 95 in 100 err by at most, each of its own albedo; relative RMSE
  of colour; 100 x MSE of V, the paper's figure;
- parts of the texels that err by less than `expected_error`, and than twice that; lamps found of all lamps.

Texels that got less than 3 % of the median light do not count; under single flashes those count that the
flash explains to a quarter. Peers divide by ambient occlusion, by nine harmonics (SH), and by the same with
the face's own shadows.
"""

import os
import tempfile
import time
from collections.abc import Iterator
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from worlds.files import DATA

import scan2albedo as s2a
from bench.judging import (
    PATTERNS,
    VARIABLE,
    Received,
    ScanTruth,
    TracedImage,
    calibration,
    judged_scan,
    load_flashes,
    load_image,
    received,
    scene_names,
    score,
    simple_peers,
)
from bench.runner import Bench, Case, Timed
from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.core.arrays import BoolArray, FloatArray

FOLDERS = {"skin": "real_skin", "flashes": "yale", "scans": "traced", "images": "traced"}
"""Where each kind of scene lies in ../shared/data."""


class Scene:
    """A geometry image with its true albedo (H, W, 3) where `judged`, and the number of its lamps."""

    def __init__(
        self, image: s2a.GeometryImage, albedo_linear: FloatArray, judged: BoolArray, lamps: int
    ) -> None:
        self.image = image
        self.albedo_linear = albedo_linear
        self.judged = judged
        self.lamps = lamps
        self.estimate: Timed | None = None
        self.note = ""

    @cached_property
    def light(self) -> Received:
        """What texels receive of light from everywhere."""
        return received(self.image)

    @cached_property
    def peers(self) -> dict[str, FloatArray]:
        """Albedos of the simple peers."""
        return simple_peers(self.image, self.light)


def folder_of(kind: str) -> Path:
    named = os.environ.get(VARIABLE)
    folder = Path(named) if named else DATA / FOLDERS[kind]
    if not scene_names(folder, kind):
        raise FileNotFoundError(f"{folder} holds no scenes {PATTERNS[kind]}")
    return folder


def of_image(scene: TracedImage) -> Scene:
    return Scene(scene.image, scene.albedo_linear, scene.judged, len(scene.lamps))


def of_scan(folder: Path, name: str) -> Scene:
    truth = ScanTruth.read(folder, name)
    with tempfile.TemporaryDirectory() as out:
        start = time.process_time()
        result = s2a.process(folder / f"{name}.obj", out, seed=0)
        cpu_s = time.process_time() - start
    judged = judged_scan(result, truth)
    scene = Scene(result.geometry_image, judged.albedo_linear, judged.judged, truth.lamps)
    scene.estimate = Timed(result.albedo, cpu_s)
    scene.note = f"surface {judged.surface_mm:.2f} mm"
    return scene


@cache
def flashes_of(folder: Path, name: str) -> dict[str, Scene]:
    """Return the photographs of a person, which have one shape, by name."""
    scenes = {scene.name: of_image(scene) for scene in load_flashes(folder, name)}
    first = next(iter(scenes.values()))
    for scene in scenes.values():
        scene.light = first.light
    return scenes


def cases(kind: str, quick: bool) -> Iterator[Case]:
    folder = folder_of(kind)
    for name in scene_names(folder, kind)[: 1 if quick else None]:
        if kind == "images":
            yield Case(name, lambda name=name: of_image(load_image(folder, name)))
        elif kind == "flashes":
            with np.load(folder / f"{name}.npz") as stored:
                lights = stored["lights"].tolist()
            for light in lights[: 1 if quick else None]:
                own = f"{name}_{light}"
                yield Case(own, lambda name=name, own=own: flashes_of(folder, name)[own], name)
        else:
            yield Case(name, lambda name=name: of_scan(folder, name))


def ours(scene: Scene) -> AlbedoEstimate | Timed:
    return scene.estimate or s2a.estimate_albedo(scene.image, seed=0)


def simple_peer(name: str, scene: Scene) -> Timed:
    # They are made together: what each costs is not known.
    return Timed(scene.peers[name], np.nan)


def figures(scene: Scene, answer: AlbedoEstimate | FloatArray) -> dict[str, float | str]:
    estimate = answer if isinstance(answer, AlbedoEstimate) else None
    albedo = np.asarray(answer if estimate is None else estimate.albedo_linear, np.float64)
    errors = score(albedo, scene.albedo_linear, scene.judged)
    row: dict[str, float | str] = {
        "RMSE %": errors.rmse,
        "50 %": errors.half,
        "95 %": errors.most,
        "colour %": errors.color_rmse,
        "MSE": errors.mse,
    }
    if estimate is None:
        return row
    said, twice = calibration(
        albedo.max(2), scene.albedo_linear.max(2), estimate.expected_error, scene.judged
    )
    lamps = f"{len(estimate.lights)} of {scene.lamps}"
    return row | {
        "as said": said,
        "twice": twice,
        "lamps": f"{lamps} {scene.note}",
    }


BENCHES = {
    kind: Bench(
        partial(cases, kind),
        methods={"ours": ours},
        peers={name: partial(simple_peer, name) for name in ("as is", "AO", "SH", "SH+shadows")},
        score=figures,
        summaries=("least", "mean", "worst"),
    )
    for kind in PATTERNS
}
