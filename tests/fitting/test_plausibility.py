"""What no scan of one whole person shows is told of fitted faces, and nothing of whole ones."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.measures import row_lengths

from scan2albedo.core.raw_scan import RawScan
from scan2albedo.face_model.annotation import Region
from scan2albedo.face_model.variation import EXPRESSION_BUMPS, displacement
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.fitting.plausibility import PARTS, asymmetry, doubts, face_coverage, missing_parts
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.synthetic.face_shape import person
from scan2albedo.synthetic.sitter import compact

QUICK = FitOptions(levels=(0, 0), finest_level=0)


def fitted_to(model, control_points, *, hole=None, level=2, options=QUICK):
    """The fit to a scan of control points (C, 3), posed as the model; `hole` is a centre and a radius."""
    vertices, faces = model.subdivision(level).matrix @ control_points, model.subdivision(level).faces
    scan = vertices + np.random.default_rng(len(vertices)).normal(scale=0.2, size=vertices.shape)
    if hole is not None:
        lost = row_lengths(vertices - hole[0]) < hole[1]
        scan, faces = compact(scan, faces[~lost[faces].any(1)])
    return fit(RawScan(scan, faces), model, np.eye(4), options=options)


def someone(model, seed, expression="neutral", strength=1.0):
    return person(model, np.random.default_rng(seed), expression=expression, strength=strength)


@pytest.mark.parametrize(("seed", "expression"), [(0, "neutral"), (1, "smile"), (2, "puff"), (3, "surprise")])
def test_nothing_is_told_of_whole_faces(model, seed, expression):
    fitted = fitted_to(model, someone(model, seed, expression))
    assert list(doubts(fitted)) == []
    assert asymmetry(fitted)[0] < 0.5


@pytest.mark.parametrize("expression", ["smile", "frown", "puff"])
def test_an_expression_of_one_side_is_none_of_two_people(model, expression):
    rest = model.control_vertices
    moved = sum(displacement(bump, rest, model.landmarks) for bump in EXPRESSION_BUMPS[expression])
    of_one_side = np.clip(0.5 + rest[:, :1] / 20, 0, 1) * moved
    fitted = fitted_to(model, someone(model, 4) + 1.5 * of_one_side)
    assert asymmetry(fitted)[0] < 0.9
    assert list(doubts(fitted)) == []


@pytest.mark.parametrize("part", ["nose", "right eye", "left eye", "mouth"])
def test_a_part_without_scan_is_named(model, part):
    control_points = someone(model, 5)
    landmarks = model.landmarks_of(control_points)
    center = landmarks[list(PARTS[part][0])].mean(0)
    fitted = fitted_to(model, control_points, hole=(center, 24.0), options=FitOptions())
    assert missing_parts(fitted) == (part,)
    (told,) = doubts(fitted)
    assert told.text.startswith(f"no scan near the {part}")


def test_halves_of_two_people_are_told(model):
    """Of two who differ as measured faces do, twice as much as synthetic people: cut, or joined smoothly."""
    one, other = (someone(model, seed, strength=2.0) for seed in (10, 11))
    for joint_mm in (0.1, 25.0):
        of_one = np.clip(0.5 + model.control_vertices[:, :1] / joint_mm, 0, 1)
        fitted = fitted_to(model, of_one * one + (1 - of_one) * other, level=3, options=FitOptions())
        assert asymmetry(fitted)[0] > 1
        assert any("asymmetry" in told.text for told in doubts(fitted))
    for whole in (one, other):
        assert asymmetry(fitted_to(model, whole))[0] < 0.7


def test_one_half_copied_onto_the_other_is_told(model):
    vertices, faces = model.subdivision(3).matrix @ someone(model, 3), model.subdivision(3).faces
    vertices += np.random.default_rng(0).normal(scale=0.1, size=vertices.shape)
    whole = fit(RawScan(vertices, faces), model, np.eye(4))
    assert list(doubts(whole)) == []
    assert whole.metrics["mirror_mm"] > 0.04
    half = faces[(vertices[faces, 0] > 0).all(1)]
    both = np.vstack([half, half[:, ::-1] + len(vertices)])
    copied = fit(RawScan(np.vstack([vertices, vertices * [-1, 1, 1]]), both), model, np.eye(4))
    assert [row.stage for row in doubts(copied)] == ["fit.symmetry"]


def test_no_halves_are_compared_where_one_is_not_seen_or_the_model_is_lopsided(model):
    fitted = fitted_to(model, someone(model, 7))
    right = fitted.vertices[:, 0] < -5
    half = asymmetry(replace(fitted, residual_mm=np.where(right, np.nan, fitted.residual_mm)))
    assert half is None or half[0] == 0
    skewed = model.control_vertices + np.outer(model.control_vertices[:, 1], [0.02, 0, 0])
    lopsided = replace(model, control_vertices=skewed, _subdivisions={})
    assert asymmetry(replace(fitted, model=lopsided)) is None
    bare = replace(model, landmark_points=None)
    assert missing_parts(replace(fitted, model=bare)) == ()


def test_of_a_template_only_its_annotated_part_is_the_face(model):
    """Half of it, as if that were the back of a head, has no scan; nobody misses it."""
    fitted = fitted_to(model, someone(model, 7))
    behind = model.surface(0)[0][model.control_faces].mean(1)[:, 1] > 0
    assert 0.3 < behind.mean() < 0.7
    template = replace(
        model,
        region=np.where(behind, np.uint8(200), model.region),
        regions={**model.regions, "face": Region("face", 200)},
        template_points=SurfacePoints(np.zeros(1, np.int64), np.eye(1, 3)),
    )
    region, residual = template.region[model.subdivision(fitted.levels).parent], fitted.residual_mm.copy()
    residual[fitted.faces[region == 200]] = np.nan
    half = replace(fitted, model=template, region=region, residual_mm=residual)
    assert face_coverage(half) > 0.9
    whole = replace(half, model=replace(template, template_points=None))
    assert face_coverage(whole) == fitted.metrics["coverage"]
