"""Lenses in the mesh, in the masks, in both, in neither: all four are registered alike."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from bench.eyeglasses.scenes import EVEN, khronos, photographed, synthetic, without_lenses
from helpers.eyeglasses import nearest_weights
from helpers.measures import rms, row_lengths

from scan2albedo.eyeglasses import register_on_face
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState, SkinnedPoints
from scan2albedo.eyeglasses.on_face.lens_panes import fit_lenses_to_masks, rim_openings
from scan2albedo.eyeglasses.on_face.outline import FrameMesh
from scan2albedo.geometry.pinhole import look_at

SLAB = synthetic("slab")
BARE = without_lenses(SLAB)


def check_all_four(frame, size, bar):
    for mesh, shown in itertools.product((frame, without_lenses(frame)), (True, False)):
        seen = photographed(frame, 0, errors=EVEN, glass=shown, size=size)
        given = (mesh.vertices, mesh.faces, mesh.keypoints, mesh.weights())
        found = register_on_face(given, seen.labels, list(seen.masks), seen.cameras)
        rims = np.unique(mesh.rims)
        error = row_lengths(found.vertices[rims] - seen.vertices[np.unique(frame.rims)])
        assert rms(error) < bar
        assert found.observed[rims].mean() > 0.98
        assert found.vertices.shape == mesh.vertices.shape
        steps = [step for step in found.plan if step.stage == "glasses.lenses"]
        same = shown == bool(mesh.glass.any())
        assert [step.ran for step in steps] == ([False] if same else [True, True])
        assert same or ("left out" if mesh is frame else "put in") in steps[0].reason
        assert not any(step.stage == "glasses.contradicted" for step in found.plan)


@pytest.mark.slow
def test_a_synthetic_frame():
    check_all_four(SLAB, 512, 0.5)


@pytest.mark.slow
def test_real_sunglasses(shared_data):
    check_all_four(khronos(), 1024, 0.6)


def shown_frame(mesh, *masks):
    cameras = [look_at([0, 0, 600], [0, 0, 0], focal_px=450, shape=mask.shape) for mask in masks]
    motion = FrameMotion(mesh.keypoints, FrameState(np.eye(3), mesh.keypoints.mean(0), np.zeros((20, 3))))
    weights = nearest_weights(mesh.vertices, mesh.keypoints)
    frame = FrameMesh(SkinnedPoints(mesh.vertices, weights), mesh.faces)
    return fit_lenses_to_masks(frame, motion, cameras, masks, None)


def test_openings_know_their_lenses():
    openings = rim_openings(SLAB.vertices, SLAB.faces, SLAB.keypoints)
    for (*_, panes, sealed), side in zip(openings, (1, -1), strict=True):
        assert SLAB.glass[panes].all()
        assert len(panes) == SLAB.glass.sum() / 2
        assert (side * SLAB.vertices[SLAB.faces[panes], 0] > 0).all()
        assert not sealed
    assert [len(panes) for *_, panes, _ in rim_openings(BARE.vertices, BARE.faces, BARE.keypoints)] == [0, 0]
    marks = SLAB.keypoints.copy()
    marks[3] = np.nan
    assert [side for side, *_ in rim_openings(SLAB.vertices, SLAB.faces, marks)] == [1]


def test_each_view_and_each_lens_is_judged_by_itself():
    empty, full = np.zeros((256, 256), bool), np.ones((256, 256), bool)
    half = empty.copy()
    half[:, 128:] = True  # the wearer's left
    _, shown, steps = shown_frame(SLAB, full, empty, half)
    glass = int(SLAB.glass.sum())
    assert [len(SLAB.faces) - len(faces) for faces in shown] == [0, glass, glass // 2]
    assert steps[0].reason.startswith("the mask of view 1 shows no left lens")
    assert steps[1].reason.startswith("the masks of views 1, 2 show no right lens")
    mesh, shown, _ = shown_frame(BARE, full, empty, half)
    both, none, one = (len(faces) - len(BARE.faces) for faces in shown)
    assert none == 0
    assert both == 2 * one > 0
    assert len(mesh.points.rest) > len(BARE.vertices)
    np.testing.assert_allclose(mesh.points.weights.sum(1), 1)


def test_glass_of_one_piece_with_the_rim_is_told():
    # The lens's outline joined to the rim's vertices, which lie at the same places.
    _, first, same = np.unique(SLAB.vertices.round(5), axis=0, return_index=True, return_inverse=True)
    welded = replace(SLAB, faces=first[same.ravel()][SLAB.faces])
    _, _, steps = shown_frame(welded, np.zeros((256, 256), bool))
    assert [step.ran for step in steps] == [False, False]
    assert "cut it out" in steps[0].reason
