"""Lenses before the eyes are left out of the scan; faces without them stay whole."""

from dataclasses import replace

import numpy as np
import pytest
from worlds.glasses_on_head import worn_glasses
from worlds.raw_like import raw_like

from scan2albedo import fit
from scan2albedo.core import Budget, Meter
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.covers import uncovered
from scan2albedo.fitting.plausibility import doubts
from scan2albedo.fitting.scan_surface import ScanSurface
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import boundary_vertex_mask, vertex_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.synthetic.face_shape import face_surface, person
from scan2albedo.synthetic.sitter import join

BY_EYES_MM = 25.0


@pytest.fixture(scope="module")
def face(model):
    return face_surface(model, person(model, np.random.default_rng(8)))


def dressed(face, lens_mm):
    eyes = face.landmarks[36:48].mean(0)
    glasses = worn_glasses((face.vertices, face.faces), eyes, 3, lens_mm)
    return join([(face.vertices, face.faces), glasses])


def off_by_the_eyes(face, fitted, model_from_shape):
    points = transform_points(invert_rigid(model_from_shape), fitted.vertices)
    middles = [face.landmarks[eye].mean(0) for eye in (slice(36, 42), slice(42, 48))]
    near = np.min([np.linalg.norm((points - eye)[:, :2], axis=1) for eye in middles], axis=0) < BY_EYES_MM
    return NearestSurface(face.vertices, face.faces).query(points[near]).distance.mean()


def test_lenses_are_left_out_and_told(face, model):
    scan, scan_from_shape = raw_like(*dressed(face, 12.0), 8)
    pose = invert_rigid(scan_from_shape)
    left_out = fit(scan, model, pose)
    assert "far before the eyes" in left_out.plan.of_stage("fit.covers")[0].text
    followed = fit(scan, model, pose, options=FitOptions(covers=False))
    assert left_out.metrics["covered_mm2"] > 1000
    assert followed.metrics["covered_mm2"] == 0
    errors = [off_by_the_eyes(face, f, f.model_from_scan @ scan_from_shape) for f in (left_out, followed)]
    assert errors[0] < 2.0
    assert errors[0] < 0.5 * errors[1]
    # What was left out has no colours for the face: it is of the glasses, not of the skin behind them.
    on_shape = transform_points(invert_rigid(scan_from_shape), scan.vertices[scan.faces].mean(1))
    off_skin = NearestSurface(face.vertices, face.faces).query(on_shape).distance
    assert left_out.covered_faces.sum() > 500
    assert np.mean(off_skin[left_out.covered_faces] > 2.0) > 0.8
    assert followed.covered_faces is None
    # Half of these proportions are the model's own: nothing is said of them.
    assert not any("proportions" in doubt.text for doubt in doubts(left_out))


def surface(vertices, faces):
    boundary = boundary_vertex_mask(len(vertices), faces)
    return ScanSurface(vertices, faces, vertex_normals(vertices, faces), boundary)


def meter():
    return Meter("fit", "mm", Budget.of(None))


def test_a_face_without_covers_stays_whole_and_costs_nothing(face, model):
    whole, spent = surface(face.vertices, face.faces), meter()
    found = uncovered(whole, model, model.control_vertices, spent)
    assert found[0] is whole
    assert found[2] == 0
    assert spent.evaluations == 0


def test_a_swelling_that_rises_gradually_stays(face, model):
    middle = face.landmarks[17:27].mean(0)
    x, y, _ = (face.vertices - middle).T
    swelling = 15 * np.exp(-((x / 50) ** 4) - ((y + 12) / 14) ** 2)
    heavy = face.vertices + np.outer(swelling, [0, 0, 1])
    found = uncovered(surface(heavy, face.faces), model, model.control_vertices, meter())
    assert found[2] == 0


def test_frames_without_lenses_stay(face, model):
    vertices, faces = dressed(face, 12.0)
    lens_middles = np.flatnonzero(np.bincount(faces.ravel()) > 30)
    found = uncovered(
        surface(vertices, faces[~np.isin(faces, lens_middles).any(1)]),
        model,
        model.control_vertices,
        meter(),
    )
    assert found[2] == 0


def test_models_without_landmarks_keep_everything(face, model):
    worn = surface(*dressed(face, 12.0))
    assert uncovered(worn, model, model.control_vertices, meter())[2] > 1000
    bare = replace(model, landmark_points=None)
    assert uncovered(worn, bare, model.control_vertices, meter())[0] is worn
