"""Fit the frames of one take, each from where the face was in the one before, and smooth what was found."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded

from scan2albedo.core import Budget, Meter, OnProgress, RawScan
from scan2albedo.core.arrays import SMALLEST, BoolArray, FloatArray
from scan2albedo.errors import FitError
from scan2albedo.fitting.alignment import aligned
from scan2albedo.fitting.fit import scan_near
from scan2albedo.fitting.forces import MIN_ROBUST_MM, ForceGates, scan_forces
from scan2albedo.fitting.mouth_opening import JawHinge, corner_moves
from scan2albedo.fitting.options import GATE_MM, FitOptions
from scan2albedo.fitting.result import MIN_COVERAGE, FittedFace
from scan2albedo.fitting.samples import SurfaceSamples
from scan2albedo.fitting.stages import SHORT, Deformation, run_stage
from scan2albedo.geometry.rigid import invert_rigid


@dataclass(frozen=True)
class TrackedFace:
    """A frame of a take: `control_points` (C, 3) in the model's frame, mm, and the scan's pose (4, 4) in it.

    `mouth` (3,) is how far beside the first frame the jaw is turned, degrees, and the right and left corner
    of the mouth drawn back, mm. Control points `seen` (C,) have scan near; that is the part `coverage` of the
    surface, at a mean distance of `residual_mm`. `odds` are mean log odds of a sample that the last shape,
    before it bends, lies on the face, not beside it; it was `found_again` when that is a new registration.
    """

    control_points: FloatArray
    model_from_scan: FloatArray
    mouth: FloatArray
    seen: BoolArray
    residual_mm: float
    coverage: float
    odds: float
    found_again: bool = False


class FaceTracker:
    """Follows a face from frame to frame, from its fit to the `first`, a `FittedFace`, by `FitOptions`.

    Coarse search, size, proportions, openings, covers and painted features are the first frame's. Pose, the
    turn of the jaw and the pulls at the mouth's corners, which closest points do not move along the skin, are
    refined on the last shape; then that follows the scan in a few implicit steps. What holds it is the first
    frame's shape with jaw and corners moved, in every frame, so that errors do not add up.
    """

    def __init__(self, first: FittedFace, options: FitOptions, on_progress: OnProgress = None) -> None:
        self._model, self._options, self._rest = first.model, options, first.control_points
        self._samples = samples = SurfaceSamples.of(first.model, self._rest, 0)
        hinge, corners = JawHinge.of(first.model, self._rest), corner_moves(first.model, self._rest)
        assert hinge is not None
        assert corners is not None
        self._hinge, self._corners, self._on_progress = hinge, corners, on_progress
        self._weight = samples.area * samples.rigidity * samples.relief(samples.matrix @ self._rest)
        near = ~np.isnan(first.residual_mm[: len(self._rest)])
        figures = (float(np.nanmean(first.residual_mm)), first.coverage, np.inf)
        self.start = TrackedFace(self._rest, first.model_from_scan, np.zeros(3), near, *figures)

    def follow(self, scan: RawScan, last: TrackedFace) -> TrackedFace:
        """Return the face in the next frame, `last` being where it was; FitError where no scan is near."""
        model, options, samples = self._model, self._options, self._samples
        meter = Meter("track", "mm", Budget(), self._on_progress)
        surface = scan_near(scan, samples, last.control_points, last.model_from_scan, options)
        gates = ForceGates(GATE_MM[0], options.tangential, MIN_ROBUST_MM[1])
        # What a frame turns the jaw by is small, so that the turn is linear. Its prior has a deviation of 3
        # degrees a frame, and of 10 mm for each corner: a jaw opens in a quarter of a second, smiles sooner.
        jaw, rest = last.mouth[0], self._rest
        turned = self._hinge.opened(rest, jaw + 1) - self._hinge.opened(rest, jaw)
        modes = np.concatenate([turned[:, :, None], self._corners], axis=2)
        prior, steps = np.diag([1, 3**-2, 10**-2, 10**-2]), 2 * options.rigid_iterations
        found = aligned(
            surface,
            samples,
            last.control_points,
            self._weight,
            lambda step: gates,
            prior,
            steps=steps,  # heads turn by 40 degrees a frame
            meter=meter,
            modes=modes,
        )
        correction = invert_rigid(found.pose.rigid(model.front))
        surface, mouth = surface.moved(correction), last.mouth + found.coefficients
        moved = last.control_points + modes @ found.coefficients
        points = samples.matrix @ moved
        forces = scan_forces(surface, points, samples.normals(points), gates)
        # Distances have a half Cauchy density: beside the face of the last gate's scale, on it of a tenth of
        # that, which is what the last shape, laid on the next frame, has. Where the scan ends it tells none.
        known, on, off = ~np.isnan(forces.near_mm), GATE_MM[1] / 10, GATE_MM[1]
        square, weight = forces.near_mm[known] ** 2, self._weight[known]
        odds = weight @ np.log(on / off * (off**2 + square) / (on**2 + square)) / (weight.sum() or 1)
        reference = self._hinge.opened(rest, mouth[0]) + self._corners @ mouth[1:]
        deformation = Deformation(model, reference, surface, options, meter)
        q, finest = moved - reference, max(options.levels[-1], options.finest_level)
        for level, progress, steps in ((options.levels[0], 0.5, SHORT), (finest, 1.0, 2 * SHORT)):
            q = run_stage(deformation, level, progress, steps, q, None)
        control, (samples, _) = reference + q, deformation.sampled(finest)
        points, gates = samples.matrix @ control, ForceGates.at(options, 1.0)
        forces = scan_forces(surface, points, samples.normals(points), gates)
        shown = samples.area * (forces.near_mm < gates.distance_mm)
        coverage = float(shown.sum() / samples.area.sum())
        if coverage < MIN_COVERAGE:
            raise FitError(f"{scan.name}: only {100 * coverage:.1f} % of the face has scan near it")
        seen = samples.matrix.T @ shown > (samples.matrix.T @ samples.area) / 2
        # Small gaps follow their surroundings: between lips, in holes.
        seen[model.control_faces[seen[model.control_faces].any(1)]] = True
        mouth[0] = self._hinge.angle_deg(rest, control)
        figures = forces.mean_distance_mm(samples.area), coverage, float(odds)
        return TrackedFace(control, correction @ last.model_from_scan, mouth, seen, *figures)


def smoothed_in_time(values: FloatArray, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return curves (T, K) measured with white noise as `values`, and their standard deviations (T, K).

    Each column s has a velocity that walks at random, s_{t+1} - 2 s_t + s_{t-1} ~ N(0, r / l), and is
    measured as a_t ~ N(s_t, r) where `seen` (T,): (W + l D^T D) s = W a with second differences D and W =
    diag(seen). Noise r and ratio l of each column are those of the greatest marginal likelihood [1]_, so that
    a fast motion far above the noise stays. Of fewer than three rows seen it is a line, of unknown deviation.

    .. [1] G. Wahba, "A comparison of GCV and GML for choosing the smoothing parameter in the generalized
       spline smoothing problem", The Annals of Statistics 13, 1985.
    """
    count, free = len(values), int(seen.sum()) - 2
    if free < 1:
        rows = np.flatnonzero(seen)
        flat = np.stack([np.interp(np.arange(count), rows, column[rows]) for column in values.T], 1)
        return flat, np.full_like(flat, np.nan)
    second = sparse.diags([1.0, -2.0, 1.0], (0, 1, 2), (count - 2, count))
    below = (second.T @ second).diagonal
    penalty = np.array([np.pad(below(-k), (0, k)) for k in range(3)])
    measured = np.where(seen[:, None], values, 0.0)
    best = np.full(values.shape[1], np.inf)
    curves, deviations = np.zeros_like(values), np.zeros_like(values)
    # From half a frame's memory to one of the whole take, in octaves.
    for ratio in 2.0 ** np.arange(-10, 4 * np.log2(count)):
        factor = cholesky_banded(ratio * penalty + [seen, 0 * seen, 0 * seen], lower=True)
        found = cho_solve_banded((factor, True), measured)
        rest = np.einsum("tk,tk->k", measured, measured - np.where(seen[:, None], found, 0.0))
        noise = np.maximum(rest / free, SMALLEST)
        cost = free * np.log(noise) + 2 * np.log(factor[0]).sum() - free * np.log(ratio)
        if (better := cost < best).any():
            best[better], curves[:, better] = cost[better], found[:, better]
            inverse = np.diagonal(cho_solve_banded((factor, True), np.eye(count)))
            deviations[:, better] = np.sqrt(noise[better] * inverse[:, None])
    return curves, deviations
