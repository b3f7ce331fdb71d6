"""Images in and out: linear float32 (H, W, 3) inside, whatever the file holds."""

from __future__ import annotations

import math
import re
import struct
import warnings
import zlib
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from scan2albedo.core.arrays import ArrayLike, ByteArray, Float32Array, NDArray, all_finite
from scan2albedo.errors import OutputError, ScanError, errors_of, needs_extra, one_line
from scan2albedo.io import limits
from scan2albedo.io.atomic import atomic_path, write_bytes
from scan2albedo.io.color import decode_picture, encode_srgb_integers, label_colors

if TYPE_CHECKING:
    from PIL import Image

_TARGA = (b"\0\2", b"\0\n", b"\1\1", b"\1\t", b"\0\3", b"\0\v")  # whether it has a palette, and its kind
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_RADIANCE = re.compile(rb"(?s)#\?.{0,65536}?\n[-+][XY] +(\d{1,18}) +[-+][XY] +(\d{1,18})\s")
SUPPORTED_IMAGES = (*re.findall(r"\.\w+", ".png .jpg .jpeg .tif .tiff .bmp .webp .exr .hdr .tga .gif"),)


def read_image_linear(path: str | Path, *, alpha: bool = False, upright: bool = False) -> Float32Array:
    """Read an image as linear colour (H, W, 3), row 0 the top.

    The content decides which of `SUPPORTED_IMAGES` it is, not the extension. Integer samples (8 or 16 bit)
    are decoded as sRGB, or by the colour profile that the file holds; float samples (EXR, HDR, float TIFF)
    are linear already. Grey is repeated over three channels, alpha is dropped; with `alpha`, one that varies
    is kept, (H, W, 4). A photograph is turned `upright` by its EXIF orientation; texture coordinates refer to
    the pixels as stored. Raises ScanError, naming the file, when it is missing, unreadable, damaged or holds
    NaN; TooLargeError, before anything is decoded, when its header declares more than `limits.PIXELS`.
    """
    samples = read_image_values(path, alpha=alpha, upright=upright)
    if samples.dtype in (np.uint8, np.uint16):
        return decode_picture(cast("ByteArray", samples))
    if not all_finite(samples):
        raise ScanError(f"image {path} holds NaN or infinite samples; re-export it")
    return cast("Float32Array", samples)


def read_image_values(
    path: str | Path, *, alpha: bool = False, upright: bool = False
) -> ByteArray | NDArray[np.uint16] | Float32Array:
    """Read an image's samples, (H, W, 3), integers in sRGB, floats may be NaN; see `read_image_linear`.

    With `alpha` they are (H, W, 4) where the file has it.
    """
    file = Path(path)
    try:
        limits.require_file(file, math.inf)
        with file.open("rb") as opened:
            is_exr = opened.read(len(_EXR_MAGIC)) == _EXR_MAGIC
        if is_exr:
            channels = read_exr_channels(file)
            wanted = next((c for c in ("RGB", "YYY") if set(c) <= set(channels)), None)
            if wanted is None:
                raise ScanError(f"image {file} has the channels {', '.join(channels)}; expected R, G, B or Y")
            wanted += "A" if alpha and "A" in channels else ""
            return np.stack([channels[c] for c in wanted], axis=-1)
        data = limits.read_bytes(file)
        # Nothing is decoded whose size is not known before.
        known = picture_pixels(data, file) is not None and not is_cut_png(data)
        pixels = _decoded(data, upright) if known else None
    except (OSError, ValueError) as error:
        raise ScanError(f"image {file} cannot be read: {one_line(error)}") from error
    if pixels is None:
        said = f"image {file} cannot be decoded ({len(data)} bytes): damaged, truncated or unknown"
        raise ScanError(f"{said}; re-export it as one of {', '.join(SUPPORTED_IMAGES)}")
    pixels = np.atleast_3d(pixels)
    if pixels.shape[2] < 3:
        pixels = pixels[..., [0, 0, 0, *range(1, pixels.shape[2])]]
    pixels = pixels[..., : 4 if alpha else 3]
    if pixels.dtype in (np.uint8, np.uint16):
        return cast("ByteArray", pixels)
    if pixels.dtype.kind != "f":
        raise ScanError(f"image {file} holds {pixels.dtype} samples; save it with 8 or 16 bits, or as float")
    return np.ascontiguousarray(pixels, np.float32)


def _decoded(data: bytes, upright: bool) -> NDArray | None:
    """Return the samples of a picture, grey or with colours in the order RGB; None when it is damaged."""
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of metadata
            with Image.open(BytesIO(data)) as image:
                deep = image.format == "TIFF" and max(getattr(image, "tag_v2", {}).get(258, (1,))) > 8  # bits
                raw = image.tile[0].args if image.format == "PNG" and image.tile else ""
                if upright:
                    ImageOps.exif_transpose(image, in_place=True)
                if (in_srgb := _in_srgb(image)) is not None:
                    return np.asarray(in_srgb)
                if raw in ("RGB;16B", "RGBA;16B"):
                    # Pillow keeps the first byte of such samples; read as if the second were the first.
                    high = np.asarray(image, np.uint16)
                    with Image.open(BytesIO(data)) as again:
                        again.tile = [again.tile[0]._replace(args=raw[:-1] + "L")]
                        if upright:
                            ImageOps.exif_transpose(again, in_place=True)
                        return high << 8 | np.asarray(again, np.uint16)
                if raw == "LA;16B" or deep:
                    raise UnidentifiedImageError
                if image.mode.startswith("I;16"):
                    return np.asarray(image, np.uint16)
                if image.mode not in ("L", "LA", "RGB", "RGBA") or "transparency" in image.info:
                    kinds = {"1": "L", "P": "RGBA", "PA": "RGBA", "L": "LA", "RGB": "RGBA"}
                    return np.asarray(image.convert(kinds.get(image.mode, "RGB")))
                return np.asarray(image)
    except UnidentifiedImageError:
        pass
    except (OSError, SyntaxError, ValueError, LookupError, TypeError, EOFError, struct.error, zlib.error):
        return None
    # Radiance, floats, and more than 8 bits in TIFF.
    with needs_extra("opencv"):
        import cv2
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if pixels is None or pixels.ndim == 2 or pixels.shape[2] < 3:
        return pixels
    return pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]


def _in_srgb(image: Image.Image) -> Image.Image | None:
    """Return a picture of 8 bits a sample in sRGB, where its colour profile is another one; else None.

    Of 16 bits the first 8 are kept then, which is what Pillow's transforms take.
    """
    from PIL import Image, ImageCms

    profile = image.info.get("icc_profile")
    if not profile or image.mode.startswith(("I", "F")):
        return None
    if image.mode in ("P", "PA") or "transparency" in image.info:
        image = image.convert("RGBA")
    kind = "RGBA" if image.mode == "RGBA" else "RGB"
    try:
        own, srgb = ImageCms.ImageCmsProfile(BytesIO(profile)), ImageCms.createProfile("sRGB")
        convert = ImageCms.buildTransform(own, srgb, image.mode, kind, ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, OSError):  # a damaged profile, or one of another kind of samples
        return None
    if image.mode == kind:
        steps = np.linspace(0, 255, 9)
        cube = np.stack(np.meshgrid(steps, steps, steps, [255])[: len(kind)], axis=-1)
        cube = cube.reshape(9, 81, -1).astype(np.uint8)
        changed = np.asarray(ImageCms.applyTransform(Image.fromarray(cube), convert), int) - cube
        if np.abs(changed).max() <= 2:  # of 255: profiles of sRGB differ so much by rounding
            return None
    return ImageCms.applyTransform(image, convert)


def read_exr_channels(path: str | Path) -> dict[str, Float32Array]:
    """Return every channel of the first part of an EXR file as (H, W) float32, by its full name.

    Raises ScanError when it is missing or not whole, TooLargeError for too many samples in all parts.
    """
    import OpenEXR

    try:
        # Every part is decoded: what the headers of all declare counts.
        samples = 0
        with OpenEXR.File(str(path), header_only=True) as file:
            for part in file.parts:
                low, high = (np.asarray(corner, int) for corner in part.header["dataWindow"])
                width, height = np.maximum(high - low + 1, 0).tolist()
                samples += width * height * len(part.header["channels"])
        most = max(12 * limits.PIXELS, limits.GROWTH * Path(path).stat().st_size)
        advice = "save it with fewer pixels"
        limits.require_at_most(f"image {path}", "bytes of pixels", 4 * samples, most, advice)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {k: np.array(c.pixels, np.float32) for k, c in file.channels().items()}
    except (LookupError, OSError, RuntimeError, ValueError, TypeError) as error:
        raise ScanError(f"image {path} is missing or no complete EXR file; write it again") from error


def write_exr_channels(path: str | Path, channels: dict[str, Float32Array]) -> None:
    """Write (H, W) channels by their full names as 32-bit floats, ZIP compressed, atomically.

    Raises OutputError when the folder cannot be written; ValueError for values not finite in 32 bits.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stored = {name: np.ascontiguousarray(c, np.float32) for name, c in channels.items()}
    if wrong := [name for name, c in stored.items() if not all_finite(c)]:
        raise ValueError(f"{path}: channel {wrong[0]} holds NaN or infinite values; nothing is written")
    with atomic_path(path) as temporary:
        temporary.touch()
        advice = "check the space left in its folder"
        with errors_of(f"cannot write {path}", OutputError, RuntimeError, advice=advice):
            OpenEXR.File(header, stored).write(str(temporary))


def write_exr(path: str | Path, linear: ArrayLike) -> None:
    """Write a linear image (H, W, 3 or 4), or (H, W) as channel Y; see `write_exr_channels` for errors."""
    image = np.asarray(linear, np.float32)
    _check_shape(image)
    planes = np.moveaxis(np.atleast_3d(image), 2, 0)
    write_exr_channels(path, dict(zip("Y" if image.ndim == 2 else "RGBA", planes, strict=False)))


def write_png(path: str | Path, image: ArrayLike) -> None:
    """Write a PNG atomically; see `encode_image` for what each dtype means, `write_image` for errors."""
    write_bytes(path, encode_image(image, ".png"))


def write_indexed_png(path: str | Path, labels: ByteArray) -> None:
    """Write labels (H, W) as a PNG whose palette are `label_colors`, atomically."""
    from PIL import Image

    picture, file = Image.fromarray(labels), BytesIO()
    picture.putpalette(label_colors().ravel().tolist())
    picture.save(file, "PNG")
    write_bytes(path, file.getvalue())


def write_image(path: str | Path, image: ArrayLike) -> None:
    """Write an image in the format its extension names: `write_exr`, or 8-bit sRGB as `write_png` does.

    Raises OutputError when it cannot be written so, ValueError for another shape, another dtype, or NaN.
    """
    extension = Path(path).suffix.lower()
    if extension == ".exr":
        write_exr(path, image)
    elif extension in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        write_bytes(path, encode_image(image, extension))
    else:
        raise OutputError(f"{path}: images end with .png, .jpg, .tif or .exr, not {extension or 'nothing'}")


def encode_image(image: ArrayLike, extension: str, floats: type = np.uint8) -> bytes:
    """Return the bytes of an image file, (H, W, 3), (H, W, 4) or (H, W).

    uint8, uint16 (in a PNG) and bool are stored as they are (sRGB, bool as 0 and 255); floats are linear
    colour and are encoded to sRGB of the dtype `floats`, clipped to [0, 1].
    """
    from PIL import Image

    array = np.asarray(image)
    _check_shape(array)
    if array.dtype.kind == "f":
        if not all_finite(array):
            raise ValueError(f"an image of shape {array.shape} holds NaN or infinite values")
        array = encode_srgb_integers(array, floats)
    elif array.dtype == np.bool_:
        array = array.astype(np.uint8) * 255
    elif array.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image has samples of {array.dtype}, expected uint8, uint16, bool or floats")
    if array.dtype == np.uint16 and extension == ".png":
        # Pillow has no mode for such samples with colours: rows without filters.
        height, width = array.shape[:2]
        rows = np.ascontiguousarray(array.reshape(height, -1), ">u2").view(np.uint8)
        color_type = {1: 0, 3: 2, 4: 6}[array.size // (height * width)]
        chunks = {
            b"IHDR": struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0),
            b"IDAT": zlib.compress(np.insert(rows, 0, 0, axis=1).tobytes(), 1),
            b"IEND": b"",
        }
        return b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks.items()
        )
    kind = {".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF"}.get(extension, "PNG")
    if array.dtype == np.uint16 or 0 in array.shape:
        raise ValueError(f"an image of shape {array.shape} and {array.dtype} cannot be stored as {extension}")
    options: Any = {"JPEG": {"quality": 95}, "TIFF": {"compression": "tiff_lzw"}}
    file = BytesIO()
    stored = array[..., :3] if kind == "JPEG" and array.ndim == 3 else array
    Image.fromarray(np.ascontiguousarray(stored)).save(file, kind, **options.get(kind, {"compress_level": 1}))
    return file.getvalue()


def _check_shape(image: NDArray) -> None:
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] not in (3, 4)):
        raise ValueError(f"an image has shape {image.shape}, expected (H, W), (H, W, 3) or (H, W, 4)")


def picture_pixels(data: bytes, place: str | Path) -> int | None:
    """Return how many pixels a picture has, see `declared_pixels`; TooLargeError for too many."""
    pixels = declared_pixels(data)
    limits.require_at_most(f"image {place}", "pixels", pixels or 0, limits.PIXELS, "save fewer pixels")
    return pixels


def declared_pixels(data: bytes) -> int | None:
    """Return how many pixels the header of a picture but EXR declares.

    Pixels that take more bytes than three 32-bit floats count as several. None when it is none of these, or
    damaged. `data` may be the picture's beginning. `read_exr_channels` judges EXR files.
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

            head = b"II+\0" + data[4:16] if b"+" in data[2:4] else b"II*\0" + data[4:8]
            tags = ImageFileDirectory_v2(head, data[:2])
            stream = BytesIO(data)
            stream.seek(tags.next)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of other tags
                tags.load(stream)
            bits = tags.get(258, 1)
            pixel_bytes = (max(bits) if isinstance(bits, tuple) else bits) // 8 * tags.get(277, 1)
            width, height = tags[256] * max(-(-pixel_bytes // 12), 1), tags[257]
        elif data.startswith((b"GIF87a", b"GIF89a")):
            width, height = struct.unpack_from("<HH", data, 6)
        elif data[1:3] in _TARGA and data[16] in (8, 16, 24, 32):
            width, height = struct.unpack_from("<HH", data, 12)
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
