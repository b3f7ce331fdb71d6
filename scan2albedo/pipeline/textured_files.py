"""Files of meshes on their own texture coordinates: the unlit scan, and the textured template."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.applications.light_removal import UnlitScan
from scan2albedo.applications.template_baking import (
    FIRST_TILE,
    MOST_TILES,
    TemplateTexture,
    TemplateTile,
    normal_bytes,
)
from scan2albedo.core.arrays import FloatArray
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import encode_image, write_png
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_glb, write_textured_obj

MOST_PICTURES = 100
UNLIT_FILES = (
    "unlit.glb",
    "unlit.obj",
    "unlit.mtl",
    "unlit.png",
    "unlit_confidence.png",
    *(f"unlit.{number}.png" for number in range(MOST_PICTURES)),
    *(f"unlit_confidence.{number}.png" for number in range(MOST_PICTURES)),
)
"""With several pictures each has a number, in the order of the scan's materials."""
TEMPLATE_FILES = (
    "template.glb",
    "template.mtl",
    "template.png",
    "template_normal.png",
    *(f"template.{FIRST_TILE + number}.png" for number in range(MOST_TILES)),
    *(f"template_normal.{FIRST_TILE + number}.png" for number in range(MOST_TILES)),
)
"""Beside `template.obj`; with several tiles each has pictures with its UDIM number."""


def write_unlit(folder: Path, unlit: UnlitScan) -> None:
    """Write `UNLIT_FILES`: OBJ in the unit of the scan's file, GLB in metres, both in the scan's own frame.

    Scans without a texture have vertex colours there, and no pictures.
    """
    scan = unlit.scan
    if scan.uv is None or scan.texture_linear is None:
        mesh = TexturedMesh(scan.vertices, scan.faces, vertex_color_linear=scan.vertex_color_linear)
    else:
        mesh = _with_pictures(folder, unlit, scan.texture_linear, scan.uv)
    write_textured_obj(folder / "unlit.obj", mesh, mm_per_unit=scan.mm_per_unit)
    write_textured_glb(folder / "unlit.glb", mesh)


def _with_pictures(
    folder: Path, unlit: UnlitScan, texture: NDArray[np.float32], uv: FloatArray
) -> TexturedMesh:
    """Return the scan with the pictures and coordinates it came with; write how sure each picture is."""
    scan, shape = unlit.scan, (texture.shape[0], texture.shape[1])
    confidence = np.round(255 * np.clip(unlit.confidence, 0, 1)).astype(np.uint8)
    if not 1 < len(scan.texture_tiles) <= MOST_PICTURES:
        write_png(folder / "unlit_confidence.png", confidence)
        whole = MeshPicture("unlit.png", encode_image(texture, ".png"), np.ones(len(scan.faces), bool))
        return TexturedMesh(scan.vertices, scan.faces, uv, (whole,))
    own_uv, pictures = uv.copy(), list[MeshPicture]()
    for number, tile in enumerate(scan.texture_tiles):
        chosen = tile.holds(uv, shape)
        own_uv[chosen] = tile.own_uv(uv[chosen], shape)
        place = np.s_[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width]
        write_png(folder / f"unlit_confidence.{number}.png", confidence[place])
        pictures.append(MeshPicture(f"unlit.{number}.png", encode_image(texture[place], ".png"), chosen))
    return TexturedMesh(scan.vertices, scan.faces, own_uv, tuple(pictures))


def write_template(folder: Path, template: TemplateTexture) -> None:
    """Write `template.obj` and `TEMPLATE_FILES`, mm and metres in the model's frame; alpha: seen."""
    alone = len(template.tiles) == 1 and template.tiles[0].number == FIRST_TILE
    pictures = list[MeshPicture]()
    for tile in template.tiles:
        end = ".png" if alone else f".{tile.number}.png"
        normal = encode_image(normal_bytes(tile.normal), ".png")
        pictures.append(
            MeshPicture(f"template{end}", _png(tile), tile.faces, f"template_normal{end}", normal)
        )
    mesh = TexturedMesh(template.vertices, template.faces, template.uv, tuple(pictures))
    write_textured_obj(folder / "template.obj", mesh)
    write_textured_glb(folder / "template.glb", mesh)


def _png(tile: TemplateTile) -> bytes:
    alpha = np.where(tile.seen, np.uint8(255), np.uint8(0))
    return encode_image(np.dstack([encode_srgb_bytes(np.clip(tile.color_linear, 0, 1)), alpha]), ".png")
