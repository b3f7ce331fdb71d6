"""The files of a scan without its light, and of a baked mesh with its pictures."""

from pathlib import Path
from typing import Any

import numpy as np

from scan2albedo.core.arrays import ByteArray, Float32Array, NDArray, RealArray
from scan2albedo.geometry.rasterization import interpolate, pixels_from_uv, rasterize
from scan2albedo.io.color import encode_srgb_integers
from scan2albedo.io.images import encode_image, write_exr, write_png
from scan2albedo.io.textured_mesh import MeshPicture, TexturedMesh, write_textured_glb, write_textured_obj
from scan2albedo.io.usd import write_usda
from scan2albedo.unlit import template_baking as baking
from scan2albedo.unlit.light_removal import UnlitScan
from scan2albedo.unlit.processed_face import REACH_MM


def write_unlit(folder: Path, unlit: UnlitScan, samples: type = np.uint8, *, exr: bool = False) -> None:
    """Write the unlit scan: OBJ in the unit of the scan's file, GLB in metres, both in the scan's own frame.

    Pictures, of uint8 or uint16 `samples`, and coordinates stay, with a picture of how sure each texel is,
    and one of hair, where there is some, as it was lit, alpha: how surely hair; without them colours of
    vertices. `exr`: the pictures as linear EXR, too.
    """
    scan, uv, texture = unlit.scan, unlit.scan.uv, unlit.scan.texture_linear
    shaded = None if unlit.original is None or unlit.hair is None else unlit.original.texture_linear
    if uv is None or texture is None:
        mesh = TexturedMesh(scan.vertices, scan.faces, vertex_color_linear=scan.vertex_color_linear)
    else:
        confidence = gray_bytes(unlit.confidence)
        own_uv, pictures, whole = uv.copy(), list[MeshPicture](), texture.shape[:2]
        tiles = scan.texture_tiles if len(scan.texture_tiles) > 1 else ()
        for number, tile in enumerate(tiles):
            chosen = tile.holds(uv, whole)
            own_uv[chosen] = tile.own_uv(uv[chosen], whole)
            place = np.s_[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width]
            write_png(folder / f"unlit_confidence.{number}.png", confidence[place])
            if shaded is not None and unlit.hair is not None:
                _write_hair(folder / f"unlit_hair.{number}.png", shaded[place], unlit.hair[place], samples)
            picture = _encoded(folder / f"unlit.{number}.exr", texture[place], samples, exr)
            pictures.append(MeshPicture(f"unlit.{number}.png", picture, chosen))
        if not pictures:
            write_png(folder / "unlit_confidence.png", confidence)
            if shaded is not None and unlit.hair is not None:
                _write_hair(folder / "unlit_hair.png", shaded, unlit.hair, samples)
            every = np.ones(len(scan.faces), bool)
            picture = _encoded(folder / "unlit.exr", texture, samples, exr)
            pictures.append(MeshPicture("unlit.png", picture, every))
        mesh = TexturedMesh(scan.vertices, scan.faces, own_uv, tuple(pictures))
    write_textured_obj(folder / "unlit.obj", mesh, mm_per_unit=scan.mm_per_unit)
    write_textured_glb(folder / "unlit.glb", mesh)


def _write_hair(file: Path, linear: RealArray, share: RealArray, samples: type) -> None:
    picture: NDArray = np.empty((*share.shape, 4), samples)
    encode_srgb_integers(linear, samples, picture[..., :3])
    picture[..., 3] = baking.integers(share, samples)
    write_png(file, picture)


def _encoded(exr_file: Path, linear: Float32Array, samples: type, exr: bool) -> bytes:
    """Return a picture's PNG with such samples; with `exr` write it in linear colour, too."""
    if exr:
        write_exr(exr_file, linear)
    return encode_image(linear, ".png", samples)


def write_template(
    folder: Path,
    template: baking.TemplateTexture,
    samples: type = np.uint8,
    *,
    exr: bool = False,
    stem: str = "template",
    mm_per_unit: float = 1.0,
    **moves: Any,
) -> None:
    """Write a baked mesh in its own frame: OBJ in a unit of `mm_per_unit`, GLB in metres; alpha: seen.

    `moves` are those of a `TexturedMesh`. With maps of a skin material they are PNG of 16 bits, 0 to 1, but
    for the displacement: from -4 to 4 mm, and as EXR in mm; there is a normal map for DirectX, too, whose y
    points down, and an OpenUSD file.
    """
    alone = len(template.tiles) == 1 and template.tiles[0].number == baking.FIRST_TILE
    pictures = list[MeshPicture]()
    for tile in template.tiles:
        end = ".png" if alone else f".{tile.number}.png"
        if exr:
            write_exr((folder / f"{stem}{end}").with_suffix(".exr"), tile.color_linear)
        normal = encode_image(baking.normal_bytes(tile.normal, samples if tile.maps else np.uint8), ".png")
        color: NDArray = np.empty((*tile.seen.shape, 4), samples)
        encode_srgb_integers(tile.color_linear, samples, color[..., :3])
        color[..., 3] = tile.seen * samples(np.iinfo(samples).max)
        picture = encode_image(color, ".png")
        cut = _cut(template, tile, color)
        del color  # beside the next tile's normals it would be the most that is kept
        if tile.hair is not None:
            _write_hair(folder / f"{stem}_hair{end}", tile.hair[..., :3], tile.hair[..., 3], samples)
        if tile.maps:
            _write_maps(folder, tile, stem, end, samples)
        surface = _surface(tile) if tile.maps else None
        bumps = f"{stem}_normal{end}"
        pictures.append(MeshPicture(f"{stem}{end}", picture, tile.faces, bumps, normal, surface, cut))
    mesh = TexturedMesh(
        template.vertices,
        template.faces,
        template.uv,
        tuple(pictures),
        parts=template.parts,
        landmarks=template.landmarks,
        **moves,
    )
    write_textured_obj(folder / f"{stem}.obj", mesh, mm_per_unit=mm_per_unit)
    write_textured_glb(folder / f"{stem}.glb", mesh)
    if template.tiles and template.tiles[0].maps:
        end = ".png" if alone else ".<UDIM>.png"
        inputs = ["normal", "occlusion", "roughness"]
        if "displacement_mm" in template.tiles[0].maps:
            inputs.append("displacement")
        textures = {"diffuseColor": f"{stem}{end}", **{name: f"{stem}_{name}{end}" for name in inputs}}
        write_usda(
            folder / f"{stem}.usda",
            template.vertices,
            template.faces,
            template.uv,
            textures,
            REACH_MM,
            ior=7 / 5,
            metallic=0,
        )


def _cut(template: baking.TemplateTexture, tile: baking.TemplateTile, color: NDArray) -> bytes | None:
    """Return a tile's picture for a GLB, whose alpha opens the mesh where eyes and mouth are seen behind."""
    if template.cut_mm is None or not (template.cut_mm > 0).any():
        return None
    corners = template.uv[tile.faces].reshape(-1, 2) - divmod(tile.number - baking.FIRST_TILE, 10)[::-1]
    pixels = pixels_from_uv(corners, tile.seen.shape)
    index = np.arange(len(corners)).reshape(-1, 3)
    raster = rasterize(pixels, np.zeros(len(corners)), index, tile.seen.shape)
    depth = template.cut_mm[template.faces[tile.faces]].reshape(-1, 1)
    inside = raster.covered & (interpolate(raster, index, depth)[..., 0] > 0)
    alpha = ~inside * color.dtype.type(np.iinfo(color.dtype).max)
    return encode_image(np.dstack([color[..., :3], alpha]), ".png")


def _write_maps(folder: Path, tile: baking.TemplateTile, stem: str, end: str, samples: type) -> None:
    """Write the maps of a skin material, and the normal map for DirectX."""
    flipped = baking.normal_bytes(tile.normal * (1, -1, 1), samples)
    write_png(folder / f"{stem}_normal_directx{end}", flipped)
    for name, values in tile.maps.items():
        if name == "displacement_mm":
            write_exr((folder / f"{stem}_displacement{end}").with_suffix(".exr"), values)
            name, values = "displacement", 0.5 + values / (2 * REACH_MM)
        write_png(folder / f"{stem}_{name}{end}", baking.integers(values, samples))


def _surface(tile: baking.TemplateTile) -> bytes:
    """Return occlusion, roughness, metalness (none) and specular as glTF packs them."""
    metal = np.zeros_like(tile.maps["roughness"])
    layers = [tile.maps["occlusion"], tile.maps["roughness"], metal, tile.maps["specular"]]
    return encode_image(baking.integers(np.stack(layers, -1)), ".png")


def gray_bytes(values: RealArray) -> ByteArray:
    """Return values from 0 to 1, clipped, as bytes."""
    return np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
