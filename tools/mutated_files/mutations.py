"""Damage to files: flipped bits, cut and doubled parts, replaced numbers, raised counts."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TEXT_NUMBERS = (
    b"0", b"-1", b"1", b"2", b"255", b"65536", b"16777217", b"2147483647", b"2147483648", b"-2147483649",
    b"4294967295", b"9223372036854775807", b"18446744073709551616", b"1e308", b"-1e308", b"1e-320", b"1e999",
    b"nan", b"inf", b"-inf", b"null", b"true", b'"7"', b"[]", b"{}", b"", b"1.5", b"0x10", b"9" * 400,
)  # fmt: skip
_BINARY_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip one to sixteen bits."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 17)):
        changed[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def flip_bits_of_head(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip one to four bits of the first 128 bytes, where headers stand."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        changed[rng.integers(min(len(data), 128))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """End the file early, or take a part out."""
    start = int(rng.integers(len(data)))
    if rng.random() < 0.5:
        return data[:start]
    return data[:start] + data[start + int(rng.integers(1, len(data))) :]


def double(data: bytes, rng: np.random.Generator) -> bytes:
    """Repeat a part of the file, up to a thousand times."""
    start, length = int(rng.integers(len(data))), int(rng.integers(1, 1 + min(len(data), 400)))
    part = data[start : start + length]
    return data[:start] + part * int(rng.choice([2, 3, 10, 1000])) + data[start:]


def swap(data: bytes, rng: np.random.Generator) -> bytes:
    """Exchange two parts of the file."""
    a, b, c = np.sort(rng.integers(0, len(data), 3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def replace_numbers(data: bytes, rng: np.random.Generator) -> bytes:
    """Put other numbers in the place of up to four that are written as text, or of 1, 2 or 4 bytes."""
    for _ in range(rng.integers(1, 5)):
        found = list(_NUMBER.finditer(data[: 1 << 16]))
        if found and rng.random() < 0.7:
            number = found[rng.integers(len(found))]
            other = _TEXT_NUMBERS[rng.integers(len(_TEXT_NUMBERS))]
            data = data[: number.start()] + other + data[number.end() :]
        else:
            data = _with_binary_number(data, int(rng.integers(len(data))), rng)
    return data


def replace_numbers_of_head(data: bytes, rng: np.random.Generator) -> bytes:
    """Put other numbers of 2 or 4 bytes into the first 128 bytes."""
    for _ in range(rng.integers(1, 3)):
        data = _with_binary_number(data, int(rng.integers(min(len(data), 128))), rng)
    return data


def raise_counts(data: bytes, rng: np.random.Generator) -> bytes:
    """Multiply up to three whole numbers written as text in the first 4,096 bytes, or in the last."""
    for _ in range(rng.integers(1, 4)):
        start = 0 if rng.random() < 0.8 else max(len(data) - 4096, 0)
        found = [n for n in _NUMBER.finditer(data[start : start + 4096]) if n[0].isdigit()]
        if not found:
            return replace_numbers_of_head(data, rng)
        number = found[rng.integers(len(found))]
        factor = int(rng.choice([2, 10, 1000, 10**6, 10**9, 10**15]))
        raised = str(min(int(number[0]) + 1, 10**18) * factor).encode()
        data = data[: start + number.start()] + raised + data[start + number.end() :]
    return data


def replace_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Put a word of another place of the file, or bytes of no text, in the place of a word."""
    words = list(re.finditer(rb"[A-Za-z_]{2,40}", data[: 1 << 14]))
    if len(words) < 2:
        return flip_bits(data, rng)
    here, other = (words[i] for i in rng.integers(0, len(words), 2))
    kinds = (other[0], b"\xff\xfe\x00", b"", b"\n" * 50, b"[" * 5000, other[0] * 300)
    return data[: here.start()] + kinds[rng.integers(len(kinds))] + data[here.end() :]


def _with_binary_number(data: bytes, place: int, rng: np.random.Generator) -> bytes:
    width, order = int(rng.choice([1, 2, 4])), ("little", "big")[rng.integers(2)]
    number = _BINARY_NUMBERS[rng.integers(len(_BINARY_NUMBERS))] & (256**width - 1)
    return data[:place] + number.to_bytes(width, order) + data[place + width :]  # type: ignore[arg-type]


MUTATIONS: tuple[Mutation, ...] = (
    flip_bits,
    flip_bits_of_head,
    cut,
    double,
    swap,
    replace_numbers,
    replace_numbers_of_head,
    raise_counts,
    replace_text,
)
