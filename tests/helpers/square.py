"""Small scans with known colours at every corner; the writers share no code with the readers."""

import json
import struct
from pathlib import Path

import numpy as np

SQUARE_MM = np.array([[0.0, 0, 0], [100, 0, 0], [100, 120, 0], [0, 120, 0]])
"""Counter-clockwise from the lower left; 156 mm diagonal, the size of a face."""

SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])

CORNER_COLORS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "grey": (128, 128, 128)}
"""sRGB of the lower left, lower right, upper right and upper left quarter of `quarters()`."""

CORNER_LINEAR = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.21586050011389926] * 3])


def quarters(size=8, dtype=np.uint8):
    """(size, size, 3) sRGB image, row 0 the top; each quarter has its own colour."""
    red, green, blue, grey = (np.array(c) for c in CORNER_COLORS.values())
    image = np.zeros((size, size, 3), np.uint8)
    half = size // 2
    image[half:, :half], image[half:, half:], image[:half, half:], image[:half, :half] = (
        red,
        green,
        blue,
        grey,
    )
    return image.astype(dtype) * (257 if dtype == np.uint16 else 1)


def sample(scan, uv):
    """Nearest texel of the scan's texture at (N, 2) uv: v = 0 is the bottom row."""
    height, width = scan.texture_linear.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return scan.texture_linear[row, column]


def color_near_corner(scan, position_mm):
    """Texture colour just inside the corner of the scan at a position."""
    vertex = int(np.argmin(np.linalg.norm(scan.vertices - position_mm, axis=1)))
    face, corner = (int(i[0]) for i in np.nonzero(scan.faces == vertex))
    center = scan.uv[face].mean(0)
    return sample(scan, (0.9 * scan.uv[face, corner] + 0.1 * center)[None])[0]


def assert_corner_colors(scan, scale=1.0, atol=2e-6):
    """The four corners of the square show their own colours: no axis is flipped, colour is linear."""
    for position, color in zip(SQUARE_MM * scale, CORNER_LINEAR, strict=True):
        np.testing.assert_allclose(color_near_corner(scan, position), color, atol=atol)


def write_image(path: Path, image):
    import cv2

    order = image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]
    assert cv2.imwrite(str(path), np.ascontiguousarray(order))


def write_square_obj(
    folder: Path, *, name="face", scale=1.0, texture="face.png", image=None, header=""
) -> Path:
    """OBJ, MTL and texture of the square."""
    path = folder / f"{name}.obj"
    lines = [header, f"mtllib {name}.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in SQUARE_MM * scale]
    lines += [f"vt {u} {v}" for u, v in SQUARE_UV]
    lines += ["usemtl skin"] + ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in SQUARE_FACES]
    path.write_text("\n".join(lines) + "\n")
    (folder / f"{name}.mtl").write_text(f"newmtl skin\nKd 0.5 0.5 0.5\nmap_Kd {texture}\n")
    write_image(folder / texture, quarters() if image is None else image)
    return path


def glb_bytes(tree: dict, binary: bytes) -> bytes:
    """A binary glTF container."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def square_gltf(png: bytes | None, *, colors=None, nodes=None, scale=1.0, factor=None) -> tuple[dict, bytes]:
    """glTF tree and buffer of the square, written by hand: v counts from the top, as the standard says."""
    blocks = [
        SQUARE_FACES.astype("<u2").tobytes(),
        (SQUARE_MM * scale).astype("<f4").tobytes(),
        np.column_stack([SQUARE_UV[:, 0], 1 - SQUARE_UV[:, 1]]).astype("<f4").tobytes(),
    ]
    accessors = [
        {"bufferView": 0, "componentType": 5123, "count": 6, "type": "SCALAR"},
        {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
    ]
    attributes = {"POSITION": 1, "TEXCOORD_0": 2}
    if colors is not None:
        blocks.append(colors.astype("<f4").tobytes())
        accessors.append({"bufferView": 3, "componentType": 5126, "count": 4, "type": "VEC3"})
        attributes["COLOR_0"] = 3
    material: dict = {"name": "skin", "pbrMetallicRoughness": {}}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
    }
    if factor is not None:
        material["pbrMetallicRoughness"]["baseColorFactor"] = factor
    if png is not None:
        blocks.append(png)
        tree["images"] = [{"bufferView": len(blocks) - 1, "mimeType": "image/png"}]
        tree["textures"] = [{"source": 0}]
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    views, binary = [], b""
    for block in blocks:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(block)})
        binary += block + b"\0" * (-len(block) % 4)
    tree["bufferViews"] = views
    tree["buffers"] = [{"byteLength": len(binary)}]
    return tree, binary


def png_bytes(image) -> bytes:
    import cv2

    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    assert encoded
    return data.tobytes()
