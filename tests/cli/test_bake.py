"""`scan2albedo bake`: the colours of a mesh on another one's texture coordinates, as files."""

import numpy as np
import pytest
from helpers.cli import invoke
from helpers.commands import printed
from helpers.folders import contents
from helpers.meshes import grid
from helpers.usage import usage_error
from numpy.testing import assert_allclose

from scan2albedo.cli import applications
from scan2albedo.io.images import encode_image, read_image_linear
from scan2albedo.io.load_scan import read_mesh_file
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_obj


def sheet(cells):
    """A sheet with coordinates as they lie, on a grid of so many cells a side."""
    flat, faces = grid(cells + 1, cells + 1)
    vertices = 100 * flat
    vertices[:, 2] = 0.001 * vertices[:, 0] ** 2
    return vertices, faces, flat[faces][..., :2]


@pytest.fixture
def meshes(tmp_path):
    """A fine sheet whose picture grows redder to the right, and a coarse one whose u runs to the left."""
    vertices, faces, uv = sheet(12)
    picture = np.full((64, 64, 3), [0, 0.2, 0.4], np.float32)
    picture[..., 0] = np.linspace(0.1, 0.9, 64)
    shown = MeshPicture("fine.png", encode_image(picture, ".png"), np.ones(len(faces), bool))
    write_textured_obj(tmp_path / "fine.obj", TexturedMesh(vertices, faces, uv, (shown,)))
    vertices, faces, uv = sheet(3)
    write_textured_obj(tmp_path / "coarse.obj", TexturedMesh(vertices, faces, uv * (-1, 1) + (1, 0)))
    return tmp_path


@pytest.fixture
def bake(meshes, monkeypatch):
    """Run the command with the names of two meshes and of what it makes, in their folder."""
    monkeypatch.setattr(applications, "stop_cleanly_on_interrupt", lambda out: None)

    def run(source, target, out, *options):
        return invoke("bake", meshes / source, meshes / target, "-o", meshes / out, *options)

    return run


def test_colours_are_laid_on_the_other_coordinates(meshes, bake):
    assert printed(bake("fine.obj", "coarse.obj", "baked.obj", "--size", "32", "--json"))["seen"] > 0.95
    picture = read_image_linear(meshes / "baked.png")[..., :3]
    assert_allclose(picture[16, 2:30, 0], np.linspace(0.9, 0.1, 32)[2:30], atol=0.03)
    assert_allclose(picture[2:30, 16, 2], 0.4, atol=0.02)
    baked, given = (read_mesh_file(meshes / f"{name}.obj") for name in ("baked", "coarse"))
    assert_allclose(baked.vertices, given.vertices, atol=1e-5)
    assert_allclose(baked.uv, given.uv, atol=1e-6)
    assert (meshes / "baked.glb").is_file()
    assert (meshes / "baked_normal.png").is_file()


@pytest.mark.parametrize("out", ["baked.png", "coarse.obj"])
def test_nothing_given_is_overwritten(meshes, bake, out):
    before = contents(meshes)
    assert "takes a new name that ends in .obj" in usage_error(bake("fine.obj", "coarse.obj", out))
    assert contents(meshes) == before


def test_a_mesh_without_colours_is_named(bake):
    done = bake("coarse.obj", "fine.obj", "x.obj")
    assert repr(done.exception).startswith("ApplicationError('coarse: the mesh has no colours to bake")
