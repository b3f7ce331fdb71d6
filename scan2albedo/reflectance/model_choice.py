"""How many directions of a morphable model to keep, by people that it was not learned from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.morphable_model import MorphableReflectanceModel
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance

LEAST_SAMPLES = 10
_HELD_OUT = 5
"""One sample of so many is left out."""
_GRID = (0, 1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200, 300)
_BLOCK_MM = 25.0
_AS_GOOD = 1.01
"""Errors within this factor of the least are as good."""


def held_out_components(samples: Sequence[VertexReflectance], vertices: ArrayLike) -> int:
    """Return the fewest directions that predict one half of people's faces from the other half well.

    A model is learned from four of five samples. Of each other face, every second block of 25 mm gives the
    most probable coefficients, with what the kept directions leave out as noise, and the albedo of the other
    blocks is compared. The fewest directions are taken whose error (RMS) is within 1 % of the least: more of
    them describe the samples and not people, and make every fit slower.

    Raises `ReflectanceError` for fewer than 10 samples or another number of vertices.

    Parameters
    ----------
    samples : sequence of VertexReflectance
    vertices : (V, 3) array_like of float
        Millimetres: of any of the faces, or their mean.
    """
    if len(samples) < LEAST_SAMPLES:
        raise ReflectanceError(
            f"{len(samples)} samples do not show how many directions to keep; give {LEAST_SAMPLES} or more"
        )
    xyz = np.asarray(vertices, np.float64)
    tested = list(samples[_HELD_OUT - 1 :: _HELD_OUT])
    kept = [sample for k, sample in enumerate(samples) if k % _HELD_OUT != _HELD_OUT - 1]
    model = MorphableReflectanceModel.from_samples(kept)
    if xyz.shape != (len(model.known), 3):
        raise ReflectanceError(f"vertices is {xyz.shape}, expected ({len(model.known)}, 3)")
    # Neighbouring cubes differ in this sum by one, so that they fall into different halves.
    first = np.floor(xyz / _BLOCK_MM).sum(1) % 2 == 0
    counts = [count for count in _GRID if count < model.components] + [model.components]
    errors = np.zeros(len(counts))
    for sample in tested:
        for given in (first, ~first):
            errors += _errors(model, sample, given, counts)
    return counts[int(np.argmax(errors <= _AS_GOOD**2 * errors.min()))]


def _errors(
    model: MorphableReflectanceModel, sample: VertexReflectance, given: BoolArray, counts: Sequence[int]
) -> FloatArray:
    """Return sums of squares where a face is not given, by number of directions."""
    both = model.known & sample.known
    off = np.where(both[:, None], sample.diffuse_linear - model.diffuse_mean, 0.0)
    seen, hidden = np.flatnonzero(both & given), np.flatnonzero(both & ~given)
    basis = model.diffuse_basis[:, seen].reshape(model.components, -1)
    gram, towards = basis @ basis.T, basis @ off[seen].ravel()
    size = 3 * int(model.known.sum())
    result = np.empty(len(counts))
    for number, count in enumerate(counts):
        left = max(model.total_variance - float(np.sum(model.deviation[:count] ** 2)), 0.0)
        noise = max(left, 1e-9 * model.total_variance) / size
        b = np.linalg.solve(gram[:count, :count] + noise * np.eye(count), towards[:count])
        made = np.tensordot(b, model.diffuse_basis[:count, hidden], 1)
        result[number] = np.sum((made - off[hidden]) ** 2)
    return result
