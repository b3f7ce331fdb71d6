"""Intervals of vertices under light that the face throws on itself, traced by Mitsuba, without and with it.

Heads, pale and dark, of 54 pictures; six bounces, none in the last rows. Of each number of pairs, drawn at
random: the fit without bounced light in its model ("before") and with it ("after"), for each channel of
identified albedos: part of the 95 % intervals that hold the truth, with the truth below and above them, and
the median of the relative difference. `part` is how much bounced light was found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds.traced_captures import DISTANCE_MM, MitsubaCapture, Skin, mitsuba_capture

from benchmarks.reflectance_heads import LEAST_PAIRS
from scan2albedo.core.arrays import FloatArray
from scan2albedo.reflectance import ReflectanceFit, ReflectanceFitOptions, fit_reflectance, sample_vertices

SKINS: dict[str, Skin] = {"pale": (0.69, 0.50, 0.42), "dark": (0.15, 0.10, 0.075)}
PAIRS = (3, 5, 10, 20, 50)


def interval_figures(capture: MitsubaCapture, fit: ReflectanceFit) -> FloatArray:
    """Return (3, 4) of identified albedos: covered, truth below, truth above, median relative error."""
    figures = np.empty((3, 4))
    for k in range(3):
        sure = fit.identified[:, k]
        truth, found = capture.truth.diffuse_linear[sure, k], fit.reflectance.diffuse_linear[sure, k]
        below, above = truth < fit.low[sure, k], truth > fit.high[sure, k]
        off = np.median(np.abs(found / truth - 1))
        figures[k] = 1 - below.mean() - above.mean(), below.mean(), above.mean(), off
    return figures


def bounce_fits(capture: MitsubaCapture, pairs: int, seed: int = 0) -> tuple[ReflectanceFit, ReflectanceFit]:
    """Return the fits without and with bounced light to so many pairs, drawn at random."""
    samples = sample_vertices(
        capture.olat, capture.rig, capture.vertices, capture.faces, reference_distance_mm=DISTANCE_MM
    )
    drawn = np.random.default_rng(seed).permutation(len(capture.view))[:pairs]
    samples = replace(samples, lobes=capture.strength * samples.lobes).of_pairs(np.sort(drawn))
    options = ReflectanceFitOptions(least_pairs=LEAST_PAIRS, most_albedo=1.0)
    without = fit_reflectance(replace(samples, form_factors=None), options=options)
    return without, fit_reflectance(samples, options=options)


def print_bounce(size: int, heads: tuple[str, ...] = ("person1", "person2")) -> None:
    """Print the table of every head, skin and number of pairs."""
    print(f"{'':34s}  part" + "".join(f"  {c}: cover  below  above  error" for c in "RGB"))
    cases = [(head, skin, True) for head in heads for skin in SKINS] + [(heads[0], "pale", False)]
    for head, skin, bounces in cases:
        capture = mitsuba_capture(
            head, views=6, flashes=9, size=size, bounces=bounces, skin=SKINS[skin], rays=64
        )
        for pairs in PAIRS:
            for name, fit in zip(("before", "after"), bounce_fits(capture, pairs), strict=True):
                what = f"{head} {skin}{'' if bounces else ', none'}, {pairs} pairs {name}"
                part = fit.bounce_albedo[0] / SKINS[skin][0]
                cells = (
                    "     {:5.3f}  {:5.3f}  {:5.3f}  {:5.3f}".format(*x)
                    for x in interval_figures(capture, fit)
                )
                print(f"{what:34s} {part:5.2f}" + "".join(cells), flush=True)
