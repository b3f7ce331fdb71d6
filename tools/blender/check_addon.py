"""Checks the add-on in Blender's Python module (`pip install bpy`, in an environment of its own).

usage: PYTHON-WITH-BPY tools/blender/check_addon.py SCAN OUT COMMAND

Imports a scan named person.obj, compares scan, face and normals, and renders paint under lamps. Ends with an
AssertionError where something is wrong.
"""

import sys
from pathlib import Path

import bpy
import numpy as np
import scan2albedo_addon as addon
from mathutils import Vector

LAMP = {
    "azimuth_deg": 0.0,
    "elevation_deg": 0.0,
    "intensity": 1.0,
    "color_linear": [1, 1, 1],
    "radius_deg": 1,
}
PAINT = 0.5


def main(scan: str, out: str, command: str) -> None:
    """Run all checks."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon.register()
    call = {"filepath": scan, "out": out, "quality": "draft", "unlit": "face", "maps": "chart"}
    assert bpy.ops.import_scene.scan2albedo(command=command, **call) == {"FINISHED"}
    check_face(bpy.data.objects["person"])
    check_scan(bpy.data.objects["person"], bpy.data.objects["person scan without light"])
    check_maps(bpy.data.objects["person"], bpy.data.objects["person with maps of skin"])
    for distance_mm in (None, 800.0):
        lit = brightness([{**LAMP, "distance_mm": distance_mm}], 0.0, Path(out))
        assert abs(lit - PAINT) < 0.03, (distance_mm, lit)
    assert abs(brightness([], 1.0, Path(out)) - PAINT) < 0.03
    said = ""
    try:
        bpy.ops.import_scene.scan2albedo(command="/no/such/command", **call)
    except RuntimeError as error:
        said = str(error)
    assert "no such command" in said
    print("all of it held")


def check_face(face) -> None:  # type: ignore[no-untyped-def]
    """The face stands upright in metres; its normal map agrees with its mesh."""
    height = np.ptp([vertex.co.z for vertex in face.data.vertices])
    assert 0.1 < height < 0.3, height
    nodes = face.data.materials[0].node_tree.nodes
    assert nodes[addon.LIGHT_NODE].inputs[0].default_value == 0
    assert {"albedo", "shading", "normals"} <= {node.label for node in nodes}
    picture = next(node for node in nodes if node.label == "normals").image
    width, rows = picture.size
    pixels = np.array(picture.pixels[:]).reshape(rows, width, 4)
    places, agree = face.data.uv_layers.active.data, []
    for loop in list(face.data.loops)[::101]:
        u, v = places[loop.index].uv
        normal = Vector(pixels[int(v * rows - 0.5), int(u * width - 0.5), :3] * 2 - 1).normalized()
        agree.append(normal.dot(face.data.vertices[loop.vertex_index].normal))
    assert np.median(agree) > 0.97, np.median(agree)


def check_scan(face, scan) -> None:  # type: ignore[no-untyped-def]
    """The unlit scan lies where its face is, and is not rendered beside it."""
    bpy.context.view_layer.update()
    assert scan.hide_render
    gaps = []
    for vertex in list(scan.data.vertices)[::7]:
        place = scan.matrix_world @ vertex.co
        _, nearest, _, _ = face.closest_point_on_mesh(place)
        gaps.append((place - nearest).length)
    assert np.percentile(gaps, 20) < 0.001, np.percentile(gaps, 20)


def check_maps(face, mapped) -> None:  # type: ignore[no-untyped-def]
    """The mesh with maps is the face again, and its material reads a picture for each input of skin."""
    assert mapped.hide_render
    assert max(abs(a - b) for a, b in zip(face.dimensions, mapped.dimensions, strict=True)) < 1e-4
    nodes = mapped.data.materials[0].node_tree.nodes
    surface = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    for name in ("Base Color", "Roughness", "Normal", "Specular IOR Level"):
        assert surface.inputs[name].is_linked, name


def brightness(lights: list[dict], ambient: float, out: Path) -> float:
    """Return how bright matte paint is under lamps and ambient light."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (*[ambient] * 3, 1.0)
    bpy.ops.mesh.primitive_plane_add(size=0.2, rotation=(np.pi / 2, 0, 0))
    paint = bpy.data.materials.new("paint")
    paint.use_nodes = True
    tree = paint.node_tree
    matte = tree.nodes.new("ShaderNodeBsdfDiffuse")
    matte.inputs[0].default_value = (*[PAINT] * 3, 1.0)
    tree.links.new(matte.outputs[0], tree.nodes["Material Output"].inputs[0])
    bpy.context.object.data.materials.append(paint)
    addon._lights(lights, "x")
    bpy.data.collections["x light of the scan"].hide_render = False
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location = (0, -0.5, 0)
    camera.rotation_euler = (np.pi / 2, 0, 0)
    camera.data.lens = 400
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 64
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(out / "plane.exr")
    bpy.ops.render.render(write_still=True)
    pixels = np.array(bpy.data.images.load(scene.render.filepath).pixels[:]).reshape(-1, 4)
    return float(pixels[:, :3].mean())


if __name__ == "__main__":
    main(*sys.argv[1:])
