"""Manifests in every form, and one clear error for each fault."""

from pathlib import Path

import pytest

from scan2albedo.batch import read_manifest
from scan2albedo.errors import BatchError
from scan2albedo.pipeline.options import ProcessOptions


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def listed(folder, *rows):
    """Write a table, and return what is read of it."""
    return read_manifest(write(folder / "list.csv", "\n".join(rows)))


def test_a_table_with_options_and_columns_of_its_own(tmp_path):
    manifest = listed(
        tmp_path,
        "\ufeffScan;name;unit;lights;seed;Model;landmarks;group; age of x ",
        "a/one.ply;Anna;cm;2;7;mine.obj;one.pp;p 1 ; 4\n\n/far/two.OBJ;;;;;;;p2\n",
    )
    first, second = manifest.scans
    assert (first.name, second.name) == ("Anna", "two")
    assert (first.path, second.path) == (tmp_path / "a" / "one.ply", Path("/far/two.OBJ"))
    assert manifest.extra_columns == ("group", "age of x")
    assert first.extra == {"group": "p 1 ", "age of x": " 4"}
    assert second.extra == {"group": "p2", "age of x": ""}
    batch = ProcessOptions(size=64, seed=1)
    own = first.options(batch, manifest.folder)
    assert (own.unit, own.lights, own.seed, own.size) == ("cm", 2, 7, 64)
    assert own.model == str(tmp_path / "mine.obj")
    assert own.landmarks == str(tmp_path / "one.pp")
    assert second.options(batch, manifest.folder) == batch


def test_columns_tell_scans_of_one_name_apart(tmp_path):
    rows = ["scan,name,Person", "a/scan.obj,,ann", "b/scan.obj,,bob", "c/scan.obj,own,cy", "d/two.obj,,dan"]
    file = write(tmp_path / "list.csv", "\n".join(rows))
    names = [scan.name for scan in read_manifest(file, name_columns=("person",)).scans]
    assert names == ["ann-scan", "bob-scan", "own", "two"]
    assert [scan.name for scan in read_manifest(file).scans] == ["ann", "bob", "cy", "dan"]


def test_scans_of_one_person_are_one_entry(tmp_path):
    head, rows = "scan,name,Person,light,seed", ["a/scan.obj,day,ann,sun,2", "b.obj,,,lamp,"]
    ann, alone = listed(tmp_path, head, *rows, "c/scan.obj,,ann,lamp,2").scans
    assert (ann.name, alone.name, alone.members) == ("ann", "b", ())
    assert [(scan.name, scan.path) for scan in ann.members] == [
        ("day", tmp_path / "a" / "scan.obj"),
        ("scan", tmp_path / "c" / "scan.obj"),
    ]
    assert (ann.source, ann.extra) == ("a/scan.obj, c/scan.obj", {"Person": "ann", "light": "sun; lamp"})
    assert ann.options(ProcessOptions(), tmp_path).seed == 2


def test_a_list_of_paths(tmp_path):
    file = write(tmp_path / "list.txt", "# of today\none.ply\n\n sub/two.obj \n")
    assert [scan.name for scan in read_manifest(file).scans] == ["one", "two"]
    assert read_manifest(file).scans[1].path == tmp_path / "sub" / "two.obj"


def test_a_folder_without_textures_results_and_hidden_files(tmp_path):
    names = "one.OBJ one.mtl one.png sub/two.ply .hidden.ply .cache/three.ply out/y.ply"
    names += " earlier/two/fitted.glb earlier/two/result.json batch/batch.json batch/x/fitted.glb"
    for name in names.split():
        write(tmp_path / name, "")
    manifest = read_manifest(tmp_path, leave_out=tmp_path / "out")
    assert [scan.source for scan in manifest.scans] == ["one.OBJ", "sub/two.ply"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lacks the column scan (it is empty)"),
        ("path,name\na.ply,x\n", "lacks the column scan (its first line has path, name)"),
        ("scan\n\n", "lists no scan"),
        ("scan,name\na.ply,x\nb.ply,X\n", "line 2 and "),
        ("scan\na.ply\nsub/A.obj\n", "both results would be named A"),
        ("scan,name\na.ply,../x\n", "cannot name a result folder"),
        ("scan,name\na.ply,.x\n", "cannot name a result folder"),
        ("scan,person\na.ply,../x\n", "cannot name a result folder"),
        ("scan,person\na.ply,ann\nsub/A.obj,ann\n", "both results would be named A"),
        ("scan,person\na.ply,b\nb.ply,\n", "both results would be named b"),
        ("scan,person,seed\na.ply,ann,1\nb.ply,ann,2\n", "line 3: scans of one person with other options"),
        ("scan,status\na.ply,x\n", "has a column status of its own"),
        ("scan,path_albedo\na.ply,x\n", "of its own"),
        ("scan,x,x\na.ply,1,2\n", "has the column x twice"),
        ("scan,,x\na.ply,1,2\n", "column 2 has no name"),
        ("scan,x\n,1\n", "line 2: names no scan"),
        ("scan\na.ply,b\n", "line 2: has 2 cells, the header 1"),
        ('scan\n"a.ply\n', "mend its quotes"),
    ],
)
def test_a_faulty_table_is_one_clear_error(tmp_path, text, words):
    with pytest.raises(BatchError) as caught:
        read_manifest(write(tmp_path / "list.csv", text))
    assert words in str(caught.value)
    assert "list.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("column", "cell", "words"),
    [
        ("unit", "yard", "unit is 'yard'"),
        ("lights", "many", "lights is 'many', expected 'auto'"),
        ("lights", "0", "lights is 0"),
        ("seed", "-1", "seed is -1"),
        ("seed", "x", "seed is 'x', expected a whole number"),
    ],
)
def test_an_option_that_is_none_is_named_with_its_line(tmp_path, column, cell, words):
    (scan,) = listed(tmp_path, f"scan,{column}", f"a.ply,{cell}").scans
    with pytest.raises(BatchError, match=f"line 2.*{words}"):
        scan.options(ProcessOptions(), tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.csv", "cannot be read"),
        ("a.ply", "is a scan"),
        ("empty", r"lists no scan \(\.obj"),
    ],
)
def test_what_is_no_manifest(tmp_path, name, message):
    (tmp_path / "a.ply").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(BatchError, match=message):
        read_manifest(tmp_path / name)
