"""Width, height, depth and size of a face among people's: what a stretched or wrongly scaled scan changes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from importlib.resources import as_file, files

import numpy as np

from scan2albedo.core import Meter, PlanStep
from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import RegistrationError
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.rigid import Similarity, procrustes
from scan2albedo.io.npz import Arrays, read_npz
from scan2albedo.registration.icp import shaped_icp, stretch
from scan2albedo.registration.template import Template

NAMES = ("width to height", "depth to height", "depth to width", "size")
CONTRASTS = np.array([[1, -1, 0], [0, -1, 1], [-1, 0, 1], [1 / 3, 1 / 3, 1 / 3]])
"""Of the logarithms of width, height and depth: those of `NAMES`."""


@lru_cache(maxsize=1)
def people() -> Arrays:
    """Return what `tools/fit_proportions.py` learned of people's faces.

    Of the logarithms of `NAMES`, relative to the default model, `mean`, standard `deviation` and how far from
    the mean nearly all people `reach` (4,); and of how many `heads` and `synthetic` people.
    """
    with as_file(files("scan2albedo.registration") / "data" / "proportions.npz") as path:
        return read_npz(
            path, what="people's proportions", advice="install the package again", error=RegistrationError
        )


def template_stretch(model: AnnotatedSurface, seed: int) -> FloatArray | None:
    """Return the logarithms (3,) of a model's width, height and depth relative to the default model's.

    None without landmarks, which lay one on the other.
    """
    default = default_model()
    if model is default:
        return np.zeros(3)
    if model.landmarks is None or default.landmarks is None:
        return None
    pose = procrustes(default.landmarks, model.landmarks)
    scan, template = Template.of(model, seed).samples, Template.of(default, seed)
    start = Similarity(pose[:3, :3], pose[:3, 3])
    return stretch(scan, template, shaped_icp(scan, template, start, Meter("icp", "mm")))


def proportion_doubts(found: FloatArray) -> Iterator[PlanStep]:
    """Yield a row where a face's proportions are beyond people's, and one where its size is.

    `found` (3,) are the logarithms of its width, height and depth in mm relative to the default model's.
    """
    learned, words = people(), dict[str, str]()
    sample = f"{learned['heads']} heads and {learned['synthetic']} synthetic people"
    off = CONTRASTS @ found - learned["mean"]
    for name, value, deviation, reach in zip(NAMES, off, learned["deviation"], learned["reach"], strict=True):
        if abs(value) > reach:
            low, ratio, high = np.exp([-reach, value, reach])
            words[name] = (
                f"{name} {ratio:.2f} times the mean of {sample}, {low:.2f} to {high:.2f} expected; it is "
                f"{abs(value) / deviation:.1f} standard deviations from the mean"
            )
    size = words.pop("size", "")
    if words:
        reason = "the scan may be stretched along an axis: its proportions are beyond those of faces measured"
        yield PlanStep.doubt("register.proportions", reason, "; ".join(words.values()))
    if size:
        reason = "the unit or scale of the scan may be wrong: its face has another size than adults'"
        yield PlanStep.doubt("register.size", reason, size)
