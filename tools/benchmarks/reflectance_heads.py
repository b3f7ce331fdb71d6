"""How well vertices are found on captures that Mitsuba rendered, with the mesh's normals right and wrong.

Columns: vertices known; how far their normals are off the rendered ones (root mean square, degrees);
relative RMSE of the albedo of all known vertices, lips and nostrils included, and of the face alone; median
of the relative difference; the largest albedo called identified; vertices with an identified albedo above 1,
and with one that is off by more than half; parts of the 95 % intervals of identified albedos and weights that
hold the truth; median half width of the albedos' intervals over the albedo; part of the albedos that is
identified; CPU seconds of the fit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench.judging import relative_rmse
from worlds.flash_captures import unit
from worlds.traced_captures import DISTANCE_MM, MitsubaCapture, mitsuba_capture, write_files

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import edges_with_faces, vertex_normals
from scan2albedo.reflectance import (
    ReflectanceFit,
    ReflectanceFitOptions,
    fit_reflectance,
    sample_vertices,
)

LEAST_PAIRS = 3
"""As the command `fit` asks for."""
_RMS_OF_MEDIAN = 1.201
"""Of the angles of tilts that are normally distributed."""
WRONG = 0.5
"""Relative error from which an identified albedo counts as plainly wrong."""


@dataclass(frozen=True)
class HeadAccuracy:
    """Errors of a fit against the truth, of all known vertices unless said otherwise."""

    known: int
    normals_off_deg: float
    """Root mean square, known vertices."""
    diffuse: float
    """Relative RMSE."""
    inner: float
    """The same of the face alone."""
    median: float
    """Of the relative difference."""
    worst: float
    """Largest albedo that is called identified."""
    above_one: int
    """Vertices with an identified albedo above 1."""
    wrong: int
    """Vertices with an identified albedo that is off by more than half."""
    cover: float
    """Part of the intervals of identified albedos that hold the truth."""
    cover_weights: float
    width: float
    """Median half width of the albedos' intervals, over the albedo."""
    identified: float
    """Share of the albedos of known vertices."""
    seconds: float
    """CPU of the fit."""

    def row(self, name: str) -> str:
        return (
            f"{name:24s} {self.known:6d} {self.normals_off_deg:6.2f} {self.diffuse:8.3f} {self.inner:7.3f} "
            f"{self.median:7.3f} {self.worst:7.2f} {self.above_one:5d} {self.wrong:6d} {self.cover:6.3f} "
            f"{self.cover_weights:7.3f} {self.width:7.3f} {self.identified:6.2f} {self.seconds:6.2f}"
        )


HEADER = (
    f"{'normals of the mesh':24s}  known    off  diffuse    face  median   worst    >1  wrong  cover  "
    "weights   width  ident  CPU s"
)


def mesh_with_normals_off(capture: MitsubaCapture, angle_deg: float, seed: int = 0) -> FloatArray:
    """Return vertices moved along their normals at random until normals are off by an angle (RMS).

    It is taken from the median, since a few normals at folds turn by far more.
    """
    noise = np.random.default_rng(seed).standard_normal(len(capture.vertices))
    own, size = vertex_normals(capture.vertices, capture.faces), 0.01 * angle_deg
    for _ in range(8):
        moved = capture.vertices + size * noise[:, None] * capture.normals
        turned = vertex_normals(moved, capture.faces)
        off = np.degrees(np.arccos(np.clip((own * turned).sum(1), -1, 1)))[capture.inner]
        size *= angle_deg / max(_RMS_OF_MEDIAN * float(np.median(off)), 1e-9)
    return moved


def smoothed_mesh(capture: MitsubaCapture, rounds: int = 6) -> FloatArray:
    """Return vertices after Laplacian smoothing, as a scanner of low resolution gives them."""
    edges, _ = edges_with_faces(capture.faces)
    moved, degree = capture.vertices.copy(), np.bincount(edges.ravel(), minlength=len(capture.vertices))
    for _ in range(rounds):
        sums = np.zeros_like(moved)
        np.add.at(sums, edges[:, 0], moved[edges[:, 1]])
        np.add.at(sums, edges[:, 1], moved[edges[:, 0]])
        moved += 0.5 * (sums / np.maximum(degree, 1)[:, None] - moved)
    return moved


def accuracy_on_head(
    capture: MitsubaCapture,
    vertices: FloatArray,
    normals: FloatArray | None = None,
    options: ReflectanceFitOptions = ReflectanceFitOptions(least_pairs=LEAST_PAIRS, most_albedo=1.0),
) -> tuple[HeadAccuracy, ReflectanceFit]:
    """Fit the capture on a mesh of `vertices` and compare."""
    samples = sample_vertices(
        capture.olat,
        capture.rig,
        vertices,
        capture.faces,
        normals=normals,
        reference_distance_mm=DISTANCE_MM,
    )
    samples = replace(samples, lobes=capture.strength * samples.lobes)
    fit_reflectance(samples.of_pairs([0, 1, 2]), options=replace(options, least_pairs=1))  # compiles
    began = time.process_time()
    fit = fit_reflectance(samples, options=options)
    seconds = time.process_time() - began
    used = unit(vertex_normals(vertices, capture.faces) if normals is None else normals)
    return compare(capture, fit, used, seconds), fit


def compare(
    capture: MitsubaCapture, fit: ReflectanceFit, normals: FloatArray, seconds: float
) -> HeadAccuracy:
    """Compare a fit with the truth; `normals` (V, 3) are those it believed in."""
    known = fit.reflectance.known
    truth = np.concatenate([capture.truth.diffuse_linear, capture.truth.weights], axis=1)
    found, sure = fit.parameters, fit.identified
    angle = np.degrees(np.arccos(np.clip((normals * capture.normals).sum(1), -1, 1)))[known]
    inside = (fit.low <= truth) & (truth <= fit.high)
    off = np.abs(found[:, :3] - truth[:, :3]) / truth[:, :3]
    face = known & capture.inner
    half = (fit.high - fit.low)[known, :3] / 2 / truth[known, :3]
    return HeadAccuracy(
        int(known.sum()),
        float(np.sqrt(np.mean(angle**2))),
        relative_rmse(found[known, :3], truth[known, :3]),
        relative_rmse(found[face, :3], truth[face, :3]),
        float(np.median(off[known])),
        float(found[:, :3][sure[:, :3]].max()),
        int((sure[:, :3] & (found[:, :3] > 1)).any(1).sum()),
        int((sure[:, :3] & (off > WRONG)).any(1).sum()),
        float(inside[:, :3][sure[:, :3]].mean()),
        float(inside[:, 3:][sure[:, 3:]].mean()),
        float(np.median(half)),
        float(sure[known, :3].mean()),
        seconds,
    )


def print_heads(size: int, files: Path | None = None) -> None:
    """Print the table, and with `files` write the captures for `scan2albedo reflectance fit` there."""
    for bounces in (False, True):
        capture = mitsuba_capture(size=size, bounces=bounces)
        print(f"a head by Mitsuba, {len(capture.view)} pictures of {size} x {size}", end="")
        print(", with light between parts of the face" if bounces else ", direct light")
        if files is not None:
            write_files(capture, files / ("bounces" if bounces else "direct"), capture.vertices)
        print_table(capture)


def print_table(capture: MitsubaCapture) -> None:
    """Print a row for each mesh, its normals taken as right and with tilts."""
    print(HEADER)
    meshes = {
        "those rendered": (capture.vertices, capture.normals),
        "weighted by area": (capture.vertices, None),
        "off by 1 degree": (mesh_with_normals_off(capture, 1.0), None),
        "off by 3 degrees": (mesh_with_normals_off(capture, 3.0), None),
        "of a smoothed mesh": (smoothed_mesh(capture), None),
    }
    sigmas: tuple[float | str, ...] = (0.0, "auto")
    for sigma in sigmas:
        print("normals taken as right" if sigma == 0 else "normals with tilts (the default)")
        for name, (vertices, normals) in meshes.items():
            options = ReflectanceFitOptions(
                least_pairs=LEAST_PAIRS, most_albedo=1.0, normal_sigma_degrees=sigma
            )
            print(accuracy_on_head(capture, vertices, normals, options)[0].row(f"  {name}"), flush=True)
