"""What `process` makes of a scan without its light, in time: the scan, the template's texture, maps, eyes."""

from collections.abc import Collection
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.files import load_result
from scan2albedo.core import PlanStep, RawScan
from scan2albedo.core.arrays import FloatArray, RealArray, Values
from scan2albedo.face_model.annotation import AnnotatedSurface
from scan2albedo.fitting import FittedFace
from scan2albedo.io.texture_atlas import in_first_period
from scan2albedo.pipeline.clock import Clock
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.unlit.engine_maps import engine_maps
from scan2albedo.unlit.eyes_and_mouth import eyes_and_mouth, on_template
from scan2albedo.unlit.light_removal import LightRemoval, UnlitScan, usual_light
from scan2albedo.unlit.template_baking import TemplateTexture, template_texture, tile_numbers


@dataclass(frozen=True)
class _Cost:
    """Seconds that a part takes: to begin, for each of its texels, for each vertex of the scan."""

    start_s: float = 0.0
    texel_s: float = 0.0
    vertex_s: float = 0.0


_LIGHT = "light on the "
"""Part of making an output: the scan without its light, by how far it is taken off."""
_FILES = " files"
"""Part of writing one."""
_FIELDS = {"template_texture": "template", "maps": "maps_of_skin"}
"""Of a `ProcessResult`, by the names in plans."""
_COSTS = {
    _LIGHT + "face": _Cost(1.0, 1.5e-6, 8e-6),
    _LIGHT + "all": _Cost(1.0, 2.2e-6, 8e-6),
    "template_texture": _Cost(0.5, 7e-6, 5e-6),
    "maps": _Cost(1.0, 12e-6, 1e-5),
    "eyes": _Cost(1.5),
    "unlit" + _FILES: _Cost(0.2, 0.5e-6, 1e-5),
    "template_texture" + _FILES: _Cost(0.2, 0.5e-6),
    "maps" + _FILES: _Cost(0.5, 2e-6, 1e-5),
}
"""Measured on a busy core with a scan of 12,000 faces. Light is taken off the scan's own texels, or its
vertices; the texels of the others are those of their tiles."""
_EXR = 2.0
"""With linear pictures, too, files take so many times as long."""


class Outputs:
    """Which outputs are wanted of a scan, and how many seconds each takes with its files.

    `reaches` are their names, in the order in which they are made, and how much of the scan each needs
    without its light: a template may reach beyond the face, so its texture has no light anywhere. `seconds`
    are those of each part, by the names of `_COSTS`.
    """

    def __init__(self, scan: RawScan, model: AnnotatedSurface | None, options: ProcessOptions) -> None:
        texture, tile = scan.texture_linear, options.texture_size**2
        own = 0 if texture is None else texture.shape[0] * texture.shape[1]
        of_template = 0 if model is None else tile * _tile_count(model.template_uv)
        of_maps = of_template if options.maps == "template" else tile
        if options.maps == "scan" and scan.uv is not None and texture is not None:
            of_maps = tile * _tile_count(in_first_period(scan.uv, texture.shape))
        texels = {"template_texture": of_template, "maps": of_maps, "eyes": 0}
        self.seconds = {
            part: cost.start_s
            + cost.texel_s * texels.get(part.removesuffix(_FILES), own)
            + cost.vertex_s * len(scan.vertices)
            for part, cost in _COSTS.items()
        }
        if options.files == "all":
            self.seconds |= {part: _EXR * s for part, s in self.seconds.items() if part.endswith(_FILES)}
        self.reaches = dict[str, str]()
        if options.unlit is not None:
            self.reaches["unlit"] = options.unlit
        if model is not None and model.template_uv is not None:
            self.reaches["template_texture"] = "all"
        if options.maps is not None:
            self.reaches["maps"] = "all"
        self.have_eyes = {"template_texture"} if options.maps == "scan" else {"template_texture", "maps"}

    def cost_s(self, name: str, unlit: Collection[str] = ()) -> float:
        """Return the seconds of an output, or of "eyes", where the light is off these reaches already."""
        reach = self.reaches.get(name)
        light = 0.0 if reach is None or reach in unlit else self.seconds[_LIGHT + reach]
        return light + self.seconds.get(name, 0.0) + self.files_s(name)

    def files_s(self, name: str) -> float:
        """Return the seconds in which the files of an output are written."""
        return self.seconds.get(name + _FILES, 0.0)

    def all_s(self) -> float:
        """Return the seconds of all that is wanted."""
        seconds = 0.0
        unlit = set[str]()
        for name, reach in self.reaches.items():
            seconds += self.cost_s(name, unlit)
            unlit.add(reach)
        return seconds + (self.cost_s("eyes") if self.have_eyes & self.reaches.keys() else 0.0)


def without_light(
    scan: RawScan,
    fitted: FittedFace | None,
    estimate: AlbedoEstimate | None,
    options: ProcessOptions,
    clock: Clock,
) -> tuple[Values, list[PlanStep]]:
    """Return the outputs that are wanted, and fit into what is left of the budget, and the plan.

    They have the names of a `ProcessResult`'s fields: `unlit`, `template` and `maps_of_skin`.
    """
    outputs = Outputs(scan, None if fitted is None else fitted.model, options)
    steps = list[PlanStep]()
    if fitted is None or estimate is None:
        why = "there is no face" if fitted is None else "no albedo was estimated"
        reasons = {
            "unlit": f"unlit is left out: {why}, so the light is not known",
            "maps": "maps are left out: there is no face with an albedo",
        }
        return {}, [PlanStep.wrong(name, reasons[name]) for name in outputs.reaches if name in reasons]

    def in_time(name: str, unlit: Collection[str] = ()) -> bool:
        left, cost = clock.left_s(), outputs.cost_s(name, unlit)
        if cost > left:
            lead = f"{name} {'are' if name.endswith('s') else 'is'} left out"
            evidence = f"{max(left, 0.0):.1f} s left, {cost:.1f} s needed"
            steps.append(PlanStep.wrong(name, f"{lead}: the budget ended before it", evidence))
        return cost <= left

    removal, unlit = LightRemoval(scan, fitted, estimate), dict[str, UnlitScan]()
    made, textures = Values(), dict[str, TemplateTexture]()
    for name, reach in outputs.reaches.items():
        if not in_time(name, unlit):
            continue
        if reach not in unlit:
            unlit[reach] = removal.unlit(reach)
        clock.files_s += outputs.files_s(name)
        if name == "unlit":
            made["unlit"] = unlit[reach]
            steps += _unlit_rows(unlit[reach], reach)
        elif name == "maps":
            on, size = str(options.maps), options.texture_size
            textures[name] = engine_maps(unlit[reach].scan, fitted, estimate, on, size)
            steps.append(_texture_row(name, f"asked for, on the {on}", textures[name]))
        else:
            bare = unlit[reach]
            textures[name] = template_texture(bare.scan, fitted, options.texture_size, bare)
            steps.append(_texture_row(name, "the template has texture coordinates", textures[name]))
            steps.append(_hair_row(f"{name}.hair", bare.hair))
    carriers = [name for name in textures if name in outputs.have_eyes]
    if carriers and "eyes" in options.skip:
        steps.append(PlanStep("eyes", False, "skipped by the caller"))
    elif carriers and in_time("eyes"):
        inside = eyes_and_mouth(
            load_result(
                SimpleNamespace(scan=scan, fitted=fitted, geometry_image=estimate.image, albedo=estimate)
            )
        )
        for name in carriers:
            textures[name] = on_template(inside, fitted, usual_light(estimate), textures[name])
        there = ", ".join(part.name for part in textures[carriers[0]].parts)
        steps.append(PlanStep("eyes", bool(there), inside.reason, there))
    made |= {_FIELDS[name]: texture for name, texture in textures.items()}
    return made, steps


def _tile_count(uv: FloatArray | None) -> int:
    return 0 if uv is None else int((np.unique(tile_numbers(uv)) > 0).sum())


def _unlit_rows(unlit: UnlitScan, reach: str) -> list[PlanStep]:
    size = unlit.confidence.shape
    evidence = f"{' x '.join(map(str, size))} {'texels' if len(size) == 2 else 'vertices'}"
    what = "whole scan" if reach == "all" else "face"
    row = PlanStep("unlit", True, f"the light is taken off the {what}", evidence)
    return [row, _hair_row("unlit.hair", unlit.hair)]


def _texture_row(name: str, reason: str, texture: TemplateTexture) -> PlanStep:
    seen = sum(float(tile.seen.mean()) for tile in texture.tiles) / max(len(texture.tiles), 1)
    evidence = f"{len(texture.tiles)} tile(s), {seen:.0%} of their texels seen"
    return PlanStep(name, True, reason, evidence)


def _hair_row(stage: str, hair: RealArray | None) -> PlanStep:
    if hair is None:
        return PlanStep(stage, False, "no hair, beard or brows are found: nothing is kept apart")
    reason = "hair, beard and brows as they were lit are kept apart"
    return PlanStep(stage, True, reason, f"{hair.mean():.0%} of the colours")
