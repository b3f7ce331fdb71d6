"""Blocks of rows, worked on by all cores."""

import pytest

from scan2albedo.geometry.rays import blocks, each_block


def test_blocks_cover_all_rows_once():
    assert [(b.start, b.stop) for b in blocks(7, 3)] == [(0, 3), (3, 6), (6, 7)]
    assert blocks(0, 3) == []


@pytest.mark.parametrize("count", [1, 2, 9])
def test_every_block_is_worked_on_once_and_errors_come_through(count):
    done = []
    each_block(lambda block: done.append(block.start), blocks(count, 1))
    assert sorted(done) == list(range(count))

    def fail(block):
        raise RuntimeError(f"block {block.start}")

    with pytest.raises(RuntimeError, match="block"):
        each_block(fail, blocks(count, 1))
