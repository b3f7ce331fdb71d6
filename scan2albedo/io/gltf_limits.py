"""What a glTF file declares, judged before its arrays, pictures and scene are made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

from scan2albedo.errors import MissingDependencyError, ScanError
from scan2albedo.io import limits
from scan2albedo.io.image_headers import require_small_picture

Tree = dict[str, Any]

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5124: 4, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DRACO = "KHR_draco_mesh_compression"
_NOT_DECODED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MANY_COPIES = "KHR_materials_pbrSpecularGlossiness"
"""Its pictures are converted in floats of 64 bits, several at a time."""
_COPIES = 8


def require_readable(name: str, tree: Tree, image_bytes: Callable[[int], bytes | None]) -> None:
    """Raise TooLargeError for a file that declares more than is read, ScanError for unknown compression.

    `image_bytes` returns the content of a picture, None when it is missing. Raises MissingDependencyError
    when the library that decodes the file's compression is not installed; LookupError, TypeError or
    ValueError for a damaged tree.
    """
    used, required = tree.get("extensionsUsed", ()), tree.get("extensionsRequired", ())
    advice = f"export {name} again without compression"
    for extension in _NOT_DECODED:
        if extension in required:
            raise ScanError(f"{name}: is compressed with {extension}, which is not decoded here; {advice}")
    if _DRACO in (*used, *required) and find_spec("DracoPy") is None:
        raise MissingDependencyError(
            f"{name}: is compressed with Draco; install what reads it with: "
            f"pip install 'scan2albedo[draco]', or {advice}"
        )
    total = 0
    for accessor in tree.get("accessors", ()):
        if accessor["count"] < 0:
            raise ValueError(f"an accessor has {accessor['count']} elements")
        element = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        total += element * accessor["count"]
    limits.require_at_most(name, "bytes of arrays", total, limits.FILE_BYTES, "decimate it")
    # All meshes, as the file has them and as often as its scene shows them: vertices, triangles, primitives.
    meshes = []
    for mesh in tree.get("meshes", ()):
        vertices = triangles = 0
        for primitive in mesh["primitives"]:
            corners = count = tree["accessors"][primitive["attributes"]["POSITION"]]["count"]
            if "indices" in primitive:
                corners = tree["accessors"][primitive["indices"]]["count"]
            vertices += count
            triangles += corners if primitive.get("mode") == 5 else corners // 3  # 5 is a strip
        meshes.append((vertices, triangles, len(mesh["primitives"])))
    most = {"vertices": limits.VERTICES, "triangles": limits.TRIANGLES, "primitives": limits.NODES}
    shown = [meshes[node["mesh"]] for node in _nodes(name, tree) if "mesh" in node]
    for sizes in (meshes, shown):
        totals = [sum(column) for column in zip(*sizes, strict=True)] or [0, 0, 0]
        for (what, limit), count in zip(most.items(), totals, strict=True):
            limits.require_at_most(name, f"{what} of all its meshes", count, limit, "decimate or join them")
    # Every picture by its header, and all base colours together.
    colors = set()
    for material in tree.get("materials", ()):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}).get("index")
        entry = {} if texture is None else tree["textures"][texture]
        webp = entry.get("extensions", {}).get("EXT_texture_webp", {})
        colors.add(webp.get("source", entry.get("source")))
    copies, total = _COPIES if _MANY_COPIES in used else 1, 0
    for number in range(len(tree.get("images", ()))):
        data = image_bytes(number)
        size = None if data is None else require_small_picture(data, f"{number} of {name}")
        if size is not None and (number in colors or copies > 1):
            total += copies * size.pixels
    what, advice = f"the textures of {name}", "save its textures with fewer pixels"
    limits.require_at_most(what, "pixels", total, limits.PIXELS, advice)


def _nodes(name: str, tree: Tree) -> Iterator[Tree]:
    """Yield the nodes of the scene, each as often as it is reached; a circle is too deep."""
    nodes = tree.get("nodes", [])
    roots = tree["scenes"][tree.get("scene", 0)].get("nodes", []) if "scenes" in tree else range(len(nodes))
    left = [(root, 1) for root in roots]
    count = 0
    advice = "export the scan alone, without its scene"
    limits.require_at_most(name, "nodes", max(len(nodes), len(left)), limits.NODES, advice)
    while left:
        number, depth = left.pop()
        count += 1
        limits.require_at_most(name, "nodes in its scene", count, limits.NODES, advice)
        limits.require_at_most(name, "nodes below each other", depth, limits.NODE_DEPTH, advice)
        yield nodes[number]
        children = nodes[number].get("children", ())
        limits.require_at_most(name, "nodes in its scene", count + len(children), limits.NODES, advice)
        left += [(child, depth + 1) for child in children]
