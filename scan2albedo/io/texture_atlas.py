"""One texture out of several materials, with coordinates inside it, and which colours a picture showed."""

import math
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, Texts
from scan2albedo.core.raw_scan import TextureTile
from scan2albedo.io import limits
from scan2albedo.io.parsed_mesh import Material, ParsedMesh

Image = Float32Array

GUTTER = 2
"""Texels repeated around each tile, so that interpolation at its edge meets its own colour."""


@dataclass(frozen=True)
class PackedTexture:
    """Texture, per-corner coordinates, notes and tiles for a `RawScan`; both None when there is nothing."""

    uv: FloatArray | None
    texture_linear: Image | None
    """(H, W, 3), or with alpha (H, W, 4): 0 where no picture showed the surface."""
    notes: Texts
    tiles: tuple[TextureTile, ...] = ()


@dataclass(frozen=True)
class _Tile:
    """A picture of the atlas, the faces (N,) that show it, and their coordinates (N, 3, 2) in it."""

    name: str
    picture: Image
    faces: IntArray
    uv: FloatArray


def pack_texture(mesh: ParsedMesh) -> PackedTexture:
    """Bring all materials of a mesh into one texture.

    A single texture is kept as it is. Several are laid side by side, each with a gutter, and the
    coordinates follow. Materials without a texture, and faces without coordinates, become a small patch of
    their base colour, which no picture showed. Coordinates outside [0, 1] repeat the texture, as renderers
    do: faces are moved by whole periods, and where one crosses an edge the texture is laid out repeatedly.
    """
    if mesh.uv is None:
        reason = "the texture was left out: the faces have no texture coordinates"
        wasted = any(m.texture_linear is not None for m in mesh.materials)
        return PackedTexture(None, None, (reason,) if wasted else ())
    has_uv = np.asarray(np.isfinite(mesh.uv).all(axis=(1, 2)))
    material = np.zeros(len(mesh.faces), int) if mesh.material is None else mesh.material
    textured = np.array([m.texture_linear is not None for m in mesh.materials] + [False])
    mapped = has_uv & textured[material]
    if not mapped.any():
        return PackedTexture(np.where(has_uv[:, None, None], mesh.uv, 0.0), None, ())
    first: dict[int, int] = {}  # material of each picture: several may share one
    pictures = [first.setdefault(id(m.texture_linear), i) for i, m in enumerate(mesh.materials)]
    # The material of each face's picture; of faces without one, which come last, their own.
    count = len(mesh.materials)
    label = np.where(
        mapped, np.array([*pictures, -1])[material], count + 1 + (-1 if mesh.material is None else material)
    )
    tiles, notes = _tiles(mesh, mesh.uv, label)
    if len(tiles) == 1:
        return PackedTexture(tiles[0].uv, tiles[0].picture, tuple(notes))
    boxes, height, width = _on_shelves([tile.picture.shape[:2] for tile in tiles])
    most = limits.PIXELS * 5 // 4  # gutters and sizes leave gaps
    what, advice = "the texture of the scan's materials", "save its textures as one picture"
    limits.require_at_most(what, "pixels", height * width, most, advice)
    atlas = np.zeros((height, width, max(tile.picture.shape[2] for tile in tiles)), np.float32)
    uv = np.empty(mesh.uv.shape)
    for tile, (x, y, w, h) in zip(tiles, boxes, strict=True):
        area = atlas[y - GUTTER : y + h + GUTTER, x - GUTTER : x + w + GUTTER]
        area[..., 3:] = 1
        padding = ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0))
        area[..., : tile.picture.shape[2]] = np.pad(tile.picture, padding, "edge")
        # Texel centres of a tile stay texel centres in its box of the atlas.
        uv[tile.faces, :, 0] = (x + tile.uv[..., 0] * w) / width
        uv[tile.faces, :, 1] = 1 - (y + (1 - tile.uv[..., 1]) * h) / height
    if plain := int((~mapped).sum()):
        notes.append(f"faces without texture, given their material's colour: {plain}")
    if (packed := len({pictures[i] for i in np.flatnonzero(textured)})) > 1:
        notes.append(f"packed {packed} textures into one of {width}x{height}")
    placed = tuple(TextureTile(tile.name, *box) for tile, box in zip(tiles, boxes, strict=True))
    return PackedTexture(uv, atlas, tuple(notes), placed)


def _tiles(mesh: ParsedMesh, uv: FloatArray, label: IntArray) -> tuple[list[_Tile], list[str]]:
    """Return tiles and notes for the M materials' pictures, repeated as faces need, and base colours.

    `label` (F,) is below M for a face with that material's picture, M for one without a material, and
    1 + M more than its material for others without a picture.
    """
    count = len(mesh.materials)
    used = np.unique(label).tolist()
    tiles: list[_Tile] = []
    notes: list[str] = []
    left = limits.PIXELS - sum(_texels(mesh.materials[i].texture_linear) for i in used if i < count)
    for index in used:
        faces = np.flatnonzero(label == index)
        one = Material("no material")
        if index != count:
            one = mesh.materials[index % (count + 1)]
        if index < count and one.texture_linear is not None:
            most = left + _texels(one.texture_linear)
            inside, picture, note = _inside_unit_square(uv[faces], one.texture_linear, most)
            left = most - _texels(picture)
            notes += [f"{one.name}: {note}"] if note else []
        else:
            picture = np.full((2 * GUTTER, 2 * GUTTER, 4), (*one.base_color_linear, 0), np.float32)
            inside = np.full((len(faces), 3, 2), 0.5)
        tiles.append(_Tile(one.name, picture, faces, inside))
    return tiles, notes


def _texels(picture: Image | None) -> int:
    return 0 if picture is None else picture.shape[0] * picture.shape[1]


def _on_shelves(sizes: list[tuple[int, ...]]) -> tuple[list[tuple[int, int, int, int]], int, int]:
    """Return where tiles (height, width) stand, each with a gutter, as (left, top, width, height); and the
    height and width of all, about square: the tallest first, side by side on shelves."""
    wide = [width + 2 * GUTTER for _, width in sizes]
    tall = [height + 2 * GUTTER for height, _ in sizes]
    most = max(*wide, math.ceil(math.sqrt(np.dot(wide, tall))))
    boxes = dict[int, tuple[int, int, int, int]]()
    column = row = shelf = 0
    for i in sorted(range(len(sizes)), key=lambda i: (-tall[i], i)):
        if column + wide[i] > most:
            column = 0
            row = row + shelf
            shelf = 0
        boxes[i] = (column + GUTTER, row + GUTTER, sizes[i][1], sizes[i][0])
        column, shelf = column + wide[i], max(shelf, tall[i])
    right = max(left + width for left, _, width, _ in boxes.values())
    return [boxes[i] for i in range(len(sizes))], row + shelf, right + GUTTER


def _inside_unit_square(uv: FloatArray, texture: Image, most: int) -> tuple[FloatArray, Image, str]:
    """Return (uv in [0, 1], the texture repeated as they need, up to `most` texels, note)."""
    texel = 1.0 / np.array([texture.shape[1], texture.shape[0]])
    if (uv >= -texel).all() and (uv <= 1 + texel).all():
        return np.clip(uv, 0.0, 1.0), texture, ""
    moved = in_first_period(uv, texture.shape)
    # As floats: absurd coordinates overflow any integer.
    columns, rows = (float(n) for n in np.maximum(np.ceil(moved.max(axis=(0, 1)) - texel), 1))
    if columns * rows * _texels(texture) > most:
        far = int((moved > 1 + texel).any(axis=(1, 2)).sum())
        note = f"texture coordinates of {far} faces span {columns:.4g}x{rows:.4g} repeats: clamped to one"
        return np.clip(moved, 0.0, 1.0), texture, note
    note = "texture coordinates outside [0, 1] repeat the texture"
    if columns * rows > 1:
        note += f": laid out {columns:.0f}x{rows:.0f} times"
        texture = np.tile(texture, (int(rows), int(columns), 1))
    return np.clip(moved / (columns, rows), 0.0, 1.0), texture, note


def in_first_period(uv: FloatArray, texture_shape: tuple[int, ...]) -> FloatArray:
    """Return uv (F, 3, 2) with each face moved by whole periods, so that it begins in [0, 1)."""
    texel = 1.0 / np.array([texture_shape[1], texture_shape[0]])
    return uv - np.floor(uv.min(axis=1, keepdims=True) + texel)


_LOOKS = np.array([*np.ones((1, 3)) / 3, *np.eye(3), *(1 - np.eye(3)) / 2])
"""(7, 3) barycentric places where a face is looked at: its middle, its corners, the middles of its sides."""


def seen_colors(
    colors: Float32Array, faces: IntArray, uv: FloatArray | None = None
) -> tuple[Float32Array, BoolArray | None]:
    """Return colours without alpha, and which of them some picture showed; None where that is all.

    They are those of a texture (H, W, 3 or 4) with coordinates `uv` (F, 3, 2) in [0, 1], or of vertices
    (V, 3 or 4), of which `faces` (F, 3) has the corners; nothing is seen where no face shows anything. What
    has less than half of the largest alpha was not seen, nor was the colour that programs fill in: more faces
    are wholly of it than of any other, by more than chance. The faces of one colour that smooth or coarse
    pictures have share many colours. Clipped white is seen, unless all is white. O(F + H W).
    """
    shown = np.ones(colors.shape[:-1], bool)
    if colors.shape[-1] == 4:
        shown, colors = colors[..., 3] >= colors[..., 3].max() / 2, np.ascontiguousarray(colors[..., :3])
    flat = colors.reshape(-1, 3)
    height, width = colors.shape[:2] if uv is not None else (1, 1)

    def looked_at(look: FloatArray) -> IntArray:
        """Return (F,) the texel, or the vertex, of each face at a barycentric place."""
        if uv is None:
            return faces[:, int(look.argmax())]
        u, v = np.einsum("k,fkc->cf", look, uv)
        row, column = ((1 - v) * height).astype(int), (u * width).astype(int)
        return np.clip(row, 0, height - 1) * width + np.clip(column, 0, width - 1)

    middle = looked_at(_LOOKS[0])
    uniform = shown.ravel()[middle]
    for look in _LOOKS[1:]:
        uniform[uniform] = (flat[looked_at(look)[uniform]] == flat[middle[uniform]]).all(1)
    values, counts = np.unique(flat[middle[uniform]], axis=0, return_counts=True)
    if len(values) > 1 or not uniform.all():
        counts[(values >= 1).all(1)] = 0
    # Poisson: log odds against no more than the second colour has, the prior odds being one face of all.
    second, most = np.maximum(np.sort([1, 1, *counts])[-2:], 1).tolist()
    if most * math.log(most / second) - (most - second) > math.log(len(faces)):
        shown &= (colors != values[counts.argmax()]).any(-1)
    shown &= shown.ravel()[middle].any()
    return colors, None if shown.all() else shown
