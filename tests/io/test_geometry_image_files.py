import numpy as np
import pytest
from helpers.npz import cut

from scan2albedo.core import GeometryImage
from scan2albedo.core.geometry_image import ARRAYS, NO_CAMERA
from scan2albedo.errors import GeometryImageError
from scan2albedo.io.geometry_image_files import (
    read_geometry_image,
    write_geometry_image,
    write_geometry_image_exr,
)
from scan2albedo.io.images import read_exr_channels

RNG = np.random.default_rng(8)


SHAPE = 12, 20


def picture(complete=True):
    mask = np.zeros(SHAPE, bool)
    mask[1:, 3:] = True
    position, normal = np.where(mask[..., None], RNG.normal(0, 60, (2, *SHAPE, 3)), 0)
    if not complete:
        return GeometryImage(position, normal, mask)
    more = {
        name: RNG.integers(0, 2, SHAPE if channels is None else (*SHAPE, channels)).astype(dtype)
        for name, (dtype, channels) in ARRAYS.items()
    }
    more |= {"position": position, "normal": normal, "mask": mask}
    more["region"][~mask] = 255
    more["camera"][~mask] = NO_CAMERA
    return GeometryImage(
        **more,
        occluder=(RNG.normal(size=(7, 3)), RNG.integers(0, 7, (4, 3))),
        camera_positions=RNG.normal(0, 900, (2, 3)),
        texture_log_odds=1.5,
    )


WRITERS = {"a.npz": write_geometry_image, "a.exr": write_geometry_image_exr}


@pytest.mark.parametrize("complete", [True, False])
@pytest.mark.parametrize("name", WRITERS)
def test_npz_keeps_every_bit_and_exr_what_is_an_image_in_single_precision(tmp_path, name, complete):
    image, exact = picture(complete), name == "a.npz"
    WRITERS[name](tmp_path / name, image)
    back = read_geometry_image(tmp_path / name)
    assert not back.mask[0].any()  # row 0 is the top
    assert back.texture_log_odds == (image.texture_log_odds if exact else 0)
    for field in (*ARRAYS, "camera_positions"):
        want, got = getattr(image, field), getattr(back, field)
        if want is None or (not exact and field in ("camera", "camera_positions")):
            assert got is None
        else:
            stored = want if exact else want.astype(np.float32).astype(want.dtype)
            np.testing.assert_array_equal(got, stored, strict=True)
    np.testing.assert_equal(back.occluder, image.occluder if exact else None)


def test_exr_layers_have_the_names_other_programs_show(tmp_path):
    write_geometry_image_exr(tmp_path / "a.exr", picture())
    layers = {"position_mm": "XYZ", "normal": "XYZ", "texture_linear": "RGB", "face_chart": "XY"}
    of_one = "mask region texture_valid specular_scale inpaint skin labels filled on_face"
    layers |= dict.fromkeys(of_one.split(), "Y")
    expected = {f"{layer}.{channel}" for layer, channels in layers.items() for channel in channels}
    assert set(read_exr_channels(tmp_path / "a.exr")) == expected


@pytest.mark.parametrize("name", WRITERS)
def test_missing_and_truncated_files_are_refused_by_name(tmp_path, name):
    file = tmp_path / name
    WRITERS[name](file, picture())
    cut(file)
    for change in (lambda: file.write_bytes(b""), file.unlink, lambda: (tmp_path / "e.png").touch()):
        with pytest.raises(GeometryImageError, match=name.replace(".", r"\.")):
            read_geometry_image(file)
        change()
    with pytest.raises(GeometryImageError, match=r"e\.png: geometry images are \.npz or \.exr"):
        read_geometry_image(tmp_path / "e.png")


GRID = np.zeros((2, 2, 3))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"normal": GRID, "other": np.zeros(2)},
            r"a\.npz: holds no position_mm, mask; .*found: normal, other",
        ),
        ({"format_version": 99}, r"a\.npz: format version 99 is newer than 1; update"),
        (
            {"position_mm": GRID, "normal": np.zeros((2, 3, 3)), "mask": np.zeros((2, 2), bool)},
            r"a\.npz: normal has shape \(2, 3, 3\)",
        ),
    ],
)
def test_archives_of_other_things_are_refused_by_name(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(GeometryImageError, match=message):
        read_geometry_image(tmp_path / "a.npz")
