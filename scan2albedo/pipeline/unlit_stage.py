"""What leaves the chart: the scan without its light, and colours on the coordinates of a template."""

from __future__ import annotations

from scan2albedo.albedo import AlbedoEstimate
from scan2albedo.applications.light_removal import UnlitScan, unlit_scan
from scan2albedo.applications.template_baking import TemplateTexture, template_texture
from scan2albedo.core import Plan, PlanStep, RawScan
from scan2albedo.fitting import FittedFace
from scan2albedo.pipeline.options import ProcessOptions

FACE_S, BEYOND_S, PAINTED_S = 0.8e-6, 0.4e-6, 4e-6
"""Seconds that a texel of the scan's own texture takes, on the face and beyond it, and a template's texel."""
MOST_OF_BUDGET = 0.3
"""Part of a budget that is kept for them: the face itself comes first."""


def unlit_seconds(scan: RawScan, options: ProcessOptions) -> float:
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
    if options.unlit is not None:
        unlit, step = _unlit(scan, fitted, estimate, options, left_s)
        steps.append(step)
    if fitted is not None and fitted.model.template_uv is not None and estimate is not None:
        everywhere = unlit if options.unlit == "all" else None
        template, step = _template(scan, fitted, estimate, everywhere, options, left_s)
        steps.append(step)
    return unlit, template, Plan(tuple(steps))


def _unlit(
    scan: RawScan,
    fitted: FittedFace | None,
    estimate: AlbedoEstimate | None,
    options: ProcessOptions,
    left_s: float,
) -> tuple[UnlitScan | None, PlanStep]:
    assert options.unlit is not None
    if fitted is None or estimate is None:
        why = "there is no face" if fitted is None else "no albedo was estimated"
        return None, PlanStep("unlit", False, f"{why}, and so no light to take off the scan")
    if unlit_seconds(scan, options) > left_s:
        return None, _too_late("unlit", left_s)
    unlit = unlit_scan(scan, fitted, estimate, options.unlit)
    size = unlit.confidence.shape
    what = "whole scan" if options.unlit == "all" else "face"
    evidence = f"{' x '.join(map(str, size))} {'texels' if len(size) == 2 else 'vertices'}"
    return unlit, PlanStep("unlit", True, f"the light is taken off the {what}", evidence)


def _template(
    scan: RawScan,
    fitted: FittedFace,
    estimate: AlbedoEstimate,
    everywhere: UnlitScan | None,
    options: ProcessOptions,
    left_s: float,
) -> tuple[TemplateTexture | None, PlanStep]:
    """Paint the template from the scan without light `everywhere`, which is made here if need be.

    A template may reach beyond the face, so its texture has no light anywhere.
    """
    if PAINTED_S * options.texture_size**2 > left_s:
        return None, _too_late("template_texture", left_s)
    colors = (everywhere or unlit_scan(scan, fitted, estimate, "all")).scan
    template = template_texture(colors, fitted, options.texture_size)
    seen = sum(float(tile.seen.mean()) for tile in template.tiles) / max(len(template.tiles), 1)
    evidence = f"{len(template.tiles)} tile(s), {seen:.0%} of their texels seen"
    return template, PlanStep("template_texture", True, "the template has texture coordinates", evidence)


def _too_late(stage: str, left_s: float) -> PlanStep:
    return PlanStep(stage, False, "the budget ended before it", f"{left_s:.1f} s left")
