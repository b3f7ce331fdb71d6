"""Glasses registered on a face from key points and masks in calibrated views (supplement, section S3)."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from scan2albedo.core import Budget, BudgetLike, Meter, OnProgress, Plan, PlanStep
from scan2albedo.core.arrays import ArrayLike, GridShape, norms
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses.mean_keypoints import BEHIND
from scan2albedo.eyeglasses.on_face import inputs, objective, outline, start_poses
from scan2albedo.eyeglasses.on_face.frame_motion import FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.inputs import FaceRegistrationOptions, RegisteredEyeglasses
from scan2albedo.eyeglasses.on_face.lens_panes import fit_lenses_to_masks
from scan2albedo.eyeglasses.on_face.objective import FrameEstimate, RegistrationObjective, descend
from scan2albedo.eyeglasses.on_face.report import WORN_MM, depth_open, mark_deviations, report
from scan2albedo.eyeglasses.weights import solve_weights
from scan2albedo.geometry.mesh import thinned
from scan2albedo.geometry.pinhole import camera_centers, project
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import transform_points

_RESOLUTION_MM = 2.0
"""Deviation of depth up to which a frame need not rest on the nose; cells that join the head's vertices."""

_FOUND = 0.9
"""Share of the front's outline from which a frame counts as found in pictures: they show .96 and more of one
that is there, .4 to .77 where the frame was painted out."""


def register_on_face(
    glasses: Any,
    keypoints_2d: ArrayLike,
    masks: Sequence[ArrayLike | None] | ArrayLike | None,
    cameras: ArrayLike,
    budget: BudgetLike = None,
    *,
    head: Any | None = None,
    start: ArrayLike | None = None,
    shapes: Sequence[GridShape] | None = None,
    pictures: Sequence[ArrayLike | None] | None = None,
    options: FaceRegistrationOptions = FaceRegistrationOptions(),
    on_progress: OnProgress = None,
) -> RegisteredEyeglasses:
    """Return a frame placed where calibrated pictures show it, bent as they show it.

    Minimises over the frame's pose and the shifts of its key points

        sum rho(project(x_k) - l_ck) + sum rho(n_i . (project(y_i) - edge_i)) + bend's prior,

    l_ck the labels, y_i the points that make the frame's outline in a view, edge_i where its mask ends along
    the outline's normal n_i; first the pose alone on the labels, then bent, then with the outlines. Raises
    EyeglassesError when labels fix no pose, lie outside their pictures, or have left and right exchanged,
    units differ, weights cannot be solved, or numbers are not finite; ValueError when shapes do not fit.

    Parameters
    ----------
    glasses : object or tuple
        With attributes vertices (V, 3), faces (F, 3), keypoints (20, 3), NaN for those that it lacks, and
        maybe weights (V, 20), such as `CanonicalEyeglasses`; or a tuple of these, in the cameras' unit.
    keypoints_2d : (C, 20, 2) array_like of float
        Labels in pixels (column, row), centres of pixels at integers; NaN for missing ones.
    masks : sequence of C (H, W) array_like, or None
        Nonzero where a view shows the frame, with lenses or without, whether the mesh has them or not. None,
        also for a single view, where there is no segmentation. Empty or against labels, it does not count.
    cameras : (C, 3, 4) array_like of float
        Projection matrices of any scale and sign.
    budget, on_progress : optional
        Seconds, or evaluations of the objective. When it ends the best pose and bend so far are returned;
        labels are always used; called with each row of the trace.
    head : optional
        What may hide the frame, such as the fitted face: an object with vertices and faces, or a tuple of
        them, in the cameras' frame.
    start : (4, 4) array_like, optional
        `world_from_glasses`, about; needed only where the labels fix no pose, and there is no head in the
        face model's frame with pictures or masks, on which the frame is put otherwise.
    shapes : sequence of C (H, W), optional
        Of the pictures: where a view has no mask, they determine which of the frame's points lie outside.
    pictures : sequence of C (H, W, 3) array_like, or None, optional
        Photographs, in sRGB values; of views without a mask they show where the frame ends, and
        `proposed_labels` and `proposed_masks` of the result come from them.
    options : FaceRegistrationOptions

    Notes
    -----
    Deviations hold for a mesh true to about a percent, labels that miss the key point alike in all views
    (0.5 mm) and masks too wide or too narrow throughout (1 px). Li et al. (supplement, equation S3) minimise
    a rendered segmentation with Adam in some thousand renderings; this takes about a hundred evaluations.
    """
    meter = Meter("glasses", "px", budget, on_progress)
    checked = inputs.checked_inputs(glasses, keypoints_2d, masks, cameras, head, start, shapes, pictures)
    with threadpool_limits(1, "blas"):
        # Matrices of 66 rows: more threads only wait for each other.
        return _Registration(checked, options, meter).run()


class _Registration:
    """One registration: what its stages share."""

    def __init__(
        self, checked: inputs.RegistrationInputs, options: FaceRegistrationOptions, meter: Meter
    ) -> None:
        self.inputs, self.options, self.meter = checked, options, meter
        self.steps = list(checked.plan)
        self.bend_found = True
        self.unseen: FrameEstimate | None = None
        self.objective = RegistrationObjective(checked.keypoints, checked.views, options)
        if checked.weights is not None:
            self._note("weights", False, "the glasses bring their own")
            weights = checked.weights
        elif not options.bend:
            self._note("weights", False, "the frame stays as it is")
            weights = np.eye(1, len(checked.keypoints), int(np.argmax(checked.known)))
            weights = weights.repeat(len(checked.vertices), 0)
        else:
            seconds = meter.budget.seconds
            left = None if seconds is None else Budget(seconds=max(seconds - meter.elapsed_s, 1e-3))
            with errors_of("the glasses' weights", EyeglassesError):
                solved = solve_weights(
                    checked.vertices, checked.faces, checked.keypoints[checked.known], budget=left
                )
            evidence = f"{solved.node_count} nodes, {meter.elapsed_s:.2f} s"
            self._note("weights", True, "the glasses bring none", evidence)
            weights = np.zeros((len(checked.vertices), len(checked.keypoints)))
            weights[:, checked.known] = solved.weights
        mesh = outline.FrameMesh(SkinnedPoints(checked.vertices, weights), checked.faces)
        occluder = None
        if checked.head is not None:
            coarse = thinned(*checked.head, _RESOLUTION_MM)
            occluder = RayCaster(*((coarse.vertices, coarse.faces) if len(coarse.faces) else checked.head))
        self.sampler = outline.OutlineSampler(mesh, checked.views, occluder)

    def run(self) -> RegisteredEyeglasses:
        found = self._match_outlines(self._rest_on_nose(self._bend(self._find_pose())))
        found = replace(found, converged=found.converged and not self.meter.out_of_time)
        rest: Any = {"bend_found": self.bend_found, "meter": self.meter, "plan": Plan(tuple(self.steps))}
        return report(self.inputs, self.sampler, self.objective, found, **rest)

    def _note(self, step: str, ran: bool, reason: str, evidence: str = "") -> None:
        self.steps.append(PlanStep(f"{self.meter.stage}.{step}", ran, reason, evidence))

    def _find_pose(self) -> FrameEstimate:
        checked, options = self.inputs, self.options
        rigid = partial(self.objective.linearize, samples=None, rigid=True)
        if not checked.labelled:
            if checked.start is None:
                starts, where = start_poses.poses_on_face(checked), "the head puts it on its nose"
            else:
                starts = start_poses.states_of([checked.start], checked.keypoints)
                where = "the start is taken as given"
            self._note("pose", False, f"no key point is labelled: {where}")
            unseen = FrameEstimate(starts[len(starts) // 2], rigid(starts[len(starts) // 2]), True)
            self._look_at_pictures(unseen.state)
            if not self._seen_in_pictures:
                return unseen
            self.unseen = unseen
            seen = checked.keypoints, self.objective.views, self.sampler.head
            state, spread_mm, gain = start_poses.place_in_pictures(starts, self.sampler.mesh, *seen)
            evidence = f"{gain:.0f} nats a view; known to {', '.join(f'{s:.1f}' for s in spread_mm)} mm"
            self._note("pictures", True, "placed where its projection parts the colours best", evidence)
            return FrameEstimate(state, rigid(state), True)
        starts = start_poses.starting_poses(
            checked.keypoints, checked.views, options.label_noise_px, checked.start
        )
        self.meter.count(len(starts))
        found = self._fit_labels("pose", rigid, min(starts, key=lambda state: rigid(state).cost))
        error_px = found.at.median_label_px
        self._note("pose", True, f"the best of {len(starts)} starts, refined", f"{error_px:.2f} px")
        # A descent that the budget cut short fits badly without being mirrored.
        if error_px > options.label_noise_px and not self.meter.exhausted:
            start_poses.require_unmirrored(checked, options, error_px)
        return found

    @property
    def _seen_in_pictures(self) -> bool:
        return any(view.colors is not None for view in self.inputs.views)

    def _look_at_pictures(self, state: FrameState) -> None:
        """Let pictures stand in for masks, their colours grouped around where the frame is about."""
        motion, views = self.objective.motion(state), []
        place = motion.positions(self.sampler.mesh.points)
        for view, picture in zip(self.inputs.views, self.inputs.pictures, strict=True):
            colors = None
            if view.distance is None and picture is not None:
                colors = outline.grouped_colors(picture, project(view.camera, place)[0])
            views.append(replace(view, colors=colors))
        self._watch(tuple(views))

    def _unfound(self, evidence: str) -> FrameEstimate | None:
        """Leave pictures aside that do not show the frame; return where it was before they were looked at."""
        reason = "the frame is not found in the pictures: nothing is proposed; label key points"
        self.steps.append(PlanStep.doubt("glasses.pictures", reason, evidence))
        self._watch(tuple(replace(view, colors=None) for view in self.inputs.views))
        return self.unseen

    def _watch(self, views: tuple[outline.ObservedView, ...]) -> None:
        """Take other views from here on."""
        keypoints, contact = self.inputs.keypoints, self.objective.contact
        self.inputs = replace(self.inputs, views=views)
        self.objective = RegistrationObjective(keypoints, views, self.options, contact)
        self.sampler = replace(self.sampler, views=views)

    def _bend(self, before: FrameEstimate) -> FrameEstimate:
        if not (self.options.bend and self.inputs.labelled):
            why = "no key point is labelled" if self.options.bend else "the frame stays as it is"
            self._note("key_points", False, why)
            return before
        if self.meter.exhausted and not self.meter.out_of_time:
            self._note("key_points", False, "the budget has ended")
            self.bend_found = False
            return replace(before, converged=False)
        found = self._fit_labels("key_points", partial(self.objective.linearize, samples=None), before.state)
        evidence = f"{before.at.median_label_px:.2f} -> {found.at.median_label_px:.2f} px"
        self._note("key_points", True, "labels ask for a bend", evidence)
        self.bend_found = found.converged or not self.meter.exhausted
        return found

    def _rest_on_nose(self, before: FrameEstimate) -> FrameEstimate:
        motion = self.objective.motion(before.state)
        depth = depth_open(self.inputs, motion, before.at)
        evidence = f"depth known to {depth:.1f} mm"
        if depth <= _RESOLUTION_MM or self.inputs.head is None:
            reason = "the views see depth" if depth <= _RESOLUTION_MM else "there is no head to rest on"
            self._note("contact", False, reason, evidence)
            return before
        contact = objective.HeadContact(self.sampler.mesh.points, *self.inputs.head)
        if not contact or self.meter.exhausted:
            self._note("contact", False, "the frame has no front, or the budget has ended", evidence)
            return before
        contact.orient(motion, camera_centers(np.stack([view.camera for view in self.inputs.views])))
        contact.select_candidates(motion)
        gap = abs(contact.nearest_point(motion)[2])
        if gap > WORN_MM:
            reason = "the head is not near the frame: is it in its frame and unit?"
            self._note("contact", False, reason, f"{gap:.0f} mm")
            return before
        self.objective.contact = contact
        linearize = partial(self.objective.linearize, samples=None, rigid=not self.options.bend)
        found = self._fit_labels("contact", linearize, before.state)
        contact.select_candidates(self.objective.motion(found.state))
        self._note("contact", True, "the views do not see depth: the frame rests on the nose", evidence)
        return found

    def _fit_labels(self, step: str, linearize: Any, state: FrameState) -> FrameEstimate:
        """Descend on labels alone, without a deadline: it takes little, and without it there is no answer."""
        child = self.meter.sub_meter(f"{self.meter.stage}.{step}", "px")
        child.budget = replace(child.budget, seconds=None)
        found = descend(linearize, state, child, error="median_label_px")
        self.meter.merge(child)
        return found

    def _show_lenses(self, state: FrameState) -> None:
        """Take lenses out of the outline, or put them in, as each view's mask shows them."""
        motion, views = self.objective.motion(state), self.inputs.views
        masks = [m if v.distance is not None else None for v, m in zip(views, self.inputs.masks, strict=True)]
        for number, view in enumerate(views):
            if view.colors is not None:
                masks[number] = outline.color_odds(view.colors, self.sampler.mask(motion, number)[0]) > 0
        cameras = [view.camera for view in views]
        sampler = self.sampler
        mesh, shown, steps = fit_lenses_to_masks(sampler.mesh, motion, cameras, masks, sampler.head)
        self.steps += steps
        self.sampler = replace(sampler, mesh=mesh, shown=shown)

    def _match_outlines(self, before: FrameEstimate) -> FrameEstimate:
        if self.inputs.labelled and any(picture is not None for picture in self.inputs.pictures):
            self._look_at_pictures(before.state)
        if not any(view.outlined for view in self.inputs.views):
            self._note("outlines", False, "no view has a mask or a picture")
            return before
        if self.meter.exhausted:
            self._note("outlines", False, "the budget has ended")
            return replace(before, converged=False)
        self._show_lenses(before.state)
        views = self.inputs.views
        found, first, settled = before, np.nan, False
        moves: list[float] = []
        known = self.inputs.known
        motion = self.objective.motion(before.state)
        # What labels leave open: outlines that have found a wrong place would call it certain.
        deviation_mm = mark_deviations(self.inputs, motion, before.at)
        if not self.inputs.labelled and self._seen_in_pictures:
            lever = norms(np.nan_to_num(self.inputs.keypoints - motion.center))
            # Half the step between the slopes that were tried.
            deviation_mm = np.diff(start_poses.LEANS_RAD).max() / 2 * lever
        # One clock for all tracings: the rows of a stage count from its start.
        meter = self.meter.sub_meter(f"{self.meter.stage}.outlines", "px")
        while len(moves) < 10 and not settled and not meter.exhausted:
            samples = self.sampler.sample(self.objective.motion(found.state), deviation_mm)
            if len(samples) == 0:
                self.meter.merge(meter)
                reach = f"{outline.REACH_PX:g} px"
                self._note("outlines", False, "no outline of the frame is near a mask's", reach)
                lost = self._unfound(reach) if self._seen_in_pictures else None
                return lost or found
            start = found.state
            # Without labels the first outlines may be beside the true ones: bends would follow them.
            rigid = not (self.options.bend and (self.inputs.labelled or len(moves) > 2))
            linearize = partial(self.objective.linearize, samples=samples, rigid=rigid)
            found = descend(linearize, start, meter, steps=6, tolerance=1e-3, error="mean_outline_px")
            moved = self.objective.motion(found.state)
            first = found.at.mean_outline_px if not moves else first
            if not self.inputs.labelled and self.options.bend:
                # What is open to bends so far is looked for farther away.
                at = self.objective.linearize(found.state, samples)
                deviation_mm = mark_deviations(self.inputs, moved, at)
            # The longest way of a key point, in its standard deviations: half of one has settled. It may
            # grow once, for tracing jumps from pixel to pixel.
            places = []
            for state in (start, found.state):
                world = self.objective.motion(state).world_from_frame
                places.append(transform_points(world, self.inputs.keypoints[known] + state.shifts[known]))
            deviation = mark_deviations(self.inputs, moved, found.at)[known]
            moves.append((norms(places[1] - places[0]) / deviation).max())
            increases = sum(move > min(moves[:i]) for i, move in enumerate(moves) if i)
            settled = (moves[-1] < 0.5 or increases > 1) and rigid != self.options.bend
            found = replace(found, converged=settled)
        self.meter.merge(meter)
        evidence = f"{first:.2f} -> {found.at.mean_outline_px:.2f} px"
        self._note("outlines", True, f"traced {len(moves)} times", evidence)
        watched = [number for number, view in enumerate(views) if view.colors is not None]
        if watched:
            share = np.ma.masked_invalid(samples.share[watched][:, ~BEHIND & known])
            found_of = share.mean(1).filled(0.0)
            shares = ", ".join(f"view {n} {part:.0%}" for n, part in zip(watched, found_of, strict=True))
            evidence = f"of the front's outline: {shares}"
            if found_of.mean() < _FOUND:
                return self._unfound(evidence) or before
            self._note("pictures", True, "the frame is found in the pictures", evidence)
        labels = before.at.median_label_px, found.at.median_label_px
        if labels[1] > max(2 * labels[0], self.options.label_noise_px):
            evidence = f"labels {labels[0]:.1f} -> {labels[1]:.1f} px"
            self._note("masks", False, "they disagree with the labels and are left aside", evidence)
            self._watch(tuple(replace(view, distance=None, colors=None) for view in views))
            return before
        return found
