"""Geometry images of surfaces whose answer is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.meshes import grid
from helpers.patches import FlatAnnotation, Patch, patch
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo import fit, load_scan, register
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rigid import compose, invert_rigid, random_rotation, transform_points
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
from scan2albedo.sampling import geometry_image, texture_lookup
from scan2albedo.sampling.geometry_images import texture_doubt
from scan2albedo.sampling.texture_lookup import MOVES, moved_colors, sample_colors

WHITE = np.ones((16, 16, 3), np.float32)


def textured_scan(fitted, texture):
    """The patch itself as a raw scan, in the scan's own frame, with uv = chart."""
    vertices = transform_points(invert_rigid(fitted.model_from_scan), fitted.vertices)
    return RawScan(vertices, fitted.faces, fitted.uv[fitted.faces], texture)


def uv_of_texels(size):
    """Return (size, size, 2): texture coordinates of the middles of an image's texels."""
    rows, columns = (np.indices((size, size)) + 0.5) / size
    return np.stack([columns, 1 - rows], -1)


def test_position_follows_the_texel_centres_with_row_0_on_top():
    image = geometry_image(patch(), None, size=50)
    assert image.mask.all()
    assert_allclose(image.position[0, 0], [-49, 49, 0], atol=1e-9)
    assert_allclose(image.position[-1, -1], [49, -49, 0], atol=1e-9)
    assert_allclose(image.normal, np.broadcast_to([0, 0, 1], (50, 50, 3)), atol=1e-12)
    assert (image.region == 3).all()
    assert image.texture_linear is None


def test_skin_is_where_the_surface_was_seen():
    fitted = patch()
    fitted.residual_mm[fitted.vertices[:, 0] > 20] = np.nan
    for scan in (None, textured_scan(fitted, np.full((9, 9, 3), 0.4, np.float32))):
        image = geometry_image(fitted, scan, size=50)
        assert image.skin[:, :34] == pytest.approx(1)
        assert image.skin[:, 36:] == pytest.approx(0)
        assert image.figures()["skin"] == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_texture_is_reproduced_in_any_pose(seed):
    rng = np.random.default_rng(seed)
    pose = compose(random_rotation(rng), rng.uniform(-500, 500, 3))
    fitted = patch(lambda x, y: 10 * np.cos(x / 30), model_from_scan=pose)
    texture = np.dstack([uv_of_texels(256), np.full((256, 256), 0.25)]).astype(np.float32)
    image = geometry_image(fitted, textured_scan(fitted, texture), size=64)
    assert image.texture_valid.mean() > 0.99
    inside = np.s_[2:-2, 2:-2]
    assert_allclose(image.texture_linear[inside][..., :2], uv_of_texels(64)[inside], atol=2e-3)
    assert_allclose(image.texture_linear[..., 2], 0.25, atol=1e-6)


@pytest.mark.parametrize("size", [16, 64])
def test_a_photograph_finer_than_the_texels_is_averaged_over_their_footprints(size, monkeypatch):
    fitted = patch(lambda x, y: 12 * np.sin(x / 25) * np.cos(y / 30))
    scan = textured_scan(fitted, np.random.default_rng(0).random((350, 350, 3)).astype(np.float32))

    def colors(side):
        return geometry_image(fitted, scan, side).texture_linear

    truth = colors(512).reshape(size, 512 // size, size, 512 // size, 3).mean((1, 3))
    averaged = np.abs(colors(size) - truth).mean()
    for name in ("FEWEST_TAPS", "MOST_TAPS"):
        monkeypatch.setattr(texture_lookup, name, 1)
    assert averaged < 0.01
    assert averaged < 0.1 * np.abs(colors(size) - truth).mean()


@pytest.mark.parametrize("size", [32, 128])
def test_every_size_samples_the_same_surface(size):
    image = geometry_image(patch(lambda x, y: 8 * np.cos(x / 20), n=161), None, size)
    x, _, z = image.position[image.mask].T
    assert np.abs(z - 8 * np.cos(x / 20)).max() < 0.01
    assert image.mask.all()
    assert image.figures()["texel_area_mm2"] == pytest.approx((100 / size) ** 2, rel=0.1)


def test_the_texel_areas_tell_a_stretched_chart():
    fitted = patch()
    even = geometry_image(fitted, None, 64).figures()["texel_area_p95_to_p5"]
    fitted.uv = np.column_stack([fitted.uv[:, 0] ** 2, fitted.uv[:, 1]])
    stretched = geometry_image(fitted, None, 64).figures()["texel_area_p95_to_p5"]
    assert even == pytest.approx(1)
    assert stretched > 3


def test_a_geometry_image_goes_back_to_the_mesh_it_came_from(model):
    vertices, faces = model.surface(2)
    uv = linear_refinement(len(model.control_vertices), model.control_faces, 2) @ model.uv
    back, back_faces = geometry_image(Patch(vertices, faces, uv, np.eye(4)), None, 512).triangulated()
    assert ClosestPointQuery(vertices, faces).query(back).distance.mean() < 0.001
    assert ClosestPointQuery(back, back_faces).query(vertices).distance.mean() < 0.02


def test_the_border_is_the_rim_of_the_mask():
    fitted = patch()
    fitted.uv = 0.25 + 0.5 * fitted.uv
    image = geometry_image(fitted, None, 64)
    rows, columns = np.nonzero(image.border)
    assert image.mask.sum() == 32 * 32
    assert image.border.sum() == 4 * 31
    assert {*rows, *columns} <= set(range(16, 48))


@pytest.mark.parametrize("lost", ["a hole in the scan", "left out by the fit"])
def test_what_is_lost_is_known_as_unseen(lost):
    fitted = patch()
    scan = textured_scan(fitted, WHITE)
    middle = np.linalg.norm(fitted.centres, axis=1) < 15
    if lost == "a hole in the scan":
        scan = replace(scan, faces=scan.faces[~middle], uv=scan.uv[~middle])
    else:
        fitted.covered_faces = middle
    image = geometry_image(fitted, scan, size=100)
    radius = np.linalg.norm(image.position, axis=-1)
    assert not image.texture_valid[radius < 12].any()
    assert image.texture_valid[radius > 18].all()


def test_a_surface_that_faces_away_or_lies_far_off_is_unseen():
    fitted = patch()
    scan = textured_scan(fitted, WHITE)
    flipped = replace(scan, faces=scan.faces[:, ::-1], uv=scan.uv[:, ::-1])
    far = replace(scan, vertices=scan.vertices + [0, 0, 30])
    for unseen in (flipped, far):
        assert not geometry_image(fitted, unseen, 32).texture_valid.any()


def test_colours_that_no_picture_showed_are_taken_from_around():
    given = patch()
    colors = np.tile(np.float32([0.5, 0.4, 0.3]), (len(given.vertices), 1))
    hole = np.linalg.norm(given.vertices, axis=1) < 20
    colors[hole] = [1.0, 0.2, 0.0]
    bare = RawScan(given.vertices, given.faces, vertex_color_linear=colors)
    image = geometry_image(given, replace(bare, color_seen=~hole), 64)
    assert image.filled[32, 32]
    assert not image.seen[image.filled].any()
    assert image.skin[image.filled].max() == 0
    assert_allclose(image.texture_linear[image.seen | image.filled][:, 0], 0.5, rtol=1e-5)
    assert image.figures()["filled"] == image.filled.sum() / image.mask.sum()
    assert geometry_image(given, bare, 64).filled is None
    # Where the scan shows nothing of the face, its colours say nothing.
    assert geometry_image(given, replace(bare, color_seen=hole & False), 64).texture_linear is None


def test_of_a_template_only_the_annotated_part_is_the_face(monkeypatch):
    given = patch()
    given.region = np.where(given.centres[:, 0] > 0, 4, 3).astype(np.uint8)
    assert geometry_image(given, None, 32).on_face is None
    monkeypatch.setattr(FlatAnnotation, "face_regions", lambda self: np.arange(256) == 4)
    image = geometry_image(given, None, 32)
    assert_array_equal(image.on_face, image.region == 4)
    assert image.face_side == 32 * (image.on_face.sum() / image.mask.sum()) ** 0.5


def test_annotated_values_change_gradually_and_regions_stay_crisp():
    fitted = patch()
    fitted.region = np.where(fitted.centres[:, 0] < 0, 3, 4).astype(np.uint8)
    image = geometry_image(fitted, None, 100)
    assert set(np.unique(image.region)) == {3, 4}
    row = image.specular_scale[50]
    assert_allclose(row[[5, -5]], [0.7, 0.0], atol=1e-3)
    assert np.abs(np.diff(row)).max() < 0.2
    assert image.inpaint[50, 5]
    assert not image.inpaint[50, -5]


def test_texels_of_the_default_model_know_their_own_places(model):
    vertices, faces = model.surface(1)
    fitted = Patch(vertices, faces, model.refined_uv(1), np.eye(4))
    assert geometry_image(fitted, None, 40).face_chart is None
    fitted.model = model
    fitted.levels = 1
    fitted.region = model.region[model.subdivision(1).parent]
    image = geometry_image(fitted, None, 40)
    own = (np.moveaxis(np.indices((40, 40)), 0, 2) + 0.5) / 40
    assert image.face_chart[image.mask] == pytest.approx(own[image.mask], abs=1e-6)


def test_a_texture_is_looked_up_as_if_what_was_done_to_it_were_undone():
    corners, faces = grid(2, 2)
    points = np.array([[30, 40, 0], [61, 45, 0], [52, 70, 0.0]])
    row, column = np.indices((100, 140)) / 140
    smooth = np.stack([row, column, row * column], axis=-1).astype(np.float32)
    scan = RawScan(100 * corners, faces, uv=(0.1 + 0.8 * corners[:, :2])[faces], texture_linear=smooth)
    seen, up = np.array([[True, False], [True, True]]), np.tile([0, 0, 1.0], (3, 1))
    right = moved_colors(scan, seen, points, up)["as it is"]
    assert not right[0, 1].any()
    for name, texture, shift in (
        ("with V flipped", smooth[::-1], 0),
        ("with U flipped", smooth[:, ::-1], 0),
        ("turned by 180 degrees", smooth[::-1, ::-1], 0),
        ("with U shifted by +3 %", smooth, (0.03, 0)),
        ("with U shifted by -3 %", smooth, (-0.03, 0)),
        ("with V shifted by +3 %", smooth, (0, 0.03)),
        ("with V shifted by -3 %", smooth, (0, -0.03)),
    ):
        wrong = replace(scan, texture_linear=texture.copy(), uv=scan.uv + shift)
        found = moved_colors(wrong, seen, points, up)
        assert set(found) == set(MOVES)
        assert_allclose(found[name], right, atol=2e-3, err_msg=name)
        assert np.abs(found["as it is"] - right).max() > 1e-2


@pytest.mark.slow
def test_what_was_done_to_a_texture_is_told_by_name(shared_data, model):
    scan = load_scan(shared_data / "james.obj")
    fitted = fit(scan, model, register(scan, model, seed=0))
    assert texture_doubt(fitted, scan, geometry_image(fitted, scan, 128)) is None
    noise = srgb_to_linear(np.random.default_rng(0).random(scan.texture_linear.shape)).astype(np.float32)
    for name, texture in (
        ("with V flipped", scan.texture_linear[::-1]),
        ("with V shifted by +3 %", np.roll(scan.texture_linear, round(0.03 * len(noise)), axis=0)),
        ("another scan's", noise),
        ("red and blue", scan.texture_linear[..., ::-1]),
        ("a negative", srgb_to_linear(1 - linear_to_srgb(scan.texture_linear)).astype(np.float32)),
    ):
        wrong = replace(scan, texture_linear=np.ascontiguousarray(texture))
        doubt = texture_doubt(fitted, wrong, geometry_image(fitted, wrong, 128))
        assert doubt is not None
        assert name in doubt.reason


def test_vertex_colours_are_those_of_the_faces_near_the_points():
    """The face's own, though the scan begins with something else that lies far away."""
    square, faces = grid(2, 2)
    vertices = np.concatenate([9 * square + 500, 9 * square])
    colors = np.zeros((8, 3), np.float32)
    colors[:4, 0] = 1
    colors[4:, 1:] = square[:, :2]
    scan = RawScan(vertices, np.concatenate([faces, faces + 4]), vertex_color_linear=colors)
    points = np.random.default_rng(0).uniform(1, 8, (40, 3)) * (1, 1, 0)
    found = sample_colors(scan, points, np.tile((0.0, 0, 1), (40, 1)), np.zeros((40, 3, 2)))
    assert_allclose(found.color_linear[:, 0], 0)
    assert_allclose(found.color_linear[:, 1:], points[:, :2] / 9, atol=1e-6)
    assert found.seen.all()
