"""Several meshes in one GLB, each of one colour."""

import numpy as np
import pytest
import trimesh

from scan2albedo.io.glb import GlbPart, write_parts_glb


def test_parts_come_back_with_their_colours(tmp_path):
    ball = trimesh.creation.icosphere(1, 20.0)
    stray = np.vstack([ball.vertices, [[999.0, 0, 0]]])
    glass = GlbPart("glass", np.eye(3), [[0, 1, 2]], (0.1, 0.5, 2.0), opacity=0.25, roughness=0.05)
    write_parts_glb(tmp_path / "a.glb", [GlbPart("ball", stray, ball.faces, (0.2, 0.4, 0.6)), glass])
    scene = trimesh.load_scene(tmp_path / "a.glb")
    found = scene.geometry["ball"]
    assert found.is_watertight
    np.testing.assert_allclose(1000 * found.bounds, ball.bounds, atol=1e-4)
    assert found.visual.material.alphaMode is None
    seen = scene.geometry["glass"].visual.material
    assert seen.alphaMode == "BLEND"
    np.testing.assert_allclose(np.array(seen.baseColorFactor) / 255, [0.1, 0.5, 1, 0.25], atol=0.005)


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needs a mesh"):
        write_parts_glb(tmp_path / "a.glb", [])
    for vertices, faces in ((np.eye(3), np.zeros((0, 3), int)), (np.eye(3) * np.nan, [[0, 1, 2]])):
        with pytest.raises(ValueError, match="'part' needs faces"):
            write_parts_glb(tmp_path / "a.glb", [GlbPart("part", vertices, faces, (1, 1, 1))])
    assert list(tmp_path.iterdir()) == []
