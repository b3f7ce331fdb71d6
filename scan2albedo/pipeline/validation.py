"""The paper's validation, computed again on synthetic scenes: the tables behind `scan2albedo validate`."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from scan2albedo.albedo import albedo_error, estimate_albedo
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import NDArray, Values
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at, with_normal_error

PAPER_MSE_PERCENT = {"hemisphere": 1.07, "face": 2.01}
"""The paper's albedo MSE by scene."""
CAPTURE_NOISE = 0.005
REFLECTANCES = {
    "lambert": Material(sigma_rad=0.0),
    "oren-nayar + phong": Material(sigma_rad=0.3, specular_strength=0.1, specular_exponent=20.0),
}


@dataclass(frozen=True)
class ValidationRow:
    """Errors of one scene's estimate.

    `light_angle_deg` is the true azimuth of the one distant light; `texture` and `brdf` are unknown to the
    estimator. `input_mse_percent` is the error of the texture as it is, nothing removed, `mse_percent` and
    `relative_rmse` that of the albedo in linear RGB after the best single scale (`albedo_error`),
    `value_mse_percent` the same on V of HSV, the channel the paper works on. `light_error_deg` is between the
    true light and the strongest of `light_count` found; the true count is 1.
    """

    light_angle_deg: float
    texture: str
    brdf: str
    input_mse_percent: float
    mse_percent: float
    value_mse_percent: float
    relative_rmse: float
    light_error_deg: float
    light_count: int

    def text(self) -> str:
        """Return the row as a line of the table."""
        return (
            f"{self.brdf:<20}{self.texture:<9}{self.light_angle_deg:>5.0f}°{self.input_mse_percent:>9.3f}"
            f"{self.mse_percent:>10.4f}{self.value_mse_percent:>10.4f}{self.relative_rmse:>11.4f}"
            f"{self.light_error_deg:>10.2f}°"
        )


@dataclass(frozen=True)
class ValidationTable:
    """All scenes of one kind beside the paper's figure (percent MSE)."""

    scene: str
    rows: tuple[ValidationRow, ...]
    paper_mse_percent: float

    @property
    def worst_mse_percent(self) -> float:
        """Largest error of any row, in RGB or on V, whichever is worse."""
        return max(max(row.mse_percent, row.value_mse_percent) for row in self.rows)

    def figures(self) -> Values:
        """Return the table as plain numbers for JSON."""
        return {**asdict(self), "worst_mse_percent": self.worst_mse_percent}

    def text(self) -> str:
        """Return the table for a terminal, the paper's figure beside ours."""
        head = (
            f"{'reflectance':<20}{'texture':<9}{'light':>6}{'input':>9}{'albedo':>10}{'on V':>10}"
            f"{'rel. RMSE':>11}{'light off':>11}"
        )
        title = f"{self.scene}: albedo MSE in percent after the best single scale"
        worst = f"worst: {self.worst_mse_percent:.4f} %   the paper: {self.paper_mse_percent:.2f} %"
        return "\n".join([title, head, "-" * len(head), *(row.text() for row in self.rows), worst])


@dataclass(frozen=True)
class LightingRow:
    """One subject under several lights: mean standard deviation over the lights, percent of white."""

    seed: int | str
    texture_std_percent: float
    albedo_std_percent: float

    def text(self) -> str:
        """Return the row as a line of the table."""
        return f"{self.seed!s:<10}{self.texture_std_percent:>8.2f} %{self.albedo_std_percent:>8.2f} %"


@dataclass(frozen=True)
class LightingTable:
    """How much less an albedo depends on the light than the texture does, beside the paper's figures."""

    rows: tuple[LightingRow, ...]
    paper_texture_std_percent: float = 11.0
    paper_albedo_std_percent: float = 4.0

    @property
    def mean(self) -> LightingRow:
        """Mean over the subjects."""
        texture = float(np.mean([row.texture_std_percent for row in self.rows]))
        albedo = float(np.mean([row.albedo_std_percent for row in self.rows]))
        return LightingRow("mean", texture, albedo)

    def figures(self) -> Values:
        """Return the table as plain numbers for JSON."""
        mean = asdict(self.mean)
        del mean["seed"]
        return {**asdict(self), **mean}

    def text(self) -> str:
        """Return the table for a terminal, the paper's figures beside ours."""
        title = "lighting: mean standard deviation over three lights, percent of white"
        paper = LightingRow("the paper", self.paper_texture_std_percent, self.paper_albedo_std_percent)
        lines = [row.text() for row in (*self.rows, self.mean, paper)]
        return "\n".join([title, f"{'subject':<10}{'texture':>10}{'albedo':>10}", "-" * 30, *lines])


def validate_scenes(
    scene: str, *, size: int = 256, seed: int | None = None, on_row: Callable[[Any], None] | None = None
) -> ValidationTable:
    """Estimate the albedo of scenes of wood and skin under a light at 0, 30 and 60 degrees.

    `scene` is "hemisphere" or "face", cast shadows included; `size` the side of the geometry images in texels
    (the pictures have 8 bits), `seed` that of the textures or of the face; `on_row` is called with each row
    as it is done.
    """
    rows = []
    for brdf, material in REFLECTANCES.items():
        for texture in ("wood", "skin"):
            for angle in (0.0, 30.0, 60.0):
                made: Values = {"lights": [light_at(angle)], "texture": texture, "material": material}
                if scene == "face":
                    shown = face(1 if seed is None else seed, size=size, **made)
                else:
                    shown = hemisphere(size=size, seed=seed or 0, **made)
                rows.append(validation_row(shown, angle, brdf))
                if on_row is not None:
                    on_row(rows[-1])
    return ValidationTable(scene, tuple(rows), PAPER_MSE_PERCENT[scene])


def validation_row(scene: SyntheticScene, light_angle_deg: float, brdf: str) -> ValidationRow:
    """Estimate one scene's albedo and compare it with the truth over all texels of the surface."""
    estimate, mask = estimate_albedo(scene.image), scene.image.mask
    texture = scene.image.texture_linear
    assert texture is not None
    error = albedo_error(estimate.albedo_linear, scene.albedo_linear, mask)
    return ValidationRow(
        light_angle_deg,
        scene.texture,
        brdf,
        albedo_error(texture, scene.albedo_linear, mask).mse_percent,
        error.mse_percent,
        albedo_error(estimate.albedo_linear.max(-1), scene.albedo_linear.max(-1), mask).mse_percent,
        error.relative_rmse,
        angle_between_deg(estimate.lights, scene.lights[0]),
        len(estimate.lights),
    )


def angle_between_deg(found: Sequence[PointLight], true: PointLight) -> float:
    """Return the angle between the true light and the strongest found; 180 when none was found."""
    if not found:
        return 180.0
    strongest = max(found, key=lambda light: light.intensity)
    cross = np.linalg.norm(np.cross(strongest.direction, true.direction))
    return float(np.rad2deg(np.arctan2(cross, strongest.direction @ true.direction)))


def validate_lighting(
    *, size: int = 256, seed: int = 1, on_row: Callable[[Any], None] | None = None
) -> LightingTable:
    """Compare textures and albedos of the same faces under three different lights.

    The paper's test: a subject is lit from the left, from the right and from above; per texel the standard
    deviation over the three images, averaged over texels and channels. Every image is first scaled to the
    mean level of the textures, for neither exposure nor the albedo's scale can be known.

    The paper captured real subjects, so the geometry given to the estimator is imperfect here too: each
    capture's normals are tilted by 3 degrees rms of its own, and the pictures have 0.5 % noise and 8 bits.
    The two subjects have the seeds `seed` and `seed` + 1; `on_row` is called with each row as it is done.
    """
    rows = []
    for subject in (seed, seed + 1):
        rows.append(lighting_row(subject, size))
        if on_row is not None:
            on_row(rows[-1])
    return LightingTable(tuple(rows))


def lighting_row(seed: int, size: int) -> LightingRow:
    """Compare textures and albedos of one subject under the three lights."""
    material, rng = REFLECTANCES["oren-nayar + phong"], np.random.default_rng(seed)
    lights = (light_at(45, 10), light_at(-50, 0), light_at(10, 40, distance_mm=900.0))
    images = [face(seed, lights=[x], material=material, size=size, noise=CAPTURE_NOISE).image for x in lights]
    mask = images[0].mask
    textures = [image.texture_linear[mask] for image in images if image.texture_linear is not None]
    fitted = [with_normal_error(image, 3.0, rng) for image in images]
    albedos = [estimate_albedo(image).albedo_linear[mask] for image in fitted]
    level = float(np.mean(textures))
    return LightingRow(seed, mean_deviation_percent(textures, level), mean_deviation_percent(albedos, level))


def mean_deviation_percent(images: Sequence[NDArray], level: float) -> float:
    """Return 100 times the mean over texels of the standard deviation over images scaled to mean `level`."""
    scaled = np.stack([level / np.mean(image) * np.asarray(image, float) for image in images])
    return float(100 * scaled.std(axis=0).mean())
