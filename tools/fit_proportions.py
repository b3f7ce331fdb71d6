"""Learn which proportions people's faces have (`scan2albedo.registration.acceptance`).

    python tools/fit_proportions.py ../shared/data -o scan2albedo/registration/data/proportions.npz

Sixteen VALID heads and five light-stage people (NOTICE; these with twelve expressions too) are registered;
the pose of 164 synthetic people is known. A head counts as much as another, whatever its expressions, and the
synthetic people together as much as the heads. The deviation is from the mean without the head (with all its
expressions). Printed are the greatest distances, and how many heads are told, each judged by all others, when
they are stretched along an axis or scaled.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
from benchmarks.landmark_cases import LightStage, expressions_of_light_stage
from benchmarks.raw_like import raw_like
from scipy import stats

import scan2albedo as s2a
from scan2albedo.core import Meter, RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rigid import Similarity, transform_points
from scan2albedo.io.npz import write_npz
from scan2albedo.registration.acceptance import CONTRASTS, NAMES
from scan2albedo.registration.icp import shaped_icp, stretch
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.scan_preparation import prepared_scan
from scan2albedo.registration.template import Template
from scan2albedo.synthetic.face_shape import EXPRESSION_BUMPS, person

SYNTHETIC, SYNTHETIC_SHARE = 164, 1 / 2
RARE = 0.001
"""Part of people of whom one of the three proportions is told, and of whom the size is."""
PUPILS_SD, ALIKE = 3.83 / 63.4, 0.45
"""Of the distance of adults' pupils, relative (N. A. Dodgson, "Variation and extrema of human interpupillary
distance", SPIE 5291, 2004), and how lengths of a face along three axes correlate: size is their mean."""
FACTORS = (1.25, 0.8, 1.5, 1 / 1.5)


@dataclass(frozen=True)
class Face:
    """Of whom a scan in the frame of the model is, and its width, height and depth by `stretch` (3,)."""

    name: str
    scan: RawScan

    def measured(self, factors: FloatArray) -> FloatArray:
        """Return `NAMES` (4,) of the scan, stretched by factors (3,)."""
        scan = RawScan(self.scan.vertices * factors, self.scan.faces)
        prepared = prepared_scan(scan, RegistrationOptions())
        template = Template.of(s2a.AnnotatedFaceModel.default(), 0)
        pose = prepared.prepared_from_scan
        start = Similarity(pose[:3, :3], pose[:3, 3])
        shaped = shaped_icp(prepared.samples, template, start, Meter("icp", "mm"))
        return np.asarray(CONTRASTS @ stretch(prepared.samples, template, shaped))


def scans(folder: Path) -> Iterator[tuple[str, RawScan]]:
    """Yield the name of a head, and a scan of it."""
    for file in sorted((folder / "heads").glob("*.obj")):
        yield file.stem, s2a.load_scan(file)
    stage = LightStage.load()
    for number, (name, shape) in enumerate(stage.shapes.items()):
        yield name, raw_like(shape, stage.faces, number)[0]
    pairs = zip(expressions_of_light_stage().values(), cycle(stage.shapes), strict=False)
    for number, (moved, name) in enumerate(pairs):
        yield name, raw_like(stage.shapes[name] + moved, stage.faces, 50 + number)[0]


def heads(folder: Path) -> Iterator[Face]:
    """Yield the heads of a folder, upright."""
    model = s2a.AnnotatedFaceModel.default()
    for name, scan in scans(folder):
        pose = s2a.register(scan, model, seed=0).model_from_scan
        yield Face(name, RawScan(transform_points(pose, scan.vertices), scan.faces))


def synthetic() -> Iterator[Face]:
    """Yield synthetic people with all expressions."""
    model, kinds = s2a.AnnotatedFaceModel.default(), sorted(EXPRESSION_BUMPS)
    for seed in range(SYNTHETIC):
        shape = person(model, np.random.default_rng([seed, 42]), expression=kinds[seed % len(kinds)])
        yield Face(f"{seed}", RawScan(model.subdivision(2).matrix @ shape, model.subdivision(2).faces))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="with heads/ and ict_faces.npz")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    faces, others = list(heads(arguments.folder)), list(synthetic())
    names = np.array([face.name for face in faces])
    values = np.array([face.measured(np.ones(3)) for face in [*faces, *others]])
    _, place, count = np.unique(names, return_inverse=True, return_counts=True)
    share = np.concatenate([1 / count[place], np.ones(len(others))])
    share[: len(faces)] *= (1 - SYNTHETIC_SHARE) / len(count)
    share[len(faces) :] *= SYNTHETIC_SHARE / len(others)
    mean, off = share @ values, values - share @ values
    for name in set(names):
        rest = share * np.append(names != name, np.ones(len(others)))
        out = np.flatnonzero(names == name)
        off[out] = values[out] - rest @ values / rest.sum()
    deviation = np.sqrt(share @ off**2)
    deviation[3] = PUPILS_SD * np.sqrt((1 + 2 * ALIKE) / 3)
    # Student's predictive distribution of one person more, of as many as the shares are worth.
    worth = 1 / ((1 - SYNTHETIC_SHARE) ** 2 / len(count) + SYNTHETIC_SHARE**2 / len(others))
    limit = np.full(4, stats.t.isf(RARE / 6, worth - 1) * np.sqrt(1 + 1 / worth))
    limit[3] = stats.norm.isf(RARE / 2)
    print(f"{NAMES}: mean {mean.round(3)}, deviation {deviation.round(3)}, limit {limit.round(2)}")
    for label, rows in (("heads left out", off[: len(faces)]), ("synthetic people", off[len(faces) :])):
        print(f"greatest distance, {label}: {np.abs(rows / deviation).max(0).round(2)}")
    for axis, label in enumerate(("width", "height", "depth", "size")):
        for factor in FACTORS:
            factors = np.where((np.arange(3) == axis) | (axis == 3), factor, 1.0)
            change = np.array([face.measured(factors) for face in faces[: len(count)]]) - values[: len(count)]
            told = (np.abs(off[: len(count)] + change) > limit * deviation).any(1)
            print(f"{label} x {factor:.2f}: {told.mean():.0%} told", flush=True)
    if arguments.output is not None:
        learned = {"mean": mean, "deviation": deviation, "reach": limit * deviation}
        counts = {"heads": np.array(len(count)), "synthetic": np.array(len(others))}
        write_npz(arguments.output, learned | counts, what="people's proportion")


if __name__ == "__main__":
    main()
