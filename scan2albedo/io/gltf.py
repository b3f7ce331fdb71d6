"""GLB and glTF files, read through trimesh; skinned meshes as their joints hold them."""

from __future__ import annotations

import io
import logging
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.raw_scan import require_valid_indices
from scan2albedo.errors import ScanError, one_line
from scan2albedo.io import limits
from scan2albedo.io.color import decode_picture
from scan2albedo.io.gltf_file import MARK, GltfFile
from scan2albedo.io.parsed_mesh import Material, ParsedMesh
from scan2albedo.io.scan_folder import ScanFolder

if TYPE_CHECKING:
    import trimesh


def read_gltf(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read a GLB or glTF file: scene transforms applied, all meshes joined, base colours as materials.

    Skinned meshes come as their joints hold them, without animation. Base colour textures are sRGB, factors
    and vertex colours linear (glTF 2.0, 3.7.2 and 3.9.2). Raises ScanError when the file is damaged.
    """
    try:
        return _read_parts(GltfFile.read(path, folder))
    except limits.DAMAGE as error:
        kind, cause = path.suffix[1:].upper(), one_line(error)
        cause = f"there is no {cause}" if isinstance(error, KeyError) else cause
        raise ScanError(
            f"{path.name}: cannot be read as {kind} ({cause}); "
            "the file is damaged, truncated or refers to a missing file: export it again"
        ) from error


def files_of_gltf(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the buffers and pictures of a glTF file."""
    try:
        tree = GltfFile.read(path, folder).tree
        uris = [entry.get("uri", "") for entry in (*tree.get("buffers", ()), *tree.get("images", ()))]
    except (ValueError, AttributeError, TypeError, RecursionError):
        return []  # load_scan says what is wrong with the file
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]


def _read_parts(file: GltfFile) -> ParsedMesh:
    import trimesh

    file.require_readable()
    # trimesh only warns of a compression that it cannot decode, and goes on with zeros.
    warned: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING:
            warned.append(record.getMessage())
        return True

    logging.getLogger("trimesh").addFilter(collect)
    try:
        stream, kind = io.BytesIO(file.for_trimesh()), "glb" if file.binary else "gltf"
        scene = trimesh.load_scene(stream, file_type=kind, resolver=file, process=False)  # type: ignore[arg-type]
    finally:
        logging.getLogger("trimesh").removeFilter(collect)
    if warned:
        raise ScanError(f"{file.path.name}: {warned[0]}; export it again without compression")
    # trimesh drops base colour textures that it cannot read without a word.
    reasons = {}
    for declared in file.tree.get("materials", []):
        if (wanted := declared.get("pbrMetallicRoughness", {}).get("baseColorTexture")) is not None:
            texture = file.tree["textures"][wanted["index"]]
            basis = "KHR_texture_basisu" in texture.get("extensions", {}) and "source" not in texture
            reasons[declared.get("name", "material")] = (
                "is KTX2 (KHR_texture_basisu), which is not read; export the scan again with PNG or JPEG"
                if basis
                else "is missing, damaged or of an unknown kind"
            )
    materials: dict[int, Material] = {}
    pictures: dict[int, NDArray[np.float32]] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh):
            by_joints = _skinning_transforms(file, scene, node, mesh) if file.tree.get("skins") else None
            moved = np.asarray(transform, np.float64) if by_joints is None else by_joints
            parts.append(_part(mesh, moved, materials, pictures, file.path.name))
    lost = [m.name for m in materials.values() if m.texture_linear is None and m.name in reasons]
    without = {name: f"the texture of {name} {reasons[name]}: went on without it" for name in lost}
    notes = tuple(without.values())
    if not parts:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), notes=notes)
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    names = ("vertices", "uv", "material", "vertex_color_linear")
    vertices, uv, material, colors = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
    # Colours and coordinates that no part has are left out.
    return ParsedMesh(
        vertices=vertices,
        faces=np.concatenate([p.faces + offset for p, offset in zip(parts, offsets, strict=False)]),
        uv=uv if np.isfinite(uv).any() else None,
        material=material,
        materials=tuple(materials.values()),
        vertex_color_linear=colors if colors[:, 3].any() else None,
        notes=notes,
    )


def _part(
    mesh: trimesh.Trimesh,
    transform: FloatArray,
    materials: dict[int, Material],
    pictures: dict[int, NDArray[np.float32]],
    name: str,
) -> ParsedMesh:
    """Return a mesh moved by (4, 4) or (V, 4, 4); its material and pictures are added to those known."""
    visual: Any = mesh.visual
    source = getattr(visual, "material", None)
    if id(source) not in materials:
        limits.require_at_most(name, "materials", 1 + len(materials), limits.MATERIALS, "join its materials")
        factor = getattr(source, "baseColorFactor", None)
        color = np.ones(3, np.float32) if factor is None else _scaled(np.asarray(factor)[None])[0, :3]
        image, texture = getattr(source, "baseColorTexture", None), None
        if image is not None and id(image) not in pictures:
            pixels, advice = image.size[0] * image.size[1], "save it with fewer pixels"
            limits.require_at_most(f"a texture of {name}", "pixels", pixels, limits.PIXELS, advice)
            with suppress(OSError, SyntaxError, ValueError):
                pictures[id(image)] = decode_picture(np.asarray(image.convert("RGBA"), np.uint8))
        if image is not None and id(image) in pictures:
            texture = pictures[id(image)]
            if (color < 1).any():
                texture = texture * np.append(color, 1)[: texture.shape[2]].astype(np.float32)
        base = (float(color[0]), float(color[1]), float(color[2]))
        materials[id(source)] = Material(str(getattr(source, "name", None) or "material"), texture, base)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    # Joined with other meshes, a wrong index would point at a vertex of the next one.
    require_valid_indices(faces, len(vertices), name)
    linear, shift = transform[..., :3, :3], transform[..., :3, 3]
    if np.median(np.linalg.det(linear)) < 0:
        faces = faces[:, ::-1]
    uv = getattr(visual, "uv", None)
    # A mesh without material and colours has no attributes either.
    others = getattr(visual, "vertex_attributes", {})
    given = visual.vertex_colors if visual.kind == "vertex" else others.get("color")
    number = list(materials).index(id(source))
    if given is None:  # of alpha 0, for no picture showed it
        colors = np.tile([*materials[id(source)].base_color_linear, 0], (len(vertices), 1)).astype(np.float32)
    else:
        colors = _scaled(np.asarray(given))
        colors = np.pad(colors, ((0, 0), (0, 4 - colors.shape[1])), constant_values=1)
    if uv is None or len(uv) != len(vertices):
        uv = np.full((len(vertices), 2), np.nan)
    return ParsedMesh(
        vertices=(linear @ vertices[:, :, None])[:, :, 0] + shift,
        faces=faces,
        uv=np.asarray(uv, np.float64)[faces],
        material=np.full(len(faces), number),
        vertex_color_linear=colors,
    )


def _scaled(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return (N, 3), or with alpha (N, 4), in [0, 1] from whole integers or floats, not decoded."""
    return (colors / (np.iinfo(colors.dtype).max if colors.dtype.kind in "ui" else 1.0)).astype(np.float32)


def _skinning_transforms(
    file: GltfFile, scene: trimesh.Scene, frame: str, mesh: trimesh.Trimesh
) -> FloatArray | None:
    """Return the transforms (V, 4, 4) of a mesh's vertices by their joints; None for a mesh without a skin.

    v' = sum over k of w_k J_k B_k v, and the transform of the mesh's own node `frame` is ignored (glTF 2.0,
    3.7.3.2 and 3.7.3.3). The scene is that of `GltfFile.for_trimesh`.
    """
    attributes = {name: np.asarray(values) for name, values in mesh.vertex_attributes.items()}
    skin = file.tree["nodes"][int(frame.partition("_")[0])].get("skin")
    sets = sum(name.startswith(f"{MARK}JOINTS_") for name in attributes)
    if skin is None or sets == 0:
        return None
    joints = np.concatenate([attributes[f"{MARK}JOINTS_{n}"] for n in range(sets)], 1).astype(np.int64)
    weights = np.concatenate([attributes[f"{MARK}WEIGHTS_{n}"] for n in range(sets)], 1).astype(np.float64)
    total = weights.sum(1, keepdims=True)
    if not (total > 0).all():
        raise ValueError("a vertex of a skinned mesh has no weights")
    places = np.array([scene.graph[str(joint)][0] for joint in file.tree["skins"][skin]["joints"]])
    transforms = places @ file.inverse_binds(skin)
    blended, block = np.empty((len(joints), 4, 4)), 1 << 16  # to spare memory
    for start in range(0, len(joints), block):
        rows = slice(start, start + block)
        blended[rows] = np.einsum("vj,vjab->vab", weights[rows] / total[rows], transforms[joints[rows]])
    return blended
