"""A robust ICP that also finds how the person differs from the model, within what people do."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray
from scan2albedo.face_model.variation import STRETCHES
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.oriented_points import OrientedPoints
from scan2albedo.geometry.rigid import Similarity, rotation_from_vector
from scan2albedo.registration.robust_icp import correspond
from scan2albedo.registration.template import Template

_STAGE = "shaped_icp"
_SIGMAS_MM = (4.0, 3.0)
"""First and last scale of the weights: with noise as in raw stereo, 2 mm scatters more than 3."""
_FEW, _FEW_STEPS, _MOST_STEPS = 500, 6, 16
"""Samples and steps of the first part, whose scale narrows; most steps with all samples at the last scale."""
_SETTLED = 0.02
"""Step, in degrees or mm, below which nothing more is gained."""
_PRIOR = 4.0
"""Samples that err together: what a sample is worth against the prior is divided by it."""
_SCALE_SD = 0.1
_LARGEST_GROWTH = 0.05
_LOOSE, _LOOSE_STEPS = 6.0, 8
"""Standard deviations that another width, height or depth may have, and steps to find them."""
_LEAST_GROWTH = 0.05


@dataclass(frozen=True)
class ShapedPose:
    """A pose, and the coefficients (K,) of the template's modes, in standard deviations."""

    pose: Similarity
    coefficients: FloatArray


def shaped_icp(scan: OrientedPoints, template: Template, start: Similarity, meter: Meter) -> ShapedPose:
    """Refine a pose by point-to-plane ICP over rotation, translation, scale and the modes of shape.

    Minimises sum_i w_i rho_i (n_i . (s R (p_i + B_i c) + t - q_i))^2 + P sigma^2 (|c|^2 + (log s / 0.1)^2)
    with the weights w_i rho_i of `robust_icp` relative to the mean of w_i, and n_i the mean of both normals
    [1]_: with those of the scan alone it creeps along the face, and ends where it began. A template that
    cannot change is drawn aside by a smile or an open jaw; this one follows it. The meter records the loss of
    the last scale wherever it is lower than of any pose before.

    .. [1] S. Rusinkiewicz, "A symmetric objective function for ICP", SIGGRAPH 2019.
    """
    shaped = ShapedPose(start, np.zeros(len(template.modes)))
    precision = np.ones(len(template.modes))
    few = [(float(sigma_mm), _FEW) for sigma_mm in np.geomspace(*_SIGMAS_MM, _FEW_STEPS)]
    for sigma_mm, count in few + _MOST_STEPS * [(_SIGMAS_MM[1], len(template.samples))]:
        if meter.exhausted:
            break
        shaped, moved, loss_mm = _stepped(scan, template, shaped, sigma_mm, count, precision)
        meter.count()
        if loss_mm < min((row.error for row in meter.rows if row.stage == _STAGE), default=np.inf):
            meter.record(loss_mm, _STAGE)
        if count > _FEW and moved < _SETTLED:
            break
    return shaped


def proportions(scan: OrientedPoints, template: Template, shaped: ShapedPose) -> FloatArray:
    """Return the logarithms of the face's height to width, depth to width and depth to height (3,).

    They are relative to the template's. The template is fitted further for it, with little against another
    width, height and depth: they would else be taken for those of people. This judges a pose, before there is
    a fit; `fitting.plausibility` judges the landmarks of one.
    """
    precision = np.ones(len(template.modes))
    precision[STRETCHES] = _LOOSE**-2
    for _ in range(_LOOSE_STEPS):
        shaped, *_ = _stepped(scan, template, shaped, _SIGMAS_MM[1], _FEW, precision)
    rest = template.first(_FEW)
    moved = template.modes.at_samples[:_FEW] @ shaped.coefficients
    offset = rest.points - rest.areas @ rest.points / rest.areas.sum()
    growth = 1 + (rest.areas @ (offset * moved)) / (rest.areas @ offset**2)
    width, height, depth = np.log(np.maximum(growth, _LEAST_GROWTH))
    return np.array([height - width, depth - width, depth - height])


def _stepped(
    scan: OrientedPoints,
    template: Template,
    shaped: ShapedPose,
    sigma_mm: float,
    count: int,
    precision: FloatArray,
) -> tuple[ShapedPose, float, float]:
    """Take one reweighted Gauss-Newton step with the first `count` samples.

    Also return its length, the larger of degrees and mm, and the loss in mm before it. `precision` (K,) is
    that of the coefficients, before the scan is seen.
    """
    pose, c = shaped.pose, shaped.coefficients
    model, modes = template.first(count), template.modes.at_samples[:count]
    moved = OrientedPoints(model.points + modes @ c, model.normals, model.areas)
    measured, (turned, of_scan, offset) = correspond(scan, moved, pose)
    target = normalized(of_scan + model.normals @ pose.rotation.T)
    measured = replace(measured, plane_mm=np.einsum("ij,ij->i", offset, target))
    r = measured.plane_mm
    robust = (sigma_mm**2 / (sigma_mm**2 + r**2)) ** 2 * np.maximum(measured.agreement, 0) ** 2
    # Few samples stand for all.
    weights = template.rigidity[:count]
    weights = weights * (len(template.samples) / weights.sum())
    rho = np.where(np.isfinite(measured.distance_mm), robust, 0) * weights
    along = np.einsum("ij,ij->i", turned, target)[:, None]
    by_modes = ((target @ pose.rotation * pose.scale)[:, None, :] @ modes)[:, 0]
    rows = np.concatenate([np.cross(turned, target), target, along, by_modes], 1)
    weighted = rows * rho[:, None]
    prior = _PRIOR * sigma_mm**2 * np.concatenate([np.zeros(6), [_SCALE_SD**-2], precision])
    known = np.concatenate([np.zeros(6), [np.log(pose.scale)], c])
    gram = weighted.T @ rows
    gram[np.diag_indices(len(gram))] += prior + 1e-9
    step = np.linalg.solve(gram, -(weighted.T @ r) - prior * known)
    growth = float(np.exp(np.clip(step[6], -_LARGEST_GROWTH, _LARGEST_GROWTH)))
    rotation = rotation_from_vector(step[:3]) @ pose.rotation
    pose = Similarity(rotation, pose.translation + step[3:6], pose.scale * growth)
    length = max(float(np.rad2deg(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:6])))
    loss_mm = measured.icp_loss_mm(weights, _SIGMAS_MM[1])
    return ShapedPose(pose, c + step[7:]), length, loss_mm
