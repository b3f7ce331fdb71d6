"""Edited, swapped and hostile files in a result: every reader ends in one clear error that names the file."""

import json
import os
import shutil
from contextlib import suppress

import numpy as np
import pytest
from helpers.gltf import Gltf
from helpers.npz import rewritten
from helpers.records import read_json

from scan2albedo.applications import load_result
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.images import write_exr
from scan2albedo.recognition.manifest import read_face
from scan2albedo.report import write_report

pytestmark = pytest.mark.usefixtures("no_endless_reading")


def record(text):
    return "result.json", lambda folder: (folder / "result.json").write_bytes(text)


def entry(*keys, value):
    def change(folder):
        content = place = read_json(folder / "result.json")
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        (folder / "result.json").write_text(json.dumps(content))

    return "result.json", change


def arrays(**changes):
    def change(folder):
        file = folder / "geometry_image.npz"
        with np.load(file) as stored:
            made = {
                name: value(stored[name]) if callable(value) else value for name, value in changes.items()
            }
        rewritten(file, **made)

    return "geometry_image.npz", change


def other(name, make):
    def change(folder):
        (folder / name).unlink()
        make(folder / name)

    return name, change


TAMPERED = {
    "no JSON": record(b"{hello"),
    "bytes": record(bytes(range(256))),
    "a list": record(b"[]"),
    "deep JSON": record(b"[" * 100_000),
    "a number of 100,000 digits": entry("seed", value="9" * 100_000),
    "a wrong type": entry("plan", value={"a": 1}),
    "no light": entry("lights", 0, "color_linear", value=[0, -1, 0]),
    "a light of 1e308": entry("lights", 0, "color_linear", value=[1e308] * 3),
    "no environment": entry("environment", value={"coefficients": [[1e308] * 3] * 8, "occluded": False}),
    "a reflectance of text": entry("parameters", "sigma_rad", value="\x1b[2J"),
    "a version of many": arrays(format_version=np.arange(3)),
    "a version of text": arrays(format_version=np.array("one")),
    "a mask of numbers": arrays(mask=lambda mask: mask.astype(float)),
    "an empty mask": arrays(mask=np.zeros_like),
    "positions of text": arrays(position_mm=lambda position: position.astype(str)),
    "an occluder of text": arrays(occluder_vertices_mm=np.array(["a"])),
    "indices far away": arrays(occluder_faces=lambda faces: faces + 2**40),
    "NaN": arrays(normal=lambda normal: np.full_like(normal, np.nan)),
    "a pipe": other("geometry_image.npz", os.mkfifo),
    "another size": other("albedo.exr", lambda file: write_exr(file, np.ones((8, 8, 3)))),
    "a picture without end": other("albedo.exr", lambda file: file.symlink_to("/dev/zero")),
    "glTF 1": other("fitted.glb", Gltf({"asset": {"version": "1.0"}}).write),
    "a folder": other("fitted.glb", os.mkdir),
}
"""The file that is to be named, and what is done to the folder."""


@pytest.mark.parametrize("kind", TAMPERED)
def test_every_reader_names_the_file(stored, tmp_path, kind):
    folder = shutil.copytree(stored, tmp_path / "out" / "rest")
    name, change = TAMPERED[kind]
    change(folder)
    with pytest.raises(Scan2AlbedoError, match=name):
        load_result(folder)
    for read in (read_face, lambda out: write_report(out, tmp_path / "page.html")):
        try:
            read(folder)
        except Scan2AlbedoError as error:
            assert name in str(error)  # noqa: PT017  readers that do not need the file go on
    write_report(folder.parent, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert name in page
    assert "\x1b" not in page


@pytest.mark.parametrize("name", ["error_vs_time.png", "overview.png"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda file: file.symlink_to("/dev/zero"), os.mkdir])
def test_a_report_reads_no_pipe_and_no_device(stored, tmp_path, name, make):
    folder = shutil.copytree(stored, tmp_path / "rest")
    with suppress(FileNotFoundError):
        (folder / name).unlink()
    make(folder / name)
    assert write_report(folder, tmp_path / "page.html").done == 1


@pytest.mark.parametrize(
    "value",
    ["text", [1e308] * 9, {"a": [None]}, 10**400, True],
    ids=["text", "numbers", "nested", "huge", "true"],
)
@pytest.mark.parametrize(
    "keys", [("metrics", "fit", "residual_mean_mm"), ("metrics", "albedo"), ("options", "model")]
)
def test_figures_of_another_kind_end_in_a_page_or_a_clear_error(stored, tmp_path, keys, value):
    folder = shutil.copytree(stored, tmp_path / "out" / "rest")
    _, change = entry(*keys, value=value)
    change(folder)
    with suppress(Scan2AlbedoError):
        write_report(folder, tmp_path / "page.html")
    assert write_report(folder.parent, tmp_path / "page.html").scans == 1
    with suppress(Scan2AlbedoError):
        load_result(folder)
