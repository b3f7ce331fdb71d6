import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.io.parsed_mesh import Material, ParsedMesh
from scan2albedo.io.texture_atlas import pack_texture

RNG = np.random.default_rng(3)


def smooth(height, width, seed):
    """A texture whose bilinear lookup is exact for linear ramps."""
    slope = np.random.default_rng(seed).random((2, 3))
    places = np.stack(np.mgrid[0.5:height, 0.5:width], -1) / (height, width)
    return (places @ slope).astype(np.float32)


def looked_up(texture, uv):
    """Bilinear lookup with the convention of `RawScan`; texel centres at half-integers."""
    values = bilinear(texture, pixels_from_uv(uv.reshape(-1, 2), texture.shape[:2]))
    return values.reshape(*uv.shape[:-1], -1)


def packed_of(uv, *materials, material=None):
    """Pack materials, or the only texture "a", of faces without common corners."""
    faces = np.arange(len(uv) * 3).reshape(-1, 3)
    named = tuple(one if isinstance(one, Material) else Material("a", one) for one in materials)
    return pack_texture(ParsedMesh(RNG.random((len(uv) * 3, 3)), faces, uv, material, named))


def test_interpolated_lookups_are_the_same_in_the_atlas():
    textures = [smooth(h, w, i) for i, (h, w) in enumerate([(16, 31), (64, 8), (7, 7), (40, 40), (3, 90)])]
    material = np.repeat(np.arange(5), 30)
    uv = RNG.random((150, 3, 2))
    uv[::5, 0] = RNG.integers(0, 2, (30, 2))  # corners of the tiles too
    packed = packed_of(uv, *textures, material=material)
    for i, texture in enumerate(textures):
        mine = material == i
        assert_allclose(
            looked_up(packed.texture_linear, packed.uv[mine]), looked_up(texture, uv[mine]), atol=1e-5
        )
    assert packed.uv.min() >= 0
    assert packed.uv.max() <= 1
    height, width = packed.texture_linear.shape[:2]
    assert height * width < 3 * sum(t.shape[0] * t.shape[1] for t in textures)


def test_untextured_faces_get_colour_and_unused_textures_no_room():
    materials = (
        Material("a", smooth(8, 8, 1)),
        Material("b", None, (0.1, 0.2, 0.3)),
        Material("c", smooth(512, 512, 1)),
    )
    uv = RNG.random((4, 3, 2))
    uv[2, 1] = np.nan
    packed = packed_of(uv, *materials, material=np.array([0, 1, 0, -1]))
    assert max(packed.texture_linear.shape) < 30
    # No picture showed the colour of a material: its alpha is 0.
    assert_allclose(looked_up(packed.texture_linear, packed.uv[1]), [[0.1, 0.2, 0.3, 0]] * 3, rtol=1e-6)
    plain = np.tile([0.5, 0.5, 0.5, 0], (2, 3, 1))
    assert_allclose(looked_up(packed.texture_linear, packed.uv[[2, 3]]), plain, rtol=1e-6)
    assert looked_up(packed.texture_linear, packed.uv[0])[:, 3].min() == 1
    assert "faces without texture, given their material's colour: 3" in packed.notes


@pytest.mark.parametrize("shift", [(3.0, -2.0), (-1.0, 0.0)])
def test_whole_periods_are_moved_back(shift):
    texture, uv = smooth(16, 16, 2), RNG.random((6, 3, 2)) * 0.8 + 0.1
    moved = uv.copy()
    moved[3:] += shift
    packed = packed_of(moved, texture)
    assert_allclose(packed.uv, uv, atol=1e-12)
    assert packed.texture_linear is texture
    assert packed.notes == ("a: texture coordinates outside [0, 1] repeat the texture",)


def test_faces_across_a_period_get_the_texture_repeated():
    texture = RNG.random((8, 8, 3)).astype(np.float32)
    uv = np.array([[[0.5, 0.5], [2.5, 0.5], [0.5, 1.25]]])
    packed = packed_of(uv, texture)
    assert packed.texture_linear.shape == (16, 24, 3)
    # At the corners, and between them.
    weights = np.concatenate([np.eye(3), [[0.2, 0.3, 0.5], [0.6, 0.3, 0.1], [0.1, 0.8, 0.1]]])
    want, got = (weights @ uv[0] + 1e-9) % 1, weights @ packed.uv[0] + 1e-10
    nearest = [texture[int((1 - v) * 8), int(u * 8)] for u, v in want]
    found = [packed.texture_linear[int((1 - v) * 16), int(u * 24)] for u, v in got]
    assert_array_equal(found, nearest)
    assert packed.notes == ("a: texture coordinates outside [0, 1] repeat the texture: laid out 3x2 times",)


def test_rounding_beyond_the_rim_and_absurd_repeats_do_not_repeat_the_texture():
    texture, inside = smooth(64, 64, 4), np.array([[[0.1, 0.1], [0.2, 0.1], [0.1, 0.2]]])
    rounded = np.array([[[-1e-4, 0.0], [1.0001, 0.5], [0.5, 1.0]]])
    absurd = np.array([[[0.0, 0.0], [900.0, 0.5], [0.5, 900.0]]])
    told = "a: texture coordinates of 1 faces span 900x900 repeats: clamped to one"
    for uv, notes in ((rounded, ()), (absurd, (told,))):
        packed = packed_of(np.concatenate([uv, inside]), texture)
        assert packed.texture_linear is texture
        assert packed.notes == notes
        assert_array_equal(packed.uv[1], inside[0])
        if uv is rounded:
            assert_array_equal(packed.uv[0], np.clip(rounded[0], 0, 1))


def test_a_texture_without_coordinates_is_left_out_and_told():
    material = Material("a", smooth(4, 4, 0))
    packed = pack_texture(ParsedMesh(np.eye(3), np.array([[0, 1, 2]]), materials=(material,)))
    assert packed.texture_linear is None
    assert packed.notes == ("the texture was left out: the faces have no texture coordinates",)


def test_coordinates_without_a_texture_are_kept():
    uv = RNG.random((2, 3, 2))
    uv[1, 0] = np.nan
    packed = packed_of(uv)
    assert packed.texture_linear is None
    assert_array_equal(packed.uv[0], uv[0])
    assert_array_equal(packed.uv[1], 0)
