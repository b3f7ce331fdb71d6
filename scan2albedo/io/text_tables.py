"""Numbers of text mesh files, by NumPy's parser; corners of OBJ files and rows of binary ones, by kernels."""

import re
from itertools import chain
from typing import NamedTuple

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.core.compiled import compiled
from scan2albedo.io import limits

_PLAIN = bytes.maketrans(b",dD_", b".ee?")
"""Some programs write a comma in place of the point, or D before the exponent as Fortran does; Python, not
NumPy, reads 1_000 as a number."""
_NO_NUMBER = re.compile(rb"[-+]?\d+[.,]#\w*")
"""1.#QNAN and 1.#INF of old Microsoft compilers."""


class NumberTable(NamedTuple):
    """The numbers of lines of any length, one after the other, and how many each line has (N,)."""

    values: FloatArray
    counts: IntArray
    bad: int = -1
    """The first line that is not made of numbers, -1 for none; there are no values then."""

    @property
    def first(self) -> IntArray:
        """Return the place (N,) of each line's first number."""
        return np.cumsum(self.counts) - self.counts

    def columns(self, width: int) -> FloatArray:
        """Return the first numbers (N, width) of each line, NaN where it ends before."""
        if len(self.counts) and (self.counts == self.counts[0]).all():  # much faster than by a mask
            rows = self.values.reshape(len(self.counts), -1)[:, :width]
            missing = np.full((len(rows), width - rows.shape[1]), np.nan)
            return np.concatenate([rows, missing], axis=1) if missing.size else rows
        place = self.first[:, None] + np.arange(width)
        there = np.arange(width) < self.counts[:, None]
        values = np.full(there.shape, np.nan)
        values[there] = self.values[place[there]]
        return values

    def ranges(self, begin: IntArray, counts: IntArray) -> FloatArray:
        """Return `counts` (N,) numbers from place `begin` (N,) in each line, line after line."""
        before = np.cumsum(counts) - counts
        return self.values[np.arange(int(counts.sum())) + np.repeat(self.first + begin - before, counts)]


def plain_numbers(text: bytes) -> bytes:
    """Return text without comments, which begin with #, and with numbers as C writes them."""
    if b"#" in text:
        text = re.sub(rb"#[^\r\n]*", b"", _NO_NUMBER.sub(b"nan", text))
    return text.translate(_PLAIN)


def number_table(lines: list[bytes]) -> NumberTable:
    """Return the numbers in lines of `plain_numbers`."""
    if any(lines):
        try:  # Lines of one length, which is the rule.
            rows = np.loadtxt(lines, ndmin=2)
            if len(rows) == len(lines):
                return NumberTable(rows.ravel(), np.full(len(lines), rows.shape[1]))
        except ValueError:
            pass
    words = [line.split() for line in lines]
    counts = np.array([len(line) for line in words], int)
    if not counts.any():
        return NumberTable(np.zeros(0), counts)
    try:
        return NumberTable(np.loadtxt([*chain.from_iterable(words)], ndmin=1), counts)
    except ValueError:
        wrong = (number for number, line in enumerate(words) if not all(map(_is_number, line)))
        return NumberTable(np.zeros(0), counts, next(wrong, 0))


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def filled_lines(data: bytes, name: str) -> list[bytes]:
    """Return the lines of `plain_numbers` that are not blank; may raise TooLargeError, naming the file."""
    limits.require_at_most(name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
    return list(filter(bytes.strip, plain_numbers(data).splitlines()))


@compiled
def _parse_integer(text, position):  # type: ignore[no-untyped-def]
    """Return (value, whether it is a number of at most 18 digits, position after it)."""
    negative = text[position] == 45
    if negative or text[position] == 43:
        position += 1
    begin = position
    value = 0
    while 48 <= text[position] <= 57:
        value = value * 10 + (text[position] - 48)
        position += 1
    return -value if negative else value, 0 < position - begin <= 18, position


@compiled
def parse_corners(text, line_count):  # type: ignore[no-untyped-def]
    """Read lines of face corners written v, v/vt, v//vn or v/vt/vn, each ended by a line feed.

    Returns the corners (C, 2) as indices as written: 1-based, negative = from the end, 0 = not given; how
    many each line has (L,); and the first bad line, -1 for none.
    """
    counts = np.zeros(line_count, np.int64)
    line = 0
    inside = comment = False
    for byte in text:
        comment = (comment or (byte == 35 and not inside)) and byte != 10  # a number sign
        counts[min(line, line_count - 1)] += byte > 32 and not inside and not comment
        inside = byte > 32
        line += byte == 10
    corners = np.zeros((counts.sum(), 2), np.int64)
    row = position = 0
    for line in range(line_count):
        for _ in range(counts[line]):
            while text[position] <= 32:
                position += 1
            corners[row, 0], good, position = _parse_integer(text, position)
            for column in range(1, 3):
                if text[position] == 47:  # a slash
                    index, _, position = _parse_integer(text, position + 1)
                    corners[row, 1] = index if column == 1 else corners[row, 1]
            if not (good and text[position] <= 32 and corners[row, 0] != 0):
                return corners, counts, line
            row += 1
        while text[position] != 10:
            position += 1
        position += 1
    return corners, counts, -1


@compiled
def walk_rows(body, count, item_sizes, counter_sizes, big_endian):  # type: ignore[no-untyped-def]
    """Find the properties of `count` binary rows with lists of any length in `body` (N,) uint8.

    `item_sizes` and `counter_sizes` (P,) are bytes of an item and of a list's counter, 0 for a property that
    is not a list. Returns where the first item stands (count, P), how many items there are (count, P), 1 for
    a property that is not a list, and the bytes of all rows, -1 when `body` ends before.
    """
    offsets = np.zeros((count, item_sizes.size), np.int64)
    counts = np.ones((count, item_sizes.size), np.int64)
    position = 0
    for row in range(count):
        for i in range(item_sizes.size):
            width = counter_sizes[i]
            if position + width > body.size:
                return offsets, counts, -1
            if width > 0:
                value = np.int64(0)
                for k in range(width):
                    value = value * 256 + body[position + (k if big_endian else width - 1 - k)]
                counts[row, i] = value
                position += width
            offsets[row, i] = position
            position += counts[row, i] * item_sizes[i]
            if position > body.size or position < 0:
                return offsets, counts, -1
    return offsets, counts, position


@compiled
def byte_ranges(body, starts, sizes):  # type: ignore[no-untyped-def]
    """Return the `sizes` (N,) bytes of `body` from each of `starts` (N,) on, one after the other."""
    found = np.empty(sizes.sum(), np.uint8)
    place = 0
    for row in range(starts.size):
        for k in range(sizes[row]):
            found[place + k] = body[starts[row] + k]
        place += sizes[row]
    return found
