"""One scan's page: whole, safe, and it says what the files say."""

import base64
import json
import sys

import numpy as np
import pytest
from helpers.records import files_in
from numpy.testing import assert_allclose

import scan2albedo as s2a
from scan2albedo import report
from scan2albedo.applications import load_result, relight
from scan2albedo.errors import MissingDependencyError, OutputError, Scan2AlbedoError
from scan2albedo.lighting.environment_light import open_transfer
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.report.html.write import _environment, data_json
from tests.report.pages import check, written

EVIL = "<script>alert('x')</script>\"'&<!--"


def test_a_scan_gets_a_page_beside_its_files(one_scan):
    made = report.write_report(one_scan)
    assert made.path == one_scan / "report.html"
    assert (made.scans, made.done, made.failed, made.sections) == (1, 1, 0, 1)
    words = check(made).words()
    for told in (
        "fit 0.125 mm mean · 2 lights at (35°, 20°), (−50°, 5°) · albedo ± 3.7 % a texel · 12.5 s",
        "albedo · shadows did it shades itself at most 28 %",
        "left out no model was asked for",
        "± 0.5°",
        "Other lights explain the image nearly as well: (−20°, 5°), 2 times less probable",
        "0" * 64,
    ):
        assert told in words


def test_a_report_of_somebody_else_is_never_replaced(one_scan):
    path = report.write_report(one_scan).path
    assert report.write_report(one_scan).path == path  # our own is
    path.write_text("<title>mine</title>")
    with pytest.raises(OutputError, match=r"holds report\.html, which no run of scan2albedo report wrote"):
        report.write_report(one_scan)
    assert path.read_text() == "<title>mine</title>"
    report.write_report(one_scan, path)  # asked for by name
    assert path.read_text() != "<title>mine</title>"


def embedded(page):
    """Return the data of a page by the names of its scripts."""
    return {a["id"]: json.loads(text) for _, a, text in page.raw if a.get("type") == "application/json"}


def test_the_viewer_gets_lights_reflectance_and_textures(one_scan, tmp_path):
    page = written(one_scan, tmp_path / "a.html")
    data = embedded(page)
    face = data["scan-face"]
    assert f"topology-{face['topology']}" in data
    assert [light["azimuth"] for light in face["lights"]] == pytest.approx([35, -50])
    assert face["reflectance"] == {"brdf": "oren-nayar", "roughness": 0.3, "strength": 0.15, "exponent": 20.0}
    assert face["albedo"]["type"] == "image/png"
    assert {"texture", "frame", "positions", "normals"} <= set(face)


def test_whatever_a_result_holds_is_text(write_scan, tmp_path):
    evil = {"name": EVIL, "notes": (EVIL,), "versions": {EVIL: EVIL}, "timings_s": {EVIL: 1.0}}
    options = {EVIL: EVIL, "model": "none"}
    folder = write_scan(tmp_path / "evil", options=options, files=(EVIL,), **evil)
    page = written(folder, tmp_path / "page.html")
    assert page.words().count(EVIL) >= 6
    assert len([raw for raw in page.raw if raw[0] == "script"]) == 3


def test_files_that_are_damaged_or_missing_leave_their_part_out_and_say_so(write_scan, tmp_path):
    folder = write_scan(tmp_path / "poor")
    for name in ("geometry_image.npz", "overview.png", "error_vs_time.png"):
        (folder / name).unlink()
    page = written(folder, tmp_path / "page.html")
    for told in ("There is nothing to turn", "geometry_image.npz", "no whole error_vs_time.png"):
        assert told in page.words()
    assert not page.all("img")


def test_data_inside_scripts_cannot_end_them():
    text = data_json({"a": "</script><!-- & \u2028"})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text)["a"] == "</script><!-- & \u2028"


def test_links_are_relative_to_the_page_and_never_another_kind(write_scan, tmp_path):
    folder = write_scan(tmp_path / "javascript:alert(1)" / "50% #1?")
    page = written(folder, tmp_path / "pages.html")
    assert "javascript%3Aalert%281%29/50%25%20%231%3F/trace.csv" in page.links()
    inside = written(folder, folder / "report.html")
    assert "trace.csv" in inside.links()


def test_a_result_without_an_albedo_shows_its_shape(write_scan, tmp_path):
    folder = write_scan(tmp_path / "grey", parameters={}, lights=(), metrics={"seconds": 1.0})
    (folder / "albedo.exr").unlink()
    words = written(folder, tmp_path / "page.html").words()
    assert "no albedo (see the plan)" in words
    assert "the shape is shown in grey" in words


def test_warnings_and_notes_are_told_apart(write_scan, tmp_path):
    metrics = {"fit": {"converged": False}, "albedo": {"expected_error": 0.36}}
    folder = write_scan(tmp_path / "bad", metrics=metrics, notes=("unit: mm",))
    words = written(folder, tmp_path / "page.html").words()
    assert "Worth a look fit did not converge" in words
    assert "albedo ± 36 % a texel" in words
    assert "Noted on the way unit: mm" in words


def test_harmonic_light_is_carried_over(write_scan, tmp_path):
    rows = np.arange(27.0).reshape(9, 3).tolist()
    parameters = {"brdf": "spherical-harmonics", "sh_coefficients": rows}
    folder = write_scan(tmp_path / "sh", parameters=parameters, lights=())
    face = embedded(written(folder, tmp_path / "page.html"))["scan-face"]
    assert face["harmonics"] == list(range(27))
    assert face["reflectance"]["brdf"] == "lambert"


def test_coloured_lamps_and_soft_light_are_carried_over(write_scan, tmp_path):
    lamp = s2a.PointLight(0.5, 0.2, intensity=2.0, color_linear=(1.5, 1.0, 0.5), radius_deg=12.0)
    soft = s2a.EnvironmentLight(np.eye(9, 3) + 0.1, fill=0.2)
    folder = write_scan(tmp_path / "warm", lights=(lamp,), environment=soft)
    page = written(folder, tmp_path / "page.html")
    face = embedded(page)["scan-face"]
    assert face["lights"][0]["color"] == [1.5, 1.0, 0.5]
    normal = np.array([[0.6, 0.0, 0.8]])
    shown = harmonics(normal, 2) @ np.reshape(face["harmonics"], (9, 3))
    assert_allclose(shown, open_transfer(normal) @ soft.coefficients)
    assert "12° #ffd59c" in page.words()
    assert "soft light from around, which the face partly hides" in page.words()
    # At each vertex, with what the surface hides.
    light = np.frombuffer(base64.b64decode(face["soft"]["data"]), "<u2").reshape(-1, 3)
    assert len(light) == len(base64.b64decode(face["positions"])) // 6
    given = load_result(folder)
    mean = relight(given, environment=soft).diffuse[given.mask].mean(0)
    assert_allclose(face["soft"]["scale"] * light.mean(0) / 65535, mean, rtol=0.1)


def test_what_no_page_is_made_of_is_refused_by_name_and_leaves_nothing(write_scan, one_scan, tmp_path):
    (tmp_path / "empty").mkdir()
    (write_scan(tmp_path / "cut") / "result.json").write_text("{")
    for folder, options, error, words in (
        (tmp_path / "none", {}, Scan2AlbedoError, "no such folder"),
        (tmp_path / "empty", {}, Scan2AlbedoError, "holds no"),
        (tmp_path / "cut", {}, Scan2AlbedoError, r"cut/result.json"),
        (one_scan, {"path": tmp_path / "missing" / "page.html"}, OutputError, "missing"),
        (one_scan, {"scans": -1}, ValueError, "scans is -1"),
    ):
        with pytest.raises(error, match=words):
            report.write_report(folder, **options)
    assert files_in(tmp_path) == {"empty", "cut"}


def test_without_jinja_the_extra_is_named(one_scan, tmp_path, monkeypatch):
    _environment.cache_clear()
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingDependencyError, match=r"jinja2.*pip install 'scan2albedo\[report\]'"):
        report.write_report(one_scan, tmp_path / "page.html")
    assert files_in(tmp_path) == set()


@pytest.mark.slow
def test_a_page_of_512_texels_stays_small(write_scan, tmp_path):
    folder = write_scan(tmp_path / "large", size=512)
    assert report.write_report(folder).size_bytes < 15e6
    for k in range(2):
        write_scan(tmp_path / "batch" / f"scan-{k}", size=512)
    # Forty such scans stay below 60 MB.
    assert report.write_report(tmp_path / "batch").size_bytes < 2 * 1.5e6
