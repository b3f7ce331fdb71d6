"""The colours of a light's parts, from how the ratios of the channels change over the surface."""

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.linalg import block_diag, cho_factor

from scan2albedo.albedo.light_parameters import HARMONICS
from scan2albedo.albedo.node_field import inverse, posterior_factor, solved
from scan2albedo.albedo.posterior import EXTRA, NOISE, Point, Posterior, cell_trust, robust_weights
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import FloatArray, IntArray

STAGE = "albedo.light_colour"
_COLOUR_SD = 0.5, 0.1, 0.05
"""Standard deviations of the log of a lamp's colour beside that of the ambient light, one channel to the
next, and of colour in the harmonics of orders 1 and 2: log blue / red differs by 1.2 from daylight (6500 K)
to a bulb's light (2700 K), and by 0.5 (root mean square) in two lights evenly in between."""
_TINT_SD = (0.045, 0.089), (-0.027, 0.013)
"""Standard deviations of log green / red and log blue / red of the mean light, along the locus of black
bodies and daylight and across: white balance errs by two degrees [1]_.

.. [1] D. Cheng, D. Prasad, M. Brown, "Illuminant estimation for color constancy: why spatial-domain methods
   work and the role of the color distribution", JOSA A 31(5), 2014.
"""
CAST = 0.3
"""Variance of the colour of light that no part stands for, as a part of that of its brightness."""


@dataclass(frozen=True)
class LightColours:
    """The colours of the parts of a light.

    `lamps` (L, 3), `ambient` (3,) and `bounce` (3,) multiply the white parts, `harmonics` (8, 3) are added to
    the white ones. `cast` (M, 3) is the log colour, at the nodes, of light that no part stands for. `gloss`
    is what multiplies the strength of the highlights, which have their lamps' colours.
    """

    lamps: FloatArray
    step: PlanStep
    ambient: FloatArray = field(default_factory=lambda: np.ones(3))
    harmonics: FloatArray = field(default_factory=lambda: np.zeros((HARMONICS, 3)))
    bounce: FloatArray = field(default_factory=lambda: np.ones(3))
    cast: FloatArray = field(default_factory=lambda: np.zeros((1, 3)))
    gloss: float = 1.0

    @classmethod
    def white(cls, lamps: int, reason: str = "white", evidence: str = "", nodes: int = 1) -> Self:
        """Return white light of so many lamps, and why it is white."""
        return cls(np.ones((lamps, 3)), PlanStep(STAGE, False, reason, evidence), cast=np.zeros((nodes, 3)))


def light_colours(point: Point, choice: bool | None) -> LightColours:
    """Solve the colours of the light of a point, two channels beside the brightest one.

        T_c / T_0 = (q_c exp(t_c) I_c / I_0 + g k_c) / (1 + g),   log q_c = o_c + m_c + M u_c

    with the prior of log ratios m, u on the nodes and o of a person; lamps of any colour near the ambient
    light's, I_c / I_0 being 1 on average; bounced light of the colour of the surface; the highlights' ratio g
    to the rest of the brightest channel, in the colours k of the lamps, as strong as the search has it for
    skin of the picture's colour, weaker where o is that of paler skin; and the tint t of all light. Light of
    one colour is told from pigment by what is known of both, and by highlights. `choice` False leaves it out.
    """
    count, nodes = point.model.lights, len(point.problem.field.used)
    color = point.problem.level.color
    if choice is False:
        return LightColours.white(count, "left out by the caller", nodes=nodes)
    if not np.ptp(color, axis=1).any():
        return LightColours.white(count, "the picture is grey", "no colour", nodes)
    colours = _Colours(point)
    for _ in range(10):
        colours.step()
    return colours.found()


class _Colours:
    """The posterior of x: log colours of lamps and harmonics by channel, o and t of both, and log strength of
    the highlights. `known` and `expected` are the precision and the mean of their prior.
    """

    def __init__(self, point: Point) -> None:
        self.point, p, self.lamps = point, point.problem, point.model.lights
        self.channels = [c for c in range(3) if c != p.lead]
        # Log ratios to red, which the prior knows, become those to the leading channel.
        change = (np.eye(3)[self.channels] - np.eye(3)[p.lead])[:, 1:]
        self.ratios = [_Ratio(point, c, row) for c, row in zip(self.channels, change, strict=True)]
        deviation = np.repeat(_COLOUR_SD, [self.lamps, 3, HARMONICS - 3])
        tint = np.transpose(_TINT_SD) @ np.array(_TINT_SD)
        both = [np.linalg.inv(change @ part @ change.T) for part in (p.prior.chroma[1:], tint)]
        scale, likeness = point.x[-EXTRA:]
        whole = point.light * np.exp(scale + likeness * p.mean + p.nodes @ point.u)
        self.gloss, strength_sd = point.highlights / whole, NOISE
        if self.gloss.any():
            at = point.model.slices["specular"].start
            strength_sd = min(math.sqrt(point.covariance()[at, at]) / point.x[at], 1.0)
        # Log strength follows the level of the pigment's colour, not that of the picture's.
        tie = np.eye(2 * len(deviation) + 5)
        tie[-1, -5:-3] = p.prior.level[1] * np.linalg.inv(change)[0] * self.gloss.any()
        self.known = tie.T @ block_diag(np.diag(np.tile(deviation**-2.0, 2)), *both, strength_sd**-2) @ tie
        seen = [np.median(ratio.log - ratio.mean) for ratio in self.ratios]
        prior_mean = change @ p.prior.chroma[0]
        none = np.zeros(2 * len(deviation))
        self.expected = np.r_[none, prior_mean, 0.0, 0.0, tie[-1, -5:-3] @ (seen - prior_mean)]
        self.x, self.precision = np.r_[none, seen, np.zeros(3)], self.known

    def at(self, number: int) -> IntArray:
        """Return the places in x of one of the two channels: parts, o, t and the highlights' strength."""
        size, parts = len(self.x), (len(self.x) - 5) // 2
        return np.r_[number * parts : (number + 1) * parts, size - 5 + number, size - 3 + number, size - 1]

    def light(self, x: FloatArray) -> tuple[FloatArray, float]:
        """Return (N,) the untinted light of the channel whose parts, o, ... are x, and its mean by I's."""
        point, weights = self.point, self.point.problem.level.weight
        light = point.light + np.expm1(x[: self.lamps]) @ point.lamps + point.bounced() * math.expm1(x[-3])
        light = np.maximum(light + point.problem.soft.transfer[:, 1:] @ x[self.lamps : -3], DARKEST)
        return light, float(np.average(light, weights=weights) / np.average(point.light, weights=weights))

    def step(self) -> None:
        """Take one step of Gauss and Newton; the nodes' fields and the robust weights follow."""
        p, point = self.point.problem, self.point
        matrix, slope = self.known.copy(), self.known @ (self.expected - self.x)
        for number, ratio in enumerate(self.ratios):
            at = self.at(number)
            x = self.x[at]
            colors, (light, white) = np.exp(x[: self.lamps]), self.light(x)
            relative = light / point.light / white
            gloss, own = np.vstack([np.ones(self.lamps), colors / white]) @ self.gloss * math.exp(x[-1])
            own /= np.exp(x[-3] + ratio.mean) * relative
            left = ratio.log - ratio.mean - x[-3] - x[-2] - np.log(relative * (1 + own) / (1 + gloss))
            parts = np.column_stack([point.lamps.T * colors, p.soft.transfer[:, 1:]]) / light[:, None]
            parts -= np.average(parts, weights=p.level.weight * light, axis=0)
            seen = 1 / (1 + own[:, None])
            rows = [parts * seen, seen, np.ones_like(seen), 1 / (1 + gloss[:, None]) - seen, left[:, None]]
            inner = ratio.reduced(p, np.hstack(rows))
            matrix[np.ix_(at, at)] += inner[:-1, :-1]
            slope[at] += inner[:-1, -1]
        self.x = self.x + np.clip(np.linalg.solve(matrix, slope), -1, 1)
        self.precision = matrix

    def found(self) -> LightColours:
        """Return the colours, and the log odds for them."""
        point, p = self.point, self.point.problem
        found = LightColours.white(self.lamps, nodes=len(p.field.used))
        _, _, waves = point.model.soft(point.light_x)
        for number, (c, ratio) in enumerate(zip(self.channels, self.ratios, strict=True)):
            x = self.x[self.at(number)]
            light, white = self.light(x)
            cast = CAST * p.field.light_covariance @ (ratio.precision @ ratio.u)
            gain = math.exp(x[-2]) / white
            gain /= float(np.average(np.exp(p.nodes @ cast), weights=light * p.level.weight))
            found.lamps[:, c] = gain * np.exp(x[: self.lamps])
            found.ambient[c], found.bounce[c] = gain, gain * math.exp(x[-3])
            found.harmonics[:, c] = gain * (waves + x[self.lamps : -3]) - waves
            found.cast[:, c] = cast
        # Of the colours' posterior and prior where there is none (Dickey, see `light_priors.parts_steps`).
        at = np.r_[: len(self.x) - 5, -3, -2]
        x, own = self.x[at], np.linalg.inv(np.linalg.inv(self.precision)[np.ix_(at, at)])
        before = np.linalg.slogdet(self.known[np.ix_(at, at)])[1]
        odds = float(x @ own @ x - np.linalg.slogdet(own)[1] + before) / 2
        step = PlanStep(STAGE, True, "the parts of the light have their own colours", f"log odds {odds:.1f}")
        return replace(found, step=step, gloss=math.exp(self.x[-1]))


class _Ratio:
    """A channel beside the leading one: its log ratio, what is known of it, and the nodes' field `u` (M,).

    It is the sum of log ratios to red by their signs (2,).
    """

    def __init__(self, point: Point, channel: int, signs: FloatArray) -> None:
        p, level = point.problem, point.problem.level
        value, leading = level.color[:, channel], level.color[:, p.lead]
        least = NOISE * np.median(leading)
        self.log = np.log(np.maximum(value, least) / np.maximum(leading, least))
        self.mean = p.prior.mean_at(p.places)[:, 1:] @ signs
        dark = NOISE * np.median(value) / np.maximum(value, least)
        grain = p.prior.deviation_at(p.places)[:, 1:] ** 2 @ signs**2
        self.variance = (grain + NOISE**2 + dark**2) / cell_trust(level)
        fields = [s**2 * p.field.of_used(p.prior.covariance(n)) for n, s in enumerate(signs, 1)]
        covariance = np.add(*fields) + CAST * p.field.light_covariance
        self.precision = inverse(cho_factor(covariance, lower=True)[0])
        self.weight = 1 / (p.repeats * self.variance)
        self.u = np.zeros(len(covariance))

    def reduced(self, p: Posterior, rows: FloatArray) -> FloatArray:
        """Return (K, K) the products of `rows` (N, K), weighted, with the nodes' field taken out of them.

        The last column is what is left: the field and the weights for the next step come from it.
        """
        weighted = rows * self.weight[:, None]
        onto = p.onto_nodes @ weighted
        fields = solved(posterior_factor(p.nodes, self.weight, self.precision), onto)
        self.u = fields[:, -1]
        self.weight = robust_weights(rows[:, -1] - p.nodes @ self.u, self.variance, p.repeats)
        return rows.T @ weighted - onto.T @ fields
