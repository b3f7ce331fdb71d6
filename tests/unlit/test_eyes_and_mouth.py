"""Eyeballs lie behind the lids where the scan shows them, and are left out where lids are shut."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers.faces import unseen
from helpers.measures import row_lengths
from helpers.meshes import sphere
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.applications import relight
from scan2albedo.core.lights import PointLight
from scan2albedo.geometry.mesh import join, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.io.glb import write_parts_glb
from scan2albedo.synthetic.textures import landmark_uv
from scan2albedo.templates import AnnotatedFaceModel
from scan2albedo.unlit.eyes import GLOBE_MM, LID_LANDMARKS, eyeball_mesh
from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth, on_template
from scan2albedo.unlit.face_features import grown, texels_of_parts
from scan2albedo.unlit.template_baking import TemplateTexture
from tests.unlit.test_face_features import with_shut_eyes


def at_uv(face, uv):
    """Return places (N, 3) of a face at coordinates (N, 2) of its chart."""
    return bilinear(face.image.position, pixels_from_uv(uv, face.mask.shape))


@pytest.fixture(scope="module")
def seen(person):
    """Make a synthetic person with landmarks: (seed) -> ProcessedFace."""

    def made(seed):
        face = person(seed, size=256)
        return replace(face, landmarks=at_uv(face, landmark_uv(AnnotatedFaceModel.default())))

    return made


def iris_centres(face):
    """Return (2, 2) where `synthetic.textures` paints the middles of the irises, right and left, in mm."""
    uv = landmark_uv(AnnotatedFaceModel.default())
    lids = np.array([uv[lid] for lid in LID_LANDMARKS.values()])
    widths = row_lengths(lids[:, 3] - lids[:, 0])
    return at_uv(face, lids.mean(1) + np.outer(widths, [0, 0.04]))[:, :2]


@pytest.mark.parametrize("seed", range(6))
def test_irises_are_found_where_they_are_painted(seen, seed):
    face = seen(seed)
    found = eyes_and_mouth(face)
    assert [eye.side for eye in found.eyes] == ["right", "left"]
    assert all(eye.painted for eye in found.eyes)
    places = np.array([(eye.center_mm + eye.radius_mm * eye.gaze)[:2] for eye in found.eyes])
    assert row_lengths(places - iris_centres(face)).max() < 1
    right, left = found.eyes
    assert right.gaze @ left.gaze > np.cos(np.radians(4))
    # Dark pupil, bright white, and the openings in the face lie over the eyes.
    rings = right.rings_linear.max(1)
    assert rings[0] < 0.1 * rings[-1]
    eyes = texels_of_parts(face, ["left_eye", "right_eye"])
    assert (found.cut_mm[grown(~eyes & face.mask, 0) & ~grown(eyes, 0)] <= 0).all()
    assert (found.cut_mm > 0).sum() > 0.1 * eyes.sum()


def test_shut_eyes_are_left_out_each_for_itself(seen):
    face = seen(1)
    assert eyes_and_mouth(with_shut_eyes(face)).eyes == ()
    winking = eyes_and_mouth(with_shut_eyes(face, ["left_eye"]))
    assert [eye.side for eye in winking.eyes] == ["right"]


def test_holes_between_lids_get_usual_eyes_that_look_ahead(seen):
    face = seen(2)
    torn = unseen(with_shut_eyes(face), eyes_and_mouth(face).cut_mm > 0)
    found = eyes_and_mouth(torn)
    assert len(found.eyes) == 2
    assert "left out" in found.reason
    for eye in found.eyes:
        assert not eye.painted
        assert_allclose(eye.gaze, [0, 0, 1])
        red, green, blue = eye.rings_linear[len(eye.rings_linear) // 2]
        assert red > green > blue
    assert any("left out" in note for note in relight(torn, [PointLight(0.3, 0.3)]).notes)
    with pytest.raises(TypeError, match="load_result"):
        eyes_and_mouth("out/subject")


def test_a_side_that_was_not_scanned_has_no_eye_and_the_other_side_has(seen):
    face = seen(1)
    half = unseen(face, face.image.position[..., 0] <= -5)
    found = eyes_and_mouth(half)
    assert [(eye.side, eye.painted) for eye in found.eyes] == [("left", True)]
    assert found.reason.startswith("one eye")
    relit = relight(half, [PointLight(0.3, 0.3)])
    assert relit.face.inside is not None
    assert replace(relit.face, landmarks=None).inside is None  # a copy is looked at anew


def test_without_landmarks_or_albedo_the_reason_is_told(person, seen):
    assert "no landmarks" in eyes_and_mouth(person(0)).reason
    assert "no albedo" in eyes_and_mouth(replace(seen(0), has_albedo=False)).reason


def test_parts_are_closed_outward_meshes(seen, tmp_path):
    found = eyes_and_mouth(seen(3))
    for eye in found.eyes:
        part = eyeball_mesh(eye)
        outward = part.vertices - eye.center_mm
        off = row_lengths(outward)
        assert abs(eye.radius_mm - GLOBE_MM) < 1.5
        # The cornea stands out by about a millimetre, and nothing else does.
        assert off.min() == pytest.approx(eye.radius_mm)
        assert 0.5 < off.max() - eye.radius_mm < 2.5
        facing = (vertex_normals(part.vertices, part.faces) * outward).sum(1) > 0
        assert facing.mean() > 0.99
    names = [part.name for part in found.parts]
    assert names == ["eye_right", "eye_left", "mouth", "teeth_upper", "teeth_lower"]
    write_parts_glb(tmp_path / "parts.glb", found.parts)
    loaded = trimesh.load(tmp_path / "parts.glb")
    assert sorted(loaded.geometry) == sorted(names)
    colors = loaded.geometry["eye_left"].visual.vertex_attributes["color"][:, :3]
    assert np.ptp(colors, axis=0).min() > 0.2


def test_the_lower_teeth_follow_the_jaw_and_the_upper_ones_stay(seen):
    parts = {part.name: part for part in eyes_and_mouth(seen(0)).parts}
    moved = np.zeros((68, 3))
    moved[[8, *range(55, 60)]] = [0, -10, -3]
    assert_allclose(parts["teeth_lower"].follows @ moved, np.tile([0, -10, -3], (484, 1)))
    assert not (parts["teeth_upper"].follows @ moved).any()
    bag = parts["mouth"]
    down = (bag.follows @ moved)[:, 1]
    middle = parts["teeth_upper"].vertices[:, 1].min()
    assert down.min() < -9
    assert np.abs(down[bag.vertices[:, 1] > middle + 5]).max() < 2


def test_relit_eyes_glint_and_stand_behind_the_lids(seen, tmp_path):
    relit = relight(seen(4), [PointLight(0.3, 0.3, intensity=2.0)])
    plain = replace(relit, face=replace(relit.face))
    with_eyes, without = (one.picture(shape=(300, 300)) for one in (relit, plain))
    assert_array_equal(with_eyes.alpha, without.alpha)
    changed = np.abs(with_eyes.linear - without.linear).max(-1) > 0.01
    assert 0.001 < changed.mean() < 0.05
    bright = with_eyes.linear.max(-1)
    assert bright[changed].max() > 1.2 * np.percentile(bright[with_eyes.alpha > 0], 99)
    relit.write_glb(tmp_path / "relit.glb")
    assert {"face", "eye_left", "eye_right"} <= set(trimesh.load(tmp_path / "relit.glb").geometry)


def test_a_template_keeps_eyeballs_of_its_own(seen):
    face = seen(5)
    found, mesh = eyes_and_mouth(face), face.mesh
    fitted = SimpleNamespace(vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, landmarks=face.landmarks)
    made = on_template(found, fitted, 2.0, TemplateTexture(mesh.vertices, mesh.faces, mesh.uv[mesh.faces]))
    assert len(made.parts) == len(found.parts)
    assert_allclose(made.parts[0].color_linear, 2 * found.parts[0].color_linear)
    assert (made.cut_mm > 0).any()
    balls = [sphere(3, 12.0, eye.center_mm) for eye in found.eyes]
    vertices, faces = join([(mesh.vertices, mesh.faces), *balls])
    own = TemplateTexture(vertices, faces, np.zeros((len(faces), 3, 2)))
    made = on_template(found, fitted, 1.0, own)
    assert [part.name for part in made.parts] == ["mouth", "teeth_upper", "teeth_lower"]
    assert not (made.cut_mm > 0).any()
