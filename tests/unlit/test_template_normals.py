"""Normal maps of templates: read as glTF says, they give back the shape the template lacks."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.eyeglasses import angle_deg
from helpers.fits import fit_of
from helpers.gltf import Gltf
from helpers.measures import row_lengths
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

import scan2albedo as s2a
from scan2albedo.core import RawScan
from scan2albedo.geometry.loop_subdivision import SurfacePoints
from scan2albedo.geometry.mesh import normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear
from scan2albedo.geometry.rigid import compose, invert_rigid, rotation_from_vector, transform_points
from scan2albedo.unlit.files import write_template
from scan2albedo.unlit.template_baking import FineShape, tangent_normals, template_texture

HALF_MM = 60.0
WAVE_MM = 9.0
HEIGHT_MM = 3.0
POSE = compose(rotation_from_vector([0.3, -1.0, 0.4]), [10.0, 200.0, -30.0])


def bumps(cells):
    """A cap with bumps, the same on both sides of x = 0, on a grid of so many cells a side."""
    flat, _ = grid(cells + 1, cells + 1)
    x, y, _ = (2 * flat.T - 1) * HALF_MM
    height = HEIGHT_MM * np.cos(x / WAVE_MM) * np.cos(y / WAVE_MM) - (x**2 + y**2) / 250
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    below, right = corner + cells + 1, (corner % (cells + 1) >= cells // 2).astype(int)
    # Diagonals, too, are the same on both sides.
    first = np.stack([corner, corner + 1, below + right], 1)
    faces = np.concatenate([first, np.stack([corner + 1 - right, below + 1, below], 1)])
    return np.stack([x, y, height], axis=1), faces


def true_normals(points):
    turn = points[:, :2] / WAVE_MM
    down = HEIGHT_MM / WAVE_MM * np.sin(turn) * np.cos(turn[:, ::-1]) + points[:, :2] / 125
    return normalized(np.insert(down, 2, 1, axis=1))


def plain(x, y, right):
    return np.stack([x, y], axis=-1) / (2 * HALF_MM) + 0.5


def turned(x, y, right):
    return plain(x, y, right)[..., ::-1] * [1, -1] + [0, 1]


def mirrored(x, y, right):
    """Both halves on the same texels, with a common line."""
    return np.stack([np.abs(x) / HALF_MM, y / (2 * HALF_MM) + 0.5], axis=-1)


def two_tiles(x, y, right):
    """The left half is mirrored, in a tile of its own."""
    uv = mirrored(x, y, right) * 0.9 + 0.05
    uv[..., 0] += ~right
    return uv


def charted(cells, chart):
    """Return vertices and faces of bumps, and the coordinates (F, 3, 2) of their corners by a chart."""
    vertices, faces = bumps(cells)
    corners = vertices[faces]
    right = np.broadcast_to(corners.mean(1)[:, :1] > 0, faces.shape)
    return vertices, faces, chart(corners[..., 0], corners[..., 1], right)


def carried(chart, noise_mm=0.0, scan_cells=120):
    """A coarse template on a smooth fitted surface, and a scan of it in another pose, with noise."""
    vertices, faces, uv = charted(8, chart)
    fine, fine_faces = bumps(60)
    scanned, scan_faces = bumps(scan_cells)
    rng = np.random.default_rng(1)
    scanned += true_normals(scanned) * rng.normal(0, noise_mm, (len(scanned), 1))
    at_first = SurfacePoints(np.zeros(len(vertices), np.int64), np.tile([1.0, 0, 0], (len(vertices), 1)))
    model = replace(
        s2a.AnnotatedFaceModel.default(), template_points=at_first, template_faces=faces, template_uv=uv
    )
    fitted = replace(
        fit_of(model, model.control_vertices),
        vertices=fine,
        faces=fine_faces,
        uv=plain(*fine.T),
        region=np.zeros(len(fine_faces), np.uint8),
        residual_mm=np.zeros(len(fine)),
        model_from_scan=POSE,
        template_vertices=vertices,
    )
    color = np.full(scanned.shape, 0.5, np.float32)
    placed = transform_points(invert_rigid(POSE), scanned)
    return RawScan(placed, scan_faces, vertex_color_linear=color, name="cap"), fitted


def parts_of(path):
    """Yield of each mesh of a GLB its arrays by name, and the picture of its normals."""
    file = Gltf.read(path)
    for mesh in file.tree["meshes"]:
        (primitive,) = mesh["primitives"]
        arrays = {name: file.array(number).astype(float) for name, number in primitive["attributes"].items()}
        arrays["faces"] = file.array(primitive["indices"]).reshape(-1, 3)
        texture = file.tree["materials"][primitive["material"]]["normalTexture"]
        image = file.tree["images"][file.tree["textures"][texture["index"]]["source"]]
        assert image["mimeType"] == "image/png"
        view = file.tree["bufferViews"][image["bufferView"]]
        encoded = np.frombuffer(file.binary, np.uint8, view["byteLength"], view["byteOffset"])
        picture = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)[..., ::-1]
        assert picture.shape[2] == 3
        yield arrays, picture


def shaded(arrays, picture):
    """Return points (N, 3) in mm, and normals (N, 3) there without and with the map, by glTF 2.0."""
    weights = np.array([[0.34, 0.33, 0.33], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
    point, normal, tangent, uv = (
        np.einsum("kb,fbc->fkc", weights, arrays[name][arrays["faces"]]).reshape(-1, arrays[name].shape[1])
        for name in ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")
    )
    pixels = np.mod(uv, 1) * picture.shape[1::-1] - 0.5
    x, y, z = (bilinear(picture / 255.0, pixels) * 2 - 1).T[..., None]
    flat, right = normalized(normal), normalized(tangent[:, :3])
    up = np.cross(flat, right) * tangent[:, 3:]
    return point * 1000, flat, normalized(x * right + y * up + z * flat)


@pytest.mark.parametrize("chart", [plain, turned, mirrored, two_tiles])
def test_a_coarse_template_is_shaded_like_the_fine_surface(tmp_path, chart):
    painted = template_texture(*carried(chart), 256)
    write_template(tmp_path, painted)
    parts = list(parts_of(tmp_path / "template.glb"))
    assert len(parts) == len(painted.tiles) == (2 if chart is two_tiles else 1)
    for arrays, picture in parts:
        tangents, hands = np.split(arrays["TANGENT"], [3], axis=1)
        assert np.isin(hands, [-1, 1]).all()
        assert_allclose(row_lengths(tangents), 1, atol=1e-6)
        assert_allclose(np.einsum("ij,ij->i", tangents, arrays["NORMAL"]), 0, atol=1e-6)
        at = row_lengths(arrays["POSITION"][:, None] * 1000 - painted.vertices).argmin(1)
        assert_allclose(arrays["NORMAL"], vertex_normals(painted.vertices, painted.faces)[at], atol=1e-6)
        points, without, with_map = shaded(arrays, picture)
        inner = np.abs(points[:, :2]).max(1) < HALF_MM - 5  # the grids' rims are one-sided
        true = true_normals(points)
        before, after = (angle_deg(found, true)[inner] for found in (without, with_map))
        assert before.mean() > 6
        assert after.mean() < 0.5
        assert np.percentile(after, 95) < 1.5
    hands = np.concatenate([arrays["TANGENT"][:, 3] for arrays, _ in parts])
    assert (len(np.unique(hands)) == 2) == (chart in (mirrored, two_tiles))


def test_noise_of_the_scan_stays_out_and_without_a_scan_the_fit_serves():
    def mean_error(noise_mm, scanned):
        scan, fitted = carried(plain, noise_mm)
        points = fitted.vertices[np.abs(fitted.vertices[:, :2]).max(1) < HALF_MM - 5]
        found, known = FineShape(fitted, scan if scanned else None).normals(points)
        assert known.all()
        return angle_deg(found, true_normals(points)).mean()

    noisy = carried(plain, 0.1)[0]
    found = vertex_normals(noisy.vertices, noisy.faces) @ POSE[:3, :3].T
    raw = angle_deg(found, true_normals(bumps(120)[0])).mean()
    assert raw > 3
    assert mean_error(0.1, True) < 0.4 * raw
    assert mean_error(0.0, True) < mean_error(0.0, False)


def test_what_lies_far_is_flat_and_another_side_does_not_stand():
    _, fitted = carried(plain)
    away = RawScan(fitted.vertices + 1000, fitted.faces)
    shape = FineShape(replace(fitted, model_from_scan=np.eye(4)), away)
    middle = len(fitted.vertices) // 2
    points = fitted.vertices[middle] + [[0, 0, 0], [0, 0, 9]]
    fine = shape.normals(points)
    assert_array_equal(fine[1], [True, False])
    frames = np.tile([0.0, 0, -1], (2, 1)), np.tile([1.0, 0, 0, 1], (2, 1))
    found, stands = tangent_normals(fine, *frames)
    assert_array_equal(found[1], [0, 0, 1])
    assert_array_equal(stands, [False, True])


def test_a_texture_made_in_bands_is_the_same(monkeypatch):
    whole = template_texture(*carried(plain), 64).tiles[0]
    monkeypatch.setattr("scan2albedo.unlit.template_baking.LARGEST_TEXTURE", 256)  # four rows a band
    banded = template_texture(*carried(plain), 64).tiles[0]
    for name in ("color_linear", "seen", "normal"):
        assert_allclose(getattr(banded, name), getattr(whole, name), atol=2e-3)
    assert whole.normal[..., 0].std() > 0.02


def test_files_of_the_map_are_named_like_the_colours(tmp_path):
    for chart, names in ((plain, [""]), (two_tiles, [".1001", ".1002"])):
        painted = template_texture(*carried(chart), 32)
        write_template(tmp_path, painted)
        text = (tmp_path / "template.mtl").read_text()
        for name, tile in zip(names, painted.tiles, strict=True):
            assert f"map_Kd template{name}.png\nnorm template_normal{name}.png\n" in text
            stored = cv2.imread(str(tmp_path / f"template_normal{name}.png"))[..., ::-1]
            assert np.abs(stored / 127.5 - 1 - tile.normal).max() < 0.005
            assert_allclose(row_lengths(tile.normal), 1, atol=1e-5)
