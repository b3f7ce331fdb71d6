"""Damage to files: flipped bits, cut and doubled parts, replaced numbers, raised counts.

Half of the files that carry checksums or lengths of their parts get them right again (`mutated`), so that the
damage passes the first check.
"""

import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TEXT_NUMBERS = (
    b"0",
    b"-1",
    b"1",
    b"2",
    b"255",
    b"65536",
    b"16777217",
    b"2147483647",
    b"2147483648",
    b"-2147483649",
    b"4294967295",
    b"9223372036854775807",
    b"18446744073709551616",
    b"1e308",
    b"-1e308",
    b"1e-320",
    b"1e999",
    b"nan",
    b"inf",
    b"-inf",
    b"null",
    b"true",
    b'"7"',
    b"[]",
    b"{}",
    b"",
    b"1.5",
    b"0x10",
    b"9" * 400,
)
_BINARY_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip one to sixteen bits."""
    return _flipped(data, 16, len(data), rng)


def flip_bits_of_head(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip one to four bits of the first 128 bytes, where headers stand."""
    return _flipped(data, 4, min(len(data), 128), rng)


def _flipped(data: bytes, most: int, reach: int, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.integers(1, most + 1)):
        changed[rng.integers(reach)] ^= 1 << int(rng.integers(8))
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


def grow(data: bytes, rng: np.random.Generator) -> bytes:
    """Repeat a line, in lines of its own, as one long line, or both, up to four million bytes."""
    lines = data.split(b"\n")
    place = int(rng.integers(len(lines)))
    part = lines[place][:200] or b"0 0 0"
    times = int(rng.choice([1000, 4_000_000 // (len(part) + 1)]))
    kind = rng.integers(3)
    added = [] if kind == 0 else [part] * times
    if kind != 1:
        lines[place] = b" ".join([part] * times)
    return b"\n".join([*lines[:place], *added, *lines[place:]])


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
    grow,
    replace_text,
)


def mutated(name: str, data: bytes, mutation: Mutation, rng: np.random.Generator) -> bytes:
    """Return a file damaged as a whole, or in a part whose checksum and length are made right again."""
    mend = {".glb": _in_json_of_glb, ".png": _in_chunk_of_png, ".npz": _in_member_of_npz}.get(name[-4:])
    return mutation(data, rng) if mend is None or rng.random() < 0.5 else mend(data, mutation, rng)


def _in_json_of_glb(data: bytes, mutation: Mutation, rng: np.random.Generator) -> bytes:
    end = 20 + int.from_bytes(data[12:16], "little")
    text = mutation(data[20:end], rng)
    text += b" " * (-len(text) % 4)
    length = 20 + len(text) + len(data) - end
    return struct.pack("<4sIII", b"glTF", 2, length, len(text)) + data[16:20] + text + data[end:]


def _in_chunk_of_png(data: bytes, mutation: Mutation, rng: np.random.Generator) -> bytes:
    chunks = []
    place = 8
    while place < len(data):
        length = int.from_bytes(data[place : place + 4], "big")
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    chosen = int(rng.integers(len(chunks))) if rng.random() < 0.5 else 0  # the first has the size
    kind, body = chunks[chosen]
    chunks[chosen] = kind, mutation(body.ljust(8, b"0"), rng)
    parts = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return data[:8] + b"".join(parts)


def _in_member_of_npz(data: bytes, mutation: Mutation, rng: np.random.Generator) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = list(members)[rng.integers(len(members))]
    whole = members[chosen]
    # The array's header alone, or all of it.
    start = 10 + int.from_bytes(whole[8:10], "little") if rng.random() < 0.5 else len(whole)
    head = mutation(whole[10:start], rng)
    changed = mutation(whole, rng)
    if start < len(whole):
        changed = whole[:8] + struct.pack("<H", min(len(head), 65535)) + head[:65535] + whole[start:]
    members[chosen] = changed
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()
