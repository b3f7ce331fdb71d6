"""The scan itself without its light, and colours on a template's own coordinates, through `process`."""

from dataclasses import replace

import numpy as np
import pytest
from bench.applications import LIMIT, exported_textures, rim_step
from helpers.faces import with_template
from helpers.meshes import grid
from helpers.records import files_in, read_json
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo as s2a
from scan2albedo.applications import UnlitScan, load_result, swap_texture, unlit_scan, write_face
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.rasterization import pixels_from_uv
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import is_deep
from scan2albedo.io.images import encode_image, read_image_linear, read_image_values
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_obj
from scan2albedo.pipeline.demo import compare_with_truth
from scan2albedo.unlit import light_removal
from scan2albedo.unlit.files import write_template, write_unlit
from scan2albedo.unlit.template_baking import template_texture

SIZE = 128


@pytest.fixture(scope="module")
def result(coarse_scan, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    asked = {"unlit": "all", "texture_size": 256, "quality": "draft", "pictures": False}
    return s2a.process(coarse_scan[0], out, model=with_template(2), size=SIZE, **asked)


@pytest.fixture(scope="module")
def face_unlit(result):
    return unlit_scan(result.scan, result.fitted, result.albedo)


def mse_percent(scan, result, truth):
    """Of a scan's colours on the face, against the true albedo."""
    image = s2a.geometry_image(result.fitted, scan, SIZE)
    return compare_with_truth(replace(result, geometry_image=image), truth).texture.mse_percent


@pytest.mark.slow
def test_the_scans_own_texels_are_as_good_as_the_charts(coarse_scan, result, face_unlit):
    truth = coarse_scan[1]
    chart = compare_with_truth(result, truth)
    assert chart.albedo.mse_percent < 0.3 * chart.texture.mse_percent
    for unlit in (face_unlit, result.unlit):
        inside = mse_percent(unlit.scan, result, truth)
        # The rim of the face, a tenth of it, keeps its light or has it from a rougher shape.
        assert inside < chart.albedo.mse_percent + 0.2 * chart.texture.mse_percent


def test_nothing_but_colours_differs_and_beyond_the_face_nothing(result, face_unlit):
    scan, unlit = result.scan, face_unlit.scan
    for name in ("vertices", "faces", "uv"):
        assert getattr(unlit, name) is getattr(scan, name)
    far = face_unlit.confidence == 0
    assert 0.2 < far.mean() < 0.95
    apart = np.abs(unlit.texture_linear - scan.texture_linear).max(-1)
    assert np.median(apart[far]) < 1e-6
    assert np.median(apart[~far]) > 0.01
    assert (result.unlit.confidence[far] <= 0.5).all()
    assert (result.unlit.confidence > 0).sum() > (face_unlit.confidence > 0).sum()


def test_tiles_lie_where_they_belong(result, face_unlit, monkeypatch):
    monkeypatch.setattr(light_removal, "_TILE", 200)
    tiled = unlit_scan(result.scan, result.fitted, result.albedo)
    apart = np.abs(tiled.scan.texture_linear - face_unlit.scan.texture_linear).max(-1)
    assert np.percentile(apart, 99) < 0.01


def test_a_scan_with_vertex_colours_gets_unlit_ones(result):
    scan, fitted = result.scan, result.fitted
    grey = np.full((len(scan.vertices), 3), 0.5, np.float32)
    plain = replace(scan, uv=None, texture_linear=None, vertex_color_linear=grey)
    unlit = unlit_scan(plain, fitted, result.albedo)
    assert unlit.confidence.shape == (len(scan.vertices),)
    away = unlit.confidence == 0
    assert np.isclose(unlit.scan.vertex_color_linear[away], 0.5).mean() > 0.99
    # Even paint divided by the light is the light's inverse.
    assert unlit.scan.vertex_color_linear[unlit.confidence > 0.5].std() > 0.02


def test_what_was_left_out_of_the_fit_keeps_its_colours(result):
    placed = transform_points(result.fitted.model_from_scan, result.scan.vertices)
    middles = placed[result.scan.faces].mean(1)
    covered = np.linalg.norm(middles - result.fitted.landmarks[30], axis=1) < 12  # of the nose
    assert covered.any()
    unlit = unlit_scan(result.scan, replace(result.fitted, covered_faces=covered), result.albedo)
    column, row = pixels_from_uv(unlit.scan.uv[covered].mean(1), unlit.confidence.shape).round().astype(int).T
    assert np.median(unlit.confidence[row, column]) == 0


def test_errors_name_what_is_missing(result):
    scan, fitted, albedo = result.scan, result.fitted, result.albedo
    bare = replace(scan, uv=None, texture_linear=None)
    plain = replace(fitted, model=s2a.AnnotatedFaceModel.default())
    elsewhere = replace(scan, vertices=scan.vertices + 1000)
    moved = replace(fitted, vertices=fitted.vertices + 1)
    for call, given, words in (
        (unlit_scan, (bare, fitted, albedo), "no colours"),
        (unlit_scan, (scan, fitted, albedo, "head"), "reach is 'head'"),
        (unlit_scan, (elsewhere, fitted, albedo), "no part of it lies at the fitted face"),
        (unlit_scan, (scan, moved, albedo), "of another face"),
        (template_texture, (scan, plain), "no template with texture coordinates"),
        *((template_texture, (scan, fitted, n), "whole number of texels") for n in (7, 9000, "x", 8.5)),
    ):
        with pytest.raises((ApplicationError, ValueError), match=words):
            call(*given)


def test_a_template_gets_the_colours_of_the_skin_below_it(result):
    """Its control mesh's chart is that of the face, so its picture is the chart's."""
    fitted = replace(result.fitted, model=with_template())
    painted = template_texture(result.scan, fitted, SIZE)
    (tile,) = painted.tiles
    assert tile.number == 1001
    assert_array_equal(painted.vertices, fitted.template_vertices)
    image = result.geometry_image
    both = tile.seen & image.seen
    assert both.sum() > 0.8 * image.seen.sum()
    assert np.abs(tile.color_linear - image.texture_linear)[both].mean() < 0.02
    assert (tile.color_linear[~tile.seen].max(-1) > 0.01).all()  # nothing is left black


def test_each_tile_is_a_picture_of_its_own(result):
    tiles = {tile.number: tile for tile in result.template.tiles}
    assert sorted(tiles) == [1001, 1002]
    assert (tiles[1001].faces ^ tiles[1002].faces).all()
    # They meet in the middle of the face.
    image, middle = s2a.geometry_image(result.fitted, result.unlit.scan, SIZE), SIZE // 2
    for tile, column in ((tiles[1001], -3), (tiles[1002], 2)):
        there = tile.color_linear[128:192, column], image.texture_linear[middle : middle + 32, middle]
        assert np.abs(there[0][::2] - there[1]).mean() < 0.03


def test_files_and_plan_tell_of_both(result):
    record = read_json(result.out / "result.json")
    assert files_in(result.out) & set(record["files"]) >= {
        *("unlit.glb", "unlit.obj", "unlit.mtl", "unlit.png", "unlit_confidence.png"),
        *("template.obj", "template.mtl", "template.glb", "template.1001.png", "template.1002.png"),
        *("template_normal.1001.png", "template_normal.1002.png"),
    }
    assert result.plan.ran("unlit")
    assert result.plan.ran("template_texture")
    assert record["options"]["unlit"] == "all"
    assert record["template_from_model"] is None  # the model was not made from a mesh
    again = s2a.load_scan(result.out / "unlit.obj", unit="mm")
    assert_allclose(again.vertices, result.scan.vertices, atol=1e-4)
    assert_allclose(again.texture_linear, np.clip(result.unlit.scan.texture_linear, 0, 1), atol=0.01)
    assert s2a.load_scan(result.out / "template.glb").texture_linear is not None


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"skip": ["albedo"]}, "no albedo was estimated, so the light is not known"),
        ({"budget": 0.05}, "the budget ended before it"),
    ],
)
def test_what_cannot_be_made_is_left_out_with_its_reason_and_the_face_comes_first(
    coarse_scan, options, reason
):
    made = s2a.process(coarse_scan[0], size=32, quality="draft", unlit="all", **options)
    (step,) = made.plan.of_stage("unlit")
    assert not step.ran
    assert step.reason == f"unlit is left out: {reason}"
    assert step.level == "wrong"
    assert step.text in made.notes
    assert made.unlit is None
    assert made.fitted is not None


@pytest.mark.slow
def test_minimal_files_leave_out_what_others_have_and_all_have_the_unlit_scan(coarse_scan, tmp_path):
    options = {"size": 32, "quality": "draft", "budget": s2a.Budget(evaluations=20)}
    minimal = s2a.process(coarse_scan[0], tmp_path / "a", files="minimal", **options)
    names = files_in(minimal.out)
    assert names == {
        *("result.json", "registration.json", "landmarks.json", "landmarks.csv", "trace.csv"),
        *("geometry_image.npz", "albedo.exr", "albedo.png", "fitted.glb"),
    }
    load_result(minimal.out)
    every = s2a.process(coarse_scan[0], tmp_path / "a", files="all", **options)
    assert {"unlit.glb", "overview.png"} <= files_in(every.out)


def test_several_pictures_come_back_as_they_came(tmp_path):
    flat, faces = grid(9, 9)
    right = flat[faces].mean(1)[:, 0] > 0.5
    rng = np.random.default_rng(0)
    pictures = tuple(
        MeshPicture(name, encode_image(rng.uniform(0.2, 0.9, (*size, 3)), ".png"), chosen)
        for name, size, chosen in (("a.png", (40, 30), ~right), ("b.png", (20, 50), right))
    )
    uv = np.clip(flat[faces][..., :2], 0.01, 0.99)
    write_textured_obj(tmp_path / "two.obj", TexturedMesh(180 * flat, faces, uv, pictures))
    scan = s2a.load_scan(tmp_path / "two.obj", unit="mm")
    assert [tile.name for tile in scan.texture_tiles] == ["a", "b"]
    write_unlit(tmp_path, UnlitScan(scan, np.ones(scan.texture_linear.shape[:2], np.float32)))
    for number, picture in enumerate(pictures):
        assert (tmp_path / f"unlit.{number}.png").read_bytes() == picture.png
        assert (tmp_path / f"unlit_confidence.{number}.png").is_file()
    again = s2a.load_scan(tmp_path / "unlit.obj", unit="mm")
    assert_allclose(again.uv, scan.uv, atol=1e-7)
    assert_array_equal(again.texture_linear, scan.texture_linear)
    assert s2a.load_scan(tmp_path / "unlit.glb").texture_linear.shape == scan.texture_linear.shape


def test_pictures_keep_their_sixteen_bits(result, tmp_path):
    texture = result.scan.texture_linear  # of eight bits, as the synthetic scanner's
    assert not is_deep(texture)
    assert not is_deep(texture * np.float32([1.1, 1, 0.9]))  # a white balance leaves green
    assert is_deep(0.97 * texture)
    deep = replace(result.scan, texture_linear=0.97 * texture[:64, :64])
    unlit = UnlitScan(deep, np.ones((64, 64), np.float32))
    for samples, exact in ((np.uint8, 0.005), (np.uint16, 3e-5)):
        write_unlit(tmp_path, unlit, samples, exr=samples is np.uint16)
        assert read_image_values(tmp_path / "unlit.png").dtype == samples
        again = read_image_linear(tmp_path / "unlit.png")
        assert_allclose(again, np.clip(deep.texture_linear, 0, 1), atol=exact)
    assert_array_equal(read_image_linear(tmp_path / "unlit.exr"), deep.texture_linear)
    write_template(tmp_path, result.template, np.uint16, exr=True)
    for tile in result.template.tiles:
        for folder, samples in ((result.out, np.uint8), (tmp_path, np.uint16)):
            picture = read_image_values(folder / f"template.{tile.number}.png", alpha=True)
            assert picture.dtype == samples
            assert_array_equal(picture[..., 3] > 0, tile.seen)
        assert_array_equal(read_image_linear(tmp_path / f"template.{tile.number}.exr"), tile.color_linear)


def test_no_exported_texture_has_a_fringe_at_the_rim_of_its_charts(result, tmp_path):
    face = load_result(result.out)
    write_face(swap_texture(face, face), tmp_path, application="swap", inputs=[face, face])
    steps = [
        (rim_step(picture, covered), folder, name)
        for folder in (result.out, tmp_path)
        for name, picture, covered in exported_textures(folder)
    ]
    assert len(steps) >= 6
    assert max(steps)[0] < LIMIT, steps
