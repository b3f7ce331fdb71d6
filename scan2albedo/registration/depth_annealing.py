"""Simulated annealing of the pose on the derivatives of depth images (Toderici et al., section 3.1.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rigid import Similarity, compose, rotation_angle_rad, rotation_from_vector
from scan2albedo.optimization import AnnealingOptions, AnnealingResult, simulated_annealing
from scan2albedo.registration.options import RegistrationOptions
from scan2albedo.registration.relief import DepthFrame, depth_image, render_depth
from scan2albedo.registration.robust_icp import Note, rigid_distance_mm, tightened
from scan2albedo.registration.scan_preparation import PreparedScan
from scan2albedo.registration.shaped_icp import shaped_icp
from scan2albedo.registration.template import Template

_TRUNCATION = 0.5
_LARGEST_ANGLE_RAD = np.deg2rad(8.0)
_LARGEST_SHIFT_MM = 8.0
_LOOK_THROUGH_MM = 30.0
_IMAGE_SIZE = 64
_CHECK_SIGMAS_MM = (0.5, 2.0)


@dataclass(frozen=True)
class AnnealedPose:
    """What annealing found: the pose, the objective before and at it, and whether the schedule ended."""

    pose: Similarity
    start_error: float
    error: float
    converged: bool


@dataclass(frozen=True)
class Annealed:
    """The pose after annealing (or before, when that was better), its objective and the note for the plan."""

    pose: Similarity
    depth_error: float | None
    note: Note


class DepthDerivativeObjective:
    """Truncated weighted L1 difference between the depth derivatives of model and scan.

    cost = sum_p w_p (min(|dx_p - dx'_p|, tau) + min(|dy_p - dy'_p|, tau)) / (2 tau sum_p w_p), 0 ... 1, over
    the pixels where the scan has derivatives; a pixel the model does not reach counts as tau. The scan,
    vertices (V, 3) mm and faces (F, 3), is drawn once in the `start` pose, the model at every evaluation,
    both with `size` pixels a side. Derivatives do not see a shift along the viewing axis, so there are five
    parameters (rotation vector in radians and x, y in mm, about the model's origin) and z is solved apart.
    """

    def __init__(
        self,
        scan_vertices: FloatArray,
        scan_faces: IntArray,
        template: Template,
        start: Similarity,
        size: int,
    ) -> None:
        frame = DepthFrame(template.image.frame.center, template.image.frame.width, size)
        self._vertices, self._faces = template.coarse_vertices, template.coarse_faces
        self._view = (frame.center[0], frame.center[1], frame.pixel)
        limit = float(self._vertices[:, 2].max()) + _LOOK_THROUGH_MM
        self._scan = depth_image(scan_vertices, scan_faces, frame, start.inverse(), z_limit=limit)
        self._weights = _weight_image(self._vertices, self._faces, template.coarse_stiffness, frame)
        self._pixels, self._slopes = _scan_slopes(self._scan, self._weights)
        self._pixel_weights = self._weights.ravel()[self._pixels]
        self._total = float(self._pixel_weights.sum())
        self._projected, self._image = np.empty_like(self._vertices), np.empty((size, size))

    def __call__(self, parameters: FloatArray) -> float:
        """Return the cost at (rx, ry, rz, tx, ty)."""
        self._draw(_moved(parameters, 0.0))
        if self._total == 0:
            return 1.0
        limit = _TRUNCATION * self._view[2]
        cost = _slope_cost(self._image, self._pixels, self._slopes, self._pixel_weights, limit)
        return float(cost) / (2 * limit * self._total)

    def depth_shift_mm(self, parameters: FloatArray) -> float:
        """Return the weighted median of scan depth minus model depth: the z that derivatives cannot see."""
        self._draw(_moved(parameters, 0.0))
        common = np.isfinite(self._image) & np.isfinite(self._scan) & (self._weights > 0)
        if not common.any():
            return 0.0
        difference = (self._scan - np.where(common, self._image, 0.0))[common]
        order = np.argsort(difference, kind="stable")
        cumulated = np.cumsum(self._weights[common][order])
        return float(difference[order][np.searchsorted(cumulated, cumulated[-1] / 2)])

    def _draw(self, pose: FloatArray) -> None:
        render_depth(self._vertices, self._faces, pose, self._view, np.inf, self._projected, self._image)


def anneal_depth_derivatives(
    scan_vertices: FloatArray,
    scan_faces: IntArray,
    template: Template,
    start: Similarity,
    *,
    size: int,
    evaluations: int,
    seed: int,
    meter: Meter,
) -> AnnealedPose:
    """Anneal the pose within 8 degrees and 8 mm of the start, then more finely near the result.

    Half of the `evaluations` see images of half the `size` (pixels a side). The scale of `start` is kept; the
    meter records the objective's improvements.
    """
    bounds = np.array([_LARGEST_ANGLE_RAD] * 3 + [_LARGEST_SHIFT_MM] * 2)
    coarse, fine = (
        DepthDerivativeObjective(scan_vertices, scan_faces, template, start, pixels)
        for pixels in (max(size // 2, 1), size)
    )
    start_error = fine(np.zeros(5))
    meter.count()
    meter.record(start_error)
    # The coarse stage measures another objective, so its rows stay out of the trace.
    unseen = meter.untraced()
    rough = _annealed(coarse, np.zeros(5), bounds, seed, evaluations // 2, unseen)
    meter.count(rough.evaluations + 1)
    begin = rough.x if fine(rough.x) < start_error else np.zeros(5)
    result = _annealed(fine, begin, bounds / 4, seed, evaluations - evaluations // 2, meter)
    delta = _moved(result.x, fine.depth_shift_mm(result.x))
    rotation = start.rotation @ delta[:3, :3]
    translation = start.translation + start.scale * start.rotation @ delta[:3, 3]
    pose = Similarity(rotation, translation, start.scale)
    return AnnealedPose(pose, start_error, result.cost, rough.converged and result.converged)


def _annealed(
    objective: DepthDerivativeObjective,
    start: FloatArray,
    reach: FloatArray,
    seed: int,
    evaluations: int,
    meter: Meter,
) -> AnnealingResult:
    return simulated_annealing(
        objective,
        start,
        start - reach,
        start + reach,
        seed=seed,
        options=AnnealingOptions(evaluations=evaluations, initial_temperature=0.1),
        meter=meter,
    )


def _moved(parameters: FloatArray, z_mm: float) -> FloatArray:
    return compose(rotation_from_vector(parameters[:3]), [parameters[3], parameters[4], z_mm])


def _weight_image(
    vertices: FloatArray, faces: IntArray, vertex_weights: FloatArray, frame: DepthFrame
) -> FloatArray:
    """Return (size, size) weights of the model at rest, 0 outside."""
    half = (frame.size - 1) / 2
    column = (vertices[:, 0] - frame.center[0]) / frame.pixel + half
    row = half - (vertices[:, 1] - frame.center[1]) / frame.pixel
    raster = rasterize(np.stack([column, row], 1), vertices[:, 2], faces, (frame.size, frame.size))
    return interpolate(raster, faces, vertex_weights)


def _scan_slopes(depth: FloatArray, weights: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return flat indices (P,) of weighted pixels with derivatives, and these (P, 2): to the right, down."""
    seen = np.isfinite(depth)
    used = np.zeros_like(seen)
    used[:-1, :-1] = seen[:-1, :-1] & seen[:-1, 1:] & seen[1:, :-1] & (weights[:-1, :-1] > 0)
    row, column = np.nonzero(used)
    here = depth[row, column]
    slopes = np.stack([depth[row, column + 1] - here, depth[row + 1, column] - here], 1)
    return row * depth.shape[1] + column, slopes


def annealed(
    scan: PreparedScan,
    template: Template,
    start: Similarity,
    options: RegistrationOptions,
    meter: Meter,
    seed: int,
) -> Annealed:
    """Anneal on depth derivatives when forced, tighten, and keep the answer if the surface is nearer for it.

    Left out by default: ICP mostly returns from the annealed pose to where it was; else annealing's optimum
    is biased by the differences between the face's relief and the template's, as often nearer to the truth as
    not (`tools/bench_registration.py`). Its answer counts only when the robust distance of the rigid regions
    falls at two scales.
    """
    if options.annealing_evaluations == 0:
        return Annealed(start, None, ("depth_annealing", False, "switched off", "0 evaluations"))
    if meter.exhausted:
        return Annealed(start, None, ("depth_annealing", False, "the budget had ended", ""))
    if not options.force_annealing:
        reason = "no gain measured over the ICP that knows people's shapes; force it to compare"
        return Annealed(start, None, ("depth_annealing", False, reason, ""))
    found = anneal_depth_derivatives(
        scan.vertices,
        scan.faces,
        template,
        start,
        size=_IMAGE_SIZE,
        evaluations=options.annealing_evaluations,
        seed=seed,
        meter=meter,
    )
    # ICP measures another distance than the annealing, so its rows stay out of the trace.
    unseen = meter.untraced()
    near = shaped_icp(scan.samples, template, found.pose, unseen).pose
    polished = tightened(scan.samples, template, near, options.settling_iterations, unseen)
    meter.count(unseen.evaluations)
    before, after = (
        [rigid_distance_mm(scan.samples, template, p, sigma) for sigma in _CHECK_SIGMAS_MM]
        for p in (start, polished.pose)
    )
    better = all(a < b for a, b in zip(after, before, strict=True))
    note = _annealing_note(better, found, start, polished.pose, before, after, meter.evaluations)
    if better:
        return Annealed(polished.pose, found.error, note)
    return Annealed(start, found.start_error, note)


def _annealing_note(
    better: bool,
    found: AnnealedPose,
    start: Similarity,
    polished: Similarity,
    before_mm: list[float],
    after_mm: list[float],
    evaluations: int,
) -> Note:
    angle_deg = np.rad2deg(rotation_angle_rad(polished.rotation @ start.rotation.T))
    shift_mm = float(np.linalg.norm(polished.translation - start.translation))
    distances = " and ".join(f"{b:.3f} -> {a:.3f}" for b, a in zip(before_mm, after_mm, strict=True))
    evidence = (
        f"robust distance {distances} mm, objective {found.start_error:.4f} -> "
        f"{found.error:.4f} in {evaluations} evaluations, {angle_deg:.2f} degrees and {shift_mm:.2f} mm away"
    )
    verdict = "taken: the surface distance is less" if better else "dropped: the surface is no nearer"
    return ("depth_annealing", True, f"its pose is {verdict}", evidence)


@njit(cache=True, nogil=True)
def _slope_cost(model, pixels, slopes, weights, limit):  # type: ignore[no-untyped-def]
    """Sum the truncated differences; a slope next to nothing is infinite or NaN and costs the limit."""
    width, flat, cost = model.shape[1], model.ravel(), 0.0
    for i in range(len(pixels)):
        here = flat[pixels[i]]
        across = abs(flat[pixels[i] + 1] - here - slopes[i, 0])
        down = abs(flat[pixels[i] + width] - here - slopes[i, 1])
        if across < np.inf and down < np.inf:
            cost += weights[i] * (min(across, limit) + min(down, limit))
        else:
            cost += 2 * weights[i] * limit
    return cost
