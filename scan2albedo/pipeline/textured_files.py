"""Files of meshes on their own texture coordinates: the unlit scan, and the textured template."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2albedo.applications.light_removal import UnlitScan
from scan2albedo.applications.template_baking import (
    FIRST_TILE,
    TemplateTexture,
    normal_bytes,
)
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import encode_image, write_png
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_glb, write_textured_obj

UNLIT_FILES = (
    "unlit.glb",
    "unlit.obj",
    "unlit.mtl",
    "unlit.png",
    "unlit.*.png",
    "unlit_confidence.png",
    "unlit_confidence.*.png",
)
"""With several pictures each has a number, in the order of the scan's materials."""
TEMPLATE_FILES = (
    "template.glb",
    "template.obj",
    "template.mtl",
    "template.png",
    "template.*.png",
    "template_normal.png",
    "template_normal.*.png",
)
"""With several tiles each has pictures with its UDIM number."""


def write_unlit(folder: Path, unlit: UnlitScan) -> None:
    """Write `UNLIT_FILES`: OBJ in the unit of the scan's file, GLB in metres, both in the scan's own frame.

    Scans with a texture keep the pictures and coordinates they came with, and get a picture of how sure each
    texel is; those without one have vertex colours there, and no pictures.
    """
    scan, uv, texture = unlit.scan, unlit.scan.uv, unlit.scan.texture_linear
    if uv is None or texture is None:
        mesh = TexturedMesh(scan.vertices, scan.faces, vertex_color_linear=scan.vertex_color_linear)
    else:
        confidence = np.round(255 * np.clip(unlit.confidence, 0, 1)).astype(np.uint8)
        whole, own_uv, pictures = texture.shape[:2], uv.copy(), list[MeshPicture]()
        tiles = scan.texture_tiles if len(scan.texture_tiles) > 1 else ()
        for number, tile in enumerate(tiles):
            chosen = tile.holds(uv, whole)
            own_uv[chosen] = tile.own_uv(uv[chosen], whole)
            place = np.s_[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width]
            write_png(folder / f"unlit_confidence.{number}.png", confidence[place])
            picture = encode_image(texture[place], ".png")
            pictures.append(MeshPicture(f"unlit.{number}.png", picture, chosen))
        if not pictures:
            write_png(folder / "unlit_confidence.png", confidence)
            every = np.ones(len(scan.faces), bool)
            pictures.append(MeshPicture("unlit.png", encode_image(texture, ".png"), every))
        mesh = TexturedMesh(scan.vertices, scan.faces, own_uv, tuple(pictures))
    write_textured_obj(folder / "unlit.obj", mesh, mm_per_unit=scan.mm_per_unit)
    write_textured_glb(folder / "unlit.glb", mesh)


def write_template(folder: Path, template: TemplateTexture) -> None:
    """Write `TEMPLATE_FILES`, mm and metres in the model's frame; alpha: seen."""
    alone = len(template.tiles) == 1 and template.tiles[0].number == FIRST_TILE
    pictures = list[MeshPicture]()
    for tile in template.tiles:
        end = ".png" if alone else f".{tile.number}.png"
        alpha = np.where(tile.seen, np.uint8(255), np.uint8(0))
        color = np.dstack([encode_srgb_bytes(np.clip(tile.color_linear, 0, 1)), alpha])
        normal = encode_image(normal_bytes(tile.normal), ".png")
        picture = encode_image(color, ".png")
        pictures.append(MeshPicture(f"template{end}", picture, tile.faces, f"template_normal{end}", normal))
    mesh = TexturedMesh(template.vertices, template.faces, template.uv, tuple(pictures))
    write_textured_obj(folder / "template.obj", mesh)
    write_textured_glb(folder / "template.glb", mesh)
