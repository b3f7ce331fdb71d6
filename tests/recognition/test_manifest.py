"""Manifests: what is read, and what of a file that is not one is told."""

import pytest

from scan2albedo.errors import RecognitionError
from scan2albedo.recognition import read_manifest


@pytest.fixture
def folder(tmp_path):
    for name in ("ann", "bob", "é, one"):
        (tmp_path / "out" / name).mkdir(parents=True)
    return tmp_path


def written(folder, text, encoding="utf-8"):
    path = folder / "list.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_persons_and_results_are_read(folder, encoding, end):
    lines = ["Person,note,RESULT", "ann,x,out/ann", "", ' Zoe\u0308 ,,"out/é, one"', ",,"]
    manifest = read_manifest(written(folder, end.join(lines), encoding))
    expected = [("ann", "out/ann", 2), ("Zo\u00eb", "out/é, one", 4)]
    assert [(e.person, e.result, e.line) for e in manifest.entries] == expected
    assert [e.path for e in manifest.entries] == [folder / result for _, result, _ in expected]
    assert manifest.notes == ()


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_other_separators_are_seen_in_the_header(folder, delimiter):
    text = f"result{delimiter}person\nout/ann{delimiter}ann\nout/é, one{delimiter}zoe\n"
    assert [e.person for e in read_manifest(written(folder, text)).entries] == ["ann", "zoe"]


def test_persons_may_be_left_open(folder):
    path = written(folder, "person,result\n,out/ann\nbob,out/bob\n")
    assert [e.person for e in read_manifest(path, persons_required=False).entries] == [None, "bob"]
    with pytest.raises(RecognitionError, match="line 2: out/ann has no person"):
        read_manifest(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"lacks the columns person and result \(it is empty\)"),
        ("\n\n", "it is empty"),
        ("name,result\nann,out/ann\n", r"lacks the column person \(its first line has name, result\)"),
        ("ann,out/ann\n", "lacks the columns person and result"),
        ("person,result\n", "no entry below its header"),
        ("person,result\nann\n", "line 2: names no result"),
        ("person,result\nann,\n", "line 2: names no result"),
        ("person,result\nann,out/é, one\n", "line 2: has 3 cells, the header 2"),
        ('person,result\nann,"out/ann\n', "line 2: .*mend its quotes"),
        ("person,result\n\nann,out/cy\n", "line 3: out/cy: no such folder or file"),
        ("person,result\nann,out/ann\nbob,out/../out/ann\n", "shows ann on line 2 and bob on line 3"),
        (b"person,result\nZo\xeb,out/ann\n", r"no UTF-8 text \(byte 16 is 0xeb\)"),
        ("person,result\nann,out/ann\n".encode("utf-16"), "UTF-16"),
        (b"PK\x03\x04\x00\x00person,result", "not a text file"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(folder, text, words):
    path = written(folder, text)
    with pytest.raises(RecognitionError, match=words) as caught:
        read_manifest(path)
    assert str(path) in str(caught.value)


def test_files_that_are_not_there_or_no_files_are_told(folder):
    with pytest.raises(RecognitionError, match=r"none\.csv cannot be read"):
        read_manifest(folder / "none.csv")
    (folder / "empty").mkdir()
    with pytest.raises(RecognitionError, match="holds no folder of a processed scan"):
        read_manifest(folder / "empty")


def test_a_result_that_comes_twice_is_noted(folder):
    manifest = read_manifest(written(folder, "person,result\nann,out/ann\nann,./out/ann\n"))
    assert len(manifest.entries) == 2
    assert "comes twice, on lines 2 and 3" in manifest.notes[0]
