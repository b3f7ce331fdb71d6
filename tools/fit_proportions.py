"""Learn which proportions people's faces have (`scan2albedo.registration.acceptance`).

    python tools/fit_proportions.py ../shared/data -o scan2albedo/registration/data/proportions.npz

Sixteen VALID heads and five light-stage people (NOTICE; these with twelve expressions too) are registered;
the pose of 164 synthetic people is known. A head counts as much as another, whatever its expressions, and the
synthetic people together as much as the heads. How a stretch moves the shape is measured on the heads; it is
told from how people differ by a linear discriminant, with a covariance mixed with that of the model's modes.
The deviation is that without the head (with all its expressions), or without a tenth of the synthetic people.
Nobody is told for being as flat as a face of East Asia. Printed are the greatest distances, and how many
heads are told, each judged by all others, when they are stretched along an axis or scaled.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from benchmarks.landmark_cases import LightStage, expressions_of_light_stage
from benchmarks.raw_like import raw_like
from scipy import stats

import scan2albedo as s2a
from scan2albedo.core import Meter, RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.variation import EXPRESSION_BUMPS
from scan2albedo.geometry.rigid import Similarity, invert_rigid, transform_points
from scan2albedo.io.npz import write_npz
from scan2albedo.registration.acceptance import NAMES
from scan2albedo.registration.icp import FEW, loosely_shaped, shaped_icp
from scan2albedo.registration.inputs import RegistrationOptions, Template, prepared_scan
from scan2albedo.synthetic.face_shape import person

SYNTHETIC, SYNTHETIC_SHARE = 164, 1 / 2
OF_MODES = 0.1
"""Share of the covariance that is the modes' own, 1: people of a kind that is left out (VALID, light stage,
synthetic) are likeliest with 0.02 to 0.05; with 0.1 those of other scans are told less often."""
RARE, RARE_SIZE = 0.002, 0.001
"""Part of people of whom one of the three proportions is told, and of whom the size is."""
PUPILS_SD, ALIKE = 3.83 / 63.4, 0.45
"""Of the distance of adults' pupils, relative (N. A. Dodgson, "Variation and extrema of human interpupillary
distance", SPIE 5291, 2004), and how lengths of a face along three axes correlate: size is their mean."""
FACTORS = (1.25, 0.8, 1.5, 1 / 1.5)
FLATTEST = (0.75, 0.85)
"""Depth and height of the nose, of the model's, that faces of East Asia may have, of whom the heads are few.
One standard deviation more of noses than the sample's is between that height and the model's."""


def shape(scan: RawScan) -> FloatArray:
    """Return the shape (K + 1,) of a scan in the frame of the model, see `acceptance.shape_of`."""
    prepared = prepared_scan(scan, RegistrationOptions())
    template = Template.of(s2a.AnnotatedFaceModel.default(), 0)
    pose = prepared.prepared_from_scan
    start = Similarity(pose[:3, :3], pose[:3, 3])
    found = shaped_icp(prepared.samples, template, start, Meter("icp", "mm"))
    found = loosely_shaped(prepared.samples, template, found)
    return np.concatenate([[np.log(found.pose.scale)], found.coefficients])


def stretched(scan: RawScan, factors: FloatArray) -> RawScan:
    return RawScan(scan.vertices * factors, scan.faces)


def scans(folder: Path) -> Iterator[tuple[str, RawScan]]:
    """Yield the name of a head, and a scan of it."""
    for file in sorted((folder / "heads").glob("*.obj")):
        yield file.stem, s2a.load_scan(file)
    stage = LightStage.load()
    for number, (name, shape) in enumerate(stage.shapes.items()):
        yield name, raw_like(shape, stage.faces, number)[0]
    for number, (moved, name) in enumerate(product(expressions_of_light_stage().values(), stage.shapes)):
        yield name, raw_like(stage.shapes[name] + moved, stage.faces, 50 + number)[0]


def heads(folder: Path) -> Iterator[tuple[str, RawScan]]:
    """Yield the heads of a folder, upright."""
    model = s2a.AnnotatedFaceModel.default()
    for name, scan in scans(folder):
        pose = s2a.register(scan, model, seed=0).model_from_scan
        yield name, RawScan(transform_points(pose, scan.vertices), scan.faces)


def synthetic() -> Iterator[RawScan]:
    """Yield synthetic people with all expressions."""
    model, kinds = s2a.AnnotatedFaceModel.default(), sorted(EXPRESSION_BUMPS)
    for seed in range(SYNTHETIC):
        face = person(model, np.random.default_rng([seed, 42]), expression=kinds[seed % len(kinds)])
        yield RawScan(model.subdivision(2).matrix @ face, model.subdivision(2).faces)


def flat_faces(depth: float, nose: float) -> Iterator[RawScan]:
    """Yield scans of the model with parts of its depth, and of the height of its nose."""
    model = s2a.AnnotatedFaceModel.default()
    vertices, faces = model.surface(3)
    assert model.landmarks is not None
    tip, eyes = model.landmarks[30], model.landmarks[[36, 45]].mean(0)
    off = (vertices - tip - [0, 6, 0]) / [16, 22, np.inf]
    low = vertices - np.exp(-(off**2).sum(1) / 2)[:, None] * [0, 0, (1 - nose) * (tip - eyes)[2]]
    flat = low * [1, 1, depth]
    yield RawScan(flat, faces)
    for seed in range(8):
        scan, scan_from_face = raw_like(flat, faces, seed, hair=False, shoulders=False)
        yield RawScan(transform_points(invert_rigid(scan_from_face), scan.vertices), scan.faces)


def size_weights() -> FloatArray:
    """Return (K + 1,) how the logarithm of a face's size depends on its shape."""
    template = Template.of(s2a.AnnotatedFaceModel.default(), 0).first(FEW)
    areas, points = template.samples.areas, template.samples.points
    off = areas[:, None] * (points - areas @ points / areas.sum())
    growth = np.einsum("na,nak->ak", off, template.modes) / (off * points).sum(0)[:, None]
    return np.concatenate([[1.0], growth.mean(0)])


def learned_from(
    shapes: FloatArray, share: FloatArray, change: FloatArray, nose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return weights (4, K + 1) and mean (4,) of the logarithms of people's stretches and size.

    A stretch by the logarithm 1 `change`s the shape, (3, K + 1); people's noses differ by `nose` (K + 1,)
    more than the sample's. Stretches do not depend on the scale: the unit may be wrong.
    """
    share, along = share / share.sum(), change[:, 1:]
    off = (shapes - share @ shapes)[:, 1:]
    covariance = (1 - OF_MODES) * (share * off.T) @ off + OF_MODES * np.eye(off.shape[1])
    filters = np.linalg.solve(covariance + np.outer(nose[1:], nose[1:]), along.T)
    stretches = np.pad((filters / (along.T * filters).sum(0)).T, ((0, 0), (1, 0)))
    weights = np.vstack([stretches, size_weights()])
    return weights, weights @ (share @ shapes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="with heads/ and ict_faces.npz")
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    faces, others = list(heads(arguments.folder)), list(synthetic())
    names = np.array([name for name, _ in faces] + [f"synthetic {seed % 10}" for seed in range(len(others))])
    shapes = np.array([shape(scan) for scan in [*(scan for _, scan in faces), *others]])
    _, place, count = np.unique(names[: len(faces)], return_inverse=True, return_counts=True)
    cases = {
        (label, factor): np.where((np.arange(3) == axis) | (axis == 3), factor, 1.0)
        for axis, label in enumerate(NAMES)
        for factor in FACTORS
    }
    first = [scan for _, scan in faces[: len(count)]]
    moved = {case: np.array([shape(stretched(scan, by)) for scan in first]) for case, by in cases.items()}
    change = np.array([(moved[name, 1.25] - moved[name, 0.8]).mean(0) for name in NAMES[:3]]) / np.log(
        1.25 / 0.8
    )
    share = np.concatenate([1 / count[place], np.ones(len(others))])
    share[: len(faces)] *= (1 - SYNTHETIC_SHARE) / len(count)
    share[len(faces) :] *= SYNTHETIC_SHARE / len(others)
    depth, height = FLATTEST
    flattest = np.array([shape(scan) for scan in flat_faces(depth, height)])
    nose = flattest.mean(0) - np.mean([shape(scan) for scan in flat_faces(depth, 1.0)], axis=0)
    weights, mean = learned_from(shapes, share, change, nose)
    off, told = np.empty((len(names), 4)), {case: np.empty((len(count), 4)) for case in cases}
    for name in set(names):
        rest, out = names != name, np.flatnonzero(names == name)
        by, middle = learned_from(shapes[rest], share[rest], change, nose)
        off[out], out = shapes[out] @ by.T - middle, out[out < len(count)]
        for case, values in moved.items():
            told[case][out] = values[out] @ by.T - middle
    deviation = np.sqrt(share @ off**2)
    deviation[3] = PUPILS_SD * np.sqrt((1 + 2 * ALIKE) / 3)
    # Student's predictive distribution of one person more, of as many as the shares are worth.
    worth = 1 / ((1 - SYNTHETIC_SHARE) ** 2 / len(count) + SYNTHETIC_SHARE**2 / len(others))
    limit = np.full(4, stats.t.isf(RARE / 6, worth - 1) * np.sqrt(1 + 1 / worth))
    limit[3] = stats.norm.isf(RARE_SIZE / 2)
    flat = flattest @ weights.T - mean
    reach = np.array([-limit * deviation, limit * deviation])
    reach[0, 2] = min(reach[0, 2], flat[:, 2].min())
    print(f"{NAMES}: mean {mean.round(3)}, deviation {deviation.round(3)}, reach {np.exp(reach).round(2)}")
    print(f"flattest faces: {(flat / deviation).round(1)}")
    for label, rows in (("heads left out", off[: len(faces)]), ("synthetic people", off[len(faces) :])):
        beyond = ((rows < reach[0]) | (rows > reach[1])).any(1).mean()
        print(f"{label}: greatest distance {np.abs(rows / deviation).max(0).round(2)}, {beyond:.1%} told")
    for (label, factor), values in told.items():
        beyond = ((values < reach[0]) | (values > reach[1])).any(1).mean()
        print(f"{label} x {factor:.2f}: {beyond:.0%} told", flush=True)
    if arguments.output is not None:
        learned = {"weights": weights, "mean": mean, "deviation": deviation, "reach": reach}
        counts = {"heads": np.array(len(count)), "synthetic": np.array(len(others))}
        write_npz(arguments.output, learned | counts, what="people's proportion")


if __name__ == "__main__":
    main()
