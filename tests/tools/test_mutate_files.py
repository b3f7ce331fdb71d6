"""The tool that damages files: the same file for a number, findings of every kind, and few files of each."""

from pathlib import Path

import mutate_files
import numpy as np
import pytest
from helpers.folders import contents
from mutated_files.base_files import BaseFile, base_files
from mutated_files.mutations import MUTATIONS, mutated

from scan2albedo.errors import ScanError

BASES = tuple(base_files())


def test_a_number_is_the_same_file_in_every_run(tmp_path):
    work = mutate_files.Work(BASES, seed=3)
    for number in (5, 40):
        first, again = (tmp_path / f"{number}{run}" for run in "ab")
        for folder in (first, again):
            folder.mkdir()
            base, _ = work.make(number, folder)
        assert contents(first) == contents(again) != base.files


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_every_mutation_changes_every_kind_of_file(mutation):
    for base in BASES:
        name = base.damaged[0]
        data = base.files[name]
        changed = [mutated(name, data, mutation, np.random.default_rng(seed)) for seed in range(4)]
        assert {*changed} != {data}
        assert max(map(len, changed)) < 20e6


def outcome(read):
    work = mutate_files.Work((BaseFile("x", "a.obj", {"a.obj": b"v 0 0 0\n"}, ("a.obj",), read),), seed=0)
    return work.run(0)


def test_what_leaves_bare_is_a_fault_and_a_clear_error_is_none():
    def bare(path):
        raise KeyError(path.name)

    def clear(path):
        raise ScanError(f"{path.name}: damaged")

    assert outcome(bare).fault == "bare KeyError"
    assert outcome(clear).fault == ""
    assert outcome(Path.read_bytes).ending == mutate_files.LOADED


def test_memory_is_that_of_the_file_alone(monkeypatch):
    def large(path):
        return np.ones(40_000_000).sum()

    first, then = outcome(large), outcome(Path.read_bytes)
    assert first.memory_bytes - then.memory_bytes > 2e8
    monkeypatch.setattr(mutate_files, "MEMORY_BYTES", first.memory_bytes - 1)
    assert first.fault == "over 2 GB"
    assert then.fault == ""


def test_a_file_of_each_kind_ends_well():
    work = mutate_files.Work(BASES, seed=7)
    rows = [work.run(number) for number in range(2 * len(BASES))]
    assert not [row.line() for row in rows if row.fault]
    assert len(mutate_files.table(rows).splitlines()) == 1 + len(BASES)
