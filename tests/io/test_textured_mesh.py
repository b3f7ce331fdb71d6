"""Meshes with pictures on their own coordinates come back as they were written."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.gltf import Gltf
from helpers.meshes import grid
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import encode_image
from scan2albedo.io.load_scan import read_mesh_file
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_glb, write_textured_obj

COLORS = [(0.8, 0.1, 0.1), (0.1, 0.6, 0.2)]


def bent_sheet():
    """Vertices, faces and coordinates of a sheet of 100 mm."""
    flat, faces = grid(6, 6)
    vertices = 100 * flat
    vertices[:, 2] = 0.01 * vertices[:, 0] ** 2
    return vertices, faces, flat[faces][..., :2]


@pytest.fixture
def sheet():
    """A sheet whose left and right half have a picture each, in tiles of their own, and which is right."""
    vertices, faces, uv = bent_sheet()
    right = vertices[faces].mean(1)[:, 0] > 50
    uv[right, :, 0] += 1.0
    pictures = tuple(
        MeshPicture(f"mine.{number}.png", encode_image(np.full((8, 8, 3), color), ".png"), chosen)
        for number, color, chosen in zip((1001, 1002), COLORS, (~right, right), strict=True)
    )
    return TexturedMesh(vertices, faces, uv, pictures), right


def test_an_obj_keeps_vertices_coordinates_and_a_picture_for_each_tile(sheet, tmp_path):
    mesh, right = sheet
    write_textured_obj(tmp_path / "mine.obj", mesh, mm_per_unit=10.0)
    written = {"mine.obj", "mine.mtl", "mine.1001.png", "mine.1002.png"}
    assert {file.name for file in tmp_path.iterdir()} == written
    parsed = read_mesh_file(tmp_path / "mine.obj")
    assert_allclose(parsed.vertices * 10, mesh.vertices, atol=1e-6)
    order = np.concatenate([np.flatnonzero(~right), np.flatnonzero(right)])  # by material
    assert_array_equal(parsed.faces, mesh.faces[order])
    assert_allclose(parsed.uv, mesh.uv[order], atol=1e-8)
    assert_array_equal(parsed.material, right[order])
    for material, color in zip(parsed.materials, COLORS, strict=True):
        assert_allclose(material.texture_linear[4, 4], color, atol=0.01)


def test_a_glb_has_them_too(sheet, tmp_path):
    mesh, right = sheet
    write_textured_glb(tmp_path / "mine.glb", mesh)
    parsed = read_mesh_file(tmp_path / "mine.glb")
    assert len(parsed.faces) == len(mesh.faces)
    assert_array_equal(np.bincount(parsed.material), [(~right).sum(), right.sum()])


def test_vertex_colours_stand_in_both(tmp_path):
    vertices, faces, _ = bent_sheet()
    colors = (vertices / 100).astype(np.float32)
    mesh = TexturedMesh(vertices, faces, vertex_color_linear=colors)
    write_textured_obj(tmp_path / "mine.obj", mesh)
    write_textured_glb(tmp_path / "mine.glb", mesh)
    for name in ("mine.obj", "mine.glb"):
        parsed = read_mesh_file(tmp_path / name)
        found = encode_srgb_bytes(parsed.vertex_color_linear[:, :3]).astype(int)  # alpha follows
        assert np.abs(found - encode_srgb_bytes(colors)).max() <= 1


def test_morph_targets_lead_from_the_rest_to_the_vertices(sheet, tmp_path):
    mesh, _ = sheet
    lift = mesh.vertices[:, :1] * [0, 0, 0.2]
    targets, weights = {"jawOpen": lift, "eyeWideLeft": np.roll(lift, 1, axis=1)}, np.array([0.75, 0.0])
    moving = replace(mesh, rest=mesh.vertices - 0.75 * lift, targets=targets, weights=weights)
    write_textured_glb(tmp_path / "mine.glb", moving)
    file = Gltf.read(tmp_path / "mine.glb")
    assert len(file.tree["meshes"]) == 2
    for part in file.tree["meshes"]:
        assert part["extras"] == {"targetNames": ["jawOpen", "eyeWideLeft"]}
        assert part["weights"] == [0.75, 0.0]
        (primitive,) = part["primitives"]
        moved, turned = (file.array(primitive["attributes"][name]) for name in ("POSITION", "NORMAL"))
        for weight, target in zip(weights, primitive["targets"], strict=True):
            moved = moved + weight * file.array(target["POSITION"])
        nearest = np.linalg.norm(1000 * moved[:, None] - mesh.vertices, axis=2)
        assert nearest.min(1).max() < 1e-3
        # The first target tilts the sheet by as much everywhere, also beside the seam.
        whole = vertex_normals(moving.rest + lift, mesh.faces)
        found = turned + file.array(primitive["targets"][0]["NORMAL"])
        assert_allclose(found, whole[nearest.argmin(1)], atol=1e-5)
