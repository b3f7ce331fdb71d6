"""Reflectance of vertices from flash captures: the solver beside scipy's nnls, and errors against the truth.

`solver` turns normal equations of 2,000 vertices into bounded estimates; scipy solves the 6 x 6 Cholesky
factors of the same equations, and all rows; "differ" is the largest difference from the latter. `cases` are a
head's 20,000 vertices in 99 pictures, 1 % noise of white: relative RMSE of the albedo, of identified weights
and of the radiance in pictures left out (one in ten), and how many 95 % intervals of identified numbers hold
the truth. `rig` are pictures of `synthetic.flash_capture` (8 bits, room light, saturation) through files,
with rays: the median is of the relative difference of albedos.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls
from worlds.flash_captures import Capture, head_capture, of_pairs, radiance, samples_of

from bench.judging import relative_rmse
from bench.runner import Bench, Case
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.reflectance import (
    ReflectanceFit,
    ReflectanceFitOptions,
    VertexSamples,
    fit_reflectance,
    lobe_slopes,
    point_light_lobes,
    point_light_radiance,
    read_capture,
)
from scan2albedo.reflectance.vertex_kernels import add_normal_equations, solve_bounded
from scan2albedo.runs.reflectance.capture_run import FittedCapture, fit_capture
from scan2albedo.runs.reflectance.demo import write_synthetic_capture
from scan2albedo.synthetic import FlashCapture, flash_capture

MEAN = np.array([0.5, 0.5, 0.5, 0.15, 0.15, 0.15])
"""Of the prior that the solvers are given."""
PRIOR = 1 / np.array([2.5, 2.5, 2.5, 0.25, 0.25, 0.25]) ** 2
"""Its precisions."""


def normal_equations(samples: VertexSamples) -> FloatArray:
    """Return (V, 6, 7)."""
    count = samples.observed_linear.shape[1]
    normal = np.empty((count, 6, 7))
    precision = np.where(samples.valid, 1 / samples.sigma**2, 0.0)
    weight = np.ones(samples.observed_linear.shape[:2])
    for start in range(0, count, 128):
        rows = np.arange(start, min(start + 128, count))
        part = normal[rows[0] : rows[-1] + 1]
        nothing = np.empty((0, 0, 3))
        add_normal_equations(samples.observed_linear, precision, samples.lobes, nothing, weight, rows, part)
    return normal


def design(samples: VertexSamples, vertex: int) -> tuple[FloatArray, FloatArray]:
    """Return all rows of a vertex, whitened, those of the prior last: (3 J + 6, 6) and (3 J + 6,)."""
    count = len(samples.observed_linear)
    rows, right = np.zeros((count, 3, 6)), samples.observed_linear[:, vertex] / samples.sigma[:, vertex]
    for k in range(3):
        rows[:, k, k] = samples.lobes[:, vertex, 0]
        rows[:, k, 3:] = samples.lobes[:, vertex, 1:]
    rows /= samples.sigma[:, vertex, :, None]
    valid = samples.valid[:, vertex]
    return (
        np.concatenate([rows[valid], np.diag(np.sqrt(PRIOR))]),
        np.concatenate([right[valid], np.sqrt(PRIOR) * MEAN]),
    )


class Equations:
    """Samples of a capture with 3 % noise, where a part of the bounds hold, and their equations."""

    def __init__(self, count: int) -> None:
        self.samples = samples_of(head_capture(count), noise=0.03)
        self.normal = normal_equations(self.samples)
        self.rows = [design(self.samples, v) for v in range(count)]
        self.products = [(rows.T @ rows, rows.T @ right) for rows, right in self.rows]


def bounded(normal: FloatArray) -> FloatArray:
    estimate = np.empty((len(normal), 6))
    solve_bounded(normal, MEAN, PRIOR, estimate)
    return estimate


def nnls_on_factor(matrix: FloatArray, right: FloatArray) -> FloatArray:
    lower = np.linalg.cholesky(matrix)
    return nnls(lower.T, np.linalg.solve(lower, right))[0]


def off_nnls(equations: Equations, estimate: FloatArray) -> dict[str, float]:
    reference = np.array([nnls(*rows)[0] for rows in equations.rows])
    at_bound = 100 * float((estimate == 0).any(1).mean())
    return {"differ": float(np.abs(estimate - reference).max()), "at a bound %": at_bound}


@dataclass(frozen=True)
class Lit:
    """A capture, the samples that are fitted, and the pictures left out."""

    capture: Capture
    samples: VertexSamples
    unseen: Capture

    @classmethod
    def of(cls, capture: Capture, used: BoolArray, held_out: BoolArray, **how: float) -> Lit:
        samples = samples_of(of_pairs(capture, np.flatnonzero(used)), **how)
        return cls(capture, samples, of_pairs(capture, np.flatnonzero(held_out)))


def lit_cases(quick: bool) -> Iterator[Case]:
    count = 1500 if quick else 20_000
    capture = head_capture(count)
    black = replace(capture, truth=head_capture(count, black=0.03).truth)
    pictures = len(capture.cameras)
    held_out = np.arange(pictures) % 10 == 3
    used, none = ~held_out, np.zeros(pictures, bool)
    few = none.copy()
    few[np.random.default_rng(0).choice(np.flatnonzero(used), 6, replace=False)] = True
    colocated = used & (np.linalg.norm(capture.cameras - capture.lights, axis=1) < 1e-6)
    for name, shown, pairs, how in (
        ("1 % noise", capture, used, {"noise": 0.01}),
        ("no noise", capture, used, {"said_noise": 1e-9}),
        ("3 % shadow", capture, used, {"noise": 0.01, "shadowed": 0.03}),
        ("normals off 1 deg", capture, used, {"noise": 0.01, "normals_off_deg": 1.0}),
        ("normals off 3 deg", capture, used, {"noise": 0.01, "normals_off_deg": 3.0}),
        ("6 pictures", capture, few, {"noise": 0.01}),
        ("colocated", capture, colocated, {"noise": 0.01}),
        ("3 % black channels", black, used, {"noise": 0.01}),
        ("all pictures", capture, ~none, {"noise": 0.01}),
    ):
        yield Case(name, partial(Lit.of, shown, pairs, held_out, **how), name)


def fitted(options: ReflectanceFitOptions, scene: Lit) -> ReflectanceFit:
    """Fit samples, with the lobes that this takes."""
    capture, samples = scene.capture, scene.samples
    rays = capture.vertices, capture.normals, capture.cameras, capture.lights
    point_light_lobes(*rays)
    if options.normal_sigma_degrees == 0:
        return fit_reflectance(replace(samples, slopes=None), options=options)
    lobe_slopes(*rays)
    return fit_reflectance(samples, options=options)


def accuracy(scene: Lit, fit: ReflectanceFit) -> dict[str, float]:
    known, identified = fit.reflectance.known, fit.identified
    truth, found, unseen = scene.capture.parameters, fit.parameters, scene.unseen
    clean, faced = radiance(unseen)
    lobes = point_light_lobes(scene.capture.vertices, scene.capture.normals, unseen.cameras, unseen.lights)
    shown = faced & known
    inside = (fit.low <= truth) & (truth <= fit.high)
    sure = identified[:, 3:]
    weights = relative_rmse(found[:, 3:][sure], truth[:, 3:][sure]) if sure.any() else np.nan
    return {
        "albedo %": 100 * relative_rmse(found[known, :3], truth[known, :3]),
        "weights %": 100 * weights,
        "relit %": 100 * relative_rmse(point_light_radiance(fit.reflectance, lobes)[shown], clean[shown]),
        "cover %": 100 * float(inside[identified].mean()),
    }


def rig_cases(quick: bool) -> Iterator[Case]:
    for seed in range(1 if quick else 3):
        for hair in (False,) if quick else (False, True):
            name = f"person {seed}, {'hair not in the mesh' if hair else 'no hair'}"
            options: dict[str, Any] = {"views": 2, "flashes": 3, "levels": 1} if quick else {}
            yield Case(name, partial(flash_capture, seed, hair=hair, **options))


def from_files(capture: FlashCapture) -> FittedCapture:
    with tempfile.TemporaryDirectory() as folder:
        done = fit_capture(read_capture(write_synthetic_capture(capture, Path(folder))))
    return done


def rig_errors(capture: FlashCapture, done: FittedCapture) -> dict[str, float]:
    one = done.fit.reflectance
    found, truth = one.diffuse_linear[one.known], capture.diffuse_linear[one.known]
    row = {
        "albedo %": 100 * relative_rmse(found, truth),
        "median %": 100 * float(np.median(np.abs((found - truth) / truth))),
    }
    if done.error is not None:
        row["relit %"], row["PSNR dB"] = 100 * done.error.relative_rmse, done.error.psnr_db
    return row


Fit = Callable[[Lit], ReflectanceFit]
FITS: dict[str, Fit] = {
    "ours": partial(fitted, ReflectanceFitOptions()),
    "least squares": partial(fitted, ReflectanceFitOptions(loss="squares")),
    "normals right": partial(fitted, ReflectanceFitOptions(normal_sigma_degrees=0)),
}
BENCHES = {
    "solver": Bench(
        lambda quick: [Case("3 % noise", lambda: Equations(200 if quick else 2000))],
        methods={
            "ours": lambda equations: bounded(equations.normal),
            "with sums": lambda equations: bounded(normal_equations(equations.samples)),
        },
        peers={
            "nnls, 6 x 6": lambda of: np.array([nnls_on_factor(*each) for each in of.products]),
            "nnls, all rows": lambda of: np.array([nnls(*each)[0] for each in of.rows]),
        },
        score=off_nnls,
        warm=True,
        repeats=3,
    ),
    "cases": Bench(lit_cases, methods=FITS, score=accuracy, summaries=("mean",), warm=True),
    "rig": Bench(rig_cases, methods={"ours": from_files}, score=rig_errors),
}
