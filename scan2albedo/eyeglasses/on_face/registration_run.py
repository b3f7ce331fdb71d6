"""The stages of a frame's registration on a face, one after another."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import Budget, Meter, Plan, PlanStep
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.on_face.frame_motion import FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.head_contact import HeadContact
from scan2albedo.eyeglasses.on_face.outline_samples import FrameMesh, OutlineSampler
from scan2albedo.eyeglasses.on_face.registration_descent import ENOUGH, Descent, descend
from scan2albedo.eyeglasses.on_face.registration_inputs import RegistrationInputs
from scan2albedo.eyeglasses.on_face.registration_mirror import require_unmirrored
from scan2albedo.eyeglasses.on_face.registration_options import FaceRegistrationOptions
from scan2albedo.eyeglasses.on_face.registration_report import depth_open, mark_deviations, report
from scan2albedo.eyeglasses.on_face.registration_result import RegisteredEyeglasses
from scan2albedo.eyeglasses.on_face.registration_start import starting_poses
from scan2albedo.eyeglasses.on_face.registration_terms import (
    RegistrationObjective,
    mean_outline_px,
    median_label_px,
)
from scan2albedo.eyeglasses.weighting.weights import solve_weights
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.geometry.thinning import thinned

FloatArray = NDArray[np.float64]

_ENOUGH_A_TRACE = 1e-3
"""Part of the cost below which an improvement ends a descent on one tracing of the outline."""
_STEPS_A_TRACE, _HASTY_STEPS = 6, 10
_DISAGREE = 2.0
"""Times by which outlines may raise the labels' error before they are taken for another picture's."""
_NEAR_MM = 40.0
"""Distance up to which a frame whose depth is not known may be drawn onto the nose."""
_OCCLUDER_MM, _HASTY_OCCLUDER_MM = 2.0, 4.0
"""Cells in which the head's vertices are joined: finer than 2 mm it hides the same and costs more; coarser
where the budget has ended."""
_STILL, _NO_LESS = 0.5, 2
"""Movement of the key points between two tracings at which the outlines have settled, in standard deviations
of what is still open about them; and how often it may get no less: tracing jumps from pixel to pixel."""


def _caster(given: RegistrationInputs, cell_mm: float) -> RayCaster | None:
    """Return what the head hides is asked of; None without a head."""
    if given.head is None:
        return None
    coarse = thinned(*given.head, cell_mm)
    return RayCaster(coarse.vertices, coarse.faces) if len(coarse.faces) else RayCaster(*given.head)


class RegistrationRun:
    """One registration: what its stages share.

    Parameters
    ----------
    given : RegistrationInputs
    options : FaceRegistrationOptions
    meter : Meter

    Raises
    ------
    EyeglassesError
        When the glasses' weights cannot be solved.
    """

    def __init__(self, given: RegistrationInputs, options: FaceRegistrationOptions, meter: Meter) -> None:
        self.given, self.options, self.meter = given, options, meter
        self.steps: list[PlanStep] = list(given.plan)
        self.weights = self._weights()
        self.bend_found = True
        self.objective = RegistrationObjective(given.keypoints, given.views, options)
        mesh = FrameMesh(SkinnedPoints(given.vertices, self.weights), given.faces)
        cell_mm = _HASTY_OCCLUDER_MM if meter.out_of_time else _OCCLUDER_MM
        self.sampler = OutlineSampler(mesh, given.views, _caster(given, cell_mm), options)

    def result(self) -> RegisteredEyeglasses:
        """Run the stages that the input asks for.

        Raises
        ------
        EyeglassesError
            When the labels fix no pose and there is no start, or left and right are exchanged.
        """
        outcome = self._outlined(self._rested(self._bent(self._placed())))
        return report(
            self.given,
            self.sampler,
            self.objective,
            outcome.state,
            outcome.at,
            converged=outcome.converged and not self.meter.out_of_time,
            bend_found=self.bend_found,
            meter=self.meter,
            plan=Plan(tuple(self.steps)),
        )

    def _note(self, step: str, ran: bool, reason: str, evidence: str = "") -> None:
        self.steps.append(PlanStep(f"{self.meter.stage}.{step}", ran, reason, evidence))

    def _weights(self) -> FloatArray:
        given = self.given
        if given.weights is not None:
            self._note("weights", False, "the glasses bring their own")
            return given.weights
        if not self.options.bend:
            self._note("weights", False, "the frame stays as it is")
            return np.eye(1, len(given.keypoints), int(np.argmax(given.known))).repeat(len(given.vertices), 0)
        seconds = self.meter.budget.seconds
        left = None if seconds is None else Budget(seconds=max(seconds - self.meter.elapsed_s, 1e-3))
        try:
            solved = solve_weights(
                given.vertices,
                given.faces,
                given.keypoints[given.known],
                budget=left,
                options=self.options.weights,
            )
        except EyeglassesError as error:
            raise EyeglassesError(f"the glasses' weights: {error}") from error
        self._note(
            "weights",
            True,
            "the glasses bring none",
            f"{solved.node_count} nodes, {self.meter.elapsed_s:.2f} s",
        )
        weights = np.zeros((len(given.vertices), len(given.keypoints)))
        weights[:, given.known] = solved.weights
        return weights

    def _placed(self) -> Descent:
        """The pose alone, from the best of several starts."""
        starts = starting_poses(
            self.given.keypoints, self.given.views, self.options.label_noise_px, self.given.start
        )
        rigid = partial(self.objective.linearize, samples=None, rigid=True)
        if not self.given.labelled:
            self._note("pose", False, "no key point is labelled: the start is taken as given")
            return Descent(starts[0], rigid(starts[0]), True)
        ranked = sorted(starts, key=lambda state: rigid(state).cost)
        self.meter.count(len(starts))
        found = self._descend("pose", rigid, ranked[0])
        self._note(
            "pose", True, f"the best of {len(starts)} starts, refined", f"{median_label_px(found.at):.2f} px"
        )
        here_px = median_label_px(found.at)
        # A descent that the budget cut short fits badly without being mirrored.
        if here_px > self.options.label_noise_px and not self.meter.exhausted:
            require_unmirrored(self.given, self.options, here_px)
        return found

    def _bent(self, before: Descent) -> Descent:
        if not self.options.bend:
            self._note("key_points", False, "the frame stays as it is: options.bend is off")
            return before
        if not self.given.labelled:
            self._note("key_points", False, "no key point is labelled")
            return before
        if self.meter.exhausted and not self.meter.out_of_time:
            self._note("key_points", False, "the budget has ended")
            self.bend_found = False
            return replace(before, converged=False)
        found = self._descend("key_points", partial(self.objective.linearize, samples=None), before.state)
        self._note(
            "key_points",
            True,
            "labels ask for a bend",
            f"{median_label_px(before.at):.2f} -> {median_label_px(found.at):.2f} px",
        )
        self.bend_found = not self.meter.exhausted or found.converged
        return found

    def _rested(self, before: Descent) -> Descent:
        """Rested on the nose where the labels do not tell how far away the frame is."""
        motion = self.objective.motion(before.state)
        depth = depth_open(self.given, motion, before.at)
        evidence = f"depth known to {depth:.1f} mm"
        if depth <= self.options.observed_mm:
            self._note("contact", False, "the views see depth", evidence)
            return before
        if self.given.head is None or not self.options.contact:
            self._note("contact", False, "there is no head to rest on, or options.contact is off", evidence)
            return before
        contact = HeadContact(self.sampler.mesh.points, *self.given.head)
        if not contact or self.meter.exhausted:
            self._note("contact", False, "the frame has no front, or the budget has ended", evidence)
            return before
        contact.face(motion, camera_centers(np.stack([view.camera for view in self.given.views])))
        contact.watch(motion)
        gap = abs(contact.touch(motion)[2])
        if gap > _NEAR_MM:
            self._note(
                "contact",
                False,
                "the head is not near the frame: is it in its frame and unit?",
                f"{gap:.0f} mm",
            )
            return before
        self.objective.contact = contact
        rigid = not self.options.bend
        found = self._descend(
            "contact", partial(self.objective.linearize, samples=None, rigid=rigid), before.state
        )
        contact.watch(self.objective.motion(found.state))
        self._note("contact", True, "the views do not see depth: the frame rests on the nose", evidence)
        return found

    def _outlined(self, before: Descent) -> Descent:
        if not any(view.distance is not None for view in self.given.views):
            self._note("outlines", False, "no view has a mask")
            return before
        if self.meter.exhausted:
            self._note("outlines", False, "the budget has ended")
            return replace(before, converged=False)
        outcome, first, rounds, settled = before, np.nan, 0, False
        # What labels leave open: outlines that have found a wrong place would call it certain.
        vague = mark_deviations(self.given, self.objective.motion(before.state), before.at)
        ways: list[float] = []
        # One clock for all tracings: the rows of a stage count from its start.
        meter = self.meter.child(f"{self.meter.stage}.outlines", "px")
        while rounds < self.options.outlines and not settled and not meter.exhausted:
            motion = self.objective.motion(outcome.state)
            samples = self.sampler.sample(motion, vague)
            if len(samples) == 0:
                self.meter.adopt(meter)
                reach = f"{self.options.outline_reach_px:g} px"
                self._note("outlines", False, "no outline of the frame is near a mask's", reach)
                return outcome
            found = descend(
                partial(self.objective.linearize, samples=samples, rigid=not self.options.bend),
                outcome.state,
                meter,
                steps=_STEPS_A_TRACE,
                enough=_ENOUGH_A_TRACE,
                error=mean_outline_px,
            )
            rounds += 1
            first = mean_outline_px(found.at) if rounds == 1 else first
            ways.append(self._moved(outcome.state, found))
            settled = (
                ways[-1] < _STILL or sum(way > min(ways[:i]) for i, way in enumerate(ways) if i) >= _NO_LESS
            )
            outcome = Descent(found.state, found.at, settled)
        self.meter.adopt(meter)
        self._note(
            "outlines", True, f"traced {rounds} times", f"{first:.2f} -> {mean_outline_px(outcome.at):.2f} px"
        )
        labels = median_label_px(before.at), median_label_px(outcome.at)
        if labels[1] > max(_DISAGREE * labels[0], self.options.label_noise_px):
            self._without_masks(f"labels {labels[0]:.1f} -> {labels[1]:.1f} px")
            return before
        return outcome

    def _without_masks(self, evidence: str) -> None:
        self._note("masks", False, "they disagree with the labels and are left aside", evidence)
        views = tuple(replace(view, distance=None) for view in self.given.views)
        self.given = replace(self.given, views=views)
        contact = self.objective.contact
        self.objective = RegistrationObjective(self.given.keypoints, views, self.options, contact)
        self.sampler = OutlineSampler(self.sampler.mesh, views, self.sampler.head, self.options)

    def _descend(self, step: str, linearize: Any, state: FrameState) -> Descent:
        child, steps = self.meter.child(f"{self.meter.stage}.{step}", "px"), self.options.steps
        if self.meter.out_of_time:
            # Labels alone cost next to nothing, and without them there is no answer.
            child, steps = replace(child, budget=Budget()), min(steps, _HASTY_STEPS)
        found = descend(linearize, state, child, steps=steps, enough=ENOUGH, error=median_label_px)
        self.meter.adopt(child)
        return found

    def _moved(self, before: FrameState, found: Descent) -> float:
        """Return the longest way of a key point between two states, in its standard deviations."""
        known = self.given.known
        places = []
        for state in (before, found.state):
            world = self.objective.motion(state).world_from_frame
            places.append(transform_points(world, self.given.keypoints[known] + state.shifts[known]))
        deviation = mark_deviations(self.given, self.objective.motion(found.state), found.at)[known]
        return float((np.linalg.norm(places[1] - places[0], axis=1) / deviation).max())
