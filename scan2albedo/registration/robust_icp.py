"""A tight robust point-to-plane ICP with the face's size as a nuisance parameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, rotation_from_vector
from scan2albedo.registration.template import Template

_SCALE_PRIOR = 0.1
_PRIOR_SHARE = 0.02
_FARTHEST_MM = 30.0
_INLIER_MM = 10.0
_SETTLED = 1e-3
_NARROWING_MM, _NARROWING_STEPS = (3.0, 1.0), 8
_RIGID_PART, _NOISE_MM = 0.3, 0.25
"""So much of the rigid face within so much: that part is within 0.22 mm on scans of the same person, smiles
and open jaws too, and 0.3 to 1.1 on 21 of 22 scans of others; one, with little noise, has 0.22 too."""
_TIGHTEST_MM = 0.35


@dataclass(frozen=True)
class Residuals:
    """Model samples against the scan's tangent planes: `plane_mm`, `distance_mm`, `agreement` (M,)."""

    plane_mm: FloatArray
    distance_mm: FloatArray
    agreement: FloatArray

    @property
    def inlier(self) -> BoolArray:
        """(M,): the scan is within 10 mm and faces the same way."""
        return (self.distance_mm < _INLIER_MM) & (self.agreement > 0.5)

    def trimmed_rms_mm(self, weights: FloatArray) -> float:
        """Return the weighted RMS of the plane distances of the inliers; inf when there are none."""
        inlier = weights * self.inlier
        total = inlier.sum()
        return float(np.sqrt(inlier @ self.plane_mm**2 / total)) if total > 0 else float("inf")

    def quantile_mm(self, weights: FloatArray, part: float) -> float:
        """Return the distance to the plane that `part` of the inliers' weight keeps; inf without inliers."""
        inlier = self.inlier
        if not inlier.any():
            return float("inf")
        distance = np.abs(self.plane_mm[inlier])
        order = np.argsort(distance, kind="stable")
        cumulated = np.cumsum(weights[inlier][order])
        return float(distance[order][np.searchsorted(cumulated, part * cumulated[-1])])

    def robust_cost(self, weights: FloatArray, sigma_mm: float) -> float:
        """Return the weighted mean of min(distance, 3 sigma) with disagreeing normals at the limit."""
        capped = np.where(self.agreement > 0.5, np.minimum(np.abs(self.plane_mm), 3 * sigma_mm), 3 * sigma_mm)
        capped = np.where(self.distance_mm < _INLIER_MM, capped, 3 * sigma_mm)
        return float(weights @ capped / weights.sum())

    def icp_loss_mm(self, weights: FloatArray, sigma_mm: float) -> float:
        """Return the root of the mean loss that a step of `robust_icp` lowers (Geman-McClure).

        A sample whose normal disagrees, or without a near scan point, has the loss of one far away, sigma.
        """
        trust = np.where(np.isfinite(self.distance_mm), np.maximum(self.agreement, 0) ** 2, 0)
        near = self.plane_mm**2 / (sigma_mm**2 + self.plane_mm**2)
        # A perfect agreement of 1 + 1e-16 must not make the root's argument negative.
        loss = weights @ (1 - np.minimum(trust, 1) * (1 - near)) / weights.sum()
        return float(sigma_mm * np.sqrt(loss))


def residuals(scan: OrientedPoints, model: OrientedPoints, pose: Similarity) -> Residuals:
    """Measure the model samples at a pose against the scan."""
    return correspond(scan, model, pose)[0]


def correspond(
    scan: OrientedPoints, model: OrientedPoints, pose: Similarity
) -> tuple[Residuals, tuple[FloatArray, FloatArray, FloatArray]]:
    """Measure the samples at a pose.

    Also return them turned and scaled (M, 3), the normals of the scan samples nearest, and the offsets from
    these.
    """
    turned = pose.scale * model.points @ pose.rotation.T
    normals = model.normals @ pose.rotation.T
    distance, index = scan.tree.query(turned + pose.translation, distance_upper_bound=_FARTHEST_MM)
    found = index < len(scan)
    index = np.where(found, index, 0)
    offset = turned + pose.translation - scan.points[index]
    target = scan.normals[index]
    agreement = np.where(found, np.einsum("ij,ij->i", normals, target), -1.0)
    measured = Residuals(np.einsum("ij,ij->i", offset, target), distance, agreement)
    return measured, (turned, target, offset)


def robust_icp(
    scan: OrientedPoints,
    model: OrientedPoints,
    weights: FloatArray,
    start: Similarity,
    *,
    iterations: int,
    sigma_mm: tuple[float, float],
) -> Similarity:
    """Refine a pose by iteratively reweighted point-to-plane ICP over rotation, translation and scale.

    Minimises sum_i w_i rho_i (n_i . (s R p_i + t - q_i))^2 + W (sigma log s / 0.1)^2 (W a fiftieth of the
    weights' sum) over the model's (M,) samples with Geman-McClure weights
    rho_i = (sigma^2 / (sigma^2 + r_i^2))^2 times the squared agreement of the normals; w is larger where the
    model is rigid, sigma goes geometrically from the first to the second of `sigma_mm`. The scale takes up
    that people differ in size, which would otherwise push the pose along the viewing axis.
    """
    pose = start
    for sigma in np.geomspace(*sigma_mm, iterations):
        pose, _ = _stepped(scan, model, weights, pose, float(sigma))
    return pose


def settled_icp(
    scan: OrientedPoints,
    model: OrientedPoints,
    weights: FloatArray,
    start: Similarity,
    *,
    sigma_mm: float,
    iterations: int,
) -> tuple[Similarity, int, float]:
    """Repeat the step of `robust_icp` at one scale until it turns by < 1e-3 degrees and moves by < 1e-3 mm.

    Also return the steps taken and the length of the last (the larger of degrees and mm). The answer then
    does not depend on the start.
    """
    pose, taken, moved = start, 0, np.inf
    while taken < iterations and moved >= _SETTLED:
        taken += 1
        pose, moved = _stepped(scan, model, weights, pose, sigma_mm)
    return pose, taken, moved


def _stepped(
    scan: OrientedPoints, model: OrientedPoints, weights: FloatArray, pose: Similarity, sigma_mm: float
) -> tuple[Similarity, float]:
    """Take one reweighted Gauss-Newton step; also return its length (the larger of degrees and mm)."""
    measured, (turned, target, _) = correspond(scan, model, pose)
    r = measured.plane_mm
    near = np.isfinite(measured.distance_mm)
    robust = (sigma_mm**2 / (sigma_mm**2 + r**2)) ** 2 * np.maximum(measured.agreement, 0) ** 2
    rho = np.where(near, robust, 0) * weights / weights.sum()
    rows = np.concatenate(
        [np.cross(turned, target), target, np.einsum("ij,ij->i", turned, target)[:, None]], 1
    )
    gram = (rows * rho[:, None]).T @ rows + 1e-9 * np.eye(7)
    gradient = -(rows * rho[:, None]).T @ r
    prior = _PRIOR_SHARE * rho.sum() * (sigma_mm / _SCALE_PRIOR) ** 2
    gram[6, 6] += prior
    gradient[6] -= prior * np.log(pose.scale)
    step = np.linalg.solve(gram, gradient)
    moved = Similarity(
        rotation_from_vector(step[:3]) @ pose.rotation,
        pose.translation + step[3:6],
        pose.scale * float(np.exp(np.clip(step[6], -0.05, 0.05))),
    )
    return moved, max(float(np.rad2deg(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:6])))


Note = tuple[str, bool, str, str]
"""Step, whether it counts, reason and evidence: a row of the plan."""


@dataclass(frozen=True)
class Tightened:
    """The pose of the tight ICP, or where it was left out the pose as it was, and the note for the plan."""

    pose: Similarity
    note: Note

    @property
    def ran(self) -> bool:
        """Whether the pose is that of the tight ICP."""
        return self.note[1]


def tightened(
    scan: OrientedPoints, template: Template, start: Similarity, settling_iterations: int, meter: Meter
) -> Tightened:
    """Refine a pose on all samples, weighted to the rigid regions, where the template is the same person's.

    Then nearly a third of the rigid face is within the noise once it lies on the scan; the rest is expression
    and must not pull. Where nothing fits that closely, a narrow scale has many optima, and the pose stays, as
    it does without budget. Records the loss at the last scale.
    """
    if meter.exhausted:
        return Tightened(start, ("tight_icp", False, "the budget had ended", ""))
    samples, weights = template.samples, template.rigidity

    def record(pose: Similarity) -> None:
        meter.record(residuals(scan, samples, pose).icp_loss_mm(weights, _TIGHTEST_MM))

    meter.count(_NARROWING_STEPS)
    record(start)
    pose = robust_icp(scan, samples, weights, start, iterations=_NARROWING_STEPS, sigma_mm=_NARROWING_MM)
    near_mm = residuals(scan, samples, pose).quantile_mm(weights, _RIGID_PART)
    evidence = f"{100 * _RIGID_PART:.0f} % of the rigid face within {near_mm:.2f} mm (limit {_NOISE_MM} mm)"
    if near_mm > _NOISE_MM:
        return Tightened(start, ("tight_icp", False, "the model is not of the same person", evidence))
    record(pose)
    pose, steps, _ = settled_icp(
        scan, samples, weights, pose, sigma_mm=_TIGHTEST_MM, iterations=settling_iterations
    )
    meter.count(steps)
    record(pose)
    return Tightened(pose, ("tight_icp", True, "the model is of the same person", evidence))


def rigid_distance_mm(
    scan: OrientedPoints, template: Template, pose: Similarity, sigma_mm: float = 1.0
) -> float:
    """Return the robust distance of the model's samples to the scan, weighted to the rigid regions."""
    return residuals(scan, template.samples, pose).robust_cost(template.rigidity, sigma_mm)


def rms_mm(scan: OrientedPoints, template: Template, pose: Similarity) -> float:
    """Return the RMS distance of the model's inlying samples to the scan's tangent planes."""
    return residuals(scan, template.samples, pose).trimmed_rms_mm(template.samples.areas)
