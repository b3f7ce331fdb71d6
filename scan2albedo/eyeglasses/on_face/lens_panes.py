"""Lenses in the masks and lenses in the mesh: what covers the rims' openings in each view."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import PlanStep
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, all_finite
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.inserted_lenses import SIDES, insert_lens
from scan2albedo.eyeglasses.lenses.optics import LensMaterial
from scan2albedo.eyeglasses.lenses.rims import LensPlane, fit_normal, is_covered, pane_faces
from scan2albedo.eyeglasses.mean_keypoints import RIMS
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.eyeglasses.on_face.outline import FrameMesh, hidden_by
from scan2albedo.geometry.pinhole import project
from scan2albedo.geometry.rasterization import within
from scan2albedo.geometry.rays import RayCaster


def rim_openings(
    vertices: FloatArray, faces: IntArray, keypoints: FloatArray
) -> list[tuple[int, IntArray, IntArray, bool]]:
    """Return the openings of the rims whose key points (20, 3) are known.

    Each is the wearer's left (0) or right side (1), the numbers (5,) of the rim's key points, the faces (P,)
    of the mesh's own lens, and whether one of one piece with the rim covers it.
    """
    found, left = [], np.arange(len(faces))
    for side, rim in enumerate(RIMS):
        marks = keypoints[rim]
        if not all_finite(marks):
            continue
        try:
            plane = LensPlane.at(marks.mean(0), fit_normal(marks, vertices))
        except EyeglassesError:
            continue
        panes = pane_faces(vertices, faces[left], plane, marks)
        own, left = left[panes], left[~panes]
        found.append((side, rim, own, is_covered(vertices, faces[left], plane, marks)))
    return found


def fit_lenses_to_masks(
    mesh: FrameMesh,
    motion: FrameMotion,
    cameras: Sequence[FloatArray],
    masks: Sequence[BoolArray | None],
    head: RayCaster | None,
) -> tuple[FrameMesh, tuple[IntArray, ...], list[PlanStep]]:
    """Return the mesh with lenses that only masks (H, W) show behind it, each view's faces, and steps.

    Views whose masks show no lens do without the mesh's own.
    """
    steps, added, count = [], mesh, len(cameras)
    kept = [np.ones(len(mesh.faces), bool) for _ in cameras]
    extra: list[list[IntArray]] = [[] for _ in cameras]
    for side, marks, panes, sealed in rim_openings(mesh.points.rest, mesh.faces, motion.keypoints):
        # Shares of the opening's middle that the masks cover, at places on 24 rays from the middle of the
        # polygon of the rim's key points, from a tenth to six tenths of the way.
        rim = motion.positions(motion.marks)[marks]
        corners = np.vstack([rim, rim[:1]])
        way = np.linspace(0, len(rim), 24, endpoint=False)
        edge = np.stack([np.interp(way, np.arange(len(corners)), corners[:, k]) for k in range(3)], 1)
        places = (rim.mean(0) + np.arange(2, 13)[:, None, None] / 20 * (edge - rim.mean(0))).reshape(-1, 3)
        shares = np.full(count, np.nan)
        for view, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
            if mask is not None:
                pixels, depth = project(camera, places[~hidden_by(head, camera, places)])
                places_px = np.round(np.where(depth[:, None] > 0, pixels, -1.0)).astype(int)
                column, row = places_px[within(places_px, mask.shape)].T
                # Fewer of the 264 places say nothing.
                if len(row) >= 40:
                    shares[view] = mask[row, column].mean()
        if np.isnan(shares).all():
            continue
        # A view that cannot say is taken to be like the others.
        shown = np.where(np.isnan(shares), np.nanmean(shares), shares) >= 0.5
        name = f"{SIDES[side]} lens"
        evidence = ", ".join("-" if np.isnan(s) else f"{s:.0%}" for s in shares) + " of the opening covered"
        if len(panes) and not shown.all():
            for number in np.flatnonzero(~shown):
                kept[number][panes] = False
            reason = f"{_views(~shown)} no {name}: the mesh's own is left out of the outline"
            steps.append(PlanStep("glasses.lenses", True, reason, evidence))
        elif sealed and not shown.all():
            reason = f"{_views(~shown)} no {name}, but the mesh has one of one piece with the rim"
            reason += ", which stays; cut it out of the mesh"
            steps.append(PlanStep.doubt("glasses.lenses", reason, evidence))
        elif shown.any() and not sealed and not len(panes):
            reason = f"{_views(shown)} a {name} that the mesh does not have"
            try:
                lens = insert_lens(
                    mesh.points.rest, mesh.faces, motion.keypoints, side, LensMaterial(), seat_mm=0.5
                )
            except EyeglassesError:
                reason += ", and none fits into the rim: label the mesh's key points anew, or leave out masks"
                steps.append(PlanStep.doubt("glasses.lenses", reason, evidence))
                continue
            # The lens lies behind the mesh so far and follows the rim.
            rim = mesh.points.weights[cKDTree(mesh.points.rest).query(lens.vertices[1:])[1]]
            weights = np.vstack([added.points.weights, rim.mean(0, keepdims=True), rim])
            faces = lens.faces + len(added.points.rest)
            points = SkinnedPoints(np.vstack([added.points.rest, lens.vertices]), weights)
            added = FrameMesh(points, np.concatenate([added.faces, faces]))
            for number in np.flatnonzero(shown):
                extra[number].append(faces)
            steps.append(PlanStep("glasses.lenses", True, f"{reason}: a flat one is put in", evidence))
    if not steps:
        steps = [PlanStep("glasses.lenses", False, "masks and mesh agree on lenses, or have none")]
    return added, tuple(np.concatenate([mesh.faces[kept[n]], *extra[n]]) for n in range(count)), steps


def _views(which: BoolArray) -> str:
    if which.all():
        return "the masks show"
    numbers = ", ".join(str(number) for number in np.flatnonzero(which))
    return f"the masks of views {numbers} show" if which.sum() > 1 else f"the mask of view {numbers} shows"
