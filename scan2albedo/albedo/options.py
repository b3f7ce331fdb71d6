"""Settings of the albedo stage."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class EstimateOptions:
    """Settings of `estimate_albedo`."""

    objective: str = "residual"
    """"residual": what lit block albedos leave of the image; "albedo-deviation": the paper's own, the
    deviation of the albedo from its block means."""
    refiner: str = "auto"
    """"auto": damped least squares from several starts (the paper's objective: annealing where the polished
    starts disagree); "annealing": simulated annealing always; "nelder-mead": the same without annealing."""
    sizes: tuple[int, int] = (64, 128)
    """Longer sides, in cells, of the images searched and polished."""
    grid_size: int = 32
    """Longer side, in cells, of the image on which the direction grid is evaluated."""
    block_area: float = 0.125
    """Area of one block of the objective as a fraction of the chart's; blocks have to be larger than the
    texture's grain."""
    fit_block_area: float = 0.06
    """The same for least squares, which divides out what colour tells of the texture."""
    start_directions: int = 60
    """Light directions of which least squares tries a step."""
    descent_iterations: int = 12
    """Evaluations of one descent by least squares."""
    final_iterations: int = 8
    """Evaluations of its last one, on the largest image."""
    closer_look: float = 0.5
    """One more light is tried on a larger image when it removes this part of `light_gain` on the smallest."""
    specular_effect: float = 0.004
    """Root mean square share of the image that a highlight has to have."""
    specular_deviations: float = 4.0
    """Standard deviations by which its strength has to differ from 0; `specular_gain` serves as well."""
    specular_likely: float = 2.4
    """Standard deviations that serve where it removes `specular_likely_gain` of the cost."""
    specular_likely_gain: float = 0.02
    """Part of the cost beside which `specular_likely` serves."""
    specular_certain: float = 12.0
    """Standard deviations beyond which it may even add `specular_loss` to the cost."""
    specular_loss: float = 0.03
    """Part of the cost that it may then add: it takes colour away from the texture's guide."""
    specular_beyond: float = 0.02
    """Part of the cells on which it may exceed the darkest channel: it is white."""
    distance_effect: float = 0.014
    """Root mean square change of the albedo that a finite distance of the lights has to make."""
    distance_deviations: float = 8.0
    """Standard deviations by which it has to differ from infinity; `distance_gain` serves as well."""
    roughness_effect: float = 0.008
    """Root mean square change of the albedo that roughness has to make."""
    roughness_deviations: float = 3.0
    """Standard deviations by which it has to differ from none."""
    grid_directions: int = 80
    """Light directions of the first search and of the visibility table."""
    cone_rad: float = 1.92
    """Half angle around the view direction in which lights are sought."""
    grid_strengths: tuple[float, ...] = (0.5, 2.0, 6.0)
    """Light intensities, relative to ambient, of the first search."""
    starts: int = 3
    """Distinct directions of the first search that are polished (twice as many for two lights)."""
    start_separation_rad: float = 0.4
    """Two starts closer than this are one."""
    polish_evaluations: int = 160
    """Evaluations of one polish; one light."""
    annealing_evaluations: int = 1500
    """Evaluations of simulated annealing, where it runs."""
    maximal_lights: int = 3
    """Most lights that `lights="auto"` tries."""
    light_gain: float = 0.025
    """Part of the cost that one more light has to remove."""
    light_effect: float = 0.02
    """Root mean square change of the albedo that one more light has to make."""
    light_share: float = 0.1
    """Intensity that every light has to have, as a part of the strongest one's."""
    light_angle_rad: float = 0.26
    """Angle between two lights below which they count as one."""
    light_direction_rad: float = 0.12
    """Standard deviation that the direction of one more light may have; least squares asks for it."""
    distance_gain: float = 0.04
    """Part of the cost that a finite distance of the lights has to remove."""
    roughness_gain: float = 0.04
    """Part of the cost that roughness has to remove."""
    specular_gain: float = 0.05
    """Part of the cost that a highlight has to remove."""
    shadow_fraction: float = 0.01
    """Part of the texels facing some light that has to lie in cast shadow for shadow rays to be used."""
    shadow_offset_mm: float = 0.2
    """Shadow rays start this far along the normal."""
    saturation_linear: float = 0.995
    """Texels at or above this value are clipped: no weight, and candidates for inpainting."""
    minimal_texels: int = 64
    """Fewer usable texels than this are an error."""
    shrink: bool = True
    """Draw the albedo of badly lit texels toward their neighbourhood instead of amplifying noise."""
    shadows: bool | None = None
    """Cast shadows: True and False force, None lets the evidence decide; so for the following."""
    near_light: bool | None = None
    """A finite distance of the lights, common to all."""
    roughness: bool | None = None
    """Oren-Nayar's sigma, or Minnaert's exponent."""
    specular: bool | None = None
    """Phong's highlight."""
    rectification: bool | None = None
    """Repair of the albedo along shadow outlines."""
    inpainting: bool | None = None
    """Repair of saturated texels: channels told by surviving ones, texture resynthesised where none did and
    the annotation permits."""

    def __post_init__(self) -> None:
        if self.objective not in ("residual", "albedo-deviation"):
            raise ValueError(f"objective is {self.objective!r}, expected 'residual' or 'albedo-deviation'")
        if self.refiner not in ("auto", "annealing", "nelder-mead"):
            raise ValueError(f"refiner is {self.refiner!r}, expected 'auto', 'annealing' or 'nelder-mead'")
        if not 1 <= self.maximal_lights <= 4:
            raise ValueError(f"maximal_lights is {self.maximal_lights}, expected 1 to 4")
        counts = ["grid_size", "start_directions", "grid_directions", "starts", "minimal_texels"]
        counts += ["descent_iterations", "final_iterations", "polish_evaluations", "annealing_evaluations"]
        for name, value in [(name, getattr(self, name)) for name in counts] + [
            ("sizes", size) for size in self.sizes
        ]:
            if value < 1:
                raise ValueError(f"{name} is {value}, expected 1 or more")
        for name in ("block_area", "fit_block_area"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a part of the chart: 0 to 1")
        if not 0 < self.cone_rad <= math.pi:
            raise ValueError(f"cone_rad is {self.cone_rad}, expected above 0, up to pi")
        if not (self.grid_strengths and all(0 < strength < math.inf for strength in self.grid_strengths)):
            raise ValueError(f"grid_strengths is {self.grid_strengths}, expected numbers above 0")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name} is {value}, expected a finite number, 0 or more")
