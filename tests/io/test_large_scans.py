import resource

import numpy as np
import pytest
from helpers.meshes import grid
from helpers.scan_files import ply_head

from scan2albedo.io import load_scan


def write_ply(path, vertices, faces):
    head = ply_head(len(vertices), len(faces), "binary_little_endian")
    rows = np.zeros(len(faces), [("n", "u1"), ("i", "<i4", 3)])
    rows["n"] = 3
    rows["i"] = faces
    path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def write_obj(path, vertices, faces):
    with path.open("w") as file:
        np.savetxt(file, vertices, "v %.9g %.9g %.9g")
        np.savetxt(file, faces + 1, "f %d %d %d")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "write"), [("a.ply", write_ply), ("a.obj", write_obj)])
def test_a_million_vertices_load_exactly_within_memory(tmp_path, name, write):
    places, faces = grid(1000, 1000)
    u, v, _ = places.T
    depth = 40 * np.cos(3 * u - 1.5) * np.cos(2 * v - 1)
    vertices = np.stack([u * 180, v * 220, depth], axis=-1).astype(np.float32)
    write(tmp_path / name, vertices, faces)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scan = load_scan(tmp_path / name)
    np.testing.assert_array_equal(scan.vertices.astype(np.float32), vertices)
    np.testing.assert_array_equal(scan.faces, faces)
    assert scan.notes[0].startswith("unit: mm ")
    grown_bytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown_bytes < 1.5e9
