"""Scans as files that name other files, written by hand, and files that are refused."""

import json

import pytest

from helpers.square import square_gltf, write_square_obj
from scan2albedo.errors import ScanError
from scan2albedo.io import load_scan


def assert_refused(path, words, error=ScanError):
    """Check that loading a scan ends with an error whose text fits the pattern `words`."""
    with pytest.raises(error, match=words):
        load_scan(path)


VERTEX = [f"property float {axis}" for axis in "xyz"]
INDICES = "property list uchar int vertex_indices"


def ply_head(vertices, faces, layout="ascii", comments=(), more=()):
    """Return the header of a PLY file; `more` are names of further coordinates of vertices."""
    lines = ["ply", f"format {layout} 1.0", *(f"comment {comment}" for comment in comments)]
    lines += [f"element vertex {vertices}", *VERTEX, *(f"property float {name}" for name in more)]
    return "\n".join([*lines, f"element face {faces}", INDICES, "end_header", ""])


def textured_ply(folder, texture):
    """Write a triangle with coordinates of a texture as face.ply; return its path."""
    head = ply_head(3, 1, comments=[f"TextureFile {texture}"], more="st")
    (folder / "face.ply").write_text(f"{head}0 0 0 0 0\n100 0 0 1 0\n0 100 0 0 1\n3 0 1 2\n")
    return folder / "face.ply"


def square_of_two_materials(folder, first="face.png", second="other.png"):
    """Write the square as OBJ, its faces of a material with a picture each; return its path."""
    library = f"newmtl skin\nmap_Kd {first}\nnewmtl other\nmap_Kd {second}\n"
    return write_square_obj(folder, mtl=library, change=("f 1/1 3/3", "usemtl other\nf 1/1 3/3"))


def with_picture_file(file, uri):
    """Give a glTF file the colours of a picture beside it; return the file."""
    file.tree |= {"images": [{"uri": uri}], "textures": [{"source": 0}]}
    file.material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    return file


def write_gltf(path, file):
    """Write a file as JSON and data.bin beside it; return the path."""
    file.tree["buffers"][0]["uri"] = "data.bin"
    (path.parent / "data.bin").write_bytes(file.binary)
    path.write_text(json.dumps(file.tree))
    return path


def textured_gltf(folder, texture):
    """Write the square with a picture beside it as face.gltf; return its path."""
    return write_gltf(folder / "face.gltf", with_picture_file(square_gltf(), texture))
