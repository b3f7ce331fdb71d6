"""Tables that people write: separators, line numbers, and what is said of files that are none."""

import os

import pytest

from scan2albedo.errors import BatchError
from scan2albedo.io.csv_tables import cells_by_column, read_text, table_rows


def text_of(path, **limit):
    return read_text(path, what=f"list {path.name}", advice="give another", error=BatchError, **limit)


def test_text_is_read_with_and_without_a_byte_order_mark(tmp_path):
    for encoding in ("utf-8", "utf-8-sig"):
        (tmp_path / "a.csv").write_text("Zoë", encoding)
        assert text_of(tmp_path / "a.csv") == "Zoë"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("a".encode("utf-16"), "list a.csv is UTF-16 text"),
        (b"a\xe4", r"list a.csv is no UTF-8 text \(byte 1 is 0xe4\)"),
        (b"a\0", "list a.csv is not a text file; give another"),
        (None, "list a.csv cannot be read .*; give another"),
    ],
)
def test_what_is_no_text_is_named(tmp_path, data, words):
    if data is not None:
        (tmp_path / "a.csv").write_bytes(data)
    with pytest.raises(BatchError, match=words):
        text_of(tmp_path / "a.csv")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_rows_keep_their_lines_and_their_separator_is_seen_in_the_header(tmp_path, delimiter):
    text = f'\na{delimiter}b\n\n"1\n1"{delimiter}2\n{delimiter}\n'
    assert table_rows(text, tmp_path, BatchError) == [(2, ["a", "b"]), (5, ["1\n1", "2"])]


def test_faults_of_a_table_are_named_with_their_line_and_short_rows_are_none(tmp_path):
    with pytest.raises(BatchError, match=r"line 2: .*mend its quotes"):
        table_rows('a,b\n"1,2\n', tmp_path, BatchError)
    with pytest.raises(BatchError, match="line 2: has 3 cells, the header 2"):
        cells_by_column(["a", "b"], ["1", "2", "3"], "line 2", BatchError)
    assert cells_by_column(["a", "b"], ["1"], "line 2", BatchError) == {"a": "1", "b": ""}


def test_pipes_devices_and_endless_lists_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    for name in ("pipe.csv", "zero.csv"):
        with pytest.raises(BatchError, match=rf"list {name} cannot be read .*a pipe or a device"):
            text_of(tmp_path / name)
    (tmp_path / "long.csv").write_text("a" * 100)
    told = r"^list long.csv cannot be read \(100 bytes are more than the 99 that are read; make it smaller\);"
    with pytest.raises(BatchError, match=told):
        text_of(tmp_path / "long.csv", limit=99)
