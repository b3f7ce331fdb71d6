import numpy as np
import pytest

from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.io import load_scan
from scan2albedo.io.color import linear_to_srgb


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "unit"),
    [
        ("james.obj", 6393, 12228, "mm"),
        ("humface.ply", 10381, 19999, "mm"),
        ("frame_giraut.stl", 6609, 13238, "mm"),
        ("canonical_face_model.obj", 468, 898, "cm"),
        ("sunglasses_khronos.glb", None, 13396, "m"),
    ],
)
def test_sizes_and_units(shared_data, name, vertices, faces, unit):
    scan = load_scan(shared_data / name)
    assert len(scan.vertices) == vertices or vertices is None
    assert len(scan.faces) == faces
    assert scan.notes[0].startswith(f"unit: {unit} ")


def test_james(shared_data):
    scan = load_scan(shared_data / "james.obj")
    assert scan.texture_linear.shape == (1600, 2400, 3)
    assert scan.notes[0] == "unit: mm (largest extent 318 mm), decided from the size"
    assert "6 loose components, all kept" in scan.notes
    # Split along the seams of its texture, as most readers do, it falls into 15.
    corners = np.concatenate([scan.faces[..., None], scan.uv], axis=2).reshape(-1, 3)
    assert len(np.unique(corners, axis=0)) == 6680


def test_james_skin_and_hair_have_their_colours(shared_data):
    """A flipped v axis, or swapped channels, would put cloth or background on the nose."""
    scan = load_scan(shared_data / "james.obj")
    points = np.loadtxt(shared_data / "james_ibug68.csv", delimiter=",")
    height, width = scan.texture_linear.shape[:2]
    colors = []
    for index in (30, 33, 35, 31):  # nose
        face, corner = np.unravel_index(
            np.argmin(np.linalg.norm(scan.vertices[scan.faces] - points[index], axis=2)), scan.faces.shape
        )
        u, v = scan.uv[face, corner]
        colors.append(scan.texture_linear[int((1 - v) * height), int(u * width)])
    red, green, blue = linear_to_srgb(np.mean(colors, axis=0))
    assert red > 1.1 * green > 1.1 * blue
    assert red > 0.4


def test_humface(shared_data):
    scan = load_scan(shared_data / "humface.ply")
    assert not scan.has_color
    assert "duplicate faces dropped: 1" in scan.notes
    assert "3 loose components, all kept" in scan.notes


def test_sunglasses(shared_data):
    scan = load_scan(shared_data / "sunglasses_khronos.glb")
    assert 130 < np.ptp(scan.vertices, axis=0).max() < 180
    assert vertex_components(len(scan.vertices), scan.faces).max() + 1 == 26


def test_canonical_face_model_is_in_centimetres(shared_data):
    scan = load_scan(shared_data / "canonical_face_model.obj")
    assert scan.uv.shape == (898, 3, 2)
    np.testing.assert_allclose(scan.vertices[0], [0, -34.06404, 59.79507], atol=1e-9)  # its first line, in mm
