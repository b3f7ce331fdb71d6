"""NPZ files and their records: what is wrong is told by one error that names the file."""

import numpy as np
import pytest
from pydantic import BaseModel

from scan2albedo.errors import ScanError
from scan2albedo.io.npz import read_npz, read_npz_record, write_npz, write_npz_record

MESSAGES = {"what": "thing", "advice": "write it again", "error": ScanError}


class Header(BaseModel):
    """A record beside arrays."""

    unit: str


def assert_refused(file, words, *names):
    with pytest.raises(ScanError, match=words):
        read_npz(file, *names, **MESSAGES)


def test_arrays_come_back_by_name_and_the_same_content_gives_the_same_bytes(tmp_path):
    arrays, files = {"a": np.arange(3), "b": np.eye(2)}, [tmp_path / "x.npz", tmp_path / "y.npz"]
    for file in files:
        write_npz(file, arrays, what="thing", compression=6)
    assert files[0].read_bytes() == files[1].read_bytes()
    np.testing.assert_equal(read_npz(files[0], **MESSAGES), arrays)
    chosen = read_npz(files[0], ["b"], optional=["a", "c"], **MESSAGES)
    np.testing.assert_equal(chosen, arrays)
    assert list(read_npz(files[0], ["b"], **MESSAGES)) == ["b"]
    assert_refused(files[0], r"thing .*x\.npz cannot be read .*c.*; write it again", ["c"])


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.97])
def test_damaged_files_are_named(tmp_path, share):
    file = tmp_path / "x.npz"
    write_npz(file, {"a": np.random.default_rng(0).random(999)}, what="thing", compression=6)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert_refused(file, r"x\.npz cannot be read")


def test_what_is_no_archive_is_named(tmp_path):
    np.save(tmp_path / "x.npz", np.eye(2), allow_pickle=False)
    (tmp_path / "x.npz.npy").rename(tmp_path / "x.npz")
    assert_refused(tmp_path / "x.npz", "no archive")
    assert_refused(tmp_path / "none.npz", "No such file")
    with pytest.raises(ValueError, match=r"things are written as \.npz"):
        write_npz(tmp_path / "x.zip", {}, what="thing")


def test_a_record_stands_beside_the_arrays(tmp_path):
    file = tmp_path / "x.npz"
    write_npz_record(file, Header(unit="mm"), {"a": np.arange(3)}, what="thing")
    header, arrays = read_npz_record(file, Header, {"a": "iu"}, **MESSAGES)
    assert header.unit == "mm"
    assert arrays["a"].tolist() == [0, 1, 2]
    with pytest.raises(ScanError, match=r"x\.npz: a holds int64"):
        read_npz_record(file, Header, {"a": "f"}, **MESSAGES)
    write_npz(file, {"header": np.array("{}"), "a": np.arange(3)}, what="thing")
    with pytest.raises(ScanError, match=r"x\.npz: unit: Field required .*; write it again"):
        read_npz_record(file, Header, {"a": "iu"}, **MESSAGES)
