"""What leaves the chart: the scan without its light, and colours on the coordinates of a template."""

from __future__ import annotations

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.light_removal import UnlitScan, unlit_scan
from scan2albedo.applications.template_baking import TemplateTexture, template_texture
from scan2albedo.core import Plan, PlanStep, RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.pipeline.options import ProcessOptions

FACE_S, BEYOND_S, PAINTED_S = 0.8e-6, 0.4e-6, 3e-6
"""Seconds that a texel of the scan's own texture takes, on the face and beyond it, and a template's texel."""
MOST_OF_BUDGET = 0.3
"""Part of a budget that is kept for them: the face itself comes first."""


def kept_s(scan: RawScan, options: ProcessOptions) -> float:
    """Return the seconds that the unlit scan needs; 0 where it is not asked for."""
    if options.unlit is None or scan.texture_linear is None:
        return 0.0
    texel_s = FACE_S + (BEYOND_S if options.unlit == "all" else 0.0)
    return texel_s * scan.texture_linear[..., 0].size


def without_light(
    scan: RawScan,
    fitted: FittedFace | None,
    estimate: AlbedoEstimate | None,
    options: ProcessOptions,
    left_s: float,
) -> tuple[UnlitScan | None, TemplateTexture | None, Plan]:
    """Return the unlit scan where it is asked for, the texture of a template that has coordinates, the plan.

    What would take longer than `left_s` is left out.
    """
    unlit, template, steps = None, None, list[PlanStep]()
    uv = None if fitted is None else fitted.model.template_uv
    if options.unlit is not None:
        what = "whole scan" if options.unlit == "all" else "face"
        if fitted is None or estimate is None:
            why = "there is no face" if fitted is None else "no albedo was estimated"
            steps.append(PlanStep("unlit", False, f"{why}, and so no light to take off the scan"))
        elif kept_s(scan, options) > left_s:
            steps.append(PlanStep("unlit", False, "the budget ended before it", f"{left_s:.1f} s left"))
        else:
            unlit = unlit_scan(scan, fitted, estimate, options.unlit)
            size = unlit.confidence.shape
            evidence = f"{' x '.join(map(str, size))} {'texels' if len(size) == 2 else 'vertices'}"
            steps.append(PlanStep("unlit", True, f"the light is taken off the {what}", evidence))
    if fitted is not None and uv is not None and estimate is not None:
        needed_s = PAINTED_S * options.texture_size**2
        if needed_s > left_s:
            step = PlanStep("template_texture", False, "the budget ended before it", f"{left_s:.1f} s left")
        else:
            # A template may reach beyond the face, so its texture has no light anywhere.
            everywhere = unlit if options.unlit == "all" else None
            colors = (everywhere or unlit_scan(scan, fitted, estimate, "all")).scan
            template = template_texture(colors, fitted, options.texture_size)
            seen = sum(float(tile.seen.mean()) for tile in template.tiles) / max(len(template.tiles), 1)
            evidence = f"{len(template.tiles)} tile(s), {seen:.0%} of their texels seen"
            step = PlanStep("template_texture", True, "the template has texture coordinates", evidence)
        steps.append(step)
    return unlit, template, Plan(tuple(steps))
