import copy

import numpy as np
import pytest
from helpers.gltf import Gltf
from helpers.scan_files import assert_refused, textured_gltf
from helpers.square import (
    SQUARE_FACES,
    SQUARE_MM,
    SQUARE_UV,
    assert_corner_colors,
    png_bytes,
    quarters,
    square_gltf,
    write_image,
)
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import MissingDependencyError
from scan2albedo.geometry.mesh import face_normals
from scan2albedo.io import load_scan
from scan2albedo.io.glb import write_glb
from scan2albedo.io.load_scan import read_mesh_file

PNG = png_bytes(quarters())
UV_DOWN = SQUARE_UV * (1, -1) + (0, 1)
DRACO = "KHR_draco_mesh_compression"
MESHOPT = r".*EXT_meshopt_compression, .*export it again without compression \(gltfpack"


def test_a_file_written_by_hand_shows_its_corners(tmp_path):
    scan = square_gltf(PNG, scale=1e-3).load(tmp_path)
    assert_allclose(scan.vertices, SQUARE_MM, atol=1e-4)
    assert_allclose(scan.uv, SQUARE_UV[SQUARE_FACES], atol=1e-7)
    assert_corner_colors(scan)
    assert scan.notes[0] == "unit: m (largest extent 120 mm), decided from the size"


@pytest.mark.parametrize(
    ("nodes", "places"),
    [
        (
            [
                {"children": [1], "translation": [10, 20, 30]},
                {"children": [2], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
                {"mesh": 0, "scale": [2, 1, 1]},
            ],
            np.column_stack([10 - SQUARE_MM[:, 1], 2 * SQUARE_MM[:, 0] + 20, SQUARE_MM[:, 2] + 30]),
        ),
        ([{"mesh": 0, "scale": [-1, 1, 1]}], SQUARE_MM * (-1, 1, 1)),
        ([{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [0, 0, 50]}], SQUARE_MM),
    ],
    ids=["from the root down", "mirrored", "instances"],
)
def test_scene_transforms_keep_faces_outward_and_colours_in_place(tmp_path, nodes, places):
    file = square_gltf(PNG)
    file.tree["nodes"] = nodes
    scan = file.load(tmp_path)
    assert_allclose(scan.vertices[-4:], places, atol=1e-4)
    assert (face_normals(scan.vertices, scan.faces)[:, 2] > 0).all()
    assert_corner_colors(scan, places)
    assert scan.texture_linear.shape == (8, 8, 3)
    assert ("2 loose components, all kept" in scan.notes) == (len(scan.vertices) == 8)


def test_gltf_with_files_beside_it_and_a_damaged_texture(tmp_path):
    write_image(tmp_path / "face.png", quarters())
    path = textured_gltf(tmp_path, "face.png").rename(tmp_path / "a.GLTF")
    assert_corner_colors(load_scan(path))
    (tmp_path / "face.png").unlink()
    for scan in (load_scan(path), square_gltf(png_bytes(quarters(64))[:-60]).load(tmp_path)):
        assert scan.texture_linear is None
        assert LOST in scan.notes
    (tmp_path / "data.bin").unlink()
    assert_refused(path, r"a\.GLTF: cannot be read as GLTF.*missing file")


PICTURE = {"index": 0}
TINT = [0.4, 1.0, 0.2, 1.0]
TEXTURE = {"baseColorTexture": PICTURE}
FACTOR = {"baseColorFactor": TINT}
GLOW = {"emissiveTexture": PICTURE}
STRENGTH = {"emissiveFactor": TINT[:3]}


def of(base, **more):
    return {"pbrMetallicRoughness": base, **more}


def glossy(base=None, **diffuse):
    return of(base or {}, extensions={"KHR_materials_pbrSpecularGlossiness": diffuse})


WHITE = [1.0] * 4
BASE_COLOURS = {
    "no material": (None, WHITE, False),
    "all defaults": ({}, WHITE, False),
    "a factor beyond its range": (of({"baseColorFactor": [-1, 2, 0.5, 1]}), [0, 1, 0.5, 1], False),
    "a tinted picture": (of(TEXTURE | FACTOR), TINT, True),
    "a glow of no strength": (of(FACTOR, **GLOW), TINT, False),
    "a glow of strength zero": ({"emissiveFactor": [0, 0, 0], **GLOW}, WHITE, False),
    "a glow alone": (of({"baseColorFactor": [0, 0, 0, 1]}, **GLOW, **STRENGTH), TINT, True),
    "a glow beside a picture": (of(TEXTURE, **GLOW, **STRENGTH), WHITE, True),
    "a glow without a picture": (STRENGTH, WHITE, False),
    "diffuse by default": (glossy(), WHITE, False),
    "a diffuse picture": (glossy(FACTOR, diffuseTexture=PICTURE), WHITE, True),
    "a tinted diffuse picture": (glossy(diffuseTexture=PICTURE, diffuseFactor=TINT), TINT, True),
    "other pictures": ({"normalTexture": PICTURE, "occlusionTexture": PICTURE}, WHITE, False),
}
"""Material, base colour and whether it is that of the picture (glTF 2.0, 5.19 to 5.22 for the defaults)."""


@pytest.mark.parametrize("kind", BASE_COLOURS)
def test_materials_have_the_defaults_of_the_standard(tmp_path, kind):
    material, color, textured = BASE_COLOURS[kind]
    file = square_gltf(PNG)
    if material is None:
        del file.primitive["material"]
    file.tree["materials"] = [copy.deepcopy(material or {})]
    scan = file.load(tmp_path)
    if textured:
        assert_corner_colors(scan, factor=color[:3])
    else:
        assert scan.texture_linear is None
        (base,) = read_mesh_file(tmp_path / "a.glb").materials
        assert_allclose(base.base_color_linear, color[:3])


def test_vertex_colours_are_linear_even_beside_a_material(tmp_path):
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.25, 0.5, 0.75]])
    scan = square_gltf(colors=colors).load(tmp_path)
    assert_allclose(scan.vertex_color_linear, colors, atol=1e-6)


def test_strips_and_interleaved_arrays_and_lines(tmp_path):
    file = square_gltf()
    strip = file.add(np.array([0, 1, 3, 2], "<u2"))
    rows = np.column_stack([SQUARE_MM, SQUARE_UV]).astype("<f4")
    entry = {"componentType": 5126, "count": 4, "bufferView": file.view(rows.tobytes(), byteStride=20)}
    file.tree["accessors"][1:3] = [{**entry, "type": "VEC3"}, {**entry, "type": "VEC2", "byteOffset": 12}]
    triangles = file.primitive | {"indices": strip, "mode": 5}
    file.tree["meshes"][0]["primitives"] = [{**triangles, "mode": 1}, triangles]
    scan = file.load(tmp_path, "mm")
    assert_array_equal(scan.vertices, SQUARE_MM)
    assert scan.faces.tolist() == [[0, 1, 3], [3, 1, 2]]
    assert_allclose(scan.uv[0, :, 1], 1 - SQUARE_UV[[0, 1, 3], 1], atol=1e-6)


LOST = "the texture of skin is missing, damaged or of an unknown kind: went on without it"


def compressed_nowhere(file):
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = [DRACO]
    for accessor in file.tree["accessors"]:
        del accessor["bufferView"]
    file.primitive["extensions"] = {DRACO: {"bufferView": 0, "attributes": {"POSITION": 0}}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.tree.update(extensionsRequired=["EXT_meshopt_compression"]), MESHOPT),
        (compressed_nowhere, ""),
        (lambda file: file.tree["bufferViews"][1].update(buffer=-1), ".*a view of buffer"),
        (lambda file: file.tree["bufferViews"][1].update(byteStride=3), ".*a view of buffer"),
        (
            lambda file: file.primitive.update(indices=file.add(np.array([0, 1, 2, 0, 2, 77], "<u2"))),
            "a face refers to vertex 77, but there are 4",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(tmp_path, change, message):
    file = square_gltf()
    change(file)
    assert_refused(file.write(tmp_path / "a.glb"), rf"a\.glb: {message}")


def test_draco_is_decoded_and_without_its_decoder_what_to_install_is_named(tmp_path, monkeypatch):
    DracoPy = pytest.importorskip("DracoPy")
    file, corners = square_gltf(PNG), SQUARE_FACES.astype(np.uint32)
    options = {"tex_coord": UV_DOWN, "preserve_order": True, "quantization_bits": 14}
    blob = DracoPy.encode(SQUARE_MM, corners, **options)
    numbers = {part["attribute_type"]: part["unique_id"] for part in DracoPy.decode(blob).attributes}
    compressed_nowhere(file)
    kinds = DracoPy.AttributeType
    names = {"POSITION": numbers[kinds.POSITION], "TEXCOORD_0": numbers[kinds.TEX_COORD]}
    file.primitive["extensions"][DRACO] = {"bufferView": file.view(blob), "attributes": names}
    scan = file.load(tmp_path, "mm")
    assert_allclose(scan.vertices, SQUARE_MM, atol=0.01)
    assert_corner_colors(scan, scan.vertices)
    moved = {"KHR_texture_transform": {"scale": [0.5, 0.5], "offset": [0.25, 0.25]}}
    file.material["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = moved
    assert_allclose(file.load(tmp_path, "mm").uv, scan.uv / 2 + 0.25, atol=1e-6)
    monkeypatch.setattr("scan2albedo.io.gltf.find_spec", lambda name: None)
    words = r"a\.glb: .* pip install 'scan2albedo\[draco\]', or export"
    assert_refused(tmp_path / "a.glb", words, MissingDependencyError)


def test_a_picture_that_nothing_decodes_is_named(tmp_path):
    file = square_gltf(PNG)
    (texture,) = file.tree["textures"]
    picture = texture.pop("source")
    texture["extensions"] = {"KHR_texture_basisu": {"source": picture}}
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["KHR_texture_basisu"]
    (note,) = (note for note in file.load(tmp_path).notes if "went on without it" in note)
    assert "KTX2 (KHR_texture_basisu), which is not read; export the scan again with PNG or JPEG" in note
    texture["source"] = picture  # for programs without the extension
    assert_corner_colors(file.load(tmp_path))


def test_what_we_write_follows_the_standard(tmp_path):
    """v is counted from the top and lengths are metres in the file itself, not just for our reader."""
    write_glb(tmp_path / "a.glb", SQUARE_MM, SQUARE_FACES, SQUARE_UV, quarters())
    file = Gltf.read(tmp_path / "a.glb")
    expected = {"POSITION": SQUARE_MM / 1000, "TEXCOORD_0": UV_DOWN, "NORMAL": [[0, 0, 1]] * 4}
    for name, values in expected.items():
        assert_allclose(file.array(file.attributes[name]), values, atol=1e-7)
    assert_corner_colors(load_scan(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ((SQUARE_MM, SQUARE_FACES, None, quarters()), "a texture needs uv"),
        ((SQUARE_MM, SQUARE_FACES, SQUARE_UV[:3]), r"uv has shape \(3, 2\), expected \(4, 2\)"),
        ((SQUARE_MM[:, :2], SQUARE_FACES), "expected"),
    ],
)
def test_wrong_calls_write_nothing(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        write_glb(tmp_path / "b.glb", *wrong)
    assert not (tmp_path / "b.glb").exists()


def quantized(file):
    middle, half = SQUARE_MM.mean(0), np.abs(SQUARE_MM - SQUARE_MM.mean(0)).max()
    whole = np.round((SQUARE_MM - middle) / half * 32767).astype("<i2")
    file.attributes["POSITION"] = file.add(whole, normalized=True)
    file.tree["nodes"][0] |= {"scale": [half] * 3, "translation": middle.tolist()}
    file.tree["extensionsUsed"] = file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]


def second_set(file):
    file.attributes["TEXCOORD_1"] = file.attributes["TEXCOORD_0"]
    file.attributes["TEXCOORD_0"] = file.add(np.zeros((4, 2), "<f4"))
    file.material["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 1


def transformed(file, texture_set=0):
    """As KHR_texture_transform says: scaled, turned counter-clockwise (v is down), moved."""
    cos, sin = np.cos(0.4), np.sin(0.4)
    stored = (UV_DOWN - (0.1, -0.2)) @ np.array([[cos, sin], [-sin, cos]]) / (0.5, 2.0)
    file.attributes[f"TEXCOORD_{texture_set}"] = file.add(stored.astype("<f4"))
    place = {"rotation": 0.4, "scale": [0.5, 2.0], "offset": [0.1, -0.2], "texCoord": texture_set}
    picture = file.material["pbrMetallicRoughness"]["baseColorTexture"]
    picture["extensions"] = {"KHR_texture_transform": place}


def transformed_in_its_set(file):
    transformed(file, 1)


def sparse(file):
    first = (SQUARE_MM * [[1], [0], [1], [0]]).astype("<f4")
    file.attributes["POSITION"] = number = file.add(first)
    indices = {"bufferView": file.view(np.array([1, 3], "<u2").tobytes()), "componentType": 5123}
    values = {"bufferView": file.view(SQUARE_MM[[1, 3]].astype("<f4").tobytes())}
    file.tree["accessors"][number]["sparse"] = {"count": 2, "indices": indices, "values": values}


@pytest.mark.parametrize("dialect", [quantized, second_set, transformed, transformed_in_its_set, sparse])
def test_dialects_of_exporters_show_the_same(tmp_path, dialect):
    file = square_gltf(PNG)
    dialect(file)
    scan = file.load(tmp_path, "mm")
    assert_allclose(scan.vertices, SQUARE_MM, atol=2e-3)
    assert_corner_colors(scan, scan.vertices, atol=1e-5)
