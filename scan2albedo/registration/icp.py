"""Robust ICP of the face model: pose, the face's size and, where asked, a person's shape."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core import Meter, PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray, dots
from scan2albedo.face_model.variation import STRETCHES
from scan2albedo.geometry.alignment import Alignment, Pairs, align
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity
from scan2albedo.registration.inputs import Template
from scan2albedo.statistics.robust import geman_mcclure_weights

_SCALE_SD = 0.1
_SHAPED_MM = (4.0, 3.0)
"""First and last scale of the weights of `shaped_icp`: with noise as in raw stereo, 2 mm scatters more than
3."""
TIGHT_MM = 0.35
"""Scale of the weights at which the tight ICP settles."""
FEW = 500
"""Samples of the first steps."""
_FEW_STEPS = 8
"""Steps with few samples."""
_MOST_STEPS = 16
"""Most steps with all samples."""
_SETTLED = 0.02
"""Step, in degrees or mm, below which nothing more is gained; of the tight ICP a twentieth."""
_STAGE = "shaped_icp"
_RIGID_PART = 0.3
"""Part of the rigid face whose distance to the scan tells whether this is the same person."""
_NOISE_MM = 0.25
"""That part is within 0.22 mm on scans of the same person, smiles and open jaws too, and 0.3 to 1.1 on 21 of
22 scans of others; one, with little noise, has 0.22 too."""


@dataclass(frozen=True)
class Residuals:
    """Model samples against the scan samples nearest to them.

    `offset` (M, 3) from these, the mean `normal` (M, 3) of both (S. Rusinkiewicz, "A symmetric objective
    function for ICP", SIGGRAPH 2019), the part `plane_mm` (M,) of the offset along it, the `distance_mm`
    (M,), infinite beyond 30 mm, and the cosine `agreement` (M,) of the normals.
    """

    offset: FloatArray
    normal: FloatArray
    plane_mm: FloatArray
    distance_mm: FloatArray
    agreement: FloatArray

    @property
    def near(self) -> BoolArray:
        """(M,): the scan is within 10 mm."""
        return self.distance_mm < 10

    @property
    def inlier(self) -> BoolArray:
        """(M,): it is near and faces the same way, within 60 degrees."""
        return self.near & (self.agreement > 0.5)

    def trust(self) -> FloatArray:
        """Return (M,) the squared agreement of the normals, 0 where there is no scan."""
        return np.where(np.isfinite(self.distance_mm), np.clip(self.agreement, 0, 1) ** 2, 0.0)

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
        return float(np.quantile(distance, part, weights=weights[inlier], method="inverted_cdf"))

    def icp_loss_mm(self, weights: FloatArray, sigma_mm: float) -> float:
        """Return the root of the mean loss that a step of `icp` lowers (Geman-McClure).

        A sample whose normal disagrees, or without a near scan point, has the loss of one far away, sigma.
        """
        near = sigma_mm**2 / (sigma_mm**2 + self.plane_mm**2)
        return float(sigma_mm * np.sqrt(weights @ (1 - self.trust() * near) / weights.sum()))


def residuals(scan: OrientedPoints, model: OrientedPoints, pose: Similarity) -> Residuals:
    """Measure the model samples at a pose against the scan."""
    points, normals = pose.apply(model.points), model.normals @ pose.rotation.T
    distance, index = scan.tree.query(points, distance_upper_bound=30)
    found = index < len(scan)
    index = np.where(found, index, 0)
    offset, normal = points - scan.points[index], normalized(normals + scan.normals[index])
    agreement = np.where(found, dots(normals, scan.normals[index]), -1.0)
    return Residuals(offset, normal, dots(offset, normal), distance, agreement)


def icp(
    scan: OrientedPoints,
    template: Template,
    start: Similarity | Alignment,
    sigmas_mm: Sequence[float] | FloatArray,
    *,
    shaped: bool = False,
    stretch_sd: float = 1.0,
    settled: float = 0.0,
    meter: Meter | None = None,
) -> Alignment:
    """Refine a pose by iteratively reweighted point-to-plane ICP, one step for each scale.

    `align` with the weights w_i rho_i: w_i are the template's, larger where the face is rigid,

        rho_i = (sigma^2 / (sigma^2 + r_i^2))^2 (n_i . m_i)^2

    of the residual r_i along the mean of the normals n_i, m_i (Geman-McClure). The scale takes up that people
    differ in size; when `shaped`, the template's modes how they differ in shape, its stretches with
    `stretch_sd` standard deviations. The `meter` records the loss at the last scale where it falls.
    """
    samples, weights = template.samples, template.rigidity
    modes = template.modes if shaped else template.modes[:, :, :0]
    precision = np.concatenate([[_SCALE_SD**-2], np.ones(modes.shape[2])])
    if shaped:
        precision[1:][STRETCHES] = stretch_sd**-2

    def pairs(now: Alignment, points: FloatArray) -> Pairs | None:
        if meter is not None and meter.exhausted:
            return None
        shape = OrientedPoints(samples.points + modes @ now.coefficients, samples.normals, samples.areas)
        measured, sigma_mm = residuals(scan, shape, now.pose), float(sigmas_mm[now.steps])
        if meter is not None:
            meter.count()
            loss_mm = measured.icp_loss_mm(weights, float(sigmas_mm[-1]))
            if loss_mm < min((row.error for row in meter.rows if row.stage == _STAGE), default=np.inf):
                meter.record(loss_mm, _STAGE)
        trust = measured.trust() * geman_mcclure_weights(measured.plane_mm, sigma_mm)
        return Pairs(-measured.offset, measured.normal, trust, noise=sigma_mm)

    steps, known = len(sigmas_mm), np.diag(precision)
    return align(
        samples.points, weights, pairs, start, steps=steps, modes=modes, precision=known, settled=settled
    )


def coarsely_shaped(scan: OrientedPoints, template: Template, start: Similarity, meter: Meter) -> Alignment:
    """Take the first steps of `shaped_icp`, with few samples."""
    first = np.geomspace(*_SHAPED_MM, _FEW_STEPS)
    return icp(scan, template.first(FEW), start, first, shaped=True, meter=meter)


def shaped_icp(
    scan: OrientedPoints, template: Template, start: Similarity | Alignment, meter: Meter
) -> Alignment:
    """Refine a pose with a person's shape: one that cannot change is drawn aside by a smile or open jaw.

    An alignment is what `coarsely_shaped` returned.
    """
    shaped = start if isinstance(start, Alignment) else coarsely_shaped(scan, template, start, meter)
    last = _MOST_STEPS * [_SHAPED_MM[1]]
    return icp(scan, template, shaped, last, shaped=True, settled=_SETTLED, meter=meter)


def loosely_shaped(scan: OrientedPoints, template: Template, shaped: Alignment) -> Alignment:
    """Fit the shape further, stretches held by six standard deviations: for judging proportions."""
    last = _MOST_STEPS * [_SHAPED_MM[1]]
    return icp(scan, template.first(FEW), shaped, last, shaped=True, stretch_sd=6)


def tightened(
    scan: OrientedPoints, template: Template, start: Similarity, settling_steps: int, meter: Meter
) -> tuple[Similarity, PlanStep]:
    """Refine a pose on the rigid regions, where the template is the same person's; also return the row.

    Then nearly a third of the rigid face is within the noise, and the rest, which is expression, must not
    pull. Else a narrow scale has many optima, and the pose stays, as it does without budget.
    """
    stage = "register.tight_icp"
    if meter.exhausted:
        return start, PlanStep(stage, False, "the budget had ended")

    def record(pose: Similarity) -> None:
        meter.record(residuals(scan, template.samples, pose).icp_loss_mm(template.rigidity, TIGHT_MM))

    record(start)
    meter.count(_FEW_STEPS)
    pose = icp(scan, template, start, np.geomspace(3, 1, _FEW_STEPS)).pose
    near_mm = residuals(scan, template.samples, pose).quantile_mm(template.rigidity, _RIGID_PART)
    evidence = f"{100 * _RIGID_PART:.0f} % of the rigid face within {near_mm:.2f} mm (limit {_NOISE_MM} mm)"
    if near_mm > _NOISE_MM:
        return start, PlanStep(stage, False, "the model is not of the same person", evidence)
    record(pose)
    tight = icp(scan, template, pose, settling_steps * [TIGHT_MM], settled=_SETTLED / 20)
    meter.count(tight.steps)
    record(tight.pose)
    return tight.pose, PlanStep(stage, True, "the model is of the same person", evidence)


def rigid_distance_mm(
    scan: OrientedPoints, template: Template, pose: Similarity, sigma_mm: float = 1.0
) -> float:
    """Return the mean of min(distance, 3 sigma) of the model's samples, weighted to the rigid regions.

    Where there is no inlier it is 3 sigma.
    """
    found, weights = residuals(scan, template.samples, pose), template.rigidity
    capped = np.where(found.inlier, np.minimum(np.abs(found.plane_mm), 3 * sigma_mm), 3 * sigma_mm)
    return float(weights @ capped / weights.sum())


def rms_mm(scan: OrientedPoints, template: Template, pose: Similarity) -> float:
    """Return the RMS distance of the model's inlying samples to the scan, along the normals."""
    return residuals(scan, template.samples, pose).trimmed_rms_mm(template.samples.areas)
