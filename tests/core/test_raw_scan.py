"""Names and notes of scans: they become folders and lines on a terminal."""

import numpy as np
import pytest

from scan2albedo import RawScan
from scan2albedo.core.raw_scan import is_folder_name, scan_name
from scan2albedo.errors import ScanError, one_line, printable


@pytest.mark.parametrize("name", ["anna", "Anna Müller (2)", "脸", "a.b", "x" * 200])
def test_a_plain_stem_is_the_name(name):
    assert scan_name(f"folder/{name}.obj") == name
    assert is_folder_name(name)


@pytest.mark.parametrize(
    "stem", ["a\nb", "\x1b[2J", "a\\b", ".hidden", "\x9b31m", "\udce9", "x" * 201, "脸" * 67, "\u202eb"]
)
def test_other_stems_become_names_that_differ(stem):
    name = scan_name(f"{stem}.obj")
    assert is_folder_name(name)
    assert not is_folder_name(stem)
    assert name != scan_name(f"{stem}_.obj")
    with pytest.raises(ScanError, match="cannot be named"):
        RawScan(np.eye(3), [[0, 1, 2]], name=stem)


def test_notes_hold_nothing_that_a_terminal_obeys():
    assert RawScan(np.eye(3), [[0, 1, 2]], notes=("skin\x1b]0;x\x07\n",)).notes == (r"skin\x1b]0;x\x07",)


def test_messages_have_words_a_length_and_their_files_name_once(tmp_path):
    for long in (str(ScanError("a" * 6000 + "; export it again")), one_line("b" * 501 + "; export it again")):
        assert len(long) == 500
        assert long.endswith("; export it again")
    assert len(RawScan(np.eye(3), [[0, 1, 2]], notes=("c" * 600,)).notes[0]) == 500
    with pytest.raises(OSError, match=r"gone\.npz") as missing:
        (tmp_path / "gone.npz").read_bytes()
    assert one_line(missing.value) == "No such file or directory"
    assert one_line(AssertionError()) == "AssertionError"
    assert one_line("") == ""


def test_what_people_write_stays_and_the_rest_is_escaped():
    assert printable("Zoë 脸 🙂 a\\b") == "Zoë 脸 🙂 a\\b"
    assert printable("\x00\t\x7f\x9b\u2028\u202e\udcff\ud800") == r"\x00\x09\x7f\x9b\u2028\u202e\xff\ud800"
    assert str(ScanError("a \n b\x1b")) == r"a b\x1b"
