"""Errors that views share, frames of a slightly wrong size, bends of their own kind: found or told."""

import numpy as np
import pytest
from bench.eyeglasses.deviations import misses
from bench.eyeglasses.scenes import Errors, khronos, photographed, synthetic, without_lenses
from helpers.measures import rms, row_lengths

from scan2albedo.eyeglasses import FaceRegistrationOptions, register_on_face
from scan2albedo.eyeglasses.on_face.frame_motion import SkinnedPoints
from scan2albedo.eyeglasses.on_face.inputs import checked_inputs
from scan2albedo.eyeglasses.on_face.objective import RegistrationObjective
from scan2albedo.eyeglasses.on_face.outline import FrameMesh, OutlineSampler
from scan2albedo.eyeglasses.on_face.start_poses import starting_poses

SLAB = without_lenses(synthetic("slab"))


def mesh_of(frame, scale=1.0):
    return scale * frame.vertices, frame.faces, scale * frame.keypoints, frame.weights()


def error_mm(found, seen):
    return rms(row_lengths(found.vertices - seen.vertices))


@pytest.fixture(scope="module")
def seen():
    return photographed(SLAB, 3, errors=Errors(0, 0.3, 0, 0), glass=False, size=512, bend=False)


def register(seen, masks, scale=1.0, repeats=1):
    labels, cameras = (np.tile(part, (repeats, 1, 1)) for part in (seen.labels, seen.cameras))
    return register_on_face(mesh_of(SLAB, scale), labels, masks, cameras)


def test_masks_that_are_too_wide_throughout_move_nothing(seen):
    import cv2

    wide = [cv2.dilate(m.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for m in seen.masks]
    found = register(seen, wide)
    assert error_mm(register(seen, seen.masks), seen) < 0.2
    assert error_mm(found, seen) < 0.25
    # What is left of the two pixels are the differences between views and places.
    assert np.nanmax(found.outline_rms_px) < 1.0


def test_a_mesh_that_is_a_percent_too_small_is_stretched(seen):
    found = register(seen, seen.masks, scale=0.99)
    sizes = [row_lengths(k - k.mean(0)).mean() for k in (found.keypoints, seen.keypoints)]
    assert abs(sizes[0] / sizes[1] - 1) < 0.003
    assert error_mm(found, seen) < 0.3


def test_labels_off_alike_in_all_views_count_once(seen):
    # With three times as many views labels say more on their own errors, not on the ones they share.
    one, many = (register(seen, None, repeats=repeats).keypoint_deviation for repeats in (1, 9))
    assert 0.4 < np.median(many / one) < 1


def test_slopes_are_those_of_the_sum(seen):
    given = checked_inputs(mesh_of(SLAB), seen.labels, list(seen.masks), seen.cameras, None, None)
    objective = RegistrationObjective(given.keypoints, given.views, FaceRegistrationOptions())
    rng = np.random.default_rng(0)
    state = starting_poses(given.keypoints, given.views, 2.0, None)[0]
    mesh = FrameMesh(SkinnedPoints(given.vertices, SLAB.weights()), given.faces)
    sampler = OutlineSampler(mesh, given.views, None)
    samples = sampler.sample(objective.motion(state), np.full(20, 2.0))
    state = state.moved(np.r_[rng.normal(0, 1e-3, 6), rng.normal(0, 0.1, 60)])
    for some in (None, samples):
        at = objective.linearize(state, some)
        assert np.linalg.eigvalsh(at.matrix).min() > 0
        for _ in range(6):
            step = 1e-5 * rng.normal(size=66)
            ahead, back = (objective.linearize(state.moved(s), some).cost for s in (step, -step))
            assert (ahead - back) / 2 == pytest.approx(2 * at.gradient @ step, rel=0.02, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False])
def test_stated_deviations_hold_on_bends_of_another_kind(masked):
    check_coverage(synthetic("shield"), range(2000, 2004), Errors(), masked)


@pytest.mark.slow
def test_stated_deviations_hold_on_real_sunglasses(shared_data):
    # Masks two pixels too narrow would not show its wires at all. Deviations are somewhat small here.
    check_coverage(khronos(), range(2000, 2003), Errors(bias_px=0.4), True, most=1.7)


def check_coverage(glazed, seeds, errors, masked, most=1.4):
    frame, off, stated = without_lenses(glazed), [], []
    within = [], []
    for seed in seeds:
        pictures = photographed(frame, seed, errors=errors, glass=False)
        masks = list(pictures.masks) if masked else None
        found = register_on_face(mesh_of(frame), pictures.labels, masks, pictures.cameras)
        assert found.observed.mean() > 0.6
        for miss, share in zip(misses(found, pictures.vertices, pictures.keypoints), within, strict=True):
            off.append(rms(miss.error))
            stated.append(rms(miss.stated))
            share.append((miss.error <= 2 * miss.stated).mean())
            assert share[-1] > 0.5
    assert min(np.mean(share) for share in within) > 0.7
    assert 0.6 < rms(off) / rms(stated) < most
