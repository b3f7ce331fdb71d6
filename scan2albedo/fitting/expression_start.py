"""Where a model starts to bend: its mouth opened and its corners drawn back as the scan's are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scan2albedo.fitting.mouth_corners import CornerJudge, MouthCorners
from scan2albedo.fitting.mouth_opening import MouthSearch
from scan2albedo.fitting.stages import Deformation, run_stages

FloatArray = NDArray[np.float64]

MOUTH_LEVEL = 1
MOUTH_STAGES = 2
MOUTH_STEPS = 5
"""A trial's stages and its steps in each; longer ones tell the candidates apart no better."""


def mouth_opened(deformation: Deformation) -> Deformation:
    """Return the deformation that starts from the mouth opened as the scan's is.

    Each candidate of `MouthSearch` runs through the first, stiffest stages; trials count as evaluations
    but leave no rows in the trace.
    """
    scan, meter = deformation.scan, deformation.meter
    if meter.exhausted:
        return deformation
    search = MouthSearch.of(deformation.model, deformation.reference, scan, MOUTH_LEVEL)
    if len(search.candidates) == 1:
        return deformation
    reached = []
    for reference in search.candidates:
        if meter.exhausted:
            return deformation
        reached.append(_coarsely_fitted(deformation, reference))
    return replace(deformation, reference=search.candidates[search.best(scan, reached)])


def corners_pulled(deformation: Deformation) -> Deformation:
    """Return the deformation that starts from the corners of the mouth drawn back as the scan's are."""
    reference, meter = deformation.reference, deformation.meter
    if meter.exhausted:
        return deformation
    corners = MouthCorners.of(deformation.model, reference)
    if corners is None:
        return deformation
    judge = CornerJudge.of(deformation.model, reference, deformation.scan, MOUTH_LEVEL)
    pulls = judge.worth_a_trial(reference, corners)
    if not pulls:
        return deformation
    reached = {}
    for mm in (0.0, *pulls):
        if meter.exhausted:
            return deformation
        reached[mm] = _coarsely_fitted(deformation, corners.pulled(reference, (mm, mm)))
    return replace(deformation, reference=corners.pulled(reference, judge.chosen(reached)))


def _coarsely_fitted(deformation: Deformation, reference: FloatArray) -> FloatArray:
    """Return the control points (C, 3) after the first stages from `reference`; counted, but not recorded."""
    options = replace(deformation.options, steps=min(deformation.options.steps, MOUTH_STEPS))
    meter = deformation.meter.unseen_child()
    trial = replace(deformation, reference=reference, options=options, meter=meter)
    outcome = run_stages(trial, MOUTH_STAGES)
    deformation.meter.count(meter.evaluations)
    return reference + outcome.q
