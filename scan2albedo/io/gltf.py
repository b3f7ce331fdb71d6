"""GLB and glTF files: the meshes of a scene in one, skinned ones as their joints hold them."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from scipy.spatial.transform import Rotation

from scan2albedo.core.arrays import Float32Array, FloatArray, NDArray, Values
from scan2albedo.core.raw_scan import require_valid_indices
from scan2albedo.errors import MissingDependencyError, ScanError, errors_of, one_line
from scan2albedo.io import limits
from scan2albedo.io.color import decode_picture
from scan2albedo.io.images import picture_pixels
from scan2albedo.io.parsed_mesh import Material, ParsedMesh, ScanFolder, strip_triangles

_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5124: "<i4", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DRACO = "KHR_draco_mesh_compression"
_NOT_DECODED = ("EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclass
class GltfFile:
    """A file: the JSON `tree` in it, the `binary` chunk of a GLB, and what was read of what its URIs name."""

    path: Path
    folder: ScanFolder
    tree: Values
    binary: bytes = b""
    contents: dict[str, bytes] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, folder: ScanFolder) -> GltfFile:
        """Read a GLB or glTF file."""
        data = limits.read_bytes(path, advice="decimate it")
        start = 0
        end = len(data)
        if data[:4] == b"glTF":
            start = 20  # behind the headers of the file and of its first chunk
            end = start + int.from_bytes(data[12:16], "little")
        tree = limits.parse_json(path.name, data[start:end])
        for material in tree.get("materials", ()):
            base = material.setdefault("pbrMetallicRoughness", {})
            gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
            if gloss is not None:
                base["baseColorFactor"] = gloss.get("diffuseFactor", (1, 1, 1, 1))
                if "diffuseTexture" in gloss:
                    base["baseColorTexture"] = gloss["diffuseTexture"]
            glow = material.get("emissiveFactor", (0, 0, 0))
            if any(glow) and "emissiveTexture" in material and "baseColorTexture" not in base:
                # Shadeless exports have the colour in the slot of what glows.
                base["baseColorTexture"] = material["emissiveTexture"]
                base["baseColorFactor"] = [*glow, 1]
        return cls(path, folder, tree, data[end + 8 :])  # behind the second chunk's header

    def require_readable(self) -> None:
        """Raise TooLargeError for a file that declares more than is read, ScanError for unknown compression.

        Arrays are judged before they are made. Raises MissingDependencyError when the library that decodes
        the file's compression is missing; LookupError, TypeError, ValueError for damage.
        """
        tree, name = self.tree, self.path.name
        version = str(tree.get("asset", {}).get("version", "2.0"))
        if not self.binary and version < "2":
            raise ValueError(f"it is of version {version}, expected 2.0")
        used, required = tree.get("extensionsUsed", ()), tree.get("extensionsRequired", ())
        advice = "export it again without compression"
        for extension in _NOT_DECODED:
            if extension in required:
                said = f"{name}: is compressed with {extension}, which is not decoded here"
                raise ScanError(f"{said}; {advice} (gltfpack without -c)")
        if _DRACO in (*used, *required) and find_spec("DracoPy") is None:
            said = f"{name}: is compressed with Draco; install what reads it with"
            raise MissingDependencyError(f"{said}: pip install 'scan2albedo[draco]', or {advice}")
        for view in tree.get("bufferViews", ()):
            if view["buffer"] < 0 or view.get("byteStride", 4) < 4:
                raise ValueError(f"a view of buffer {view['buffer']}, of stride {view.get('byteStride', 4)}")
        total = 0
        for accessor in tree.get("accessors", ()):
            if accessor["count"] < 0:
                raise ValueError(f"an accessor has {accessor['count']} elements")
            dtype = np.dtype(_DTYPES[accessor["componentType"]])
            total += dtype.itemsize * _COMPONENTS[accessor["type"]] * accessor["count"]
        limits.require_at_most(name, "bytes of arrays", total, limits.FILE_BYTES, "decimate it")

    def sizes(self, primitive: Values) -> tuple[int, int, int]:
        """Return how many vertices, triangles and primitives a primitive declares."""
        corners = count = self.tree["accessors"][primitive["attributes"]["POSITION"]]["count"]
        if "indices" in primitive:
            corners = self.tree["accessors"][primitive["indices"]]["count"]
        return count, corners if primitive.get("mode") == 5 else corners // 3, 1  # 5 is a strip

    def scene(self) -> Iterator[tuple[int, FloatArray]]:
        """Yield the nodes of the scene, each as often as it is reached, with their transforms (4, 4)."""
        nodes = self.tree.get("nodes", [])
        scenes = self.tree.get("scenes")
        reached = 0
        roots = scenes[self.tree.get("scene", 0)].get("nodes", ()) if scenes else ()
        left = [(root, np.eye(4)) for root in roots]
        while left:  # a circle has too many
            many, advice = reached + len(left), "export the scan alone, without its scene"
            limits.require_at_most(self.path.name, "nodes in its scene", many, limits.NODES, advice)
            reached, (number, transform) = reached + 1, left.pop()
            node, own = nodes[number], np.eye(4)
            if "matrix" in node:
                own = np.array(node["matrix"], float).reshape(4, 4).T
            else:  # glTF 2.0, 3.5.3
                turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
                own[:3, :3], own[:3, 3] = turn * node.get("scale", 1), node.get("translation", 0)
            transform = transform @ own
            yield number, transform
            left += [(child, transform) for child in node.get("children", ())]

    def color_number(self, material: Values) -> int | None:
        """Return the number of the picture of a material's base colour."""
        texture = material["pbrMetallicRoughness"].get("baseColorTexture", {}).get("index")
        entry = {} if texture is None else self.tree["textures"][texture]
        number: int | None = entry.get("extensions", {}).get("EXT_texture_webp", entry).get("source")
        return number

    def colors(self) -> dict[int | None, Float32Array]:
        """Return the pictures (H, W, 3 or 4) of base colours that can be read, linear, by their numbers.

        Each picture is judged by its header, and these together, before it is decoded.
        """
        from PIL import Image

        name = self.path.name
        total = 0
        found, wanted = dict[int | None, Float32Array](), set[int | None]()
        wanted.update(self.color_number(material) for material in self.tree.get("materials", ()))
        for number, entry in enumerate(self.tree.get("images", ())):
            data: bytes | memoryview = b""
            if "bufferView" in entry:
                data = self.view(entry["bufferView"])
            else:
                with suppress(KeyError, OSError, ValueError):  # it is missing
                    data = self._content(entry["uri"])
            pixels = picture_pixels(bytes(data), f"{number} of {name}")
            if pixels is not None and number in wanted:
                total, advice = total + pixels, "save its textures with fewer pixels"
                limits.require_at_most(f"the textures of {name}", "pixels", total, limits.PIXELS, advice)
                with suppress(OSError, SyntaxError, ValueError), Image.open(BytesIO(data)) as image:
                    found[number] = decode_picture(np.asarray(image.convert("RGBA"), np.uint8))
        return found

    def decoded(self, primitive: Values) -> dict[str, NDArray]:
        """Return the arrays of a primitive that Draco compressed, by their names and as "indices"."""
        if (packed := primitive.get("extensions", {}).get(_DRACO)) is None:
            return {}
        import DracoPy

        said, advice = f"{self.path.name}: is no whole Draco mesh", "export it again without compression"
        with errors_of(said, ScanError, DracoPy.FileTypeException, advice=advice):
            mesh = DracoPy.decode(bytes(self.view(packed["bufferView"])))
        stored = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
        return {"indices": mesh.faces, **{name: stored[k] for name, k in packed["attributes"].items()}}

    def array(self, number: int) -> NDArray:
        """Return (count, components) what an accessor holds; zeros where it has no bytes."""
        accessor = self.tree["accessors"][number]
        shape = accessor["count"], _COMPONENTS[accessor["type"]]
        found = np.zeros(shape, _DTYPES[accessor["componentType"]])
        if "bufferView" in accessor:
            found[:] = self._stored(accessor)
        if few := accessor.get("sparse"):
            at = self._stored({"type": "SCALAR", "count": few["count"], **few["indices"]})[:, 0]
            found[at] = self._stored({**accessor, "byteOffset": 0, "count": few["count"], **few["values"]})
        return found

    def _stored(self, accessor: Values) -> NDArray:
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _COMPONENTS[accessor["type"]]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start, data = accessor.get("byteOffset", 0), self.view(accessor["bufferView"])
        steps = (view.get("byteStride", width * dtype.itemsize), dtype.itemsize)
        return np.ndarray((accessor["count"], width), dtype, data, start, steps)

    def view(self, number: int) -> memoryview:
        """Return the bytes of a view of a buffer."""
        view = self.tree["bufferViews"][number]
        buffer = self.tree["buffers"][view["buffer"]]
        own = view["buffer"] == 0 and "uri" not in buffer
        whole = memoryview(self.binary if own else self._content(buffer["uri"]))
        found = whole[(start := view.get("byteOffset", 0)) : start + view["byteLength"]]
        if start < 0 or len(found) != view["byteLength"]:
            raise ValueError(f"view {number} reaches beyond its buffer")
        return found

    def _content(self, uri: str) -> bytes:
        """Return what a URI refers to; FileNotFoundError for a file that the scan may not refer to."""
        if uri not in self.contents:
            if uri.startswith("data:"):
                head, _, body = uri.partition(",")
                content = base64.b64decode(body) if head.endswith(";base64") else unquote_to_bytes(body)
            elif (file := self.folder.find(name := unquote(uri))) is not None:
                content = limits.read_bytes(file)
            else:
                raise FileNotFoundError(f"{name} {self.folder.why_missing(name)}")
            self.contents[uri] = content
            total, place = sum(map(len, self.contents.values())), f"what {self.path.name} refers to"
            limits.require_at_most(place, "bytes", total, 4 * limits.FILE_BYTES, "decimate it")
        return self.contents[uri]


def read_gltf(path: Path, folder: ScanFolder) -> ParsedMesh:
    """Read a GLB or glTF file: scene transforms applied, all meshes joined, base colours as materials.

    Skinned meshes come as their joints hold them, without animation. Base colour textures are sRGB, factors
    and vertex colours linear (glTF 2.0, 3.7.2 and 3.9.2). Raises ScanError when the file is damaged.
    """
    try:
        return _joined(GltfFile.read(path, folder))
    except limits.DAMAGE as error:
        kind, cause = path.suffix[1:].upper(), one_line(error)
        cause = f"there is no {cause}" if isinstance(error, KeyError) else cause
        said = f"{path.name}: cannot be read as {kind} ({cause})"
        advice = "the file is damaged, truncated or refers to a missing file: export it again"
        raise ScanError(f"{said}; {advice}") from error


def files_of_gltf(path: Path, folder: ScanFolder) -> list[str]:
    """Return the names of the buffers and pictures of a glTF file."""
    try:
        tree = GltfFile.read(path, folder).tree
        uris = [entry.get("uri", "") for entry in (*tree.get("buffers", ()), *tree.get("images", ()))]
    except (ValueError, AttributeError, TypeError, RecursionError):
        return []  # load_scan says what is wrong with the file
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]


def _joined(file: GltfFile) -> ParsedMesh:
    """Return the meshes of the scene in one; lines and points are left out."""
    file.require_readable()
    placed, pictures, name = [*file.scene()], file.colors(), file.path.name
    materials, surfaces, world = dict[int | None, Material](), dict[int, _Surface](), dict(placed)
    most = {"vertices": limits.VERTICES, "triangles": limits.TRIANGLES, "primitives": limits.NODES}
    notes, parts, totals = dict[str, None](), list[ParsedMesh](), [0, 0, 0]
    for index, matrix in placed:
        node = file.tree["nodes"][index]
        for primitive in file.tree["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            totals = [a + b for a, b in zip(totals, file.sizes(primitive), strict=True)]
            for (what, limit), count in zip(most.items(), totals, strict=True):
                limits.require_at_most(name, f"{what} of its meshes", count, limit, "decimate or join them")
            if primitive.get("mode", 4) not in (4, 5):
                continue
            if (key := primitive.get("material")) not in materials:
                count = 1 + len(materials)
                limits.require_at_most(name, "materials", count, limits.MATERIALS, "join its materials")
                materials[key], note = _material(file, key, pictures)
                notes |= {note: None} if note else {}
            if id(primitive) not in surfaces:
                surfaces[id(primitive)] = _surface(file, primitive, materials[key], [*materials].index(key))
            part, joints, weights = surfaces[id(primitive)]
            skinned = "skin" in node and joints.size
            moved = _by_joints(file, world, node["skin"], joints, weights) if skinned else matrix
            linear, shift = moved[..., :3, :3], moved[..., :3, 3]
            part = replace(part, vertices=(linear @ part.vertices[:, :, None])[:, :, 0] + shift)
            if np.median(np.linalg.det(linear)) < 0 and part.uv is not None:
                part = replace(part, faces=part.faces[:, ::-1], uv=part.uv[:, ::-1])
            parts.append(part)
    if not parts:
        return ParsedMesh(np.zeros((0, 3)), np.zeros((0, 3), int), notes=tuple(notes))
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
        notes=tuple(notes),
    )


def _material(
    file: GltfFile, number: int | None, pictures: dict[int | None, Float32Array]
) -> tuple[Material, str]:
    """Return a material, white where a primitive has none, and a note where its texture is lost."""
    entry = {"pbrMetallicRoughness": {}} if number is None else file.tree["materials"][number]
    base, name, note = entry["pbrMetallicRoughness"], str(entry.get("name") or "material"), ""
    color = np.clip(np.array(base.get("baseColorFactor", (1, 1, 1))[:3], float), 0, 1)
    texture = pictures.get(source := file.color_number(entry))
    if texture is not None and (color < 1).any():
        texture = texture * np.append(color, 1)[: texture.shape[2]].astype(np.float32)
    if texture is None and (wanted := base.get("baseColorTexture")) is not None:
        basis = "KHR_texture_basisu" in file.tree["textures"][wanted["index"]].get("extensions", {})
        note = (
            "is KTX2 (KHR_texture_basisu), which is not read; export the scan again with PNG or JPEG"
            if basis and source is None
            else "is missing, damaged or of an unknown kind"
        )
        note = f"the texture of {name} {note}: went on without it"
    return Material(name, texture, (float(color[0]), float(color[1]), float(color[2]))), note


def _surface(file: GltfFile, primitive: Values, material: Material, number: int) -> _Surface:
    """Return a primitive, of a material, in its own frame."""
    names, decoded, entries = primitive["attributes"], file.decoded(primitive), file.tree["accessors"]
    count = len(decoded["POSITION"]) if decoded else entries[names["POSITION"]]["count"]
    quantized = "KHR_mesh_quantization" in file.tree.get("extensionsUsed", ())

    def numbers(name: str, width: int, scaled: bool = not quantized) -> FloatArray:
        """Return (count, width), whole numbers as parts of their range (3.6.2), NaN where there are none."""
        if name not in names or (name not in decoded and entries[names[name]]["count"] != count):
            return np.full((count, width), np.nan)
        values = decoded[name] if name in decoded else file.array(names[name])
        if values.dtype.kind == "f" or not entries[names[name]].get("normalized", scaled):
            return values.astype(float)
        return np.maximum(values / np.iinfo(values.dtype).max, -1)

    vertices, colors = numbers("POSITION", 3), numbers("COLOR_0", 4, scaled=True)
    index = decoded.get("indices", np.arange(count))
    if not decoded and "indices" in primitive:
        index = file.array(primitive["indices"])
    corners = index.astype(int).ravel()
    faces = strip_triangles(corners) if primitive.get("mode") == 5 else corners.reshape(-1, 3)
    # Joined with other meshes, a wrong index would point at a vertex of the next one.
    require_valid_indices(faces, count, file.path.name)
    # Coordinates, v down, that `texCoord` of the base colour chooses and KHR_texture_transform moves.
    entry = file.tree["materials"][primitive["material"]] if "material" in primitive else {}
    picture = entry.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    moved = picture.get("extensions", {}).get("KHR_texture_transform", {})
    uv = numbers(f"TEXCOORD_{moved.get('texCoord', picture.get('texCoord', 0))}", 2)
    cos, sin = np.cos(turn := moved.get("rotation", 0)), np.sin(turn)
    uv = uv * moved.get("scale", 1) @ np.array([[cos, -sin], [sin, cos]]) + moved.get("offset", 0)
    if np.isnan(colors).all():  # of alpha 0, for no picture showed it
        colors = np.tile([*material.base_color_linear, 0], (count, 1))
    seen = np.pad(colors, ((0, 0), (0, 4 - colors.shape[1])), constant_values=1).astype(np.float32)
    whose = np.full(len(faces), number)
    part = ParsedMesh(vertices, faces, (uv * (1, -1) + (0, 1))[faces], whose, vertex_color_linear=seen)
    sets = range(sum(name.startswith("JOINTS_") for name in names))
    joints, weights = (
        np.concatenate([np.zeros((count, 0)), *(numbers(f"{kind}_{n}", 4, scaled=False) for n in sets)], 1)
        for kind in ("JOINTS", "WEIGHTS")
    )
    return part, joints, weights


_Surface = tuple[ParsedMesh, FloatArray, FloatArray]
"""A primitive in its own frame, with the joints and weights (V, K) of its vertices."""


def _by_joints(
    file: GltfFile, world: dict[int, FloatArray], skin: int, joints: FloatArray, weights: FloatArray
) -> FloatArray:
    """Return the transforms (V, 4, 4) of vertices by their joints, whose nodes' transforms are in `world`.

    v' = sum over k of w_k J_k B_k v, and the transform of the mesh's own node is ignored (glTF 2.0, 3.7.3.2
    and 3.7.3.3).
    """
    total, entry = weights.sum(1, keepdims=True), file.tree["skins"][skin]
    if not (total > 0).all():
        raise ValueError("a vertex of a skinned mesh has no weights")
    transforms = np.array([world[joint] for joint in entry["joints"]])
    if "inverseBindMatrices" in entry:  # else they are identities
        columns = file.array(entry["inverseBindMatrices"])[: len(transforms)].reshape(-1, 4, 4)
        transforms = transforms @ columns.transpose(0, 2, 1).astype(float)
    blended, block = np.empty((len(joints), 4, 4)), 1 << 16  # to spare memory
    for start in range(0, len(joints), block):
        rows = slice(start, start + block)
        chosen = transforms[joints[rows].astype(int)]
        blended[rows] = np.einsum("vj,vjab->vab", weights[rows] / total[rows], chosen)
    return blended
