import json

import numpy as np
import pytest
from helpers.square import (
    CORNER_LINEAR,
    SQUARE_FACES,
    SQUARE_MM,
    SQUARE_UV,
    assert_corner_colors,
    color_near_corner,
    glb_bytes,
    png_bytes,
    quarters,
    square_gltf,
    write_image,
)

from scan2albedo.errors import MissingDependencyError, ScanError
from scan2albedo.io import load_scan
from scan2albedo.io.glb import write_glb


def write(path, *arguments, **options):
    path.write_bytes(glb_bytes(*square_gltf(*arguments, **options)))
    return path


def test_a_file_written_by_hand_shows_its_corners(tmp_path):
    scan = load_scan(write(tmp_path / "a.glb", png_bytes(quarters()), scale=1e-3))
    np.testing.assert_allclose(scan.vertices, SQUARE_MM, atol=1e-4)
    np.testing.assert_allclose(scan.uv, SQUARE_UV[SQUARE_FACES], atol=1e-7)
    assert_corner_colors(scan)
    assert scan.notes[0].startswith("unit: m ")


def test_scene_transforms_apply_from_the_root_down(tmp_path):
    nodes = [
        {"children": [1], "translation": [10, 20, 30]},
        {"children": [2], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
        {"mesh": 0, "scale": [2, 1, 1]},
    ]
    scan = load_scan(write(tmp_path / "a.glb", None, nodes=nodes))
    expected = np.column_stack([-SQUARE_MM[:, 1] + 10, 2 * SQUARE_MM[:, 0] + 20, SQUARE_MM[:, 2] + 30])
    np.testing.assert_allclose(scan.vertices, expected, atol=1e-4)


def test_a_mirroring_transform_keeps_faces_outward_and_colours_in_place(tmp_path):
    nodes = [{"mesh": 0, "scale": [-1, 1, 1]}]
    scan = load_scan(write(tmp_path / "a.glb", png_bytes(quarters()), nodes=nodes))
    corners = scan.vertices[scan.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    for position, color in zip(SQUARE_MM * (-1, 1, 1), CORNER_LINEAR, strict=True):
        np.testing.assert_allclose(color_near_corner(scan, position), color, atol=1e-6)


def test_instances_are_joined_with_one_texture(tmp_path):
    nodes = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [0, 0, 50]}]
    scan = load_scan(write(tmp_path / "a.glb", png_bytes(quarters()), nodes=nodes))
    assert scan.vertices.shape == (8, 3)
    assert scan.texture_linear.shape == (8, 8, 3)
    assert "2 loose components, all kept" in scan.notes
    assert_corner_colors(scan)


def test_base_colour_factors_multiply_in_linear_light(tmp_path):
    path = write(tmp_path / "a.glb", png_bytes(quarters()), factor=[0.4, 1.0, 0.2, 1.0])
    scan = load_scan(path)
    upper_left = color_near_corner(scan, SQUARE_MM[3])
    np.testing.assert_allclose(upper_left, CORNER_LINEAR[3] * [0.4, 1, 0.2], atol=1e-6)


def test_vertex_colours_are_linear_even_beside_a_material(tmp_path):
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.25, 0.5, 0.75]])
    scan = load_scan(write(tmp_path / "a.glb", None, colors=colors))
    np.testing.assert_allclose(scan.vertex_color_linear, colors, atol=1e-6)


def test_diffuse_colours_of_specular_glossiness_are_the_base_colour(tmp_path):
    tree, binary = square_gltf(png_bytes(quarters()))
    picture = tree["materials"][0].pop("pbrMetallicRoughness")["baseColorTexture"]
    name = "KHR_materials_pbrSpecularGlossiness"
    gloss = {"diffuseTexture": picture, "diffuseFactor": [0.4, 1.0, 0.2, 1.0]}
    tree["materials"][0]["extensions"], tree["extensionsUsed"] = {name: gloss}, [name]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    upper_left = color_near_corner(load_scan(tmp_path / "a.glb"), SQUARE_MM[3])
    np.testing.assert_allclose(upper_left, CORNER_LINEAR[3] * [0.4, 1, 0.2], atol=1e-6)


def test_strips_and_interleaved_arrays_and_lines(tmp_path):
    tree, binary = square_gltf(None)
    (primitive,) = tree["meshes"][0]["primitives"]
    rows = np.column_stack([SQUARE_MM, SQUARE_UV]).astype("<f4")
    binary += np.array([0, 1, 3, 2], "<u2").tobytes() + rows.tobytes()
    views, start = tree["bufferViews"], len(binary) - rows.nbytes
    views.append({"buffer": 0, "byteOffset": start - 8, "byteLength": 8})
    views.append({"buffer": 0, "byteOffset": start, "byteLength": rows.nbytes, "byteStride": 20})
    entry = {"componentType": 5126, "count": 4, "bufferView": len(views) - 1}
    tree["accessors"][0] |= {"bufferView": len(views) - 2, "count": 4}
    tree["accessors"][1:] = [{**entry, "type": "VEC3"}, {**entry, "type": "VEC2", "byteOffset": 12}]
    tree["buffers"] = [{"byteLength": len(binary)}]
    tree["meshes"][0]["primitives"] = [{**primitive, "mode": 1}, {**primitive, "mode": 5}]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    scan = load_scan(tmp_path / "a.glb", unit="mm")
    np.testing.assert_array_equal(scan.vertices, SQUARE_MM)
    assert scan.faces.tolist() == [[0, 1, 3], [3, 1, 2]]
    np.testing.assert_allclose(scan.uv[0, :, 1], 1 - SQUARE_UV[[0, 1, 3], 1], atol=1e-6)


def test_gltf_with_files_beside_it(tmp_path):
    tree, binary = square_gltf(None)
    tree["buffers"][0]["uri"] = "data.bin"
    tree["images"] = [{"uri": "face.png"}]
    tree["textures"] = [{"source": 0}]
    tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    (tmp_path / "data.bin").write_bytes(binary)
    write_image(tmp_path / "face.png", quarters())
    path = tmp_path / "a.GLTF"
    path.write_text(json.dumps(tree))
    assert_corner_colors(load_scan(path))
    (tmp_path / "face.png").unlink()
    scan = load_scan(path)
    assert scan.texture_linear is None
    assert "the texture of skin is missing, damaged or of an unknown kind: went on without it" in scan.notes
    (tmp_path / "data.bin").unlink()
    with pytest.raises(ScanError, match=r"a\.GLTF: cannot be read as GLTF.*missing file"):
        load_scan(path)


def test_a_damaged_texture_is_told(tmp_path):
    scan = load_scan(write(tmp_path / "a.glb", png_bytes(quarters(64))[:-60]))
    assert scan.texture_linear is None
    assert any("the texture of skin is missing, damaged" in note for note in scan.notes)


@pytest.mark.parametrize("part", [0.01, 0.1, 0.5, 0.95])
def test_truncated_files_are_refused_by_name(tmp_path, part):
    path = write(tmp_path / "a.glb", None)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(ScanError, match=r"a\.glb: "):
        load_scan(path)


def test_a_wrong_index_is_refused_by_name(tmp_path):
    tree, binary = square_gltf(None)
    broken = np.array([0, 1, 2, 0, 2, 77], "<u2").tobytes() + binary[12:]
    path = tmp_path / "a.glb"
    path.write_bytes(glb_bytes(tree, broken))
    with pytest.raises(ScanError, match=r"a\.glb: a face refers to vertex 77, but there are 4"):
        load_scan(path)


def test_a_mesh_without_material_and_colours(tmp_path):
    tree, binary = square_gltf(None)
    del tree["meshes"][0]["primitives"][0]["material"], tree["materials"]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    np.testing.assert_array_equal(load_scan(tmp_path / "a.glb").vertices, SQUARE_MM)


@pytest.mark.parametrize(("component", "dtype"), [(5121, "u1"), (5123, "<u2")])
@pytest.mark.parametrize("stride", [None, 8])
def test_texture_coordinates_of_few_bits(tmp_path, component, dtype, stride):
    tree, binary = square_gltf(png_bytes(quarters()))
    top = np.iinfo(dtype).max
    stored = np.zeros((4, 2 if stride is None else stride // np.dtype(dtype).itemsize), dtype)
    stored[:, :2] = np.column_stack([SQUARE_UV[:, 0], 1 - SQUARE_UV[:, 1]]) * top
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": stored.nbytes}
    tree["bufferViews"].append(view if stride is None else {**view, "byteStride": stride})
    place = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": component, "normalized": True}
    tree["accessors"][2] = {**place, "count": 4, "type": "VEC2"}
    tree["buffers"] = [{"byteLength": len(binary) + stored.nbytes}]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary + stored.tobytes()))
    assert_corner_colors(load_scan(tmp_path / "a.glb"))


def draco_square(path):
    """Write the square as Draco holds it, beside its picture; returns the tree."""
    DracoPy = pytest.importorskip("DracoPy")
    tree, binary = square_gltf(png_bytes(quarters()))
    uv = np.column_stack([SQUARE_UV[:, 0], 1 - SQUARE_UV[:, 1]])
    blob = DracoPy.encode(
        SQUARE_MM, SQUARE_FACES.astype(np.uint32), tex_coord=uv, preserve_order=True, quantization_bits=14
    )
    numbers = {part["attribute_type"]: part["unique_id"] for part in DracoPy.decode(blob).attributes}
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(blob)})
    kinds = DracoPy.AttributeType
    names = {"POSITION": numbers[kinds.POSITION], "TEXCOORD_0": numbers[kinds.TEX_COORD]}
    compressed = {"bufferView": len(tree["bufferViews"]) - 1, "attributes": names}
    tree["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": compressed}
    tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    tree["buffers"] = [{"byteLength": len(binary + blob)}]
    path.write_bytes(glb_bytes(tree, binary + blob))


def test_draco_is_decoded(tmp_path):
    draco_square(tmp_path / "a.glb")
    scan = load_scan(tmp_path / "a.glb", unit="mm")
    np.testing.assert_allclose(scan.vertices, SQUARE_MM, atol=0.01)
    for position, color in zip(scan.vertices, CORNER_LINEAR, strict=True):
        np.testing.assert_allclose(color_near_corner(scan, position), color, atol=1e-6)


def test_draco_without_its_decoder_names_what_to_install(tmp_path, monkeypatch):
    draco_square(tmp_path / "a.glb")
    monkeypatch.setattr("scan2albedo.io.gltf.find_spec", lambda name: None)
    with pytest.raises(
        MissingDependencyError, match=r"a\.glb: .* pip install 'scan2albedo\[draco\]', or export"
    ):
        load_scan(tmp_path / "a.glb")


def test_compression_that_nothing_decodes_is_named(tmp_path):
    tree, binary = square_gltf(None)
    tree["extensionsRequired"] = ["EXT_meshopt_compression"]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    with pytest.raises(
        ScanError, match=r"EXT_meshopt_compression, .*export it again without compression \(gltfpack without"
    ):
        load_scan(tmp_path / "a.glb")


def test_a_picture_that_nothing_decodes_is_named(tmp_path):
    tree, binary = square_gltf(png_bytes(quarters()))
    picture = tree["textures"][0].pop("source")
    tree["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": picture}}
    tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_texture_basisu"]
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    (note,) = (note for note in load_scan(tmp_path / "a.glb").notes if "went on without it" in note)
    assert "KTX2 (KHR_texture_basisu), which is not read; export the scan again with PNG or JPEG" in note
    tree["textures"][0]["source"] = picture  # for programs without the extension
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    assert_corner_colors(load_scan(tmp_path / "a.glb"))


def test_compressed_meshes_are_refused_not_read_as_zeros(tmp_path):
    tree, binary = square_gltf(None)
    tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    for accessor in tree["accessors"]:
        del accessor["bufferView"]
    tree["meshes"][0]["primitives"][0]["extensions"] = {
        "KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}
    }
    path = tmp_path / "a.glb"
    path.write_bytes(glb_bytes(tree, binary))
    with pytest.raises(ScanError, match=r"a\.glb: "):
        load_scan(path)


def test_what_we_write_follows_the_standard(tmp_path):
    """v is counted from the top and lengths are metres in the file itself, not just for our reader."""
    write_glb(tmp_path / "a.glb", SQUARE_MM, SQUARE_FACES, SQUARE_UV, quarters())
    data = (tmp_path / "a.glb").read_bytes()
    assert data[:4] == b"glTF"
    length = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + length]), data[20 + length + 8 :]
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]

    def values(name):
        accessor = tree["accessors"][attributes[name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(binary[start : start + view["byteLength"]], "<f4").reshape(4, -1)

    np.testing.assert_allclose(values("POSITION"), SQUARE_MM / 1000, atol=1e-8)
    np.testing.assert_allclose(values("TEXCOORD_0"), [[0, 1], [1, 1], [1, 0], [0, 0]], atol=1e-7)
    np.testing.assert_allclose(values("NORMAL"), [[0, 0, 1]] * 4, atol=1e-7)
    assert_corner_colors(load_scan(tmp_path / "a.glb"))


def test_a_glb_without_texture_and_wrong_calls(tmp_path):
    write_glb(tmp_path / "a.glb", SQUARE_MM, SQUARE_FACES, SQUARE_UV)
    np.testing.assert_allclose(load_scan(tmp_path / "a.glb").vertices, SQUARE_MM, atol=1e-4)
    with pytest.raises(ValueError, match="a texture needs uv"):
        write_glb(tmp_path / "b.glb", SQUARE_MM, SQUARE_FACES, None, quarters())
    with pytest.raises(ValueError, match=r"uv has shape \(3, 2\), expected \(4, 2\)"):
        write_glb(tmp_path / "b.glb", SQUARE_MM, SQUARE_FACES, SQUARE_UV[:3])
    with pytest.raises(ValueError, match="expected"):
        write_glb(tmp_path / "b.glb", SQUARE_MM[:, :2], SQUARE_FACES)
    assert not (tmp_path / "b.glb").exists()


def with_array(tree, binary, values, **accessor):
    """Return the number of a new accessor of values (N, K), and the buffer with them."""
    binary += b"\0" * (-len(binary) % 4)
    data = np.ascontiguousarray(values).tobytes()
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
    tree["buffers"] = [{"byteLength": len(binary + data)}]
    kinds = {"i2": 5122, "u2": 5123, "f4": 5126}
    place = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": kinds[values.dtype.str[1:]]}
    kind = f"VEC{values.shape[1]}"
    tree["accessors"].append({"count": len(values), "type": kind, **place, **accessor})
    return len(tree["accessors"]) - 1, binary + data


def turned(uv, turn, scale, offset):
    """Undo the transform of KHR_texture_transform: scaled, turned counter-clockwise (v is down), moved."""
    cos, sin = np.cos(turn), np.sin(turn)
    return (uv - offset) @ np.array([[cos, sin], [-sin, cos]]) / scale


@pytest.mark.parametrize(
    "dialect", ["quantized", "second set", "transform", "transform of its set", "emissive", "sparse"]
)
def test_dialects_of_exporters_show_the_same(tmp_path, dialect):
    tree, binary = square_gltf(png_bytes(quarters()))
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    material = tree["materials"][0]["pbrMetallicRoughness"]
    uv = np.column_stack([SQUARE_UV[:, 0], 1 - SQUARE_UV[:, 1]])
    if dialect == "quantized":
        middle, half = SQUARE_MM.mean(0), np.abs(SQUARE_MM - SQUARE_MM.mean(0)).max()
        whole = np.round((SQUARE_MM - middle) / half * 32767).astype("<i2")
        attributes["POSITION"], binary = with_array(tree, binary, np.pad(whole, ((0, 0), (0, 1)))[:, :3])
        tree["accessors"][attributes["POSITION"]]["normalized"] = True
        tree["nodes"][0] |= {"scale": [half] * 3, "translation": middle.tolist()}
        tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    elif dialect == "second set":
        attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"]
        attributes["TEXCOORD_0"], binary = with_array(tree, binary, np.zeros((4, 2), "<f4"))
        material["baseColorTexture"]["texCoord"] = 1
    elif dialect.startswith("transform"):
        place = {"rotation": 0.4, "scale": [0.5, 2.0], "offset": [0.1, -0.2]}
        stored = turned(uv, place["rotation"], place["scale"], place["offset"]).astype("<f4")
        name = "TEXCOORD_0" if dialect == "transform" else "TEXCOORD_1"
        attributes[name], binary = with_array(tree, binary, stored)
        place |= {"texCoord": int(name[-1])}
        material["baseColorTexture"]["extensions"] = {"KHR_texture_transform": place}
    elif dialect == "emissive":
        tree["materials"][0] |= {"emissiveTexture": material.pop("baseColorTexture")}
        tree["materials"][0]["emissiveFactor"] = [1, 1, 1]
        material["baseColorFactor"] = [0, 0, 0, 1]
    else:
        number, binary = with_array(tree, binary, SQUARE_MM[[1, 3]].astype("<f4"))
        _, binary = with_array(tree, binary, np.array([[1], [3]], "<u2"))
        last, moved = tree["accessors"].pop(), tree["accessors"].pop(number)
        first = SQUARE_MM.astype("<f4") * [[1], [0], [1], [0]]
        attributes["POSITION"], binary = with_array(tree, binary, first.astype("<f4"))
        tree["accessors"][attributes["POSITION"]]["sparse"] = {
            "count": 2,
            "indices": {"bufferView": last["bufferView"], "componentType": 5123},
            "values": {"bufferView": moved["bufferView"]},
        }
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    scan = load_scan(tmp_path / "a.glb", unit="mm")
    np.testing.assert_allclose(scan.vertices, SQUARE_MM, atol=2e-3)
    for position, color in zip(scan.vertices, CORNER_LINEAR, strict=True):
        np.testing.assert_allclose(color_near_corner(scan, position), color, atol=1e-5)


def test_coordinates_that_are_compressed_are_moved_too(tmp_path):
    draco_square(tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    picture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    picture["extensions"] = {"KHR_texture_transform": {"scale": [0.5, 0.5], "offset": [0.25, 0.25]}}
    whole = load_scan(tmp_path / "a.glb", unit="mm").uv
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, data[28 + size :]))
    np.testing.assert_allclose(load_scan(tmp_path / "a.glb", unit="mm").uv, whole / 2 + 0.25, atol=1e-6)


@pytest.mark.parametrize("view", [{"buffer": -1}, {"byteStride": 3}])
def test_views_of_no_buffer_are_refused_by_name(tmp_path, view):
    tree, binary = square_gltf(None)
    tree["bufferViews"][1] |= view
    (tmp_path / "a.glb").write_bytes(glb_bytes(tree, binary))
    with pytest.raises(ScanError, match=r"a\.glb: .*a view of buffer"):
        load_scan(tmp_path / "a.glb")
