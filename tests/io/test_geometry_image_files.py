from dataclasses import fields

import numpy as np
import pytest

from scan2albedo.core import GeometryImage
from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.errors import GeometryImageError
from scan2albedo.io.geometry_image_files import (
    read_geometry_image,
    write_geometry_image,
    write_geometry_image_exr,
)
from scan2albedo.io.images import read_exr_channels

RNG = np.random.default_rng(8)


def picture(complete=True):
    height, width = 12, 20
    mask = np.ones((height, width), bool)
    mask[0], mask[:, :3] = False, False
    position = np.where(mask[..., None], RNG.normal(0, 60, (height, width, 3)), 0)
    normal = np.where(mask[..., None], RNG.normal(size=(height, width, 3)), 0)
    if not complete:
        return GeometryImage(position, normal, mask)
    return GeometryImage(
        position,
        normal,
        mask,
        texture_linear=RNG.random((height, width, 3)).astype(np.float32),
        region=np.where(mask, RNG.integers(0, 20, mask.shape), 255).astype(np.uint8),
        occluder=(RNG.normal(size=(7, 3)), RNG.integers(0, 7, (4, 3))),
        texture_valid=RNG.random(mask.shape) > 0.3,
        specular_scale=RNG.random(mask.shape).astype(np.float32),
        inpaint=RNG.random(mask.shape) > 0.5,
        skin=RNG.random(mask.shape).astype(np.float32),
        face_chart=RNG.random((*mask.shape, 2)).astype(np.float32),
        camera=RNG.choice([0, 1, NO_CAMERA], mask.shape).astype(np.uint8),
        camera_positions=RNG.normal(0, 900, (2, 3)),
        labels=RNG.integers(0, 9, mask.shape).astype(np.uint8),
        filled=RNG.random(mask.shape) > 0.9,
        on_face=mask,
        texture_log_odds=1.5,
    )


@pytest.mark.parametrize("complete", [True, False])
def test_npz_keeps_every_bit(tmp_path, complete):
    image = picture(complete)
    write_geometry_image(tmp_path / "a.npz", image)
    back = read_geometry_image(tmp_path / "a.npz")
    for field in fields(GeometryImage):
        want, got = getattr(image, field.name), getattr(back, field.name)
        if field.name == "texture_log_odds":
            assert got == want == (1.5 if complete else 0)
        elif want is None or field.name == "occluder":
            assert (want is None) == (got is None)
        else:
            assert got.dtype == want.dtype
            np.testing.assert_array_equal(got, want)
    if complete:
        for want, got in zip(image.occluder, back.occluder, strict=True):
            np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("complete", [True, False])
def test_exr_keeps_single_precision(tmp_path, complete):
    image = picture(complete)
    write_geometry_image_exr(tmp_path / "a.exr", image)
    back = read_geometry_image(tmp_path / "a.exr")
    for field in fields(GeometryImage):
        want, got = getattr(image, field.name), getattr(back, field.name)
        if field.name == "texture_log_odds":
            assert got == 0
        elif want is None or field.name in ("occluder", "camera", "camera_positions"):
            assert got is None
        else:
            assert got.dtype == want.dtype
            np.testing.assert_array_equal(got, want.astype(np.float32).astype(want.dtype))


def test_exr_layers_have_the_names_other_programs_show(tmp_path):
    write_geometry_image_exr(tmp_path / "a.exr", picture())
    assert sorted(read_exr_channels(tmp_path / "a.exr")) == sorted(
        [f"position_mm.{c}" for c in "XYZ"]
        + [f"normal.{c}" for c in "XYZ"]
        + [f"texture_linear.{c}" for c in "RGB"]
        + [f"{n}.Y" for n in ("mask", "region", "texture_valid", "specular_scale", "inpaint", "skin")]
        + [f"{n}.Y" for n in ("labels", "filled", "on_face")]
        + ["face_chart.X", "face_chart.Y"]
    )


def test_row_0_is_the_top_in_both(tmp_path):
    image = picture()
    for name, write in (("a.npz", write_geometry_image), ("a.exr", write_geometry_image_exr)):
        write(tmp_path / name, image)
        assert not read_geometry_image(tmp_path / name).mask[0].any()


@pytest.mark.parametrize("name", ["a.npz", "a.exr"])
@pytest.mark.parametrize("part", [None, 0.0, 0.5])
def test_missing_and_truncated_files_are_refused_by_name(tmp_path, name, part):
    if part is not None:
        write = write_geometry_image if name == "a.npz" else write_geometry_image_exr
        write(tmp_path / name, picture())
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: int(len(data) * part)])
    with pytest.raises(GeometryImageError, match=name.replace(".", r"\.")):
        read_geometry_image(tmp_path / name)


def test_archives_of_other_things_are_refused_by_name(tmp_path):
    np.savez(tmp_path / "a.npz", normal=np.zeros((2, 2, 3)), other=np.zeros(2))
    with pytest.raises(
        GeometryImageError, match=r"a\.npz: holds no position_mm, mask; .*found: normal, other"
    ):
        read_geometry_image(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", format_version=99)
    with pytest.raises(GeometryImageError, match=r"b\.npz: format version 99 is newer than 1; update"):
        read_geometry_image(tmp_path / "b.npz")
    np.savez(
        tmp_path / "c.npz",
        position_mm=np.zeros((2, 2, 3)),
        normal=np.zeros((2, 3, 3)),
        mask=np.zeros((2, 2), bool),
    )
    with pytest.raises(GeometryImageError, match=r"c\.npz: normal has shape \(2, 3, 3\)"):
        read_geometry_image(tmp_path / "c.npz")
    np.savez(tmp_path / "d.npz", mask=np.array([object()]))
    with pytest.raises(GeometryImageError, match=r"geometry image .*d\.npz cannot be read"):
        read_geometry_image(tmp_path / "d.npz")
    (tmp_path / "e.png").touch()
    with pytest.raises(GeometryImageError, match=r"e\.png: geometry images are \.npz or \.exr"):
        read_geometry_image(tmp_path / "e.png")


@pytest.mark.parametrize(
    ("occluder", "message"),
    [
        ((np.zeros((3, 2)), np.array([[0, 1, 2]])), r"vertices have shape \(3, 2\)"),
        ((np.full((3, 3), np.nan), np.array([[0, 1, 2]])), "NaN"),
        ((np.zeros((3, 3)), np.array([[0, 1, 3]])), "vertices 0 to 3 of 3"),
        ((np.zeros((3, 3)), np.array([[0, 1, -1]])), "vertices -1 to 1 of 3"),
    ],
)
def test_an_occluder_that_is_no_mesh_is_refused(occluder, message):
    grid = np.zeros((2, 2, 3))
    with pytest.raises(GeometryImageError, match=message):
        GeometryImage(grid, grid, np.ones((2, 2), bool), occluder=occluder)


def test_nan_in_the_annotation_is_refused():
    grid = np.zeros((2, 2, 3))
    with pytest.raises(GeometryImageError, match="skin holds values beyond 0 to 1"):
        GeometryImage(grid, grid, np.ones((2, 2), bool), skin=np.full((2, 2), 1.1))
    with pytest.raises(GeometryImageError, match="specular_scale holds NaN"):
        GeometryImage(grid, grid, np.ones((2, 2), bool), specular_scale=np.full((2, 2), np.nan))
