"""Settings of the albedo stage."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

OPTIONAL_STEPS = (
    "albedo.shadows",
    "albedo.lamp_size",
    "albedo.cameras",
    "albedo.specular",
    "albedo.near_light",
    "albedo.roughness",
    "albedo.occlusion",
    "albedo.bounce",
    "albedo.environment",
    "albedo.light_colour",
    "albedo.outlines",
    "albedo.rectification",
    "albedo.inpainting",
)
"""Steps that the evidence decides on, unless `EstimateOptions.skip` or `force` names them: cast shadows, the
lamps' angular radius, the cameras that each texel is seen from, Phong's highlight, a finite distance common
to all lights, Oren-Nayar's sigma (or Minnaert's exponent), occlusion of ambient light, one bounce of light
off the surface, an environment in spherical harmonics, colours of the light's parts, softening of outlines
that the texture does not show, repair of the albedo along shadow outlines, repair of saturated texels."""

OBJECTIVES = ("residual", "albedo-deviation")


@dataclass(frozen=True)
class EstimateOptions:
    """Settings of `estimate_albedo`."""

    objective: str = "residual"
    """"residual": what lit block albedos leave of the image, by least squares; "albedo-deviation": the search
    of Toderici et al., section 3.2, which anneals the deviation of the albedo from its block means, and knows
    neither soft, bounced nor coloured light."""
    sizes: tuple[int, int, int] = (32, 64, 128)
    """Longer sides, in cells, of the images that compare starts, choose the model, refine it. Cells of the
    third say what the surface hides of soft light."""
    start_directions: int = 60
    """Light directions of which least squares tries a step."""
    starts: int = 3
    """Distinct starts that are followed (twice as many for one more light)."""
    descent_iterations: int = 12
    """Evaluations of one descent."""
    maximal_lights: int = 3
    """Most lamps that `lights="auto"` tries; it may find none."""
    shadow_offset_mm: float = 0.2
    """Shadow rays start this far along the normal."""
    saturation_linear: float = 0.995
    """Texels at or above this value are clipped: no weight, and candidates for inpainting."""
    minimal_texels: int = 64
    """Fewer usable texels than this are an error."""
    shrink: bool = True
    """Filter white noise of the albedo; False keeps the plain quotient."""
    skip: tuple[str, ...] = ()
    """Names of `OPTIONAL_STEPS` to leave out."""
    force: tuple[str, ...] = ()
    """Names of `OPTIONAL_STEPS` to do whatever the evidence says."""

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective is {self.objective!r}, expected one of {', '.join(OBJECTIVES)}")
        if not 1 <= self.maximal_lights <= 4:
            raise ValueError(f"maximal_lights is {self.maximal_lights}, expected 1 to 4")
        if len(self.sizes) != 3:
            raise ValueError(f"sizes is {self.sizes}, expected three numbers of cells")
        counts = ("start_directions", "starts", "descent_iterations", "minimal_texels")
        for name, value in [
            *((name, getattr(self, name)) for name in counts),
            *(("sizes", size) for size in self.sizes),
        ]:
            if value < 1:
                raise ValueError(f"{name} is {value}, expected 1 or more")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name} is {value}, expected a finite number, 0 or more")
        for name in (*self.skip, *self.force):
            if name not in OPTIONAL_STEPS:
                raise ValueError(f"{name!r} is no optional step; these are {', '.join(OPTIONAL_STEPS)}")
        if both := set(self.skip) & set(self.force):
            raise ValueError(f"{min(both)!r} is in skip and in force: choose one")

    def choice(self, step: str) -> bool | None:
        """Return True where `step` is forced, False where it is skipped, None where the evidence decides."""
        if step in self.skip:
            return False
        return True if step in self.force else None
