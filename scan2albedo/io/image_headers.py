"""What the header of a picture says about its size, before a pixel is decoded."""

from __future__ import annotations

import re
import struct
import warnings
from importlib import import_module
from io import BytesIO
from pathlib import Path

from scan2albedo.io import limits

_RADIANCE = re.compile(rb"(?s)#\?.{0,65536}?\n[-+][XY] +(\d{1,18}) +[-+][XY] +(\d{1,18})\s")


def picture_pixels(data: bytes, place: str | Path) -> int | None:
    """Return how many pixels a picture has, see `declared_pixels`; TooLargeError for too many."""
    pixels = declared_pixels(data)
    limits.require_at_most(
        f"image {place}", "pixels", pixels or 0, limits.PIXELS, "save it with fewer pixels"
    )
    return pixels


def declared_pixels(data: bytes) -> int | None:
    """Return how many pixels the header of a PNG, JPEG, TIFF, BMP, WebP or Radiance picture declares.

    Pixels that take more bytes than three 32-bit floats count as several. None when it is none of these, or
    damaged. `data` may be the picture's beginning. EXR files have a header a part and are judged in
    `images.read_exr_channels`.
    """
    readers = {b"\x89PNG\r\n\x1a\n": "Png", b"\xff\xd8": "Jpeg", b"BM": "Bmp"}
    pillows = next((reader for magic, reader in readers.items() if data.startswith(magic)), None)
    try:
        if pillows is not None:
            # Not `Image.open`, which refuses large pictures by a limit of its own.
            plugin = import_module(f"PIL.{pillows}ImagePlugin")
            width, height = getattr(plugin, f"{pillows}ImageFile")(BytesIO(data)).size
        elif data.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
            # Pillow reads tags also of kinds of TIFF whose pixels it cannot decode.
            from PIL.TiffImagePlugin import ImageFileDirectory_v2

            big = b"+" in data[2:4]
            head = b"II+\0" + data[4:16] if big else b"II*\0" + data[4:8]
            tags = ImageFileDirectory_v2(head, data[:2])
            stream = BytesIO(data)
            stream.seek(tags.next)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of other tags
                tags.load(stream)
            bits = tags.get(258, 1)
            pixel_bytes = (max(bits) if isinstance(bits, tuple) else bits) // 8 * tags.get(277, 1)
            width, height = tags[256] * max(-(-pixel_bytes // 12), 1), tags[257]
        elif data.startswith(b"#?") and (size := _RADIANCE.match(data)) is not None:
            width, height = int(size[1]), int(size[2])
        elif data[8:16] == b"WEBPVP8X":  # Pillow makes room for a WebP picture when it opens one
            width, height = (1 + int.from_bytes(data[i : i + 3], "little") for i in (24, 27))
        elif data[8:16] == b"WEBPVP8L":
            packed = struct.unpack_from("<I", data, 21)[0]
            width, height = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
        elif data[8:16] == b"WEBPVP8 ":
            width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
        else:
            return None
    except (OSError, SyntaxError, ValueError, TypeError, LookupError, OverflowError, struct.error):
        return None
    return int(width * height)


def is_cut_png(data: bytes) -> bool:
    """Return whether a PNG declares a chunk beyond its end; decoders make room for it before they look."""
    place = 8
    if not data.startswith(b"\x89PNG"):
        return False
    while place + 8 <= len(data) and data[place + 4 : place + 8] != b"IEND":
        place += 12 + int(struct.unpack_from(">I", data, place)[0])
    return place > len(data)
