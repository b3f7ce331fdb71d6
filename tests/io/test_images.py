import struct
import sys
import tracemalloc

import cv2
import numpy as np
import OpenEXR
import pytest
from helpers.pictures import png_chunk
from helpers.square import quarters, write_image
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageCms

from scan2albedo.errors import MissingDependencyError, OutputError, ScanError
from scan2albedo.io.color import linear_to_srgb, srgb_to_linear
from scan2albedo.io.images import (
    declared_pixels,
    read_exr_channels,
    read_image_linear,
    read_image_values,
    write_exr,
    write_exr_channels,
    write_image as write_by_extension,
    write_png,
)

RNG = np.random.default_rng(5)
SRGB = ImageCms.createProfile("sRGB")


@pytest.mark.parametrize(
    ("extension", "dtype", "channels"),
    [
        *((".png", dtype, channels) for dtype in (np.uint8, np.uint16) for channels in ((), (3,), (4,))),
        *((".tiff", dtype, (3,)) for dtype in (np.uint8, np.uint16)),
        (".bmp", np.uint8, (3,)),
    ],
)
def test_integers_are_srgb_grey_is_repeated_and_alpha_dropped(tmp_path, extension, dtype, channels):
    top = np.iinfo(dtype).max
    pixels = RNG.integers(0, top, (5, 7, *channels)).astype(dtype)
    write_image(tmp_path / f"a{extension}", pixels)
    linear = read_image_linear((tmp_path / f"a{extension}").rename(tmp_path / "a"))  # the content decides
    assert linear.dtype == np.float32
    color = pixels[..., :3] if channels else np.dstack([pixels] * 3)
    assert_allclose(linear, srgb_to_linear(color / top), rtol=1e-5)


@pytest.mark.parametrize(("kind", "options"), [("TGA", {}), ("TGA", {"compression": "tga_rle"}), ("GIF", {})])
def test_targa_and_gif(tmp_path, kind, options):
    few = np.uint8([[[255, 0, 0], [0, 128, 0]], [[0, 0, 64], [9, 9, 9]]])
    image = np.kron(few, np.ones((3, 5, 1), np.uint8))
    Image.fromarray(image).save(tmp_path / "a", kind, **options)
    assert_allclose(read_image_linear(tmp_path / "a"), srgb_to_linear(image / 255), atol=1e-6)
    assert declared_pixels((tmp_path / "a").read_bytes()) == 60


@pytest.mark.parametrize("mode", ["LA", "P", "1"])
def test_grey_with_alpha_palette_and_one_bit(tmp_path, mode):
    pixels = np.uint8(255 * (np.arange(24).reshape(4, 6) % 3 == 0))
    Image.fromarray(pixels).convert(mode).save(tmp_path / "a.png")
    assert_array_equal(read_image_linear(tmp_path / "a.png"), np.dstack([pixels / 255] * 3))


def test_exif_turns_photographs_alone(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 3  # turned by 180 degrees
    Image.fromarray(quarters(64)).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    linear = read_image_linear(tmp_path / "turned.jpg")
    assert_allclose(linear[-8, 8], [1, 0, 0], atol=0.03)  # red stays in the lower left
    upright = read_image_linear(tmp_path / "turned.jpg", upright=True)
    assert_array_equal(upright, linear[::-1, ::-1])
    pixels, deep = RNG.integers(0, 65536, (5, 7, 3)).astype(np.uint16), tmp_path / "deep.png"
    write_png(deep, pixels)
    data, chunk = deep.read_bytes(), png_chunk(b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
    deep.write_bytes(data[:33] + chunk + data[33:])
    assert_array_equal(read_image_values(deep, upright=True), pixels[::-1, ::-1])


def display_p3():
    """Bytes of an ICC profile of Display P3, as telephones tag their pictures with."""
    data = bytearray(ImageCms.ImageCmsProfile(SRGB).tobytes())
    primaries = {"rXYZ": (0.51512, 0.2412, -0.00105), "gXYZ": (0.29198, 0.69225, 0.04189)}
    primaries["bXYZ"] = (0.1571, 0.06657, 0.78407)
    for name, values in primaries.items():
        place = 128 + data[128:].index(name.encode())
        at = struct.unpack_from(">I", data, place + 4)[0]
        struct.pack_into(">3i", data, at + 8, *(round(65536 * value) for value in values))
    return bytes(data)


@pytest.mark.parametrize(
    ("kind", "mode", "options"),
    [("PNG", "RGB", {}), ("PNG", "RGBA", {}), ("JPEG", "RGB", {"quality": 100, "subsampling": 0})],
)
def test_a_colour_profile_is_carried_out(tmp_path, kind, mode, options):
    p3_from_srgb = [[0.82246, 0.17754, 0], [0.03319, 0.96681, 0], [0.01708, 0.0724, 0.91052]]
    linear = np.kron(RNG.uniform(0.05, 0.9, (4, 4, 3)), np.ones((16, 16, 1)))
    pixels = np.round(255 * linear_to_srgb(linear @ np.transpose(p3_from_srgb))).astype(np.uint8)
    alpha = RNG.integers(0, 255, (64, 64, 1)).astype(np.uint8)
    picture = Image.fromarray(np.dstack([pixels, alpha]) if mode == "RGBA" else pixels)
    picture.save(tmp_path / "a", kind, icc_profile=display_p3(), **options)
    found = read_image_linear(tmp_path / "a", alpha=True)
    assert_allclose(found[..., :3], linear, atol=0.02)
    assert np.abs(read_image_linear(tmp_path / "a") - srgb_to_linear(pixels / 255)).max() > 0.05
    if mode == "RGBA":
        assert_allclose(found[..., 3:], alpha / 255, atol=1e-6)
    # Tagged as sRGB, or with a damaged profile, samples stay as they are.
    for profile in (ImageCms.ImageCmsProfile(SRGB).tobytes(), display_p3()[:200]):
        picture.save(tmp_path / "plain", "PNG", icc_profile=profile)
        assert_array_equal(read_image_values(tmp_path / "plain"), pixels)


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3)])
def test_float_images_are_linear_already(tmp_path, shape):
    values = RNG.normal(1, 3, shape).astype(np.float32)
    write_exr(tmp_path / "a.exr", values)
    assert sorted(read_exr_channels(tmp_path / "a.exr")) == (["Y"] if len(shape) == 2 else ["B", "G", "R"])
    color = np.broadcast_to(np.atleast_3d(values), (5, 4, 3))
    assert_array_equal(read_image_linear(tmp_path / "a.exr"), color)
    cv2.imwrite(str(tmp_path / "a.tiff"), color[..., ::-1])
    assert_array_equal(read_image_linear(tmp_path / "a.tiff"), color)


@pytest.mark.parametrize("extension", [".png", ".jpg", ".tiff", ".exr"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.97])
def test_truncated_images_are_refused_by_name(tmp_path, extension, part):
    file = tmp_path / f"cut{extension}"
    write_by_extension(file, RNG.random((90, 90, 3)))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(ScanError, match=rf"cut\{extension}"):
        read_image_linear(file)


def test_pictures_that_show_no_colours_are_refused_by_name(tmp_path):
    (tmp_path / "noise.png").write_bytes(RNG.bytes(5000))
    write_exr_channels(tmp_path / "depth.exr", {"depth.Z": np.ones((3, 3), np.float32)})
    values = np.ones((3, 3, 3), np.float32)
    values[1, 1] = np.nan
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": values}).write(str(tmp_path / "nan.exr"))
    for said in (
        "noise.png .*re-export",
        "nothing.png .*No such file",
        r"depth.exr has the channels depth\.Z",
        "nan.exr holds NaN",
    ):
        with pytest.raises(ScanError, match=said):
            read_image_linear(tmp_path / said.split()[0])


def test_png_holds_srgb_of_linear_floats_and_keeps_integers_and_masks(tmp_path):
    write_png(tmp_path / "a.png", np.full((2, 2, 3), [0.2158605, 1.5, -1]))
    assert cv2.imread(str(tmp_path / "a.png"), -1)[0, 0].tolist() == [0, 255, 128]  # BGR
    deep = RNG.integers(0, 65536, (5, 7, 4)).astype(np.uint16)
    grey = quarters()[..., 0]
    rgba = np.dstack([quarters(), np.full((8, 8), 7, np.uint8)])
    for image in (quarters(), deep[..., :3], rgba, deep, grey, deep[..., 0], grey > 0):
        write_png(tmp_path / "a.png", image)
        stored = cv2.imread(str(tmp_path / "a.png"), -1)
        order = stored if stored.ndim == 2 else stored[..., [2, 1, 0, 3][: stored.shape[2]]]
        expected = image.astype(np.uint8) * 255 if image.dtype == bool else image
        assert_array_equal(order, expected, strict=True)


@pytest.mark.parametrize(
    ("name", "image", "message"),
    [
        ("a.png", np.zeros(3), r"shape \(3,\), expected"),
        ("a.png", np.full((2, 2), np.nan), "NaN"),
        ("a.png", np.zeros((2, 2), np.int64), "samples of int64, expected uint8"),
        ("a.exr", np.zeros((2, 2, 5)), "expected"),
        ("a.exr", [[0, np.nan]], r"a\.exr: channel Y holds NaN or infinite"),
        ("a.exr", [[0, 1e300]], r"a\.exr: channel Y holds NaN or infinite"),
        ("a.xyz", np.zeros((2, 2)), r"a\.xyz: images end with"),
    ],
)
def test_wrong_images_are_refused(tmp_path, name, image, message):
    with pytest.raises((ValueError, OutputError), match=message), np.errstate(over="ignore"):
        write_by_extension(tmp_path / name, image)
    assert list(tmp_path.iterdir()) == []


def test_a_big_texture_is_decoded_in_little_more_than_its_own_memory(tmp_path):
    write_image(tmp_path / "a.png", np.zeros((1500, 2000, 3), np.uint8))
    read_image_linear(tmp_path / "a.png")
    tracemalloc.start()
    linear = read_image_linear(tmp_path / "a.png")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.7 * linear.nbytes


def test_only_formats_that_pillow_lacks_need_opencv(tmp_path, monkeypatch):
    values = RNG.random((6, 5, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "a.hdr"), values)
    for name in ("a.png", "a.jpg", "a.tif"):
        write_by_extension(tmp_path / name, values)
    write_png(tmp_path / "b.png", (65535 * values).astype(np.uint16))
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("a.png", "a.jpg", "a.tif", "b.png"):
        read_image_linear(tmp_path / name)
    with pytest.raises(MissingDependencyError, match=r"scan2albedo\[opencv\]"):
        read_image_linear(tmp_path / "a.hdr")
