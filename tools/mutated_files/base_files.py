"""Small whole files of every kind that the package reads, made by its own code."""

import base64
import json
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

import scan2albedo as s2a
from scan2albedo.core import GeometryImage
from scan2albedo.core.arrays import grid_faces
from scan2albedo.io.geometry_image_files import write_geometry_image, write_geometry_image_exr
from scan2albedo.io.glb import GlbFile, write_glb, write_skinned_glb
from scan2albedo.io.images import encode_image, write_exr

Reader = Callable[[Path], object]


@dataclass(frozen=True)
class BaseFile:
    """Whole files of one scan, model or picture, by name; those of `damaged` are mutated, `first` is read."""

    kind: str
    first: str
    files: dict[str, bytes]
    damaged: tuple[str, ...]
    read: Reader


def ball(count: int = 12) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return vertices in mm, faces and texture coordinates of a ball of head size, cut at one meridian."""
    u, v = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0.05, 0.95, count))
    azimuth, polar = 2 * np.pi * u.ravel(), np.pi * v.ravel()
    around = np.stack([np.sin(polar) * np.sin(azimuth), -np.cos(polar), np.sin(polar) * np.cos(azimuth)], 1)
    return 90 * around, grid_faces(count, count + 1)[:, ::-1], np.stack([u.ravel(), v.ravel()], 1)


def picture(size: int = 32) -> NDArray[np.uint8]:
    """Return a picture (size, size, 3) of noise."""
    return np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)


def base_files() -> Iterator[BaseFile]:
    """Yield one whole file of each kind."""
    yield from _obj_files()
    yield from _ply_files()
    yield from _stl_and_off_files()
    yield from _gltf_files()
    yield from _pictures()
    yield from _arrays()


def _scan(kind: str, first: str, files: dict[str, bytes], damaged: tuple[str, ...] | None = None) -> BaseFile:
    return BaseFile(kind, first, files, damaged or (first,), lambda path: s2a.load_scan(path, unit="mm"))


def _lines(*rows: str) -> bytes:
    return ("\n".join(rows) + "\n").encode()


def _png() -> bytes:
    return encode_image(picture(), ".png")


def _rows(pattern: str, table: NDArray[Any]) -> list[str]:
    """Return a line of text for each row of a table."""
    return [pattern.format(*row) for row in table]


VERTEX = "{:.5f} {:.5f} {:.5f}"


def _obj_files() -> Iterator[BaseFile]:
    xyz, faces, uv = ball()
    corners = "f {0}/{0} {1}/{1} {2}/{2}"
    first, last = np.array_split(faces, 2)
    rows = ["mtllib face.mtl", *_rows(f"v {VERTEX}", xyz), *_rows("vt {:.5f} {:.5f}", uv)]
    rows += ["usemtl skin", *_rows(corners, first + 1), "usemtl hair", *_rows(corners, last - len(xyz))]
    library = _lines(
        "newmtl skin", "Kd 0.8 0.6 0.5", "map_Kd -s 1 1 1 face.png", "newmtl hair", "map_Kd face.png"
    )
    whole = {"face.obj": _lines(*rows), "face.mtl": library, "face.png": _png()}
    yield _scan("obj", "face.obj", whole)
    yield _scan("mtl", "face.obj", whole, ("face.mtl",))
    quads = np.column_stack([first, last[:, 2]]) + 1
    rows = _rows(f"v {VERTEX} 0.5 0.25 1", xyz) + _rows("f {} {} {} {}", quads)
    yield _scan("obj, colours and quads", "face.obj", {"face.obj": _lines(*rows)})


PLY_HEAD = """\
ply
format {layout} 1.0
comment TextureFile face.png
element vertex {vertices}
property float x
property float y
property float z
{of_vertices}element face {faces}
property list uchar int vertex_indices
{of_faces}end_header
"""
PLY_COLORS = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
PLY_CORNERS = "property list uchar float texcoord\n"


def _ply_files() -> Iterator[BaseFile]:
    xyz, faces, uv = ball()

    def whole(layout: str, body: bytes, of_vertices: str = "", of_faces: str = "") -> dict[str, bytes]:
        head = PLY_HEAD.format(
            layout=layout, vertices=len(xyz), faces=len(faces), of_vertices=of_vertices, of_faces=of_faces
        )
        return {"face.ply": head.encode() + body, "face.png": _png()}

    for layout, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        vertex = np.zeros(len(xyz), [("xyz", order + "f4", 3), ("rgb", "u1", 3)])
        vertex["xyz"] = xyz
        vertex["rgb"] = 128
        rows = np.zeros(len(faces), [("n", "u1"), ("i", order + "i4", 3)])
        rows["n"] = 3
        rows["i"] = faces
        body = vertex.tobytes() + rows.tobytes()
        yield _scan(f"ply, {layout}", "face.ply", whole(layout, body, PLY_COLORS))
    body = xyz.astype("<f4").tobytes()
    for number, face in enumerate(faces):
        count = 3 if number % 2 else 0  # corners without coordinates: lists of two lengths
        body += struct.pack("<B3iB", 3, *face.tolist(), 2 * count)
        body += uv[face[:count]].astype("<f4").tobytes()
    yield _scan("ply, lists", "face.ply", whole("binary_little_endian", body, of_faces=PLY_CORNERS))
    corners = np.hstack([faces.astype(object), uv[faces].reshape(-1, 6)])
    text = _rows(VERTEX, xyz) + _rows("3 {} {} {} 6" + 6 * " {:.4f}", corners)
    yield _scan("ply, ascii", "face.ply", whole("ascii", _lines(*text), of_faces=PLY_CORNERS))


def _stl_and_off_files() -> Iterator[BaseFile]:
    xyz, faces, _ = ball()
    mesh = trimesh.Trimesh(xyz, faces, process=False)
    yield _scan("stl", "face.stl", {"face.stl": mesh.export(file_type="stl")})
    yield _scan("stl, ascii", "face.stl", {"face.stl": mesh.export(file_type="stl_ascii").encode()})
    rows = _rows(f"{VERTEX} 200 100 50 255", xyz) + _rows("3 {} {} {}", faces)
    yield _scan("off", "face.off", {"face.off": _lines("COFF", f"{len(xyz)} {len(faces)} 0", *rows)})


def _written(name: str, write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _gltf_files() -> Iterator[BaseFile]:
    xyz, faces, uv = ball()
    whole = _written("face.glb", lambda path: write_glb(path, xyz, faces, uv, picture()))
    yield _scan("glb", "face.glb", {"face.glb": whole})
    weight = np.clip(xyz[:, :1] / 180 + 0.5, 0, 1)
    joints, weights = [[0, 0, 0], [50, 0, 0]], np.hstack([weight, 1 - weight])
    skinned = _written(
        "face.glb",
        lambda path: write_skinned_glb(path, xyz, faces, joints, weights, ["a", "b"], parents=[-1, 0]),
    )
    yield _scan("glb, skinned", "face.glb", {"face.glb": skinned})
    length = int.from_bytes(whole[12:16], "little")
    tree, rest = json.loads(whole[20 : 20 + length]), whole[20 + length + 8 :]
    for kind, uri in (
        ("gltf", "face.bin"),
        ("gltf, base64", "data:application/octet-stream;base64," + base64.b64encode(rest).decode()),
    ):
        tree["buffers"][0]["uri"] = uri
        files = {"face.gltf": json.dumps(tree).encode(), "face.bin": rest}
        yield _scan(kind, "face.gltf", files, ("face.gltf",) * 2)
    yield _scan("glb, draco", "face.glb", {"face.glb": _draco(xyz, faces, uv)})


def _draco(xyz: NDArray[np.float64], faces: NDArray[np.int64], uv: NDArray[np.float64]) -> bytes:
    """Return a GLB whose mesh is compressed."""
    import DracoPy

    extension = "KHR_draco_mesh_compression"
    blob = DracoPy.encode(xyz / 1000, faces.astype(np.uint32), tex_coord=uv, preserve_order=True)
    numbers = {part["attribute_type"]: part["unique_id"] for part in DracoPy.decode(blob).attributes}
    names = {
        "POSITION": numbers[DracoPy.AttributeType.POSITION],
        "TEXCOORD_0": numbers[DracoPy.AttributeType.TEX_COORD],
    }
    primitive = {
        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
        "indices": 2,
        "extensions": {extension: {"bufferView": 0, "attributes": names}},
    }
    accessors = ((5126, len(xyz), "VEC3"), (5126, len(xyz), "VEC2"), (5125, faces.size, "SCALAR"))
    file = GlbFile()
    file.add_bytes(blob)
    file.accessors += [{"componentType": kind, "count": n, "type": shape} for kind, n, shape in accessors]
    file.meshes.append({"name": "face", "primitives": [primitive]})
    named = {"extensionsUsed": [extension], "extensionsRequired": [extension]}
    return _written("face.glb", lambda path: file.write(path, **named))


def _pictures() -> Iterator[BaseFile]:
    def read(path: Path) -> object:
        return s2a.load_scan(path.with_name("face.obj"), unit="mm")

    xyz, faces, uv = ball()
    rows = _rows(f"v {VERTEX}", xyz) + _rows("vt {:.5f} {:.5f}", uv)
    rows += _rows("f {0}/{0} {1}/{1} {2}/{2}", faces + 1)
    linear = picture().astype(np.float32) / 255
    for extension in (".png", ".jpg", ".tif", ".bmp", ".webp", ".hdr", ".exr"):
        name = f"face{extension}"
        if extension == ".exr":
            data = _written(name, lambda path: write_exr(path, linear))
        else:
            data = cv2.imencode(extension, linear if extension == ".hdr" else picture())[1].tobytes()
        yield BaseFile(f"picture {extension}", name, {name: data, "face.obj": _lines(*rows)}, (name,), read)


def _arrays() -> Iterator[BaseFile]:
    grid = np.mgrid[:12, :12].astype(float)
    position = np.stack([*grid, np.zeros((12, 12))], -1)
    image = GeometryImage(
        position, np.broadcast_to([0.0, 0, 1], (12, 12, 3)), np.ones((12, 12), bool), position / 12
    )
    for name, write in (("image.npz", write_geometry_image), ("image.exr", write_geometry_image_exr)):
        data = _written(name, lambda path, write=write: write(path, image))  # type: ignore[misc]
        yield BaseFile(f"geometry image {name[-4:]}", name, {name: data}, (name,), s2a.read_geometry_image)
    model = s2a.AnnotatedFaceModel.from_mesh(*ball(16)[:2], control_size=60)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model.json")
        files = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    for damaged in files:
        yield BaseFile(f"model {damaged[-5:]}", "model.json", files, (damaged,), s2a.AnnotatedFaceModel.load)
