"""The colours of a light's parts, from how the ratios of the channels change over the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from scan2albedo.albedo.light_parameters import HARMONICS
from scan2albedo.albedo.node_field import posterior_factor
from scan2albedo.albedo.posterior import DARK, NOISE, Point, cell_trust, robust_weights
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.plan import PlanStep

STAGE = "albedo.light_colour"
_COLOUR_SD = 0.3, 0.1, 0.05
"""Standard deviations of the log of a lamp's colour beside that of the ambient light, one channel to the
next, and of colour in the harmonics of orders 1 and 2: the log ratio of blue and red in daylight (6500 K) and
in a bulb's light (2700 K) differs by 1.2, four standard deviations."""
_CAST = 0.3
"""Variance of the colour of light that no part stands for, as a part of that of its brightness."""
_STEPS = 10
_LONGEST, _FARTHEST = 0.4, 1.5
"""Of a step, and of any log colour."""
_REMAINS = 0.1
"""Part of a channel that a highlight leaves: it is white, and takes no channel below what albedo remains."""


@dataclass(frozen=True)
class LightColours:
    """The colours of the parts of a light, whose mean over the surface is white.

    `lamps` (L, 3), `ambient` (3,) and `bounce` (3,) multiply the white parts, `harmonics` (8, 3) are added to
    the white ones. `cast` (M, 3) is the log colour, at the nodes, of light that no part stands for.
    """

    lamps: FloatArray
    step: PlanStep
    ambient: FloatArray = field(default_factory=lambda: np.ones(3))
    harmonics: FloatArray = field(default_factory=lambda: np.zeros((HARMONICS, 3)))
    bounce: FloatArray = field(default_factory=lambda: np.ones(3))
    cast: FloatArray = field(default_factory=lambda: np.zeros((1, 3)))

    @classmethod
    def white(
        cls, lamps: int, reason: str = "white by the model", evidence: str = "", nodes: int = 1
    ) -> LightColours:
        """Return white light of so many lamps, and why it is white."""
        return cls(np.ones((lamps, 3)), PlanStep(STAGE, False, reason, evidence), cast=np.zeros((nodes, 3)))

    def in_order(self, order: IntArray) -> LightColours:
        """Return the colours with the lamps in another order (L,)."""
        return replace(self, lamps=self.lamps[order])


@dataclass(frozen=True)
class _Channel:
    """One channel's log colours of the lamps and harmonics, its tint, its cast at the nodes, and the odds."""

    lamps: FloatArray
    harmonics: FloatArray
    tint: float
    cast: FloatArray
    gain: float
    log_odds: float


def light_colours(point: Point, choice: bool | None) -> LightColours:
    """Solve the colours of the light of a point, each channel beside the brightest one.

        log T_c / T_0 = offset + m_c + M u_c + log I_c / I_0

    with the prior of log ratios on the nodes, lamps of any colour near the ambient light's, and bounced light
    of the colour of the surface. Light of one colour cannot be distinguished from pigment: the offset is free
    and the mean light white. `choice` False leaves colour out.
    """
    problem, count, nodes = point.problem, point.model.lights, len(point.problem.field.used)
    color = problem.level.color
    if choice is False:
        return LightColours.white(count, "left out by the caller", nodes=nodes)
    if not np.ptp(color, axis=1).any():
        return LightColours.white(count, "the picture is grey", "no colour", nodes)
    below = np.maximum(color - point.specular[:, None], _REMAINS * color)
    lead = problem.lead
    found = LightColours.white(count, nodes=nodes)
    odds = 0.0
    for number, c in enumerate([c for c in range(3) if c != lead], 1):
        channel = _solved(point, below[:, c], below[:, lead], number)
        gain = channel.gain
        state = point.model.soft(point.light_x)
        found.lamps[:, c] = gain * np.exp(channel.lamps)
        found.ambient[c] = gain
        found.harmonics[:, c] = gain * (state.harmonics + channel.harmonics) - state.harmonics
        found.bounce[c] = gain * channel.tint
        found.cast[:, c] = channel.cast
        odds += channel.log_odds
    reason = "the parts of the light have their own colours"
    return replace(found, step=PlanStep(STAGE, True, reason, f"log odds {odds:.1f}"))


def _solved(point: Point, value: FloatArray, leading: FloatArray, number: int) -> _Channel:
    """Solve one channel by Gauss-Newton steps; `number` is that of the prior's channel."""
    p, level, count = point.problem, point.problem.level, point.model.lights
    darkest = DARK * np.median(leading)
    log_ratio = np.log(np.maximum(value, darkest) / np.maximum(leading, darkest))
    tint = math.exp(float(np.median(log_ratio)))
    mean = p.prior.mean_at(p.places)[:, number]
    sigma = p.prior.deviation_at(p.places)[:, number]
    dark = DARK * np.median(value) / np.maximum(value, darkest)
    variance = (sigma**2 + NOISE**2 + dark**2) / cell_trust(level)
    covariance = p.field.of_used(p.prior.covariance(number)) + _CAST * p.field.light_covariance
    precision = cho_solve(cho_factor(covariance, lower=True), np.eye(len(covariance)))
    lamp, first, second = _COLOUR_SD
    deviation = np.array([lamp] * count + [first] * 3 + [second] * (HARMONICS - 3))
    prior, transfer = 1 / deviation**2, p.soft.transfer[:, 1:]
    bounced = point.bounced()
    x, offset = np.zeros(len(deviation)), float(np.median(log_ratio - mean))
    weight = 1 / (p.repeats * variance)
    for _ in range(_STEPS):
        lamps = point.lamps * np.exp(x[:count])[:, None]
        light = point.light + (lamps - point.lamps).sum(0) + transfer @ x[count:] + bounced * (tint - 1)
        light = np.maximum(light, DARKEST)
        left = log_ratio - mean - np.log(light / point.light) - offset
        slopes = np.column_stack([lamps.T, transfer]) / light[:, None]
        rows = np.column_stack([slopes, np.ones(len(left)), left])
        factor = posterior_factor(p.nodes, weight, precision)
        onto = p.onto_nodes @ (rows * weight[:, None])
        inner = rows.T @ (rows * weight[:, None]) - onto.T @ cho_solve(factor, onto, check_finite=False)
        matrix = inner[:-1, :-1] + np.diag(np.append(prior, 0.0))
        step = np.linalg.solve(matrix, inner[:-1, -1] - np.append(prior * x, 0.0))
        x = np.clip(x + np.clip(step[:-1], -_LONGEST, _LONGEST), -_FARTHEST, _FARTHEST)
        offset += float(step[-1])
        u = cho_solve(factor, onto[:, -1], check_finite=False)
        weight = robust_weights(left - p.nodes @ u, variance, p.repeats)
    cast = _CAST * p.field.light_covariance @ (precision @ u)
    change = light / point.light * np.exp(p.nodes @ cast)
    whole = np.average(point.light, weights=level.weight)
    gain = float(whole / np.average(point.light * change, weights=level.weight))
    # Of the colours' posterior and prior where there is none (Dickey, see `light_priors.parts_steps`).
    own = matrix[:-1, :-1]
    log_odds = 0.5 * (float(x @ own @ x) - float(np.linalg.slogdet(own)[1]) + float(np.log(prior).sum()))
    return _Channel(x[:count], x[count:], tint, cast, gain, log_odds)
