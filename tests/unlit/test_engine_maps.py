"""Maps of a skin material, and colours baked from one mesh onto another."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers.gltf import Gltf
from numpy.testing import assert_allclose

from scan2albedo.applications import bake, engine_maps
from scan2albedo.core import GeometryImage, RawScan
from scan2albedo.errors import ApplicationError
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.io.images import read_exr_channels
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.unlit.engine_maps import MATTE_EXPONENT
from scan2albedo.unlit.files import write_template
from tests.unlit.test_template_normals import HALF_MM, POSE, carried, charted, mirrored, plain, two_tiles

CENTERS_MM = ((np.arange(128) + 0.5) / 128 * 2 - 1) * HALF_MM
"""Of the texels of a picture with 128 a side."""


def estimate(strength=0.2, exponent=20.0):
    """What the maps ask of an albedo: its reflectance, and gloss that is twice as strong on the right."""
    mask = np.ones((16, 16), bool)
    scale = np.where(np.arange(16) < 8, 0.5, 1.0) * mask
    normal = mask[..., None] * [0.0, 0, 1]
    image = GeometryImage(0 * normal, normal, mask, specular_scale=scale)
    reflectance = Reflectance("oren-nayar", 0.3, strength, exponent)
    return SimpleNamespace(image=image, reflectance=reflectance, shading=np.full((16, 16, 3), 1.5))


def test_maps_show_relief_occlusion_and_gloss():
    scan, fitted = carried(plain)
    (tile,) = engine_maps(scan, fitted, estimate(), "template", 128).tiles
    x, y = np.meshgrid(CENTERS_MM, CENTERS_MM)
    inner = np.maximum(np.abs(x), np.abs(y)) < HALF_MM - 8
    # Coordinates grow upward, rows downward; the bumps are the same on both sides.
    bump = np.cos(x / 9) * np.cos(y / 9)
    for name in ("displacement_mm", "cavity"):
        assert np.corrcoef(tile.maps[name][inner], bump[inner])[0, 1] > 0.7, name
    assert np.ptp(tile.maps["displacement_mm"][inner]) > 2
    assert 0 <= tile.maps["cavity"].min() < 0.5 < tile.maps["cavity"].max() <= 1
    assert_allclose(tile.maps["roughness"], 41**-0.25, rtol=1e-5)
    # The peak of a GGX lobe, F0 (2 m + 1) / 4 of the light, is Phong's k_s, as bright as the albedo is made.
    assert_allclose(tile.maps["specular"][64, [8, -8]] * 0.04 * 41 / 4, [0.5 * 0.3, 0.3], rtol=0.01)
    (matte,) = engine_maps(scan, fitted, estimate(0.0), "chart", 32).tiles
    assert_allclose(matte.maps["specular"][16, [2, -2]], [0.35, 0.7], rtol=0.01)
    assert_allclose(matte.maps["roughness"], (2 * MATTE_EXPONENT + 1) ** -0.25, rtol=1e-5)
    # The chart's mesh has the bumps itself: its valleys see less of the sky, and the scan adds nothing.
    assert np.abs(matte.maps["displacement_mm"]).max() < 0.2
    open_sky = matte.maps["occlusion"]
    assert np.corrcoef(open_sky[4:-4, 4:-4].ravel(), bump[16:-16:4, 16:-16:4].ravel())[0, 1] > 0.6
    assert 0.6 < open_sky.min() < open_sky.max() <= 1


def test_the_noise_of_a_coarse_scan_is_not_in_the_displacement():
    (tile,) = engine_maps(*carried(plain, 0.3, 60), estimate(), "chart", 128).tiles
    high = tile.maps["displacement_mm"][16:-16, 16:-16]
    # The fitted surface has the true shape: what the scan, 2 mm between its vertices, differs by is noise.
    assert high.std() < 0.1
    # Averaging the scan's own points would have lowered the bumps, 3 mm high, by .3 mm.
    bump = np.cos(CENTERS_MM[16:-16] / 9)
    assert abs(high[np.outer(bump, bump) > 0.9].mean()) < 0.1


def test_pores_are_dark_spots_and_a_scan_has_no_displacement_of_its_own():
    scan, fitted = carried(plain, scan_cells=60)
    uv = plain(*transform_points(POSE, scan.vertices)[scan.faces].T).swapaxes(0, 1)
    texture = np.full((256, 256, 3), 0.5, np.float32)
    texture[100:102, 100:102] = 0.05
    scan = replace(scan, vertex_color_linear=None, texture_linear=texture, uv=uv)
    (tile,) = engine_maps(scan, fitted, estimate(), "scan", 256).tiles
    assert "displacement_mm" not in tile.maps
    assert tile.maps["cavity"][100:102, 100:102].max() < tile.maps["cavity"][90:110, 90:110].mean() - 0.2
    assert tile.color_linear[100, 100].max() < 0.2 < 0.45 < tile.color_linear[90, 90].min()


@pytest.mark.parametrize("chart", [plain, two_tiles])
def test_files_of_maps_are_what_engines_read(tmp_path, chart):
    baked = engine_maps(*carried(chart), estimate(), "template", 32)
    write_template(tmp_path, baked, np.uint16, stem="maps")
    for tile in baked.tiles:
        end = "" if chart is plain else f".{tile.number}"

        def stored(name, end=end):
            picture = cv2.imread(str(tmp_path / f"maps_{name}{end}.png"), cv2.IMREAD_UNCHANGED)
            assert picture.dtype == np.uint16
            return np.atleast_3d(picture)[..., ::-1].squeeze() / 65535

        normal = 2 * stored("normal") - 1
        assert_allclose(normal, tile.normal, atol=1e-4)
        assert_allclose(2 * stored("normal_directx")[..., 1] - 1, -normal[..., 1], atol=1e-4)
        for name in ("occlusion", "roughness", "cavity"):
            assert_allclose(stored(name), tile.maps[name], atol=1e-4)
        high = tile.maps["displacement_mm"]
        assert_allclose((stored("displacement") - 0.5) * 8, high, atol=1e-3)
        exr = read_exr_channels(tmp_path / f"maps_displacement{end}.exr")
        assert_allclose(exr["Y"], high, atol=1e-3)
    tree = Gltf.read(tmp_path / "maps.glb").tree
    assert tree["extensionsUsed"] == ["KHR_materials_specular"]
    for material in tree["materials"]:
        surface = material["pbrMetallicRoughness"]
        texture = material["extensions"]["KHR_materials_specular"]["specularTexture"]
        assert texture["index"] == material["occlusionTexture"]["index"]
        assert texture["index"] == surface["metallicRoughnessTexture"]["index"]
        assert surface["roughnessFactor"] == 1
    text = (tmp_path / "maps.usda").read_text()
    tile_name = "" if chart is plain else ".<UDIM>"
    for name in ("", "_normal", "_occlusion", "_roughness", "_displacement"):
        assert f"@./maps{name}{tile_name}.png@" in text


def test_the_usd_file_is_read_by_openusd(tmp_path):
    pytest.importorskip("pxr", reason="OpenUSD is not installed (pip install usd-core)")
    from pxr import Usd, UsdGeom, UsdShade

    scan, fitted = carried(plain)
    write_template(tmp_path, engine_maps(scan, fitted, estimate(), "template", 16), np.uint16, stem="maps")
    stage = Usd.Stage.Open(str(tmp_path / "maps.usda"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/face/surface"))
    assert_allclose(mesh.GetPointsAttr().Get(), fitted.template_vertices, rtol=1e-5, atol=1e-5)
    corners = UsdGeom.PrimvarsAPI(mesh.GetPrim()).GetPrimvar("st").ComputeFlattened()
    assert_allclose(corners, fitted.model.template_uv.reshape(-1, 2), atol=1e-5)
    bound, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
    shader, _, _ = bound.ComputeSurfaceSource()
    assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
    assert shader.GetInput("roughness").HasConnectedSource()


def test_maps_need_coordinates_and_colours():
    scan, fitted = carried(plain)
    bare = replace(fitted.model, template_points=None, template_faces=None, template_uv=None)
    for given, surface, words in (
        ((scan, fitted), "scan", "cap: the scan has no texture coordinates"),
        ((replace(scan, vertex_color_linear=None), fitted), "chart", "cap: the scan has no colours"),
        ((scan, replace(fitted, model=bare)), "template", "no template with texture coordinates"),
    ):
        with pytest.raises(ApplicationError, match=words):
            engine_maps(*given, estimate(), surface, 32)
    with pytest.raises(ValueError, match="maps is 'skin', expected one of None, chart, scan, template"):
        ProcessOptions(maps="skin")


def test_colours_go_from_one_layout_to_another():
    vertices, faces, uv = charted(20, plain)
    texture = np.full((128, 128, 3), 0.5, np.float32)
    texture[..., 1] = np.linspace(0, 1, 128)
    texture[..., 0] = texture[..., 1].T
    source = RawScan(vertices, faces, texture_linear=texture, uv=uv, name="source")
    for chart in (mirrored, two_tiles):
        target = RawScan(vertices, faces, uv=charted(20, chart)[2], name="target")
        for tile in bake(source, target, 64).tiles:
            middle = np.s_[20:44, 20:44]
            assert tile.seen[middle].all()
            # Green grows with x, red with -y; both layouts are as high as the source's.
            down = np.tile((np.arange(20, 44)[:, None] + 0.5) / 64, 24)
            if chart is mirrored:
                assert_allclose(tile.color_linear[middle][..., 0], down, atol=0.02)
            assert np.abs(np.diff(tile.color_linear[middle][..., 1], axis=1)).mean() > 0.005
            assert_allclose(tile.normal[middle][..., 2], 1, atol=0.05)
    with pytest.raises(ApplicationError, match="source: the mesh has no texture coordinates"):
        bake(source, replace(source, uv=None, texture_linear=None, vertex_color_linear=vertices * 0.0))
    with pytest.raises(ApplicationError, match="target: the mesh has no colours to bake"):
        bake(target, source)


def test_colours_go_through_the_face_to_another_pose():
    scan, fitted = carried(plain)
    scan = replace(scan, vertex_color_linear=np.abs(np.sin(transform_points(POSE, scan.vertices) / 40)) * 0.9)
    other = compose(rotation_from_vector([-0.5, 0.2, 1.0]), [-40.0, 3.0, 7.0])
    vertices, faces, uv = charted(20, plain)
    target = RawScan(transform_points(np.linalg.inv(other), vertices), faces, uv=uv, name="target")
    (tile,) = bake(scan, target, 64, (fitted, replace(fitted, model_from_scan=other))).tiles
    at = CENTERS_MM.reshape(64, 2).mean(1)[8:-8]
    middle = np.s_[8:-8, 8:-8]
    assert tile.seen[middle].all()
    expected = np.broadcast_to(np.abs(np.sin(at / 40)) * 0.9, (48, 48))
    assert_allclose(tile.color_linear[middle][..., 0], expected, atol=0.03)
