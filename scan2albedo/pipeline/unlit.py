"""The last stage: what is made of a scan without its light, in time: itself, a template's texture, maps."""

from dataclasses import dataclass

import numpy as np

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.core import Budget, PlanStep, RawScan
from scan2albedo.core.arrays import FloatArray, Values
from scan2albedo.face_model.annotation import AnnotatedSurface
from scan2albedo.fitting import FittedFace
from scan2albedo.io.color import is_deep
from scan2albedo.io.obj import write_obj
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.io.textured_mesh import TexturedMesh, write_textured_glb
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.result import ProcessResult, Run
from scan2albedo.pipeline.stages import Files, Stage
from scan2albedo.unlit.engine_maps import engine_maps
from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth, on_template
from scan2albedo.unlit.files import write_template, write_unlit
from scan2albedo.unlit.light_removal import LightRemoval, UnlitScan, median_light
from scan2albedo.unlit.processed_face import ProcessedFace
from scan2albedo.unlit.template_baking import template_texture, tile_numbers

OUTPUTS_SHARE = 0.3
"""Share of the whole budget that is kept at most for what may be left out: the face itself comes first."""
EYES_S = 1.5
"""Seconds that eyes and a mouth take. These and the costs below were measured on a busy core with a scan of
12,000 faces."""
_MAKE_S = {"unlit": 0.0, "template_texture": 7e-6, "maps": 13e-6}
"""Seconds for each texel of an output, but for taking the light off and for its files."""
_LIGHT_S = 2e-6
"""Seconds in which the light is taken off a texel of the scan."""
_FILES_S = 1e-6
"""Seconds in which a texel is written."""
_VERTEX_S = 1e-5
"""Seconds that each of these steps takes for a vertex of the scan, and one second to begin."""
_MESH = (".glb", ".obj", ".mtl", ".png", ".*.png", ".exr", ".*.exr")
_MAPS = ("normal", "normal_directx", "occlusion", "roughness", "specular", "cavity", "displacement")
_PICTURES = ("unlit_confidence", "unlit_hair", "template_normal", "template_hair")


@dataclass(frozen=True)
class Output:
    """One thing to be made: its name in plans, how far the light has to be off, and what it takes."""

    name: str
    reach: str
    make_s: float
    files_s: float
    """`make_s` without the light's removal, and `files_s`: seconds to make it and to write its files."""


def wanted_outputs(scan: RawScan, model: AnnotatedSurface | None, options: ProcessOptions) -> list[Output]:
    """Return what is to be made of a scan without its light, in the order in which it is made.

    A template may reach beyond the face, so its texture, like maps, has no light anywhere.
    """
    texture, tile = scan.texture_linear, options.texture_size**2
    of_template = 0 if model is None else tile * _tile_count(model.template_uv)
    wanted = list[Output]()

    def want(name: str, reach: str, texels: int) -> None:
        make_s, files_s = (_seconds(scan, rate * texels) for rate in (_MAKE_S[name], _FILES_S))
        wanted.append(Output(name, reach, make_s, files_s))

    if options.unlit is not None:
        want("unlit", options.unlit, _own_texels(scan))
    if model is not None and model.template_uv is not None:
        want("template_texture", "all", of_template)
    if options.maps is not None:
        of_maps = of_template if options.maps == "template" else tile
        if options.maps == "scan" and scan.uv is not None and texture is not None:
            of_maps = tile * _tile_count(in_first_period(scan.uv, texture.shape))
        want("maps", "all", of_maps)
    return wanted


def light_s(scan: RawScan) -> float:
    """Return the seconds in which the light is taken off a scan."""
    return _seconds(scan, _LIGHT_S * _own_texels(scan))


def _seconds(scan: RawScan, of_texels: float) -> float:
    return 1 + _VERTEX_S * len(scan.vertices) + of_texels


class Unlit(Stage):
    """Make the scan without its light, the texture of a template, maps: as many as fit into the budget."""

    name = "unlit"
    files = (
        *(f"{mesh}{end}" for mesh in ("template", "unlit", "maps") for end in _MESH),
        *(f"{picture}{end}" for picture in _PICTURES for end in (".png", ".*.png")),
        *(f"maps_{name}{end}" for name in _MAPS for end in (".png", ".*.png")),
        *("maps.usda", "maps_displacement.exr", "maps_displacement.*.exr"),
    )
    """Several pictures of an unlit scan have numbers, in the order of the scan's materials, those of a
    template's tiles their UDIM numbers."""

    def cost_s(self, run: Run) -> float:
        """Return the seconds of all that is wanted, at most a share of the budget."""
        wanted = wanted_outputs(run.scan, run.model, run.options)
        seconds = sum(output.make_s + output.files_s for output in wanted)
        seconds += EYES_S * bool(wanted) + light_s(run.scan) * len({output.reach for output in wanted})
        return min(seconds, OUTPUTS_SHARE * (Budget.of(run.options.budget).seconds or 0.0))

    def run(self, run: Run, clock: Clock) -> list[PlanStep]:
        """Make `unlit`, `template` and `maps_of_skin`."""
        fitted, estimate = run.fitted, run.albedo
        wanted = wanted_outputs(run.scan, None if fitted is None else fitted.model, run.options)
        if not wanted:
            return []
        with clock.timed(self.name):
            if fitted is None or estimate is None:
                why = "there is no face" if fitted is None else "no albedo was estimated"
                names = [output.name for output in wanted if output.name != "template_texture"]
                return [_left_out(name, f"{why}, so the light is not known") for name in names]
            clock.due_s.pop(self.name, None)  # what was kept for it is now to be spent
            rows = _make(wanted, run, fitted, estimate, clock)
            return rows + _put_eyes_in(run, fitted, estimate, clock)

    def write(self, result: ProcessResult, files: Files) -> None:
        """Write the unlit scan, the template and the mesh with maps."""
        moves: Values = {}
        if result.linear_model is not None and result.linear_model.model.names:
            rest, targets, weights = result.linear_model.neutral_and_targets()
            moves = {"rest": rest, "targets": targets, "weights": weights}
        texture, fitted = result.scan.texture_linear, result.fitted
        # PNG have 16 bits where the scan's texture has more than 8.
        samples = np.uint16 if texture is not None and is_deep(texture) else np.uint8
        if result.unlit is not None:
            write_unlit(files.folder, result.unlit, samples, exr=files.exr)
        if result.maps_of_skin is not None:
            write_template(files.folder, result.maps_of_skin, np.uint16, exr=files.exr, stem="maps")
        if result.template is not None:
            write_template(files.folder, result.template, samples, exr=files.exr, **moves)
        elif fitted is not None and fitted.template_vertices is not None:
            vertices, faces = fitted.template_vertices, fitted.model.template_faces
            if faces is not None:
                files.write("template.obj", write_obj, vertices, faces)
                if moves:
                    mesh = TexturedMesh(vertices, faces, **moves)
                    files.write("template.glb", write_textured_glb, mesh)


def _make(
    wanted: list[Output], run: Run, fitted: FittedFace, estimate: AlbedoEstimate, clock: Clock
) -> list[PlanStep]:
    """Make what is wanted as long as there is time, and say what was made."""
    size, rows = run.options.texture_size, list[PlanStep]()
    removal, unlit = LightRemoval(run.scan, fitted, estimate), dict[str, UnlitScan]()
    for output in wanted:
        cost_s = output.make_s + output.files_s
        if output.reach not in unlit:
            cost_s += light_s(run.scan)
        if cost_s > clock.left_s():
            rows.append(_late(output.name, cost_s, clock))
            continue
        if output.reach not in unlit:
            unlit[output.reach] = removal.unlit(output.reach)
        bare = unlit[output.reach]
        clock.due_s[f"{output.name} files"] = output.files_s
        if output.name == "unlit":
            run.unlit = bare
            off = "whole scan" if output.reach == "all" else "face"
            rows.append(PlanStep("unlit", True, f"the light is taken off the {off}"))
        elif output.name == "maps":
            on = str(run.options.maps)
            run.maps_of_skin = engine_maps(bare.scan, fitted, estimate, on, size)
            rows.append(PlanStep("maps", True, f"asked for, on the {on}"))
        else:
            run.template = template_texture(bare.scan, fitted, size, bare)
            rows.append(PlanStep(output.name, True, "the template has texture coordinates"))
        if output.name != "maps":
            reason = "hair, beard and brows are kept apart as they were lit, where any are found"
            rows.append(PlanStep(f"{output.name}.hair", bare.hair is not None, reason))
    return rows


def _put_eyes_in(run: Run, fitted: FittedFace, estimate: AlbedoEstimate, clock: Clock) -> list[PlanStep]:
    """Put eyes and a mouth into the template, and into the mesh with maps unless it is the scan itself."""
    of_maps = None if run.options.maps == "scan" else run.maps_of_skin
    meshes = {"maps_of_skin": of_maps, "template": run.template}
    if not any(meshes.values()):
        return []
    if "eyes" in run.options.skip:
        return [PlanStep("eyes", False, "skipped by the caller")]
    if clock.left_s() < EYES_S:
        return [_late("eyes", EYES_S, clock)]
    inside = eyes_and_mouth(ProcessedFace.of_stages(run.scan.name, estimate.image, fitted, estimate))
    there = ""
    for name, mesh in meshes.items():
        if mesh is not None:
            made = on_template(inside, fitted, median_light(estimate), mesh)
            setattr(run, name, made)
            there = ", ".join(part.name for part in made.parts)
    return [PlanStep("eyes", bool(there), inside.reason, there)]


def _late(name: str, cost_s: float, clock: Clock) -> PlanStep:
    evidence = f"{max(clock.left_s(), 0.0):.1f} s left, {cost_s:.1f} s needed"
    return _left_out(name, "the budget ended before it", evidence)


def _left_out(name: str, why: str, evidence: str = "") -> PlanStep:
    verb = "are" if name.endswith("s") else "is"
    return PlanStep.wrong(name, f"{name} {verb} left out: {why}", evidence)


def _own_texels(scan: RawScan) -> int:
    texture = scan.texture_linear
    return 0 if texture is None else texture.shape[0] * texture.shape[1]


def _tile_count(uv: FloatArray | None) -> int:
    return 0 if uv is None else int((np.unique(tile_numbers(uv)) > 0).sum())
