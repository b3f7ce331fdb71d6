"""A photograph's mesh may be the folder of a processed scan."""

import json

import numpy as np

from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import write_png
from scan2albedo.reflectance import read_photograph


def test_the_folder_of_a_processed_scan_stands_for_its_fitted_mesh(tmp_path):
    vertices = np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]])
    faces, uv = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), np.zeros((4, 2))
    (tmp_path / "scan").mkdir()
    write_png(tmp_path / "image.png", np.full((4, 4, 3), 128, np.uint8))
    write_glb(tmp_path / "scan" / "fitted.glb", vertices, faces, uv, np.full((2, 2, 3), 128, np.uint8))
    camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    found = []
    for mesh in ("scan", "scan/fitted.glb"):
        content = {"image": "image.png", "camera": camera, "mesh": mesh}
        (tmp_path / "photograph.json").write_text(json.dumps(content))
        found.append(read_photograph(tmp_path / "photograph.json"))
    np.testing.assert_array_equal(found[0].vertices, found[1].vertices)
    np.testing.assert_allclose(np.ptp(found[0].vertices, axis=0), 100, rtol=1e-5)
