import re

import pytest

from scan2albedo.io import load_scan


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "notes"),
    [
        ("james.obj", 6393, 12228, r"unit: mm \(largest extent 318 mm\).*6 loose components, all kept"),
        ("humface.ply", 10381, 19999, "unit: mm .*duplicate faces dropped: 1.*3 loose .*geometry only"),
        ("frame_giraut.stl", 6609, 13238, "unit: mm "),
        ("canonical_face_model.obj", 468, 898, "unit: cm "),
        ("sunglasses_khronos.glb", 6920, 13396, "unit: m .*26 loose components, all kept"),
    ],
)
def test_sizes_units_and_repairs(shared_data, name, vertices, faces, notes):
    scan = load_scan(shared_data / name)
    assert (len(scan.vertices), len(scan.faces)) == (vertices, faces)
    assert re.match(notes, " ".join(scan.notes))


def test_a_real_photograph_is_the_texture(shared_data):
    assert load_scan(shared_data / "james.obj").texture_linear.shape == (1600, 2400, 3)
