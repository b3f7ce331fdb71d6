"""Meshes, textures, residuals and charts of the page, against what they were made of."""

import base64
import io

import numpy as np
import pytest
import trimesh
from helpers.meshes import sphere
from numpy.testing import assert_array_equal
from PIL import Image

from scan2albedo.core import TraceRow
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.geometry.mesh import face_areas, face_normals, normalized
from scan2albedo.geometry.rigid import compose
from scan2albedo.io.color import decode_srgb_integers
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.records import read_record, write_record
from scan2albedo.io.result_records import InputRecord, RegistrationRecord, ResultRecord
from scan2albedo.report.html.charts import Axis, read_trace, stage_charts
from scan2albedo.report.html.encoding import (
    gray_entry,
    mesh_entry,
    octahedral,
    patch_entry,
    residual_of_result,
    texture_entry,
    thinned_chart,
)
from scan2albedo.unlit.processed_face import FaceMesh
from tests.report.pages import TRACE_HEAD


def numbers(text, dtype, columns):
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, columns).astype(float)


def pixels(entry):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(entry["data"]))))


def sheet(size):
    """A square of 1 mm texels over the plane."""
    y, x = np.mgrid[0:size, 0:size].astype(float)
    normal = np.tile([0.0, 0, 1], (size, size, 1))
    return GeometryImage(np.stack([x, -y, 0 * x], -1), normal, np.ones((size, size), bool))


def faces_up(mesh_vertices, faces):
    return (face_normals(mesh_vertices, faces)[:, 2] > 0).all()


def test_meshes_survive_16_bits():
    vertices, faces = sphere(3)
    mesh = FaceMesh(vertices + 40, faces, (vertices[:, :2] + 90) / 180)
    topologies = {}
    entry = mesh_entry(mesh, topologies)
    place = numbers(entry["positions"], "<u2", 3) / 65535 * entry["span"] + entry["low"]
    assert np.abs(place - mesh.vertices).max() <= 180 / 65535 / 2 + 1e-9
    kept = topologies[entry["topology"]]
    assert_array_equal(numbers(kept["faces"], "<u2", 3), mesh.faces)
    assert np.abs(numbers(kept["uv"], "<u2", 2) / 65535 - mesh.uv).max() < 1e-5
    # The same triangles again are kept once.
    assert mesh_entry(mesh, topologies)["topology"] == entry["topology"]
    assert len(topologies) == 1


def test_octahedral_normals_are_off_by_5_thousandths_of_a_degree_at_most():
    normals = np.random.default_rng(0).normal(size=(5000, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals = normalized(normals)
    e = octahedral(normals) / 32767
    back = np.column_stack([e, 1 - np.abs(e).sum(1)])
    under = back[:, 2] < 0
    back[under, :2] = ((1 - np.abs(back[:, 1::-1])) * np.where(back[:, :2] >= 0, 1, -1))[under]
    assert np.degrees(np.linalg.norm(normalized(back) - normals, axis=1)).max() < 0.005


@pytest.mark.parametrize("most", [800, 300, 60])
def test_a_thinned_chart_covers_what_the_chart_covers(most):
    image = sheet(49)
    row, column = np.mgrid[0:49, 0:49]
    mask = (row - 24) ** 2 + (column - 24) ** 2 < 500
    mask[:, 20] = False  # a seam
    image = GeometryImage(image.position, image.normal, mask)
    full, thin = FaceMesh.of_chart(image), thinned_chart(image, most)
    area = [face_areas(m.vertices, m.faces).sum() for m in (full, thin)]
    assert area[1] == pytest.approx(area[0])
    assert len(thin.vertices) < 0.75 * len(full.vertices)
    assert faces_up(thin.vertices, thin.faces)


def test_a_mirrored_chart_faces_the_way_of_its_normals():
    image = sheet(12)
    position, mask = image.position.copy(), image.mask.copy()
    mask[:, 5] = False
    position[:, 6:, 0] = 40 - position[:, 6:, 0]
    assert faces_up(*GeometryImage(position, image.normal, mask).triangulated())


def test_textures_hold_the_linear_values_to_8_bits_of_srgb():
    rng = np.random.default_rng(1)
    linear, mask = rng.uniform(0.001, 0.2, (40, 30, 3)).astype(np.float32), np.ones((40, 30), bool)
    entry = texture_entry(linear, mask, 64)
    back = decode_srgb_integers(pixels(entry)) / entry["factor"]
    # Half a step is 0.0045 of white at most; the brightest 0.1 % of the texels is clipped.
    assert np.abs(back - linear).max() < 0.005 * 0.2
    small = texture_entry(linear, mask, 10, quality=90)
    assert pixels(small).shape == (10, 8, 3)
    assert small["type"] == "image/jpeg"


def test_textures_are_carried_on_beyond_the_mask_and_may_be_black():
    linear, mask = np.zeros((8, 8, 3)), np.zeros((8, 8), bool)
    mask[:, :4] = True
    linear[:, :4] = 0.5
    assert (pixels(texture_entry(linear, mask, 8)) == 255).all()
    black = texture_entry(np.zeros((8, 8, 3)), mask, 8)
    assert black["factor"] == 1.0
    assert (pixels(black) == 0).all()
    gloss = gray_entry(np.where(mask, 2.0, 0.0), mask, 8)
    assert gloss["scale"] == 2.0
    assert (pixels(gloss) == 255).all()


def test_a_patch_holds_what_differs_alone_also_beyond_the_mask():
    under, mask = np.full((8, 8, 3), 0.5), np.zeros((8, 8), bool)
    mask[:, 2:] = True
    over = under.copy()
    over[3, 2:4] = 0.25
    patch = pixels(patch_entry(over, under, mask, 8, 2.0))
    whole = pixels(texture_entry(over, mask, 8, factor=2.0))
    assert (patch[3, :4, 3] == 255).all()
    assert_array_equal(patch[3, :4, :3], whole[3, :4])
    assert np.count_nonzero(patch[..., 3]) == 4


def test_residuals_are_measured_again_from_the_input(write_scan, tmp_path):
    """A scan lies 0.5 mm under a square, in another place."""
    vertices, faces = sheet(30).triangulated()
    scan, result = tmp_path / "scan.ply", tmp_path / "r"
    trimesh.Trimesh(vertices + (0, 0, 99.5), faces, process=False).export(scan)
    mesh = FaceMesh(vertices, faces, np.zeros((len(vertices), 2)))
    inside = (np.abs(np.abs(vertices[:, :2]) - 14.5) < 11.5).all(1)
    source = InputRecord(file=str(scan), sha256=input_sha256(scan), vertices=900, faces=1682)
    write_scan(result, input=source, options={"unit": "mm"})
    pose = compose(np.eye(3), [0, 0, -100])
    figures = {"rmse_mm": 1.0, "converged": True, "confidence": 1.0, "iterations": 1}
    poses = RegistrationRecord(model_from_scan=pose, fitted_from_scan=pose, **figures)
    write_record(result / "registration.json", poses)
    record = read_record(result / "result.json", ResultRecord)
    distance_mm, source = residual_of_result(result, record, mesh)
    assert np.nanmax(np.abs(distance_mm[inside] - 0.5)) < 1e-4
    assert source == "measured again against scan.ply: 0.500 mm in the mean"
    scan.write_bytes(scan.read_bytes() + b"\n")
    assert "no longer the scan" in residual_of_result(result, record, mesh)[1]
    scan.unlink()
    assert "no longer there" in residual_of_result(result, record, mesh)[1]


def rows(errors):
    return [TraceRow("fit", 0.1 * k, 0.1 * k, k, error, "mm") for k, error in enumerate(errors)]


def test_error_axes_are_logarithmic_where_the_error_falls_by_much():
    (falling,), (slow,) = stage_charts(rows([8.0, 2.0, 0.1])), stage_charts(rows([0.3, 0.2]))
    assert falling["error"].log
    assert not slow["error"].log
    assert falling["places"][0][1] < falling["places"][1][1] < falling["places"][2][1]
    assert len(falling["error_ticks"]) >= 2


def test_long_traces_keep_their_first_and_last_points():
    (chart,) = stage_charts(rows(np.linspace(2, 1, 5001)))
    assert len(chart["rows"]) <= 361
    assert (chart["rows"][0].error, chart["rows"][-1].error) == (2.0, 1.0)
    assert chart["summary"] == "2 → 1 mm after 5,000 evaluations"


def test_an_error_that_hardly_changes_is_a_line_that_hardly_rises():
    axis = Axis.around([1.0261790, 1.0261791], 0, 100)
    assert abs(axis.place(1.0261791) - axis.place(1.0261790)) < 0.1
    assert len({f"{tick:.6g}" for tick in axis.ticks()}) == len(axis.ticks())


@pytest.mark.parametrize("values", [[0.0], [3.0, 3.0], [-1.0, 1e-9], [1e-12, 1e12], [5e7, 5.1e7]])
def test_axes_hold_any_values(values):
    axis = Axis.around(values, 10, 110)
    assert all(10 <= axis.place(value) <= 110 for value in values)
    assert 1 <= len(axis.ticks()) <= 12


def test_traces_leave_out_what_is_not_finite_and_refuse_other_files(tmp_path):
    file = tmp_path / "trace.csv"
    file.write_text(f"{TRACE_HEAD}a,1,1,1,nan,mm\na,2,2,2,0.5,mm\n")
    assert [row.error for row in read_trace(file)] == [0.5]
    file.write_text("x,y\n1,2\n")
    with pytest.raises(Scan2AlbedoError, match="line 2 is not a row of a trace"):
        read_trace(file)
    with pytest.raises(Scan2AlbedoError, match="cannot be read"):
        read_trace(tmp_path / "none.csv")
