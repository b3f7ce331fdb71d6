"""`AlbedoEstimate`: the unlit texture, the light that was removed, how it was found; an albedo's error."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.albedo.uncertainty import LightUncertainty
from scan2albedo.core import EnvironmentLight, GeometryImage, Plan, PointLight, Trace
from scan2albedo.core.arrays import ArrayLike, Float32Array, all_finite, on_grid
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.environment_light import environment_light_on
from scan2albedo.lighting.shading import Reflectance, Shading, shade_points
from scan2albedo.lighting.shadow_map import ShadowMap


@dataclass(frozen=True)
class AlbedoEstimate:
    """Result of `estimate_albedo`; images are zero outside the mask."""

    albedo_linear: Float32Array
    """(H, W, 3): up to one global scale, which no image determines: ambient light is 1."""
    lights: tuple[PointLight, ...]
    """Lamps, strongest first; empty where soft light explains the image, and for spherical harmonics."""
    parameters: dict[str, object]
    """ambient (1), brdf, sigma_rad or minnaert_exponent, specular_strength, specular_exponent,
    light_distance_mm (None for distant lights); for spherical harmonics sh_coefficients (9 rows of 3)."""
    shading: Float32Array
    """(H, W, 3): I of each channel (lamps, soft and bounced light), which divided the texture."""
    specular: Float32Array
    """(H, W): mean I_s, which was subtracted from the texture in the lamps' colours."""
    shadow: Float32Array
    """(H, W): visibility in [0, 1], the smallest over the lights."""
    confidence: Float32Array
    """(H, W): in [0, 1], how much of the texel's albedo is its own measurement."""
    plan: Plan
    """What ran and what was left out, and why."""
    trace: Trace
    """Error against run time."""
    converged: bool
    """False when the budget ended the search."""
    iterations: int
    """Evaluations of the objective."""
    residual: float
    """The final value of what the trace records: the perplexity of a cell, or the paper's deviation."""
    image: GeometryImage
    """The image estimated from."""
    view_direction: tuple[float, float, float]
    """Unit vector toward the viewer, from which `relit` shows highlights; `specular` is as cameras saw it."""
    reflectance: Reflectance
    """How the surface reflects."""
    casts_shadows: bool
    """Whether shadow rays were used."""
    shadow_offset_mm: float = ShadowMap.offset_mm
    """Of the shadow rays."""
    uncertainty: LightUncertainty | None = None
    """How sure the light is; None for spherical harmonics, the paper's search, and where the budget ended."""
    albedo_deviation: Float32Array | None = None
    """(H, W): relative standard deviation of the albedo that follows from it, best scale removed."""
    environment: EnvironmentLight | None = None
    """The soft light; None is the constant white ambient light of 1."""
    expected_error: Float32Array | None = None
    """(H, W): relative error of the albedo that two texels in three stay below, best scale removed; 1 where
    nothing was measured (`uncertainty.expected_error`)."""

    def relit(
        self, lights: Sequence[PointLight], environment: EnvironmentLight | None = None
    ) -> Float32Array:
        """Return (H, W, 3) the linear texture under other lights in their colours, with shadows.

        T = A (I_a + I_d) + I_s with the estimated reflectance, highlights in the colours of their lamps.
        I_a is 1 without an environment, whose `bounce` is light that the surface throws onto itself; give the
        estimate's own for the light of the scan. One viewer sees all, whatever cameras took the texture.
        """
        mask, caster = self.image.mask, None
        if self.casts_shadows and (lights or environment):
            caster = RayCaster(*self.image.occluder_mesh())
        seen = self.reflectance, self.view_direction, caster, self.shadow_offset_mm
        shading = shade_image(self.image, lights, *seen, environment)
        albedo = self.albedo_linear[mask].astype(float)
        return on_grid(mask, (albedo * shading.light_linear + shading.specular_linear).astype(np.float32))


def shade_image(
    image: GeometryImage,
    lights: Sequence[PointLight],
    reflectance: Reflectance,
    view_direction: ArrayLike,
    caster: RayCaster | None,
    offset_mm: float,
    environment: EnvironmentLight | None = None,
) -> Shading:
    """Shade the masked texels with shadows of `caster` (None: attached shadows alone).

    `view_direction` is one for all, (3,), or one a texel, (N, 3). The environment stands for the ambient
    light of 1.
    """
    mask, scale = image.mask, image.specular_scale
    hidden = ShadowMap(caster, image.position[mask], image.normal[mask], offset_mm)
    seen = [hidden.reached(lamp.direction, lamp.distance_mm, lamp.radius_deg) for lamp in lights]
    shading = shade_points(
        hidden.position,
        hidden.normal,
        lights,
        reflectance,
        visible=np.array(seen).reshape(len(lights), len(hidden.position)),
        view_direction=view_direction,
        specular_scale=None if scale is None else scale[mask],
    )
    if environment is not None:
        soft = environment_light_on(environment, hidden, shading.light_linear - 1)
        shading = replace(shading, light=soft.mean(-1), light_linear=soft)
    return shading


@dataclass(frozen=True)
class AlbedoError:
    """`mse_percent` = 100 mean((a A - A_true)^2), `relative_rmse` = ||a A - A_true|| / ||A_true||."""

    mse_percent: float
    relative_rmse: float


def albedo_error(estimate: ArrayLike, truth: ArrayLike, mask: ArrayLike) -> AlbedoError:
    """Return the error of an albedo with the single best global scale a.

    a = sum(A A_true) / sum(A^2): light strength and albedo cannot be separated. ValueError for shapes that
    disagree, an empty mask, or values that are not finite inside it.

    Parameters
    ----------
    estimate, truth, mask : array_like
        Linear albedo, (H, W, C) or (H, W) of float; and the texels compared, (H, W) of bool.

    >>> albedo_error([[0.2, 0.4]], [[0.1, 0.2]], [[True, True]]).mse_percent
    0.0
    """
    ours, true, chosen = np.asarray(estimate, float), np.asarray(truth, float), np.asarray(mask, bool)
    if ours.shape != true.shape or ours.shape[: chosen.ndim] != chosen.shape or not chosen.any():
        shapes = f"estimate {ours.shape}, truth {true.shape} and mask {chosen.shape}"
        raise ValueError(f"{shapes} ({chosen.sum()} texels) must agree and not be empty")
    ours, true = ours[chosen], true[chosen]
    if not (all_finite(ours) and all_finite(true)):
        raise ValueError("estimate or truth holds NaN or infinite values inside the mask")
    square = float(np.sum(ours * ours))
    difference = (float(np.sum(ours * true)) / square if square > 0 else 0.0) * ours - true
    norm, rmse = (float(np.sqrt(np.sum(values**2))) for values in (true, difference))
    return AlbedoError(100 * float(np.mean(difference**2)), rmse / norm if norm > 0 else float(rmse > 0))
