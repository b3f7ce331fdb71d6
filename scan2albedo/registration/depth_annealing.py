"""Simulated annealing of the pose on the derivatives of depth images (Toderici et al., section 3.1.1)."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter, PlanStep
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.geometry.rigid import Similarity, compose, rotation_angle_rad, rotation_from_vector
from scan2albedo.optimization.annealing import simulated_annealing
from scan2albedo.registration.icp import rigid_distance_mm, shaped_icp, tightened
from scan2albedo.registration.inputs import PreparedScan, RegistrationOptions, Template
from scan2albedo.registration.relief import LOOK_THROUGH_MM, DepthFrame, depth_image

REACH = np.array([np.deg2rad(8.0)] * 3 + [8.0] * 2)
"""Half widths of the box: turns in radians, and mm."""


@dataclass(frozen=True)
class AnnealedPose:
    """The pose that annealing found, or its start, with the objective there, and the plan's row about it.

    The objective is None where annealing did not run.
    """

    pose: Similarity
    step: PlanStep
    error: float | None = None


class DepthDerivativeObjective:
    """Truncated weighted L1 difference between the depth derivatives of model and scan.

    cost = sum_p w_p (min(|dx_p - dx'_p|, tau) + min(|dy_p - dy'_p|, tau)) / (2 tau sum_p w_p), 0 ... 1, over
    the pixels where the scan has derivatives; one the model does not reach counts as tau. Of five parameters
    (rotation vector in radians, x, y in mm, about the model's origin); derivatives do not see z.
    """

    def __init__(
        self, vertices: FloatArray, faces: IntArray, template: Template, start: Similarity, size: int
    ) -> None:
        self._start = start
        self._frame = DepthFrame(template.image.frame.center, template.image.frame.width, size)
        self._vertices, self._faces = template.surface, template.image.faces
        limit = float(self._vertices[:, 2].max()) + LOOK_THROUGH_MM
        self._scan = depth_image(vertices, faces, self._frame, start.inverse(), z_limit=limit)
        # Weights of the model at rest, 0 outside.
        places, shape = self._frame.pixels(self._vertices), (size, size)
        raster = rasterize(places, self._vertices[:, 2], self._faces, shape)
        stiffness = template.surface_from_control @ template.stiffness
        self._weights = interpolate(raster, self._faces, stiffness)
        self._slopes = _slopes(self._scan)
        self._pixel_weights = np.where(np.isfinite(self._slopes).all(0), self._weights[:-1, :-1], 0.0)

    def _draw(self, parameters: FloatArray) -> FloatArray:
        return depth_image(self._vertices, self._faces, self._frame, _moved(parameters))

    def __call__(self, parameters: FloatArray) -> float:
        """Return the cost at (rx, ry, rz, tx, ty)."""
        total = float(self._pixel_weights.sum())
        if total == 0:
            return 1.0
        limit = self._frame.pixel / 2
        with np.errstate(invalid="ignore"):
            off = np.abs(_slopes(self._draw(parameters)) - self._slopes)
        return float(np.vdot(self._pixel_weights, np.fmin(off, limit).sum(0))) / (2 * limit * total)

    def pose(self, parameters: FloatArray) -> Similarity:
        """Return the start moved so, and in depth by the weighted median of scan minus model."""
        image = self._draw(parameters)
        start = self._start
        z_mm = 0.0
        common = np.isfinite(image) & np.isfinite(self._scan) & (self._weights > 0)
        if common.any():
            difference, weights = self._scan[common] - image[common], self._weights[common]
            z_mm = float(np.quantile(difference, 0.5, weights=weights, method="inverted_cdf"))
        delta = _moved(parameters, z_mm)
        translation = start.translation + start.scale * start.rotation @ delta[:3, 3]
        return Similarity(start.rotation @ delta[:3, :3], translation, start.scale)


def _moved(parameters: FloatArray, z_mm: float = 0.0) -> FloatArray:
    """Return the (4, 4) motion by (rx, ry, rz, tx, ty) and z."""
    return compose(rotation_from_vector(parameters[:3]), [parameters[3], parameters[4], z_mm])


def _slopes(image: FloatArray) -> FloatArray:
    """Return the steps (2, S - 1, S - 1) to the right and down in an image, not finite beside nothing."""
    here = image[:-1, :-1]
    with np.errstate(invalid="ignore"):
        return np.stack([image[:-1, 1:] - here, image[1:, :-1] - here])


def annealed(
    scan: PreparedScan,
    template: Template,
    start: Similarity,
    options: RegistrationOptions,
    meter: Meter,
    seed: int,
) -> AnnealedPose:
    """Anneal within 8 degrees and 8 mm of the start when forced, tighten, and keep a pose that is nearer.

    Left out by default: ICP mostly returns to where it was, and annealing's optimum is as often nearer to the
    truth as not (`tools/bench/registration.py`). The robust distance must fall at two scales.
    """
    stage, reason = "register.depth_annealing", ""
    if not options.force_annealing:
        reason = "no gain measured over the ICP that knows people's shapes; force it to compare"
    if meter.exhausted:
        reason = "the budget had ended"
    if options.annealing_evaluations == 0:
        reason = "switched off: 0 evaluations"
    if reason:
        return AnnealedPose(start, PlanStep(stage, False, reason))
    here, size = np.zeros(5), template.image.frame.size
    objective = DepthDerivativeObjective(scan.vertices, scan.faces, template, start, size)
    start_error = objective(here)
    meter.count()
    meter.record(start_error)
    count, box = options.annealing_evaluations, (-REACH, REACH)
    found = simulated_annealing(objective, here, *box, seed=seed, evaluations=count, meter=meter)
    # ICP measures another distance than the annealing, so its rows stay out of the trace.
    unseen = meter.untraced()
    near = shaped_icp(scan.samples, template, objective.pose(found.x), unseen).pose
    polished, _ = tightened(scan.samples, template, near, options.settling_iterations, unseen)
    meter.count(unseen.evaluations)
    before_mm, after_mm = (
        [rigid_distance_mm(scan.samples, template, p, sigma) for sigma in (0.5, 2)] for p in (start, polished)
    )
    better = all(a < b for a, b in zip(after_mm, before_mm, strict=True))
    angle_deg = np.rad2deg(rotation_angle_rad(polished.rotation @ start.rotation.T))
    shift_mm = float(np.linalg.norm(polished.translation - start.translation))
    distances = " and ".join(f"{b:.3f} -> {a:.3f}" for b, a in zip(before_mm, after_mm, strict=True))
    evidence = (
        f"robust distance {distances} mm, objective {start_error:.4f} -> {found.cost:.4f} in "
        f"{meter.evaluations} evaluations, {angle_deg:.2f} degrees and {shift_mm:.2f} mm away"
    )
    verdict = "taken: the surface distance is less" if better else "dropped: the surface is no nearer"
    step = PlanStep(stage, True, f"its pose is {verdict}", evidence)
    return AnnealedPose(polished, step, found.cost) if better else AnnealedPose(start, step, start_error)
