"""Numbers of text mesh files, read by NumPy's parser, and which line each stands in."""

import re
from typing import NamedTuple

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray, NDArray
from scan2albedo.io import limits

_PLAIN = bytes.maketrans(b",dD", b".ee")
"""Some programs write a comma in place of the point, or D before the exponent as Fortran does."""
_NO_NUMBER = re.compile(rb"[-+]?\d+[.,]#\w*")
"""1.#QNAN and 1.#INF of old Microsoft compilers."""
_LINE_FEED = 10
_BLANK = 32
"""It, and the control characters below it, separate words."""


class NumberTable(NamedTuple):
    """The numbers of lines of any length, one after the other, and how many each line has (N,)."""

    values: NDArray
    counts: IntArray
    places: IntArray
    """Of each number in the text."""
    bad: int = -1
    """The first line that is not made of numbers, -1 for none; the table ends before it."""

    @property
    def first(self) -> IntArray:
        """Return the place (N,) of each line's first number."""
        return np.cumsum(self.counts) - self.counts

    def columns(self, width: int) -> FloatArray:
        """Return the first numbers (N, width) of each line, NaN where it ends before."""
        there = np.arange(width) < self.counts[:, None]
        values = np.full(there.shape, np.nan)
        values[there] = self.values[ranges(self.first, np.minimum(self.counts, width))]
        return values


def ranges(begin: IntArray, counts: IntArray) -> IntArray:
    """Return `counts` (N,) whole numbers from each of `begin` (N,) on, one after the other.

    >>> ranges(np.array([5, 0]), np.array([2, 3])).tolist()
    [5, 6, 0, 1, 2]
    """
    before = np.cumsum(counts) - counts
    return np.arange(int(counts.sum())) + np.repeat(begin - before, counts)


def plain_numbers(text: bytes) -> bytes:
    """Return text without comments, which begin with #, and with numbers as C writes them."""
    if b"#" in text:
        text = re.sub(rb"#[^\r\n]*", b"", _NO_NUMBER.sub(b"nan", text))
    return text.translate(_PLAIN)


def number_table(text: bytes, kind: type = float) -> NumberTable:
    """Return the numbers in lines of `plain_numbers`, each ended by a line feed."""
    letters = np.frombuffer(text, np.uint8)
    begins = letters > _BLANK
    begins[1:] &= ~begins[:-1]
    places = np.flatnonzero(begins)
    counts = np.diff(np.searchsorted(places, np.flatnonzero(letters == _LINE_FEED)), prepend=0)
    if not len(places):
        return NumberTable(np.zeros(0, kind), counts, places)
    try:
        values: NDArray = np.fromstring(text, kind, sep=" ")
    except (ValueError, DeprecationWarning):
        values = np.zeros(0, kind)
    if len(values) == len(places):
        return NumberTable(values, counts, places)
    lines = text.split(b"\n")
    bad = next((number for number, line in enumerate(lines) if not _is_of_numbers(line, kind)), 0)
    return number_table(b"".join(line + b"\n" for line in lines[:bad]), kind)._replace(bad=bad)


def _is_of_numbers(line: bytes, kind: type) -> bool:
    try:
        return all(kind(word) is not None and b"_" not in word for word in line.split())
    except ValueError:
        return False


def filled_lines(data: bytes, name: str) -> bytes:
    """Return the lines of `plain_numbers` that are not blank; may raise TooLargeError, naming the file."""
    limits.require_at_most(name, "lines", data.count(b"\n"), limits.TEXT_LINES, "decimate it")
    text = plain_numbers(data).replace(b"\r", b"\n")
    return re.sub(rb"\n\s*", b"\n", text.strip()) + b"\n"
