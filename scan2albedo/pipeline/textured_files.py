"""Files of meshes on their own texture coordinates: the unlit scan, and the textured template."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2albedo.applications.light_removal import UnlitScan
from scan2albedo.applications.template_baking import (
    FIRST_TILE,
    MOST_TILES,
    TemplateTexture,
    TemplateTile,
)
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import encode_image, write_png
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_glb, write_textured_obj

UNLIT_FILES = ("unlit.glb", "unlit.obj", "unlit.mtl", "unlit.png", "unlit_confidence.png")
TEMPLATE_FILES = (
    "template.glb",
    "template.mtl",
    "template.png",
    *(f"template.{FIRST_TILE + number}.png" for number in range(MOST_TILES)),
)
"""Beside `template.obj`; with several tiles each has a picture with its UDIM number."""


def write_unlit(folder: Path, unlit: UnlitScan) -> None:
    """Write `UNLIT_FILES`: OBJ in the unit of the scan's file, GLB in metres, both in the scan's own frame.

    Scans without a texture have vertex colours there, and no pictures.
    """
    scan, pictures = unlit.scan, tuple[MeshPicture, ...]()
    if scan.uv is not None and scan.texture_linear is not None:
        png = encode_image(scan.texture_linear, ".png")
        pictures = (MeshPicture("unlit.png", png, np.ones(len(scan.faces), bool)),)
        confidence = np.round(255 * np.clip(unlit.confidence, 0, 1)).astype(np.uint8)
        write_png(folder / "unlit_confidence.png", confidence)
    mesh = TexturedMesh(
        vertices=scan.vertices,
        faces=scan.faces,
        uv=scan.uv if pictures else None,
        pictures=pictures,
        vertex_color_linear=None if pictures else scan.vertex_color_linear,
    )
    write_textured_obj(folder / "unlit.obj", mesh, mm_per_unit=scan.mm_per_unit)
    write_textured_glb(folder / "unlit.glb", mesh)


def write_template(folder: Path, template: TemplateTexture) -> None:
    """Write `template.obj` and `TEMPLATE_FILES`, mm and metres in the model's frame; alpha: seen."""
    pictures = tuple(
        MeshPicture(_name(tile, len(template.tiles)), _png(tile), tile.faces) for tile in template.tiles
    )
    mesh = TexturedMesh(template.vertices, template.faces, template.uv, pictures)
    write_textured_obj(folder / "template.obj", mesh)
    write_textured_glb(folder / "template.glb", mesh)


def _name(tile: TemplateTile, count: int) -> str:
    return "template.png" if count == 1 and tile.number == FIRST_TILE else f"template.{tile.number}.png"


def _png(tile: TemplateTile) -> bytes:
    alpha = np.where(tile.seen, np.uint8(255), np.uint8(0))
    return encode_image(np.dstack([encode_srgb_bytes(np.clip(tile.color_linear, 0, 1)), alpha]), ".png")
