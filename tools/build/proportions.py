"""Learn which proportions people's faces have (`scan2albedo.registration.acceptance`).

Sixteen VALID heads and five light-stage people (NOTICE; these with twelve expressions too) are registered;
the pose of 164 synthetic people is known. A head counts as much as another, whatever its expressions, and the
synthetic people together as much as the heads. How a stretch moves the shape is measured on the heads; it is
separated from how people differ by a linear discriminant, with a covariance mixed with that of the model's
modes. The deviation is that without the head (with all its expressions), or without a tenth of the synthetic
people. Nobody is refused for being as flat as a face of East Asia. How many heads are refused when they are
stretched or scaled, tools/fit_proportions.py of commit 1592766c printed.
"""

from collections.abc import Iterator
from itertools import product
from typing import cast

import numpy as np
from scipy import stats
from worlds.files import DATA
from worlds.light_stage import LightStage
from worlds.raw_like import raw_like

import scan2albedo as s2a
from build import output
from scan2albedo.core import Meter, RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.variation import EXPRESSION_BUMPS
from scan2albedo.geometry.rigid import Similarity, invert_rigid, transform_points
from scan2albedo.io.npz import write_npz
from scan2albedo.registration.acceptance import NAMES
from scan2albedo.registration.icp import FEW, loosely_shaped, shaped_icp
from scan2albedo.registration.inputs import RegistrationOptions, Template, prepared_scan
from scan2albedo.synthetic.face_shape import Expression, person

SYNTHETIC = 164
"""Synthetic people."""
SYNTHETIC_SHARE = 0.5
"""Part of all that they count together."""
OF_MODES = 0.1
"""Share of the covariance that is the modes' own, 1: people of a kind that is left out (VALID, light stage,
synthetic) are likeliest with 0.02 to 0.05; with 0.1 those of other scans are refused less often."""
RARE = 0.002
"""Part of people one of whose three proportions is out of reach."""
RARE_SIZE = 0.001
"""The same of the size."""
PUPILS_SD = 3.83 / 63.4
"""Of the distance of adults' pupils, relative (N. A. Dodgson, "Variation and extrema of human interpupillary
distance", SPIE 5291, 2004)."""
ALIKE = 0.45
"""Correlation of lengths of a face along three axes: size is their mean."""
STRETCHES = (1.25, 0.8)
"""Factors with which it is measured how a stretch moves the shape."""
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


def heads() -> Iterator[tuple[str, RawScan]]:
    """Yield the name of a head, and a scan of it, upright."""
    model, stage = s2a.AnnotatedFaceModel.default(), LightStage.load()
    scans = [(file.stem, s2a.load_scan(file)) for file in sorted((DATA / "heads").glob("*.obj"))]
    for number, (name, rest) in enumerate(stage.shapes.items()):
        scans.append((name, raw_like(rest, stage.faces, number)[0]))
    for number, (move, name) in enumerate(product(stage.expressions.values(), stage.shapes)):
        scans.append((name, raw_like(stage.shapes[name] + move, stage.faces, 50 + number)[0]))
    for name, scan in scans:
        pose = s2a.register(scan, model, seed=0).model_from_scan
        yield name, RawScan(transform_points(pose, scan.vertices), scan.faces)


def change_by(scans: list[RawScan], axis: int) -> FloatArray:
    """Return (K + 1,) how a stretch along an axis, by the logarithm 1, changes the shapes of scans."""
    moved = []
    for factor in STRETCHES:
        factors = np.where(np.arange(3) == axis, factor, 1.0)
        moved.append(np.array([shape(RawScan(scan.vertices * factors, scan.faces)) for scan in scans]))
    return (moved[0] - moved[1]).mean(0) / np.log(STRETCHES[0] / STRETCHES[1])


def synthetic() -> Iterator[RawScan]:
    """Yield synthetic people with all expressions."""
    model, kinds = s2a.AnnotatedFaceModel.default(), sorted(EXPRESSION_BUMPS)
    for seed in range(SYNTHETIC):
        expression = cast(Expression, kinds[seed % len(kinds)])
        face = person(model, np.random.default_rng([seed, 42]), expression=expression)
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


def main(arguments: list[str]) -> None:
    faces, others = list(heads()), list(synthetic())
    names = np.array([name for name, _ in faces] + [f"synthetic {seed % 10}" for seed in range(len(others))])
    shapes = np.array([shape(scan) for scan in [*(scan for _, scan in faces), *others]])
    _, place, count = np.unique(names[: len(faces)], return_inverse=True, return_counts=True)
    first = [scan for _, scan in faces[: len(count)]]
    change = np.array([change_by(first, axis) for axis in range(3)])
    share = np.concatenate([1 / count[place], np.ones(len(others))])
    share[: len(faces)] *= (1 - SYNTHETIC_SHARE) / len(count)
    share[len(faces) :] *= SYNTHETIC_SHARE / len(others)
    depth, height = FLATTEST
    flattest = np.array([shape(scan) for scan in flat_faces(depth, height)])
    nose = flattest.mean(0) - np.mean([shape(scan) for scan in flat_faces(depth, 1.0)], axis=0)
    weights, mean = learned_from(shapes, share, change, nose)
    off = np.empty((len(names), 4))
    for name in set(names):
        out = names == name
        by, middle = learned_from(shapes[~out], share[~out], change, nose)
        off[out] = shapes[out] @ by.T - middle
    deviation = np.sqrt(share @ off**2)
    deviation[3] = PUPILS_SD * np.sqrt((1 + 2 * ALIKE) / 3)
    # Student's predictive distribution of one person more, of as many as the shares are worth.
    worth = 1 / ((1 - SYNTHETIC_SHARE) ** 2 / len(count) + SYNTHETIC_SHARE**2 / len(others))
    limit = np.full(4, stats.t.isf(RARE / 6, worth - 1) * np.sqrt(1 + 1 / worth))
    limit[3] = stats.norm.isf(RARE_SIZE / 2)
    reach = np.array([-limit * deviation, limit * deviation])
    reach[0, 2] = min(reach[0, 2], (flattest @ weights.T - mean)[:, 2].min())
    print(f"{NAMES}: mean {mean.round(3)}, deviation {deviation.round(3)}, reach {np.exp(reach).round(2)}")
    learned = {"weights": weights, "mean": mean, "deviation": deviation, "reach": reach}
    counts = {"heads": np.array(len(count)), "synthetic": np.array(len(others))}
    file = output(arguments, "registration/data/proportions.npz")
    write_npz(file, learned | counts, what="people's proportion")
