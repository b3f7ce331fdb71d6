"""What leaves the chart: the scan without its light, and colours on the coordinates of a template."""

from __future__ import annotations

from typing import TypeGuard

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.light_removal import UnlitScan, unlit_scan
from scan2albedo.applications.template_baking import TemplateTexture, template_texture
from scan2albedo.core import Plan, PlanStep, RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.pipeline.options import ProcessOptions

UNLIT_S = 1e-6
"""Seconds that a texel of the scan's own texture takes."""


def wants_no_light(fitted: FittedFace | None, options: ProcessOptions) -> TypeGuard[FittedFace]:
    """Whether anything is to be made here: the unlit scan, or the texture of a template's coordinates."""
    return fitted is not None and (options.unlit is not None or fitted.model.template_uv is not None)


def without_light(
    scan: RawScan, fitted: FittedFace, estimate: AlbedoEstimate, options: ProcessOptions
) -> tuple[UnlitScan | None, TemplateTexture | None]:
    """Return the unlit scan where it is asked for, and the texture of a template that has coordinates."""
    unlit = None if options.unlit is None else unlit_scan(scan, fitted, estimate, options.unlit)
    if fitted.model.template_uv is None:
        return unlit, None
    # A template may reach beyond the face, so its texture has no light anywhere.
    everywhere = unlit if options.unlit == "all" else None
    colors = (everywhere or unlit_scan(scan, fitted, estimate, "all")).scan
    return unlit, template_texture(colors, fitted, options.texture_size)


def unlit_plan(options: ProcessOptions, unlit: UnlitScan | None, template: TemplateTexture | None) -> Plan:
    """Return the plan's rows of both; none of what nobody asked for."""
    steps = []
    if unlit is not None:
        size = unlit.scan.vertices.shape[:1] if unlit.scan.texture_linear is None else unlit.confidence.shape
        evidence = f"{' x '.join(map(str, size))}, confidence {unlit.confidence.mean():.2f}"
        steps.append(PlanStep("unlit", True, f"the light is taken off the scan's {options.unlit}", evidence))
    elif options.unlit is not None:
        steps.append(PlanStep("unlit", False, "no light was found that could be taken off"))
    if template is not None:
        seen = sum(float(tile.seen.mean()) for tile in template.tiles) / max(len(template.tiles), 1)
        evidence = f"{len(template.tiles)} tile(s), {seen:.0%} of their texels seen"
        steps.append(PlanStep("template_texture", True, "the template has texture coordinates", evidence))
    return Plan(tuple(steps))
