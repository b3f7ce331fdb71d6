"""Small scans with known colours at every corner; the writers share no code with the readers."""

import numpy as np

from helpers.gltf import Gltf

SQUARE_MM = np.array([[0.0, 0, 0], [100, 0, 0], [100, 120, 0], [0, 120, 0]])
"""Counter-clockwise from the lower left; 156 mm diagonal, the size of a face."""

SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])

CORNER_COLORS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "grey": (128, 128, 128)}
"""sRGB of the lower left, lower right, upper right and upper left quarter of `quarters()`."""

CORNER_LINEAR = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.21586050011389926] * 3])


def quarters(size=8, dtype=np.uint8):
    """(size, size, 3) sRGB image, row 0 the top; each quarter has its own colour."""
    red, green, blue, grey = CORNER_COLORS.values()
    image = np.array([[grey, blue], [red, green]], dtype).repeat(size // 2, 0).repeat(size // 2, 1)
    return image * (257 if dtype == np.uint16 else 1)


def sample(scan, uv):
    """Nearest texel of the scan's texture at (N, 2) uv: v = 0 is the bottom row."""
    height, width = scan.texture_linear.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return scan.texture_linear[row, column]


def vertex_colors(scan):
    """Return (V, 3) the texture's colour at each vertex."""
    color = np.zeros((len(scan.vertices), 3), np.float32)
    color[scan.faces.ravel()] = sample(scan, scan.uv.reshape(-1, 2) % 1)
    return color


def color_near_corner(scan, position_mm):
    """Texture colour just inside the corner of the scan at a position."""
    vertex = int(np.argmin(np.linalg.norm(scan.vertices - position_mm, axis=1)))
    face, corner = (int(i[0]) for i in np.nonzero(scan.faces == vertex))
    center = scan.uv[face].mean(0)
    return sample(scan, (0.9 * scan.uv[face, corner] + 0.1 * center)[None])[0]


def assert_corner_colors(scan, places=SQUARE_MM, factor=1.0, atol=2e-6):
    """The four corners of the square show their own colours: no axis is flipped, colour is linear."""
    found = [color_near_corner(scan, place) for place in places]
    np.testing.assert_allclose(found, CORNER_LINEAR * factor, atol=atol)


def write_image(path, image):
    import cv2

    order = image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]
    assert cv2.imwrite(str(path), np.ascontiguousarray(order))


def write_square_obj(
    folder, *, name="face", scale=1.0, texture="face.png", image=None, mtl=None, change=("", "")
):
    """OBJ, MTL and texture of the square; `mtl` is the library's text or bytes, `change` a replacement."""
    path = folder / f"{name}.obj"
    lines = ["# by hand", f"mtllib {name}.mtl"]
    lines += [f"v {x} {y} {z}" for x, y, z in SQUARE_MM * scale]
    lines += [f"vt {u} {v}" for u, v in SQUARE_UV]
    lines += ["usemtl skin"] + ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in SQUARE_FACES]
    path.write_text(("\n".join(lines) + "\n").replace(*change, 1))
    if mtl is None:
        mtl = f"newmtl skin\nKd 0.5 0.5 0.5\nmap_Kd {texture}\n"
    (folder / f"{name}.mtl").write_bytes(mtl if isinstance(mtl, bytes) else mtl.encode())
    write_image(folder / texture, quarters() if image is None else image)
    return path


def square_gltf(png=None, *, colors=None, scale=1.0):
    """The square as glTF, written by hand: v counts from the top, as the standard says."""
    made = Gltf({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]})
    attributes, tree = {}, made.tree
    indices = made.add(SQUARE_FACES.astype("<u2").ravel())
    attributes["POSITION"] = made.add((SQUARE_MM * scale).astype("<f4"))
    attributes["TEXCOORD_0"] = made.add((SQUARE_UV * (1, -1) + (0, 1)).astype("<f4"))
    if colors is not None:
        attributes["COLOR_0"] = made.add(colors.astype("<f4"))
    surface = {}
    tree["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}]
    tree["materials"] = [{"name": "skin", "pbrMetallicRoughness": surface}]
    if png is not None:
        tree["images"] = [{"bufferView": made.view(png), "mimeType": "image/png"}]
        tree["textures"] = [{"source": 0}]
        surface["baseColorTexture"] = {"index": 0}
    return made


def png_bytes(image):
    import cv2

    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    assert encoded
    return data.tobytes()
