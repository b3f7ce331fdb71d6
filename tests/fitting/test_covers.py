"""Lenses before the eyes are left out of the scan; faces without them stay whole."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fits import scan_surface
from scipy.spatial import cKDTree
from worlds.glasses_on_head import worn_glasses
from worlds.raw_like import raw_like

from scan2albedo import fit
from scan2albedo.core import Meter
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.covers import uncovered
from scan2albedo.fitting.plausibility import doubts
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic.face_shape import face_surface, person
from scan2albedo.synthetic.sitter import join

BY_EYES_MM = 25.0


@pytest.fixture(scope="module")
def face(model):
    return face_surface(model, person(model, np.random.default_rng(8)))


def dressed(face):
    skin = face.vertices, face.faces
    return join([skin, worn_glasses(skin, face.landmarks[36:48].mean(0), 3, 12.0)])


def off_by_the_eyes(face, fitted, model_from_shape):
    points = transform_points(invert_rigid(model_from_shape), fitted.vertices)
    middles = face.landmarks[36:48].reshape(2, 6, 3).mean(1)
    near = cKDTree(middles[:, :2]).query(points[:, :2])[0] < BY_EYES_MM
    return NearestSurface(face.vertices, face.faces).query(points[near]).distance.mean()


def test_lenses_are_left_out_and_told(face, model):
    scan, scan_from_shape = raw_like(*dressed(face), 8)
    pose = invert_rigid(scan_from_shape)
    left_out = fit(scan, model, pose)
    assert "far before the eyes" in left_out.plan.of_stage("fit.covers")[0].text
    followed = fit(scan, model, pose, options=FitOptions(covers=False))
    assert left_out.metrics["covered_mm2"] > 1000
    assert followed.metrics["covered_mm2"] == 0
    error, of_lenses = (
        off_by_the_eyes(face, f, f.model_from_scan @ scan_from_shape) for f in (left_out, followed)
    )
    assert error < min(2.0, 0.5 * of_lenses)
    # What was left out has no colours for the face: it is of the glasses, not of the skin behind them.
    covered = scan.vertices[scan.faces[left_out.covered_faces]].mean(1)
    off_skin = NearestSurface(face.vertices, face.faces).query(transform_points(pose, covered)).distance
    assert len(covered) > 500
    assert np.mean(off_skin > 2.0) > 0.8
    assert followed.covered_faces is None
    # Half of these proportions are the model's own: nothing is said of them.
    assert not any("proportions" in doubt.text for doubt in doubts(left_out))


def left_of(model, vertices, faces):
    """Return the scan, what is left of it without covers, their area in mm^2 and what they cost."""
    scan, meter = scan_surface(vertices, faces), Meter("fit", "mm")
    left, covers = uncovered(scan, model, model.control_vertices, meter)
    covered_mm2 = 0 if covers is None else face_areas(covers.vertices, covers.faces).sum()
    return scan, left, covered_mm2, meter.evaluations


def test_a_face_without_covers_stays_whole_and_costs_nothing(face, model):
    whole, left, covered_mm2, evaluations = left_of(model, face.vertices, face.faces)
    assert left is whole
    assert covered_mm2 == evaluations == 0


def test_a_swelling_that_rises_gradually_stays(face, model):
    x, y, _ = (face.vertices - face.landmarks[17:27].mean(0)).T
    swelling = 15 * np.exp(-((x / 50) ** 4) - ((y + 12) / 14) ** 2)
    assert left_of(model, face.vertices + np.outer(swelling, [0, 0, 1]), face.faces)[2] == 0


def test_frames_without_lenses_stay(face, model):
    vertices, faces = dressed(face)
    lens_middles = np.flatnonzero(np.bincount(faces.ravel()) > 30)
    assert left_of(model, vertices, faces[~np.isin(faces, lens_middles).any(1)])[2] == 0


def test_models_without_landmarks_keep_everything(face, model):
    assert left_of(model, *dressed(face))[2] > 1000
    worn, left, *_ = left_of(replace(model, landmark_points=None), *dressed(face))
    assert left is worn
