"""Error of one albedo from 1, 2, 4 and 8 photographs of a face, each under its own unknown flash.

Six people under single flashes (../shared/data/yale); the truth is photometric stereo over sixty flashes. The
error is 100 MSE / mean^2 on the texels that each photograph's flash reaches, mean over photographs, of the
common albedo, and of each photograph's own, found together with the others'. "stated" is the median stated
error, "holds" the share of texels that err by less.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from worlds.files import DATA
from worlds.model_faces import scaled_error

from bench.judging import flash_photograph
from bench.runner import Bench, Case
from scan2albedo import GeometryImage
from scan2albedo.albedo import estimate_common_albedo
from scan2albedo.albedo.common_albedo import CommonAlbedo
from scan2albedo.core.arrays import BoolArray, FloatArray

FOLDER = DATA / "yale"
COUNTS = (1, 2, 4, 8)
DRAWS = 2


@dataclass(frozen=True)
class Photographs:
    """Some photographs of a person, the true albedo (H, W), and the texels (H, W) that each flash reaches."""

    images: list[GeometryImage]
    truth: FloatArray
    lit: list[BoolArray]


def photographs(person: dict[str, np.ndarray], chosen: np.ndarray) -> Photographs:
    images, lit = zip(*(flash_photograph(person, k) for k in chosen), strict=True)
    return Photographs(list(images), person["albedo"].astype(float), list(lit))


def drawn(file: Path, count: int, draw: int) -> Photographs:
    with np.load(file) as stored:
        person = dict(stored)
    random = np.random.default_rng(count)
    for _ in range(draw + 1):
        chosen = random.choice(len(person["lights"]), count, replace=False)
    return photographs(person, chosen)


def cases(quick: bool) -> Iterator[Case]:
    files = sorted(FOLDER.glob("*.npz"))
    if not files:
        raise FileNotFoundError(FOLDER)
    for count in COUNTS[:2] if quick else COUNTS:
        for file in files[: 1 if quick else None]:
            for draw in range(1 if quick else DRAWS):
                yield Case(
                    f"{file.stem}, {count}, draw {draw}",
                    partial(drawn, file, count, draw),
                    f"{count} photographs",
                )


def error(albedo: FloatArray, truth: FloatArray) -> float:
    """Return 100 MSE / mean square, best scale removed."""
    return 100 * scaled_error(albedo, truth) ** 2


def figures(scene: Photographs, found: CommonAlbedo) -> dict[str, float]:
    common = found.albedo_linear.max(-1).astype(float)
    own = [one.albedo_linear.max(-1).astype(float) for one in found.estimates]
    stated = [found.expected_error[on] for on in scene.lit]
    holds = []
    for on, said in zip(scene.lit, stated, strict=True):
        scale = np.median(scene.truth[on]) / np.median(common[on])
        holds.append(100 * np.mean(np.abs(scale * common[on] / scene.truth[on] - 1) < said))
    return {
        "common %": float(np.mean([error(common[on], scene.truth[on]) for on in scene.lit])),
        "own %": float(
            np.mean([error(one[on], scene.truth[on]) for one, on in zip(own, scene.lit, strict=True)])
        ),
        "stated %": float(100 * np.median(np.concatenate(stated))),
        "holds %": float(np.mean(holds)),
    }


BENCH = Bench(
    cases, methods={"scan2albedo": lambda scene: estimate_common_albedo(scene.images)}, score=figures
)
