"""What a file declares is judged before room is made for it: one clear error, in little memory and time."""

import json
import struct
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.pictures import png_of
from helpers.scan_files import VERTEX, assert_refused, ply_head, square_of_two_materials
from helpers.square import quarters, square_gltf, write_image, write_square_obj

import scan2albedo as s2a
from scan2albedo.errors import GeometryImageError, ScanError, TooLargeError
from scan2albedo.io import limits, load_scan
from scan2albedo.io.images import declared_pixels, read_exr_channels, read_image_linear, write_exr
from scan2albedo.io.input_hash import input_sha256


def _memory_bytes(field):
    return 1024 * int(Path("/proc/self/status").read_text().split(f"{field}:")[1].split()[0])


@pytest.fixture(autouse=True)
def _small_and_soon():
    Path("/proc/self/clear_refs").write_text("5")
    before, start = _memory_bytes("VmRSS"), time.process_time()
    yield
    assert _memory_bytes("VmHWM") - before < 1e9
    assert time.process_time() - start < 20


def declaring(extension, side):
    """Return a whole picture of 16 x 16 pixels whose header declares `side` x `side`."""
    if extension == ".png":
        return png_of(side, side)
    dtype = np.float32 if extension == ".hdr" else np.uint8
    options = [cv2.IMWRITE_TIFF_COMPRESSION, 1] if extension == ".tif" else []
    data = bytearray(cv2.imencode(extension, quarters(16).astype(dtype), options)[1])
    if extension == ".hdr":
        return data.replace(b"-Y 16 +X 16", b"-Y %d +X %d" % (side, side))
    if extension == ".bmp":
        data[18:26] = struct.pack("<ii", side, -side)
    elif extension == ".jpg":
        place = data.index(b"\xff\xc0") + 5
        data[place : place + 4] = struct.pack(">HH", side, side)
    elif extension == ".webp":
        assert data[12:16] == b"VP8L"
        data[21:25] = struct.pack("<I", side - 1 | side - 1 << 14)
    else:
        for tag in (256, 257):
            place = data.index(struct.pack("<HHIH", tag, 3, 1, 16))
            data[place : place + 12] = struct.pack("<HHII", tag, 4, 1, side)
    return bytes(data)


PICTURES = {".png": 60000, ".jpg": 65000, ".bmp": 60000, ".webp": 16000, ".tif": 60000, ".hdr": 60000}


@pytest.mark.parametrize("extension", PICTURES)
def test_pictures_are_judged_by_their_header(tmp_path, extension):
    side, dtype = PICTURES[extension], np.float32 if extension == ".hdr" else np.uint8
    for height, width in ((16, 16), (4, 3), (3, 4)):
        whole = cv2.imencode(extension, np.zeros((height, width, 3), dtype))[1].tobytes()
        assert declared_pixels(whole) == height * width
    (tmp_path / "big.png").write_bytes(declaring(extension, side))
    with pytest.raises(TooLargeError, match=rf"image .*big\.png: {side * side:,} pixels are more than the "):
        read_image_linear(tmp_path / "big.png")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_tiff_headers_of_both_orders_and_sizes(order, big):
    mark = (b"II" if order == "<" else b"MM") + struct.pack(order + "H", 43 if big else 42)
    word, count = ("Q", "Q") if big else ("I", "H")
    head = mark + (struct.pack(order + "HHQ", 8, 0, 16) if big else struct.pack(order + "I", 8))
    entries = ((256, 4, 70_000), (257, 4, 50_000), (277, 3, 4), (258, 3, 32))
    body = b""
    for tag, kind, value in entries:
        packed = struct.pack(order + "HH" + word, tag, kind, 1)
        inline = struct.pack(order + ("H" if kind == 3 else "I"), value)
        body += packed + inline.ljust(struct.calcsize(word), b"\0")
    # A pixel of four 32-bit samples counts as two.
    pixels = declared_pixels(head + struct.pack(order + count, len(entries)) + body)
    assert pixels == 2 * 3_500_000_000


def test_no_room_is_made_before_the_chunks_of_a_png_are_there(tmp_path):
    data = bytearray(png_of(16, 16))
    place = data.index(b"IDAT") - 4
    data[place : place + 4] = struct.pack(">I", 0xFFFFFF00)
    for content in (data, b"P6 60000 60000 255\n" + bytes(100)):  # the other one's header is not known
        (tmp_path / "a.png").write_bytes(content)
        with pytest.raises(ScanError, match=r"a\.png cannot be decoded .*truncated or unknown"):
            read_image_linear(tmp_path / "a.png")


def test_exr_windows_are_judged_before_the_pixels(tmp_path):
    file = tmp_path / "a.exr"
    write_exr(file, np.zeros((4, 4, 3)))
    data = bytearray(file.read_bytes())
    window = data.index(b"dataWindow") + len(b"dataWindow\0box2i\0") + 4
    data[window : window + 16] = struct.pack("<iiii", 0, 0, 59_999, 59_999)
    file.write_bytes(data)
    for read in (read_exr_channels, read_image_linear):
        with pytest.raises(ScanError, match=r"a\.exr"):
            read(file)


def test_a_texture_that_is_too_large_is_an_error_not_a_scan_without_colour(tmp_path):
    path = write_square_obj(tmp_path)
    (tmp_path / "face.png").write_bytes(png_of(50_000, 50_000))
    assert_refused(path, r"face\.png: 2,500,000,000 pixels", TooLargeError)


def test_pixels_of_all_materials_count_together_and_shared_pictures_once(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "PIXELS", 100)  # each picture has 64
    write_image(tmp_path / "other.png", quarters())
    path = square_of_two_materials(tmp_path)
    assert_refused(path, r"the textures of the scan in .*: 128 pixels", TooLargeError)
    scan = load_scan(square_of_two_materials(tmp_path, second="FACE.png"))
    assert scan.texture_linear.shape == (8, 8, 3)


ROWS = 60_000
"""A table of so many rows as long as the longest would have 29 GB."""


@pytest.mark.parametrize(
    ("name", "head"),
    [("a.off", f"OFF\n{ROWS} 1 0\n"), ("a.ply", ply_head(ROWS, 1).replace("uchar", "int"))],
)
def test_one_long_line_makes_no_table_of_all_rows(tmp_path, name, head):
    lines = [f"{i % 317} {i // 317} {i % 7}" for i in range(ROWS)]
    lines.append(" ".join(map(str, (ROWS, *range(ROWS)))))
    (tmp_path / name).write_text(head + "\n".join(lines))
    assert len(load_scan(tmp_path / name, "mm").faces) > ROWS / 2


FACES = "element face 2\nproperty list uint int vertex_indices"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", "v 0 0 0\n" * 30),
        ("a.off", "OFF\n1 0 0\n" + "0 0 0\n" * 30),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n" + "0\n" * 30),
        ("a.stl", "solid\n" + "vertex 0 0 0\n" * 30 + "endsolid\n"),
    ],
)
def test_lines_of_text_are_counted_first(tmp_path, monkeypatch, name, text):
    monkeypatch.setattr(limits, "TEXT_LINES", 20)
    (tmp_path / name).write_text(text)
    assert_refused(tmp_path / name, rf"{name}: 3\d lines are more than the 20 that are read", TooLargeError)


@pytest.mark.parametrize("extension", [".obj", ".ply", ".stl", ".off", ".glb", ".gltf"])
def test_files_are_judged_by_their_size(tmp_path, extension):
    path = tmp_path / f"a{extension}"
    with path.open("wb") as file:
        file.truncate(limits.FILE_BYTES + 1)  # sparse: it takes no room
    assert_refused(path, ": 536,870,913 bytes are more than the 536,870,912 that", TooLargeError)


@pytest.mark.parametrize(
    ("head", "body", "message"),
    [
        (FACES, struct.pack("<I", 0xFFFFFFFF) + bytes(64), "it declares 2 face rows, but ends before"),
        (FACES, struct.pack("<IiiiI", 3, 0, 1, 2, 0x7FFFFFFF) + bytes(64), "it declares 2 face rows"),
        (FACES.replace("2", "4000000000"), bytes(64), "it declares 4000000000 face rows"),
        (
            "\n".join(["element more 1", *(f"property float x{i}" for i in range(2000))]),
            bytes(8000),
            "2,000 properties of more are more than the 1,024",
        ),
    ],
)
def test_counts_of_ply_files_make_no_room(tmp_path, head, body, message):
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 0", *VERTEX, head, "end_header\n"]
    (tmp_path / "a.ply").write_bytes("\n".join(lines).encode() + body)
    assert_refused(tmp_path / "a.ply", message)


def nodes(*tree_nodes, scene=(0,)):
    return {"nodes": list(tree_nodes), "scenes": [{"nodes": list(scene)}]}


MESH = {"mesh": 0}


FLOATS = {"componentType": 5126, "count": 10**9, "type": "VEC3"}


def test_material_libraries_and_names_are_limited(tmp_path, monkeypatch):
    path = write_square_obj(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("usemtl skin", "usemtl " + "x" * 10_000))
    assert_refused(path, "line 11 holds 'x{40}', expected a name of at most 4096 bytes")
    monkeypatch.setattr(limits, "MATERIALS", 50)
    path.write_text(text + "".join(f"usemtl m{i}\n" for i in range(60)))
    assert_refused(path, r"face\.obj: 61 materials", TooLargeError)
    path.write_text("mtllib face.mtl\nmtllib face.mtl\n" + text)
    assert load_scan(path).has_color
    monkeypatch.setattr(limits, "LIBRARY_BYTES", 20)
    assert_refused(path, r"face\.mtl: 43 bytes", TooLargeError)
    assert len(input_sha256(path)) == 64


def test_options_of_a_picture_that_never_end_take_no_time(tmp_path):
    library = "newmtl skin\nmap_Kd " + "-cc x " * 1_000_000 + "face.png\n"
    load_scan(write_square_obj(tmp_path, mtl=library))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (nodes(*({"children": [i + 1, i + 1]} for i in range(40)), MESH), ".* nodes"),
        (nodes({"children": [1], **MESH}, {"children": [0]}), "4,097 nodes in its scene"),
        (nodes(*[MESH] * 3000, scene=range(3000)), "4,097 primitives of its meshes"),
        ({"accessors": [FLOATS] * 3}, "36,000,000,000 bytes of arrays"),
        ({"accessors": [FLOATS | {"count": -4}] * 3}, "cannot be read as GLB .*an accessor has -4 elements"),
        (nodes(MESH, MESH, MESH, scene=range(3)), "12 vertices of its meshes"),
    ],
)
def test_scenes_are_judged_before_they_are_made(tmp_path, change, message, monkeypatch):
    if "vertices" in message:
        monkeypatch.setattr(limits, "VERTICES", 10)
    file = square_gltf()
    file.tree |= change
    file.tree["meshes"][0]["primitives"] *= 2
    assert_refused(file.write(tmp_path / "a.glb"), rf"a\.glb: {message}")


def test_pictures_in_scenes_are_judged_by_their_header(tmp_path):
    path = square_gltf(png_of(40_000, 40_000)).write(tmp_path / "a.glb")
    assert_refused(path, r"image 0 of a\.glb: 1,600,000,000 pixels", TooLargeError)


def test_values_of_json_are_counted_and_depth_is_no_crash(tmp_path, monkeypatch):
    file = tmp_path / "a.gltf"
    file.write_text('{"nodes": ' + "[" * 100_000)
    assert_refused(file, r"a\.gltf: ")
    monkeypatch.setattr(limits, "VALUES", 10)
    file.write_text(json.dumps({"nodes": [{}] * 20}))
    assert_refused(file, r"a\.gltf: 42 JSON values", TooLargeError)


def npz(path, header, body=b""):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        text = header.encode() + b" " * 20 + b"\n"
        archive.writestr("mask.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body)
    return path


def test_arrays_are_judged_by_their_header(tmp_path, monkeypatch):
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (%d, 1000000), }"
    with pytest.raises(GeometryImageError, match="mask declares 80,000,000,000 bytes and holds"):
        s2a.read_geometry_image(npz(tmp_path / "a.npz", head % 10_000))
    monkeypatch.setattr(limits, "FILE_BYTES", 400_000)
    with pytest.raises(GeometryImageError, match="its arrays have 16,000,000 bytes, more than the 1,200,000"):
        s2a.read_geometry_image(npz(tmp_path / "a.npz", head % 2, bytes(16_000_000)))
    pickled = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
    with pytest.raises(GeometryImageError, match=r"geometry image .*a\.npz cannot be read"):
        s2a.read_geometry_image(npz(tmp_path / "a.npz", pickled, b"cos\nsystem\n."))


@pytest.mark.parametrize("error", [MemoryError, RecursionError, OverflowError])
def test_errors_of_too_large_scans_name_the_scan(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr("scan2albedo.io.repair.repair", fail)
    told = r"face\.obj: (needs more memory than there is|is too deep)"
    assert_refused(write_square_obj(tmp_path), told, TooLargeError)
