"""Settings of the albedo stage."""

from dataclasses import dataclass

from scan2albedo.core.arrays import Texts

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
    "albedo.inpainting",
)
"""Steps that priors and evidence decide on, unless `EstimateOptions.skip` or `force` names them: cast
shadows, the lamps' angular radius, the cameras that each texel is seen from, Phong's highlight, a finite
distance common to all lights, Oren-Nayar's sigma (or Minnaert's exponent), occlusion of ambient light, one
bounce of light off the surface, an environment in spherical harmonics, colours of the light's parts, repair
of saturated texels. Parts of the light that are not skipped are always in the model, as far as their priors
allow."""

MINIMAL_TEXELS = 64
"""Fewer usable texels are an error."""
SATURATION_LINEAR = 0.995
"""Texels at or above this value are clipped."""
OBJECTIVES = ("residual", "albedo-deviation")


@dataclass(frozen=True)
class EstimateOptions:
    """Settings of `estimate_albedo`."""

    objective: str = "residual"
    """"residual": the posterior of light and albedo; "albedo-deviation": the search of Toderici et al.,
    section 3.2, which knows neither soft, bounced nor coloured light."""
    sizes: tuple[int, ...] = ()
    """Longer sides, in cells, of three images: where starts are compared, the model is chosen, and the light
    is refined. Cells of the third say what the surface hides of soft light. When empty, the objective's."""
    prior: str = "auto"
    """Of albedo: "auto" is that of faces where the image has a `face_chart`, else a stationary one;
    "stationary"; or a file that `AlbedoPrior.save` wrote."""
    maximal_lights: int = 3
    """Most lamps that `lights="auto"` tries; it may find none."""
    skip: Texts = ()
    """Names of `OPTIONAL_STEPS` to leave out."""
    force: Texts = ()
    """Names of `OPTIONAL_STEPS` to do whatever the evidence says."""

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective is {self.objective!r}, expected one of {', '.join(OBJECTIVES)}")
        if not self.sizes:
            paper = self.objective == "albedo-deviation"
            object.__setattr__(self, "sizes", (32, 64, 128) if paper else (22, 32, 86))
        if not 1 <= self.maximal_lights <= 4:
            raise ValueError(f"maximal_lights is {self.maximal_lights}, expected 1 to 4")
        if len(self.sizes) != 3 or min(self.sizes) < 1:
            raise ValueError(f"sizes is {self.sizes}, expected three numbers of cells, 1 or more each")
        for name in (*self.skip, *self.force):
            if name not in OPTIONAL_STEPS:
                raise ValueError(f"{name!r} is not an optional step; these are {', '.join(OPTIONAL_STEPS)}")
        if both := set(self.skip) & set(self.force):
            raise ValueError(f"{min(both)!r} is in skip and in force: choose one")

    def choice(self, step: str) -> bool | None:
        """Return True where `step` is forced, False where it is skipped, None where the evidence decides."""
        if step in self.skip:
            return False
        return True if step in self.force else None
