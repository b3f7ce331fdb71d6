"""Reflectance of vertices: speed beside scipy's nnls, and accuracy on captures of known reflectance.

    python tools/bench_reflectance.py [--vertices 20000] [--peer 400] [--seed 0] [--skip-speed] [--people 3]
    python tools/bench_reflectance.py --heads [--size 256] [--files DIR]
    python tools/bench_reflectance.py --bounce [--size 160]

Speed, on one thread, is CPU time in the same run:

- solver: vertices a second from normal equations to bounded estimates, beside `scipy.optimize.nnls` in a loop
  on the 6 x 6 Cholesky factor of the same equations, and on all rows; the largest difference between them;
- pictures: seconds of each step from 20 pictures of a ball, with rays, and the error of its albedo;
- end to end: lobes, checks, robust fit and diagnostics of 99 pictures, without rays.

Accuracy, 99 pictures, 1 % noise of white, in every case against the truth:

- diffuse: relative RMSE of the albedos; weights: of those identified;
- relight: relative RMSE of the radiance in pictures that the fit has not seen, one in ten;
- cover: part of the 95 % intervals of identified numbers that hold the truth.

The rig: pictures of `synthetic.flash_capture` (256 x 256, 1 % noise, room light, saturation) through files;
the median is of the relative difference of albedos, CPU seconds those of two fits with reading and rays.

With --heads only: captures of a head that is not of the project, rendered by Mitsuba (two minutes each), with
normals that are off (`benchmarks/reflectance_heads.py` tells the columns); needs ../shared/data and mitsuba.
--files also writes them as files for the commands.

With --bounce only: intervals on pale and dark heads that light themselves, traced by Mitsuba (ten minutes),
with and without bounced light in the model (`benchmarks/reflectance_bounce.py` tells the columns).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from bench.judging import relative_rmse
from benchmarks.reflectance_bounce import print_bounce
from benchmarks.reflectance_heads import print_heads
from benchmarks.reflectance_pictures import EXPOSURE, albedo_at, build_scene
from scipy.optimize import nnls
from skimage.metrics import structural_similarity
from threadpoolctl import threadpool_limits
from worlds.flash_captures import Capture, head_capture, of_pairs, radiance, samples_of

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.reflectance import (
    OlatOptions,
    ReflectanceFit,
    ReflectanceFitOptions,
    VertexSamples,
    extract_olat,
    fit_reflectance,
    lobe_slopes,
    point_light_lobes,
    point_light_radiance,
    read_capture,
    sample_vertices,
)
from scan2albedo.reflectance.vertex_kernels import add_normal_equations, solve_bounded
from scan2albedo.runs.reflectance.capture_run import FittedCapture, fit_capture, relit_pair
from scan2albedo.runs.reflectance.demo import write_synthetic_capture
from scan2albedo.synthetic import flash_capture

MEAN = np.array([0.5, 0.5, 0.5, 0.15, 0.15, 0.15])
PRIOR = 1 / np.array([2.5, 2.5, 2.5, 0.25, 0.25, 0.25]) ** 2


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


def nnls_on_factor(matrix: FloatArray, right: FloatArray) -> FloatArray:
    lower = np.linalg.cholesky(matrix)
    return nnls(lower.T, np.linalg.solve(lower, right))[0]


def cpu_of(work, repeats: int = 3) -> float:  # type: ignore[no-untyped-def]
    """Return the least CPU seconds of some runs, after one that compiles."""
    work()
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


@dataclass(frozen=True)
class SolverSpeed:
    """Vertices a CPU second of each solver, and the largest difference of estimates."""

    ours: float
    with_sums: float
    factor: float
    rows: float
    difference: float
    bounded: float


def solver_speed(capture: Capture, peer: int, seed: int = 0) -> SolverSpeed:
    """Measure on a capture with 3 % noise, where a part of the bounds hold."""
    samples = samples_of(capture, noise=0.03, seed=seed)
    count = len(capture.vertices)
    normal, estimate = normal_equations(samples), np.empty((count, 6))
    solve = cpu_of(lambda: solve_bounded(normal, MEAN, PRIOR, estimate))
    sums = cpu_of(lambda: normal_equations(samples))
    chosen = np.linspace(0, count - 1, peer).astype(int)
    systems = [design(samples, int(v)) for v in chosen]
    products = [(rows.T @ rows, rows.T @ right) for rows, right in systems]
    factor = cpu_of(lambda: [nnls_on_factor(*one) for one in products])
    full = cpu_of(lambda: [nnls(*one) for one in systems], 1)
    reference = np.array([nnls(*one)[0] for one in systems])
    return SolverSpeed(
        count / solve,
        count / (solve + sums),
        peer / factor,
        peer / full,
        float(np.abs(estimate[chosen] - reference).max()),
        float((estimate == 0).any(1).mean()),
    )


def end_to_end_cpu_s(capture: Capture, normals_off_deg: float | None = None) -> float:
    """Return CPU seconds of lobes, samples and fit; normals are taken as right, or off and tilted."""
    given = samples_of(capture, noise=0.01, normals_off_deg=normals_off_deg or 0.0)
    scene = capture.vertices, capture.normals, capture.cameras, capture.lights

    def work() -> None:
        point_light_lobes(*scene)
        if normals_off_deg is not None:
            lobe_slopes(*scene)
        fit_reflectance(
            VertexSamples(
                given.observed_linear,
                given.sigma,
                given.valid,
                given.lobes,
                given.light,
                None if normals_off_deg is None else given.slopes,
            )
        )

    return cpu_of(work, 2)


@dataclass(frozen=True)
class Accuracy:
    """Relative RMSE of albedos, identified weights and radiance of pictures left out; cover of intervals."""

    diffuse: float
    weights: float
    relight: float
    cover: float
    identified: float
    fit: ReflectanceFit


def accuracy(
    capture: Capture,
    used: BoolArray,
    held_out: BoolArray,
    options: ReflectanceFitOptions = ReflectanceFitOptions(),
    **how: float,
) -> Accuracy:
    """Fit the pictures `used` (J,) and relight those `held_out` (J,)."""
    samples = samples_of(of_pairs(capture, np.flatnonzero(used)), **how)  # type: ignore[arg-type]
    fit = fit_reflectance(samples, options=options)
    known, identified = fit.reflectance.known, fit.identified
    truth, found = capture.parameters, fit.parameters
    unseen = of_pairs(capture, np.flatnonzero(held_out))
    clean, faced = radiance(unseen)
    relit = point_light_radiance(
        fit.reflectance, point_light_lobes(capture.vertices, capture.normals, unseen.cameras, unseen.lights)
    )
    shown = faced & known
    inside = (fit.low <= truth) & (truth <= fit.high)
    sure = identified[:, 3:]
    return Accuracy(
        relative_rmse(found[known, :3], truth[known, :3]),
        relative_rmse(found[:, 3:][sure], truth[:, 3:][sure]) if sure.any() else np.nan,
        relative_rmse(relit[shown], clean[shown]),
        float(inside[identified].mean()),
        float(sure.mean()),
        fit,
    )


def cases(capture: Capture, seed: int) -> dict[str, Accuracy]:
    """Return the accuracy of every case that the table shows."""
    count = len(capture.cameras)
    held_out = np.arange(count) % 10 == 3
    used, none = ~held_out, np.zeros(count, bool)
    few = none.copy()
    few[np.random.default_rng(seed).choice(np.flatnonzero(used), 6, replace=False)] = True
    colocated = used & (np.linalg.norm(capture.cameras - capture.lights, axis=1) < 1e-6)
    squares = ReflectanceFitOptions(loss="squares")
    return {
        "1 % noise": accuracy(capture, used, held_out, noise=0.01, seed=seed),
        "  least squares": accuracy(capture, used, held_out, squares, noise=0.01, seed=seed),
        "no noise": accuracy(capture, used, held_out, said_noise=1e-9),
        "3 % shadow": accuracy(capture, used, held_out, noise=0.01, shadowed=0.03, seed=seed),
        "  least squares ": accuracy(capture, used, held_out, squares, noise=0.01, shadowed=0.03, seed=seed),
        "normals off 1 deg": accuracy(capture, used, held_out, noise=0.01, normals_off_deg=1.0, seed=seed),
        "normals off 3 deg": accuracy(capture, used, held_out, noise=0.01, normals_off_deg=3.0, seed=seed),
        "6 pictures": accuracy(capture, few, held_out, noise=0.01, seed=seed),
        "colocated": accuracy(capture, colocated, held_out, noise=0.01, seed=seed),
        "3 % black channels": accuracy(
            with_black_channels(capture, seed), used, held_out, noise=0.01, seed=seed
        ),
    }


def with_black_channels(capture: Capture, seed: int) -> Capture:
    """Return the capture with the truth of one that has 3 % black channels."""
    return replace(capture, truth=head_capture(len(capture.vertices), seed=seed, black=0.03).truth)


def from_pictures() -> str:
    """Return CPU seconds from pictures with half a per cent of noise to reflectance, and the error."""
    scene, rng = build_scene(96, 160), np.random.default_rng(0)
    flash, room = (values + 0.005 * rng.standard_normal(values.shape) for values in (scene.flash, scene.room))
    olat = extract_olat(flash, room, options=OlatOptions(noise=0.005))
    samples = sample_vertices(olat, scene.rig, scene.vertices, scene.faces, normals=scene.normals)
    seconds = [
        cpu_of(lambda: extract_olat(flash, room, options=OlatOptions(noise=0.005)), 1),
        cpu_of(lambda: sample_vertices(olat, scene.rig, scene.vertices, scene.faces), 1),
        cpu_of(lambda: fit_reflectance(samples), 1),
    ]
    fit = fit_reflectance(samples)
    seen = scene.head & (fit.pair_count >= 10) & fit.reflectance.known
    error = relative_rmse(fit.reflectance.diffuse_linear[seen], EXPOSURE * albedo_at(scene.vertices[seen]))
    return (
        f"{len(olat)} pictures, {len(scene.vertices)} vertices, CPU s: OLAT {seconds[0]:.2f}, samples "
        f"with rays {seconds[1]:.2f}, fit {seconds[2]:.2f}; albedo {error:.3f} where 10 or more see it\n"
    )


def from_rig(seed: int, hair: bool) -> str:
    """Return errors of a fit to the 99 pairs of a synthetic rig, and of pictures left out, as a row."""
    capture = flash_capture(seed, hair=hair)
    with tempfile.TemporaryDirectory() as folder:
        files = read_capture(write_synthetic_capture(capture, Path(folder)))
        began = time.process_time()
        done = fit_capture(files)
        seconds = time.process_time() - began
    one, error = done.fit.reflectance, done.error
    assert error is not None
    off = one.diffuse_linear[one.known] - capture.diffuse_linear[one.known]
    truth = capture.diffuse_linear[one.known]
    similar = np.mean([similarity(done, int(j)) for j in np.flatnonzero(done.held_out)])
    name = f"person {seed}, {'hair not in the mesh' if hair else 'no hair'}"
    return (
        f"{name:32s} {relative_rmse(off + truth, truth):7.3f} {np.median(np.abs(off / truth)):7.3f} "
        f"{error.relative_rmse:8.3f} {error.psnr_db:8.1f} {similar:6.3f} {seconds:6.1f}"
    )


def similarity(done: FittedCapture, pair: int) -> float:
    """Return the SSIM of a photograph and its relit face, of displayed values where both are."""
    taken, made, shown = relit_pair(done, pair)
    shown &= done.olat.valid[pair].all(-1)
    if not shown.any():
        return 1.0
    white = max(float(np.percentile(taken[shown], 99)), 1e-12)
    pictures = [np.clip(np.where(shown[..., None], p, 0) / white, 0, 1) ** (1 / 1.2) for p in (taken, made)]
    _, similar = structural_similarity(*pictures, channel_axis=2, data_range=1.0, full=True)
    return float(similar[shown].mean())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", type=int, default=20_000)
    parser.add_argument("--peer", type=int, default=400, help="vertices that scipy solves")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--skip-speed", action="store_true")
    parser.add_argument("--people", type=int, default=3, help="of the synthetic rig")
    parser.add_argument("--heads", action="store_true", help="captures rendered by Mitsuba instead")
    parser.add_argument("--bounce", action="store_true", help="intervals under light that heads bounce")
    parser.add_argument("--size", type=int, help="of their pictures; otherwise 256, with --bounce 160")
    parser.add_argument("--files", type=Path, help="folder to write them to")
    given = parser.parse_args()
    if given.heads:
        with threadpool_limits(1):
            print_heads(given.size or 256, given.files)
        return
    if given.bounce:
        with threadpool_limits(1):
            print_bounce(given.size or 160)
        return
    capture = head_capture(given.vertices, seed=given.seed)
    if not given.skip_speed:
        with threadpool_limits(1):
            speed = solver_speed(capture, given.peer, given.seed)
            seconds = [end_to_end_cpu_s(capture, off) for off in (None, 0.0, 3.0)]
        print(f"solver                     {speed.ours:12,.0f} vertices a second")
        print(f"  and sums over pictures   {speed.with_sums:12,.0f}")
        print(f"  scipy nnls, 6 x 6        {speed.factor:12,.0f}")
        print(f"  scipy nnls, all rows     {speed.rows:12,.0f}")
        print(
            f"  largest difference {speed.difference:.1e}; {100 * speed.bounded:.1f} % of vertices at a bound"
        )
        print(
            f"{given.vertices} vertices, {len(capture.cameras)} pictures, end to end, CPU s: "
            f"{seconds[0]:.2f} with normals taken as right, {seconds[1]:.2f} with tilts, {seconds[2]:.2f} "
            "with normals off by 3 degrees\n"
        )
        print(from_pictures())
    print(f"{'case':20s} diffuse  weights  relight  cover  identified  misfit  rounds")
    for name, one in cases(capture, given.seed).items():
        rounds = f"{one.fit.iterations}{'' if one.fit.converged else '+'}"
        print(
            f"{name:20s} {one.diffuse:7.2g}  {one.weights:7.2g}  {one.relight:7.2g}  {one.cover:5.3f}  "
            f"{one.identified:10.2f}  {np.nanmedian(one.fit.misfit):6.2f}  {rounds:>6s}"
        )
    print(f"\n{'rig of 99 pairs, 8 bits':32s} diffuse  median  relight  PSNR dB   SSIM  CPU s")
    for seed in range(given.people):
        for hair in (False, True):
            print(from_rig(seed, hair))


if __name__ == "__main__":
    main()
