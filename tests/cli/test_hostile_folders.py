"""A folder may come from anywhere: what only reads one changes no file, in it or elsewhere."""

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.folders import contents
from helpers.meshes import write_ball
from helpers.square import write_square_obj

from scan2albedo import AnnotatedFaceModel, reflectance
from scan2albedo.applications import load_result, reflectance_of_processed
from scan2albedo.batch import load_albedos
from scan2albedo.batch.catalogue import write_catalogue
from scan2albedo.batch.records import CATALOGUE
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.load_scan import load_scan
from scan2albedo.io.publication import PENDING
from scan2albedo.recognition import read_face


@pytest.fixture
def hostile(tmp_path):
    """An attacker's folder: its journal asks to move and remove files of the user's, and files elsewhere."""
    import pyarrow as pa

    outside, folder = tmp_path / "outside", tmp_path / "in" / "scan"
    outside.mkdir()
    folder.mkdir(parents=True)
    (outside / "albedo.exr").write_text("outside")
    (folder / "link").symlink_to(outside)
    pending = folder / PENDING
    pending.mkdir()
    (pending / "link").symlink_to(outside)
    (pending / "report.html").write_text("new here")
    (pending / ".dropped.json").write_text('["notes.txt", "albedo.exr", "link/albedo.exr"]')
    records = "application batch cameras capture landmarks model photograph reflectance result"
    others = ("notes.txt", "albedo.exr", "geometry_image.npz", "expected_error.exr")
    for name in (*(f"{record}.json" for record in records.split()), *others):
        (folder / name).write_text("{}")
    write_square_obj(folder)
    write_ball(folder / "fitted.glb")
    np.savez(folder / "model.npz", a=1)
    for place in (folder, folder.parent):
        (place / "list.csv").write_text("person,result\nann,scan\nbob,.\n")
    row = {"name": "scan", "model": "default", "status": "done", "path_albedo_exr": "scan/albedo.exr"}
    write_catalogue(folder.parent / CATALOGUE, pa.Table.from_pylist([row | {"folder": "scan"}]))
    return folder


READERS = (
    load_result,
    lambda folder: load_albedos(folder.parent),
    read_face,
    reflectance_of_processed,
    lambda folder: AnnotatedFaceModel.load(folder / "model.json"),
    lambda folder: reflectance.read_capture(folder / "capture.json"),
    lambda folder: reflectance.read_photograph(folder / "photograph.json"),
)


@pytest.mark.parametrize("read", READERS)
def test_no_function_that_reads_a_hostile_folder_changes_it(hostile, tmp_path, read):
    before = contents(tmp_path)
    with pytest.raises(Scan2AlbedoError):
        read(hostile)
    assert len(load_scan(hostile / "face.obj").vertices) == 4
    assert contents(tmp_path) == before


COMMANDS = (
    "process IN/face.obj --model IN/model.json",
    "process IN/face.obj --landmarks IN/landmarks.json",
    "process IN/face.obj --linear-model IN",
    "person ann IN/face.obj --model IN/model.json",
    "batch IN/list.csv --model IN/model.json",
    "report IN",
    "report UP",
    "relight IN --light 0,0",
    "relight IN --sweep 3",
    "swap IN IN",
    "blend IN IN",
    "transfer-expression IN IN IN",
    "personal-model IN",
    "bake IN/fitted.glb IN/face.obj --size 32",
    "identify --gallery IN/list.csv --probes UP/list.csv",
    "identify --gallery UP --probes IN",
    "glasses key-points IN/fitted.glb --keypoints IN/landmarks.json",
    "glasses canonicalize IN/fitted.glb --keypoints IN/landmarks.json --mean IN/model.json",
    "glasses register IN/fitted.glb --cameras IN/cameras.json --labels IN/model.json --head IN/fitted.glb",
    "glasses lenses IN/fitted.glb --cameras IN/cameras.json --head IN/fitted.glb",
    "reflectance olat IN/capture.json",
    "reflectance fit IN/capture.json",
    "reflectance build IN IN",
    "reflectance sample IN",
    "reflectance fit-image IN/photograph.json --model IN",
    "reflectance finetune IN IN/photograph.json",
)


@pytest.mark.usefixtures("no_endless_reading")
@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_that_reads_a_hostile_folder_changes_it(hostile, tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before, out = contents(tmp_path / "in"), tmp_path / "out"
    words = command.replace("IN", str(hostile)).replace("UP", str(hostile.parent)).split()
    one_file = ("report", "bake", "relight IN --light", "glasses key-points")
    end = ".html" if words[0] == "report" else ".obj" if words[0] == "bake" else ".png"
    invoke(*words, "-o", out.with_suffix(end) if command.startswith(one_file) else out)
    assert contents(tmp_path / "in") == before
    assert contents(tmp_path / "outside") == {"albedo.exr": b"outside"}
