"""What the header of a picture says about its size, before a pixel is decoded."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from scan2albedo.io import limits

_RADIANCE = re.compile(rb"(?s)#\?.{0,65536}?\n[-+][XY] +(\d{1,18}) +[-+][XY] +(\d{1,18})\s")
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of JPEG files that are followed by the size."""
_WIDTH, _HEIGHT, _BITS, _SAMPLES = 256, 257, 258, 277
"""Tags of TIFF files."""
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}


class PictureSize(NamedTuple):
    """Pixels of a picture, and bytes that its samples take."""

    pixels: int
    bytes: int


def picture_size(data: bytes) -> PictureSize | None:
    """Return what the header of a PNG, JPEG, TIFF, BMP, WebP or Radiance picture declares.

    None when it is none of these, or damaged. `data` may be the picture's beginning. EXR files have a header
    a part and are judged in `images.read_exr_channels`.
    """
    for magic, read in _READERS:
        if data.startswith(magic):
            try:
                return read(data)
            except (struct.error, LookupError):
                return None
    return None


def require_small_picture(data: bytes, place: str | Path) -> PictureSize | None:
    """Return the size of a picture; raises TooLargeError when it has more pixels, or bytes, than are read."""
    size = picture_size(data)
    if size is not None:
        name, advice = f"image {place}", "save it with fewer pixels"
        limits.require_at_most(name, "pixels", size.pixels, limits.PIXELS, advice)
        limits.require_at_most(name, "bytes of pixels", size.bytes, limits.PICTURE_BYTES, advice)
    return size


def is_cut_png(data: bytes) -> bool:
    """Return whether a PNG declares a chunk beyond its end; decoders make room for it before they look."""
    place = 8
    if not data.startswith(b"\x89PNG"):
        return False
    while place + 8 <= len(data) and data[place + 4 : place + 8] != b"IEND":
        place += 12 + int(struct.unpack_from(">I", data, place)[0])
    return place > len(data)


def _of_png(data: bytes) -> PictureSize:
    width, height, bits = struct.unpack_from(">IIB", data, 16)
    return PictureSize(width * height, 4 * width * height * max(bits // 8, 1))


def _of_bmp(data: bytes) -> PictureSize:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return PictureSize(abs(width * height), 4 * abs(width * height))


def _of_jpeg(data: bytes) -> PictureSize | None:
    place = 2
    while (place := data.find(b"\xff", place)) >= 0:
        marker = data[place + 1]
        if marker in _FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return PictureSize(width * height, 3 * width * height)
        # A marker without a length: fill bytes, stuffed zeros, restarts, begin and end of the picture.
        alone = marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD9
        place += 1 if marker == 0xFF else 2 if alone else 2 + struct.unpack_from(">H", data, place + 2)[0]
    return None


def _of_webp(data: bytes) -> PictureSize | None:
    kind = data[12:16]
    if data[8:12] != b"WEBP":
        return None
    if kind == b"VP8X":
        width, height = (1 + int.from_bytes(data[i : i + 3], "little") for i in (24, 27))
    elif kind == b"VP8L":
        packed = struct.unpack_from("<I", data, 21)[0]
        width, height = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    else:
        return None
    return PictureSize(width * height, 4 * width * height)


def _of_radiance(data: bytes) -> PictureSize | None:
    size = _RADIANCE.match(data)
    if size is None:
        return None
    pixels = int(size[1]) * int(size[2])
    return PictureSize(pixels, 12 * pixels)


def _of_tiff(data: bytes) -> PictureSize:
    tags = dict(_tiff_tags(data))
    pixels = tags[_WIDTH] * tags[_HEIGHT]
    return PictureSize(pixels, pixels * max(tags.get(_BITS, 1) // 8, 1) * tags.get(_SAMPLES, 1))


def _tiff_tags(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield (tag, first value) of the first directory of a TIFF or BigTIFF file."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    word, size, head = ("Q", 20, 12) if big else ("I", 12, 8)
    (place,) = struct.unpack_from(order + word, data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, place)
    place += 8 if big else 2
    for entry in range(place, place + size * min(count, 1 << 12), size):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        letter = _TIFF_TYPES.get(kind)
        if letter is None or tag not in (_WIDTH, _HEIGHT, _BITS, _SAMPLES):
            continue
        (values,) = struct.unpack_from(order + word, data, entry + 4)
        inline = values * struct.calcsize(letter) <= size - head
        value = entry + head if inline else struct.unpack_from(order + word, data, entry + head)[0]
        yield tag, struct.unpack_from(order + letter, data, value)[0]


_READERS: tuple[tuple[bytes, Callable[[bytes], PictureSize | None]], ...] = (
    (b"\x89PNG\r\n\x1a\n", _of_png),
    (b"\xff\xd8", _of_jpeg),
    (b"BM", _of_bmp),
    (b"RIFF", _of_webp),
    (b"II*\0", _of_tiff),
    (b"MM\0*", _of_tiff),
    (b"II+\0", _of_tiff),
    (b"MM\0+", _of_tiff),
    (b"#?", _of_radiance),
)
