"""Numba kernels that read lines of numbers straight from the bytes of a text mesh file."""

from typing import NamedTuple

import numpy as np

from scan2albedo.core.arrays import ByteArray, FloatArray, IntArray
from scan2albedo.core.compiled import compiled
from scan2albedo.io import limits

# Numbers, since `ord` takes long to compile.
_HASH = 35
_SLASH = 47
_POINTS = (44, 46)
"""A comma or a point before the fraction."""
_EXPONENTS = (100, 101)
"""d and e."""
_NONE = (105, 110)
"""i and n, with which infinity and NaN begin."""


@compiled
def _is_blank(byte):  # type: ignore[no-untyped-def]
    return byte == 32 or byte == 9 or byte == 13 or byte == 11 or byte == 12


def line_ranges(text: ByteArray) -> tuple[IntArray, IntArray]:
    """Return (start (L,), end (L,)) of each line of `text` (N,), newline excluded."""
    breaks = np.flatnonzero(text == 10)
    return np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [text.size]])


@compiled
def split_keywords(text, starts, ends):  # type: ignore[no-untyped-def]
    """Return the first word (L,) of each line as a number, 0 for none or above 7 bytes, and its end (L,)."""
    words = np.zeros(starts.size, np.int64)
    bodies = np.empty(starts.size, np.int64)
    for line in range(starts.size):
        position, end = starts[line], ends[line]
        while position < end and _is_blank(text[position]):
            position += 1
        begin = position
        word = 0
        while position < end and not _is_blank(text[position]):
            word = (word << 8) + text[position] if position - begin < 7 else 0
            position += 1
        words[line] = word
        bodies[line] = position
    return words, bodies


@compiled
def _parse_unsigned(text, position, end, value):  # type: ignore[no-untyped-def]
    """Return (`value` with the digits behind it, digits dropped beyond 18, digits seen, position after)."""
    dropped = 0
    seen = 0
    while position < end and 48 <= text[position] <= 57:
        if value < 100_000_000_000_000_000:
            value = value * 10 + (text[position] - 48)
        else:
            dropped += 1
        seen += 1
        position += 1
    return value, dropped, seen, position


@compiled
def _parse_float(text, position, end):  # type: ignore[no-untyped-def]
    """Return (value, whether the token at `position` is a number, where it ends); its line ends at `end`.

    Some programs write a comma in place of the point, or D before the exponent as Fortran does.
    """
    sign = 1.0
    if text[position] == 43 or text[position] == 45:
        sign = -1.0 if text[position] == 45 else 1.0
        position += 1
    letter = text[position] | 32 if position < end else 0
    if letter in _NONE:
        return np.nan if letter == 110 else sign * np.inf, True, _token_end(text, position, end)
    mantissa, exponent, seen, position = _parse_unsigned(text, position, end, 0)
    if position < end and text[position] in _POINTS:
        mantissa, dropped, digits, position = _parse_unsigned(text, position + 1, end, mantissa)
        exponent -= digits - dropped
        seen += digits
    if position < end and text[position] == _HASH:
        # 1.#QNAN and 1.#INF of old Microsoft compilers
        return np.nan, seen > 0, _token_end(text, position, end)
    if position < end and (text[position] | 32) in _EXPONENTS:
        position += 1
        negative = position < end and text[position] == 45
        if position < end and (text[position] == 43 or text[position] == 45):
            position += 1
        power, _, digits, position = _parse_unsigned(text, position, end, 0)
        exponent += -power if negative else power
        if digits == 0:
            return np.nan, False, position
    power = 1.0
    good = seen > 0 and (position == end or _is_blank(text[position]))
    if abs(exponent) > 22:
        return sign * (mantissa * 10.0**exponent), good, position
    for _ in range(abs(exponent)):  # up to 10^22 exact: numbers of up to 15 digits are rounded once
        power *= 10.0
    return sign * (mantissa / power if exponent < 0 else mantissa * power), good, position


@compiled
def _token_end(text, position, end):  # type: ignore[no-untyped-def]
    while position < end and not _is_blank(text[position]):
        position += 1
    return position


@compiled
def parse_tokens(text, starts, ends, counts):  # type: ignore[no-untyped-def]
    """Return (the numbers of lines with `counts` (N,) tokens, the first line not made of numbers or -1)."""
    values = np.empty(counts.sum())
    row = 0
    for line in range(starts.size):
        position = starts[line]
        for _ in range(counts[line]):
            while _is_blank(text[position]):
                position += 1
            values[row], is_number, position = _parse_float(text, position, ends[line])
            if not is_number:
                return values, line
            row += 1
    return values, -1


@compiled
def count_tokens(text, starts, ends):  # type: ignore[no-untyped-def]
    """Return (N,) number of blank-separated tokens of each line before a comment."""
    counts = np.zeros(starts.size, np.int64)
    for line in range(starts.size):
        count = 0
        inside = False
        for position in range(starts[line], ends[line]):
            blank = _is_blank(text[position])
            if not inside and text[position] == _HASH:
                break
            count += not blank and not inside
            inside = not blank
        counts[line] = count
    return counts


@compiled
def _parse_integer(text, position, end):  # type: ignore[no-untyped-def]
    """Return (value, whether there was a digit, position after it)."""
    negative = position < end and text[position] == 45
    if negative or (position < end and text[position] == 43):
        position += 1
    value, dropped, seen, position = _parse_unsigned(text, position, end, 0)
    return -value if negative else value, seen > 0 and dropped == 0, position


@compiled
def parse_corners(text, starts, counts):  # type: ignore[no-untyped-def]
    """Read face corners written v, v/vt, v//vn or v/vt/vn; also return the first bad line, -1 for none.

    Corners (sum of counts, 2) are indices as written: 1-based, negative = from the end, 0 = not given.
    """
    corners = np.zeros((counts.sum(), 2), np.int64)
    row = 0
    for line in range(starts.size):
        position = starts[line]
        for _ in range(counts[line]):
            while _is_blank(text[position]):
                position += 1
            corners[row, 0], good, position = _parse_integer(text, position, text.size)
            if position < text.size and text[position] == _SLASH:
                corners[row, 1], _, position = _parse_integer(text, position + 1, text.size)
                if position < text.size and text[position] == _SLASH:
                    _, _, position = _parse_integer(text, position + 1, text.size)
            ended = position == text.size or text[position] == 10 or _is_blank(text[position])
            if not (good and ended and corners[row, 0] != 0):
                return corners, line
            row += 1
    return corners, -1


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


class NumberTable(NamedTuple):
    """The numbers of lines of any length, one after the other, `counts` (N,) of each from `first` (N,)."""

    values: FloatArray
    first: IntArray
    counts: IntArray
    bad: int
    """The first line that is not made of numbers, -1 for none; numbers from there on are not set."""

    def ranges(self, begin: IntArray, counts: IntArray) -> FloatArray:
        """Return `counts` (N,) numbers from place `begin` (N,) in each line, line after line."""
        before = np.cumsum(counts) - counts
        return self.values[np.arange(int(counts.sum())) + np.repeat(self.first + begin - before, counts)]


class NumberLines(NamedTuple):
    """Lines of a text and how many words each has."""

    text: ByteArray
    starts: IntArray
    ends: IntArray
    counts: IntArray

    def table(self, rows: slice = slice(None), most: int = limits.TEXT_LINES) -> NumberTable:
        """Return the numbers of some of the lines, of each at most the first `most`."""
        counts = np.minimum(self.counts[rows], most)
        values, bad = parse_tokens(self.text, self.starts[rows], self.ends[rows], counts)
        return NumberTable(values, np.cumsum(counts) - counts, counts, int(bad))


def number_lines(data: bytes, start: int, name: str) -> NumberLines:
    """Return the lines of `data` from `start` on that hold a word; raises TooLargeError for too many."""
    limits.require_at_most(name, "lines", data.count(b"\n", start), limits.TEXT_LINES, "decimate it")
    text = np.frombuffer(data, np.uint8, offset=start)
    starts, ends = line_ranges(text)
    counts = count_tokens(text, starts, ends)
    filled = counts > 0
    return NumberLines(text, starts[filled], ends[filled], counts[filled])
