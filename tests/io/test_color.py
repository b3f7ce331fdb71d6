import numpy as np
import pytest
from hypothesis import given, strategies as st

from scan2albedo.io.color import decode_srgb_integers, encode_srgb_bytes, linear_to_srgb, srgb_to_linear


def test_curve_at_known_values():
    linear = srgb_to_linear([0, 1, 0.5, 0.04045, 0.02])
    assert linear == pytest.approx([0, 1, 0.214041140482232, 0.04045 / 12.92, 0.02 / 12.92], abs=1e-12)


@given(st.floats(-2, 8))
def test_encoding_inverts_decoding(value):
    # The standard's two branches meet within 3e-8 only.
    assert linear_to_srgb(srgb_to_linear(value)) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tables_equal_the_curve(dtype):
    samples = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, (600, 7, 3)).astype(dtype)
    expected = srgb_to_linear(samples / np.iinfo(dtype).max)
    decoded = decode_srgb_integers(samples)
    assert decoded.dtype == np.float32
    np.testing.assert_allclose(decoded, expected, rtol=1e-6)


def test_every_byte_survives_a_round_trip_and_what_is_beyond_is_clipped():
    samples = np.arange(256, dtype=np.uint8)
    assert (encode_srgb_bytes(decode_srgb_integers(samples)) == samples).all()
    assert encode_srgb_bytes([-1.0, 7.0]).tolist() == [0, 255]
