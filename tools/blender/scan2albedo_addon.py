"""Blender add-on: a raw face scan through `scan2albedo process`, and its result as an object with a material.

Install: Edit, Preferences, Add-ons, Install from Disk, this file; then give the path of the `scan2albedo`
command in its preferences. Use: File, Import, Face scan without its light. Blender 4.2 or newer.
"""

from __future__ import annotations

import json
import math
import queue
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Vector

bl_info = {
    "name": "scan2albedo",
    "author": "scan2albedo",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "File > Import",
    "description": "Register a raw 3D face scan and take its light off",
    "category": "Import-Export",
}

EXTENSIONS = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
USUAL_ALBEDO = 0.55
"""The albedo's scale is unknown: so bright becomes its brightest skin."""
PERCENTILE = 90.0
"""Of the albedo, which counts as its brightest skin."""
LIGHT_NODE = "light of the scan"
METRES_PER_MM = 1e-3
AXES = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
"""From +y up, as the face model and glTF have it, to +z up, as Blender does."""


def process_command(
    command: str, scan: Path, out: Path, *, quality: str, unlit: str, maps: str, model: str, budget_s: float
) -> list[str]:
    """Return the command line that processes a scan into the folder `out`."""
    words = [command, "process", str(scan), "-o", str(out), "--json", "--quality", quality]
    for flag, choice in (("--unlit", unlit), ("--maps", maps)):
        words += [] if choice == "none" else [flag, choice]
    words += [] if not model else ["--model", model]
    return words if budget_s <= 0 else [*words, "--budget", str(budget_s)]


class Run:
    """A process of the command line: its last line while it runs, then its folder or its error."""

    def __init__(self, words: list[str]) -> None:
        self.last, self._lines = "", queue.SimpleQueue()
        self._process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
        )
        self._out = ""
        self._threads = [threading.Thread(target=read, daemon=True) for read in (self._read, self._follow)]
        for thread in self._threads:
            thread.start()

    def _read(self) -> None:
        self._out = self._process.stdout.read()

    def _follow(self) -> None:
        for line in self._process.stderr:
            self._lines.put(line.strip())

    def poll(self) -> bool:
        """Take in what was said since; return whether the process has ended."""
        ended = self._process.poll() is not None
        if ended:
            for thread in self._threads:
                thread.join()
        while not self._lines.empty():
            self.last = self._lines.get() or self.last
        return ended

    def cancel(self) -> None:
        """End the process; it removes what it began."""
        self._process.terminate()
        self._process.wait()

    def folder(self) -> Path:
        """Return the folder of the result; raises RuntimeError with what the command said."""
        if self._process.returncode != 0:
            raise RuntimeError(self.last.removeprefix("scan2albedo: error: ") or "scan2albedo failed")
        return Path(json.loads(self._out)["out"])


def import_result(folder: Path) -> bpy.types.Object:
    """Import a result's face with its material and its lights, which are not shown in renders at first."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    face, *_ = _imported(folder / "fitted.glb", result["name"])
    face.data.materials.clear()
    face.data.materials.append(_material(folder, result["name"]))
    _lights(result["lights"], result["name"])
    if (folder / "unlit.glb").is_file():
        for scan in _imported(folder / "unlit.glb", f"{result['name']} scan without light"):
            scan.matrix_world = _pose(folder) @ scan.matrix_world
            _hide(scan)
    # In the face's own frame: its maps for engines, and a template, whose blendshapes become shape keys.
    for stem, what in (("maps", "with maps of skin"), ("template", "as template")):
        if (folder / f"{stem}.glb").is_file():
            for part in _imported(folder / f"{stem}.glb", f"{result['name']} {what}"):
                _hide(part)
    return face


def _hide(item: bpy.types.Object) -> None:
    item.hide_render = True
    item.hide_set(True)


def _pose(folder: Path) -> Matrix:
    """Return the pose that brings the scan to the face, in metres and the axes of glTF's importer."""
    if not (folder / "registration.json").is_file():
        return Matrix.Identity(4)
    pose = json.loads((folder / "registration.json").read_text(encoding="utf-8"))["model_from_scan"]
    in_metres = Matrix(pose)
    in_metres.translation *= METRES_PER_MM
    return AXES @ in_metres @ AXES.inverted()


def _imported(file: Path, name: str) -> list[bpy.types.Object]:
    """Return the meshes of a file: called `name`, with numbers; eyes and mouth by what they are, too."""
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(file))
    new = [item for item in bpy.data.objects if item not in before and item.type == "MESH"]
    for item in new:
        part = item.name.partition(".")[0]
        item.name = f"{name}, {part}" if part.startswith(("eye_", "mouth", "teeth_")) else name
    return new


def _material(folder: Path, name: str) -> bpy.types.Material:
    """Return a skin: the albedo, as much of the scan's own light as one wants, and the chart's normals."""
    material = bpy.data.materials.new(f"{name} skin")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    skin = nodes["Principled BSDF"]
    skin.inputs["Roughness"].default_value = 0.6
    if (folder / "albedo.exr").is_file():
        albedo = _texture(nodes, folder / "albedo.exr", "albedo", (-900, 300))
        pixels = np.array(albedo.image.pixels[:]).reshape(-1, 4)[:, :3].max(1)
        bright = float(np.percentile(pixels[pixels > 0], PERCENTILE)) if (pixels > 0).any() else 1.0
        scaled = _product(nodes, "albedo's scale", (-600, 300))
        scaled.inputs["Factor"].default_value = 1.0
        scaled.inputs["B"].default_value = (*[USUAL_ALBEDO / bright] * 3, 1.0)
        links.new(albedo.outputs["Color"], scaled.inputs["A"])
        color = scaled.outputs["Result"]
        if (folder / "shading.exr").is_file():
            shading = _texture(nodes, folder / "shading.exr", "shading", (-900, 0))
            lit = _product(nodes, LIGHT_NODE, (-300, 200))
            lit.inputs["Factor"].default_value = 0.0
            links.new(color, lit.inputs["A"])
            links.new(shading.outputs["Color"], lit.inputs["B"])
            color = lit.outputs["Result"]
        links.new(color, skin.inputs["Base Color"])
    with np.load(folder / "geometry_image.npz") as image:
        normals = nodes.new("ShaderNodeTexImage")
        normals.location, normals.label = (-900, -300), "normals"
        normals.image = _normal_picture(image["normal"], image["mask"], f"{name} normals")
    turned = nodes.new("ShaderNodeNormalMap")
    turned.location, turned.space = (-300, -300), "OBJECT"
    links.new(normals.outputs["Color"], turned.inputs["Color"])
    links.new(turned.outputs["Normal"], skin.inputs["Normal"])
    return material


def _texture(nodes, file: Path, label: str, place: tuple[int, int]):  # type: ignore[no-untyped-def]
    node = nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(file))
    node.image.colorspace_settings.name = "Linear Rec.709"
    node.image.pack()
    node.label, node.location = label, place
    return node


def _product(nodes, label: str, place: tuple[int, int]):  # type: ignore[no-untyped-def]
    node = nodes.new("ShaderNodeMix")
    node.data_type, node.blend_type, node.clamp_factor = "RGBA", "MULTIPLY", True
    node.name = node.label = label
    node.location = place
    # Of its sockets only those of colours have these names and are shown.
    return _Colors(node)


class _Colors:
    """The colour sockets of a Mix node, which has others of the same names."""

    def __init__(self, node) -> None:  # type: ignore[no-untyped-def]
        self.inputs = {"Factor": node.inputs[0], "A": node.inputs[6], "B": node.inputs[7]}
        self.outputs = {"Result": node.outputs[2]}


def _normal_picture(normal, mask, name: str):  # type: ignore[no-untyped-def]
    """Return the chart's normals (H, W, 3) as a picture in the axes that glTF's importer gives the mesh."""
    x, y, z = np.moveaxis(np.asarray(normal, np.float32), -1, 0)
    stored = np.ones((*mask.shape, 4), np.float32)
    stored[..., :3] = np.stack([x, -z, y], axis=-1) / 2 + 0.5
    stored[~np.asarray(mask, bool), :3] = 0.5, 0.5, 1.0
    picture = bpy.data.images.new(name, mask.shape[1], mask.shape[0], float_buffer=True, is_data=True)
    picture.pixels.foreach_set(stored[::-1].ravel())
    picture.pack()
    return picture


def _lights(lights: list[dict], name: str) -> None:
    """Put the lamps that were found into a collection that is off in renders; ambient light is 1."""
    collection = bpy.data.collections.new(f"{name} light of the scan")
    bpy.context.scene.collection.children.link(collection)
    collection.hide_render = True
    for number, entry in enumerate(lights, start=1):
        azimuth, elevation = math.radians(entry["azimuth_deg"]), math.radians(entry["elevation_deg"])
        level = math.cos(elevation)
        toward = AXES @ Vector((math.sin(azimuth) * level, math.sin(elevation), math.cos(azimuth) * level))
        far = entry["distance_mm"] is None
        lamp = bpy.data.lights.new(f"{name} lamp {number}", "SUN" if far else "POINT")
        lamp.color = np.array(entry["color_linear"]) / max(entry["color_linear"])
        strength = entry["intensity"] * max(entry["color_linear"])
        distance = 1.0 if far else entry["distance_mm"] * METRES_PER_MM
        # Under a sun of pi, or 4 pi^2 watts at one metre, paint is as bright as under ambient light of 1.
        lamp.energy = math.pi * strength if far else 4 * math.pi**2 * distance**2 * strength
        if far:
            lamp.angle = 2 * math.radians(entry["radius_deg"])
        else:
            lamp.shadow_soft_size = distance * math.tan(math.radians(entry["radius_deg"]))
        item = bpy.data.objects.new(lamp.name, lamp)
        item.location = toward * distance
        item.rotation_euler = toward.to_track_quat("Z", "Y").to_euler()
        collection.objects.link(item)


class Scan2AlbedoPreferences(bpy.types.AddonPreferences):
    """Where the command is."""

    bl_idname = __name__
    command: StringProperty(name="scan2albedo", default="scan2albedo", subtype="FILE_PATH")  # type: ignore[valid-type]

    def draw(self, context) -> None:  # type: ignore[no-untyped-def]
        """Show the path of the command."""
        self.layout.prop(self, "command")


class IMPORT_SCENE_OT_scan2albedo(bpy.types.Operator, ImportHelper):
    """Register a raw face scan, take its light off and import the face"""

    bl_idname, bl_label, bl_options = "import_scene.scan2albedo", "Import face scan", {"UNDO"}
    filter_glob: StringProperty(default=";".join(f"*{end}" for end in EXTENSIONS), options={"HIDDEN"})  # type: ignore[valid-type]
    quality: EnumProperty(  # type: ignore[valid-type]
        name="Quality",
        items=[(name, name.title(), "") for name in ("draft", "standard", "best")],
        default="standard",
    )
    unlit: EnumProperty(  # type: ignore[valid-type]
        name="Scan without light",
        items=[(name, name.title(), "") for name in ("none", "face", "all")],
        default="face",
    )
    maps: EnumProperty(  # type: ignore[valid-type]
        name="Maps of skin",
        items=[(name, name.title(), "") for name in ("none", "chart", "scan", "template")],
        default="none",
    )
    model: StringProperty(name="Template", description="Your own template's file", subtype="FILE_PATH")  # type: ignore[valid-type]
    budget_s: FloatProperty(name="Seconds", description="0: as many as it takes", default=0.0, min=0.0)  # type: ignore[valid-type]
    out: StringProperty(name="Results", description="Their folder; else a temporary one", subtype="DIR_PATH")  # type: ignore[valid-type]
    command: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context):  # type: ignore[no-untyped-def]
        """Start the command; go on when it has ended."""
        addon = context.preferences.addons.get(__name__)
        command = self.command or (addon.preferences.command if addon else "scan2albedo")
        if shutil.which(command) is None:
            self.report({"ERROR"}, f"{command}: no such command; give its path in the add-on's preferences")
            return {"CANCELLED"}
        out = Path(self.out) if self.out else Path(tempfile.mkdtemp(prefix="scan2albedo_"))
        options = {
            "quality": self.quality,
            "unlit": self.unlit,
            "maps": self.maps,
            "model": self.model,
            "budget_s": self.budget_s,
        }
        self._run = Run(process_command(command, Path(self.filepath), out, **options))
        if bpy.app.background:
            self._run._process.wait()
            self._run.poll()
            return self._finished()
        self._timer = context.window_manager.event_timer_add(0.2, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):  # type: ignore[no-untyped-def]
        """Show progress until the command has ended; Esc ends it."""
        if event.type == "ESC":
            self._run.cancel()
            self._leave(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        ended = self._run.poll()
        context.workspace.status_text_set(f"{self._run.last}   (Esc ends it)")
        if not ended:
            return {"RUNNING_MODAL"}
        self._leave(context)
        return self._finished()

    def _leave(self, context) -> None:  # type: ignore[no-untyped-def]
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)

    def _finished(self):  # type: ignore[no-untyped-def]
        try:
            import_result(self._run.folder())
        except (RuntimeError, OSError, ValueError, KeyError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, self._run.last)
        return {"FINISHED"}


class IMPORT_SCENE_OT_scan2albedo_result(bpy.types.Operator, ImportHelper):
    """Import the result of a scan that was processed before"""

    bl_idname, bl_label, bl_options = "import_scene.scan2albedo_result", "Import face result", {"UNDO"}
    filter_glob: StringProperty(default="result.json", options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context):  # type: ignore[no-untyped-def]
        """Import the folder of the result.json that was chosen."""
        try:
            import_result(Path(self.filepath).parent)
        except (RuntimeError, OSError, ValueError, KeyError) as error:
            self.report({"ERROR"}, f"{self.filepath}: {error}")
            return {"CANCELLED"}
        return {"FINISHED"}


def _menu(self, context) -> None:  # type: ignore[no-untyped-def]
    self.layout.operator(IMPORT_SCENE_OT_scan2albedo.bl_idname, text="Face scan without its light")
    self.layout.operator(IMPORT_SCENE_OT_scan2albedo_result.bl_idname, text="Face result (result.json)")


CLASSES = (Scan2AlbedoPreferences, IMPORT_SCENE_OT_scan2albedo, IMPORT_SCENE_OT_scan2albedo_result)


def register() -> None:
    """Register the add-on."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    """Take it out again."""
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)


if __name__ == "__main__":
    register()
