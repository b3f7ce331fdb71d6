"""Meshes with pictures on their own texture coordinates, as OBJ with MTL and as GLB."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, NDArray, Values
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.tangents import split_at_seams, tangent_mesh
from scan2albedo.io.atomic import write_bytes, write_text
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.io.glb import GlbFile, GlbPart, plain_material


@dataclass(frozen=True)
class MeshPicture:
    """A picture, the bytes of a PNG, that lies on the faces (F,) marked in `faces`; `name` is its file's.

    `normal_png`, if any, is the normal map beside it, in the frames of `geometry.tangents.tangent_mesh`;
    `surface_png` has occlusion, roughness, 0 and the specular factor in its channels, as glTF reads them.
    `cut_png` is the picture with alpha 0 where the mesh is cut away, in a GLB.
    """

    name: str
    png: bytes
    faces: BoolArray
    normal_name: str = ""
    normal_png: bytes | None = None
    surface_png: bytes | None = None
    cut_png: bytes | None = None


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh: vertices (V, 3) mm, faces (F, 3), and its colours.

    These are `pictures` at the corners' coordinates `uv` (F, 3, 2), v = 0 at their bottom rows, or
    `vertex_color_linear` (V, 3). Each face has one picture at most. In a GLB the vertices are `rest` (V, 3),
    where that is given, and move by morph `targets` (V, 3) by name, to `vertices` with their `weights` (K,).
    """

    vertices: FloatArray
    faces: IntArray
    uv: FloatArray | None = None
    pictures: tuple[MeshPicture, ...] = ()
    vertex_color_linear: Float32Array | None = None
    rest: FloatArray | None = None
    targets: Mapping[str, FloatArray] = field(default_factory=dict)
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))
    parts: tuple[GlbPart, ...] = ()
    """In a GLB, beside the mesh."""
    landmarks: IntArray | None = None
    """(68,): the vertices that `parts` follow."""


def write_textured_obj(path: str | Path, mesh: TexturedMesh, *, mm_per_unit: float = 1.0) -> None:
    """Write a mesh as OBJ, with its MTL and pictures beside it.

    Vertices keep their order and are written in a unit of `mm_per_unit`. Raises OutputError.
    """
    target = Path(path)
    lines = [f"mtllib {target.stem}.mtl\n"] if mesh.pictures else []
    places = mesh.vertices / mm_per_unit
    if mesh.vertex_color_linear is not None:
        rows = np.column_stack([places, linear_to_srgb(np.clip(mesh.vertex_color_linear, 0, 1))]).tolist()
        lines += [f"v {x:.9g} {y:.9g} {z:.9g} {r:.4f} {g:.4f} {b:.4f}\n" for x, y, z, r, g, b in rows]
    else:
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in places.tolist()]
    if mesh.uv is None:
        lines += [f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist()]
        write_text(target, "".join(lines))
        return
    split = split_at_seams(mesh.faces, mesh.uv)
    lines += [f"vt {u:.9g} {v:.9g}\n" for u, v in split.uv.tolist()]
    corners = np.stack([mesh.faces, split.faces], axis=-1).reshape(-1, 6) + 1
    for name, chosen in _materials(mesh):
        lines += [f"usemtl {name}\n"]
        lines += [f"f {a}/{k} {b}/{m} {c}/{n}\n" for a, k, b, m, c, n in corners[chosen].tolist()]
    materials = ""
    for picture in mesh.pictures:
        write_bytes(target.with_name(picture.name), picture.png)
        materials += f"newmtl {Path(picture.name).stem}\nKd 1 1 1\nillum 1\nmap_Kd {picture.name}\n"
        if picture.normal_png is not None:
            write_bytes(target.with_name(picture.normal_name), picture.normal_png)
            materials += f"norm {picture.normal_name}\n"
    write_text(target.with_suffix(".mtl"), materials)
    write_text(target, "".join(lines))


def write_textured_glb(path: str | Path, mesh: TexturedMesh) -> None:
    """Write a mesh as GLB, in metres, split where coordinates differ, with tangents for normal maps."""
    file, names = GlbFile(), [*mesh.targets]
    whole = mesh.vertices if mesh.rest is None else mesh.rest
    normals = vertex_normals(whole, mesh.faces)
    for name, chosen in _materials(mesh):
        picture = next((p for p in mesh.pictures if Path(p.name).stem == name), None)
        material = plain_material(name, (1.0, 1.0, 1.0, 1.0))
        attributes: dict[str, NDArray] = {}
        uv: FloatArray | None = None
        if picture is not None:
            _add_pictures(file, material, picture)
        if mesh.uv is None:
            vertex, faces = np.unique(mesh.faces[chosen], return_inverse=True)
        else:
            split = split_at_seams(mesh.faces[chosen], mesh.uv[chosen])
            if "normalTexture" in material:
                frames = tangent_mesh(whole, mesh.faces[chosen], mesh.uv[chosen], normals)
                split, attributes["TANGENT"] = frames.split, frames.tangents
            vertex, faces, uv = split.vertex, split.faces, split.uv
        if picture is None and mesh.vertex_color_linear is not None:
            attributes["COLOR_0"] = np.clip(mesh.vertex_color_linear[vertex], 0, 1)
        places, corners = whole[vertex], faces.reshape(-1, 3)
        number = file.add_mesh(material, places, corners, attributes, uv=uv, normals=normals[vertex])
        if names:
            moves = np.array([*mesh.targets.values()])
            file.add_targets(number, (whole, mesh.faces), moves, mesh.weights, vertex, names)
    for part in mesh.parts:
        if part.follows is None or mesh.landmarks is None or not names:
            part.add_to(file)
            continue
        moves = np.array([part.follows @ move[mesh.landmarks] for move in mesh.targets.values()])
        still = part.vertices - np.tensordot(mesh.weights, moves, 1)
        number = replace(part, vertices=still).add_to(file)
        file.add_targets(number, (still, part.faces), moves, mesh.weights, names=names)
    file.write(path)


def _add_pictures(file: GlbFile, material: Values, picture: MeshPicture) -> None:
    """Append the pictures of a mesh to a file, and to its material."""
    name, surface = material["name"], material["pbrMetallicRoughness"]
    surface["baseColorTexture"] = file.add_picture(picture.cut_png or picture.png, name=name)
    if picture.cut_png:
        material["alphaMode"] = "MASK"
    if picture.normal_png is not None:
        stem = Path(picture.normal_name).stem
        material["normalTexture"] = file.add_picture(picture.normal_png, name=stem)
    if picture.surface_png is not None:
        texture = file.add_picture(picture.surface_png, name=f"{name}_surface")
        surface |= {"metallicRoughnessTexture": texture, "roughnessFactor": 1.0}
        material["occlusionTexture"] = texture
        material["extensions"] = {"KHR_materials_specular": {"specularTexture": texture}}


def _materials(mesh: TexturedMesh) -> Iterator[tuple[str, BoolArray]]:
    """Yield names of materials and the faces (F,) that have each; the rest last."""
    rest = np.ones(len(mesh.faces), bool)
    for picture in mesh.pictures:
        rest &= ~picture.faces
        if picture.faces.any():
            yield Path(picture.name).stem, picture.faces
    if rest.any():
        yield "skin", rest
