"""Records of processed faces: `result.json`, `registration.json` and `application.json`."""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PlainSerializer, PlainValidator

from scan2albedo.core import EnvironmentLight, PlanStep, PointLight, RawScan
from scan2albedo.core.arrays import Texts, Values
from scan2albedo.io.input_hash import input_sha256
from scan2albedo.io.records import (
    CalledWith,
    Count,
    Figures,
    Matrix,
    Name,
    NonNegative,
    Number,
    OptionalNumber,
    OwnFileNames,
    Positive,
    PositiveCount,
    Record,
    Share,
)

APPLICATION_FILE = "application.json"
RESULT_FILE = "result.json"
SHA256 = "^[0-9a-f]{64}$"


class InputRecord(Record):
    """The scan a result was made from."""

    file: str | None = Field(None, description="Path as given; null when the scan came from memory.")
    sha256: str = Field(pattern=SHA256, description="Of the scan and what it refers to; see input_sha256.")
    vertices: PositiveCount = Field(description="After repairs.")
    faces: PositiveCount = Field(description="After repairs.")
    texture_size: tuple[int, int] | None = Field(None, description="Width and height in texels.")

    @classmethod
    def of(cls, scan: RawScan, file: Path | None, sha256: str | None) -> Self:
        """Return the record of a scan that was read from `file` of this hash; without one, of its arrays."""
        texture = scan.texture_linear
        return cls(
            file=None if file is None else str(file),
            sha256=sha256 or input_sha256(scan),
            vertices=len(scan.vertices),
            faces=len(scan.faces),
            texture_size=None if texture is None else (texture.shape[1], texture.shape[0]),
        )


class LightRecord(Record):
    """One light in the model's frame, as records hold a `PointLight`."""

    azimuth_deg: Number = Field(description="From +z toward +x.")
    elevation_deg: Number = Field(description="From the xz-plane toward +y.")
    distance_mm: OptionalNumber = Field(None, description="From the model's origin; null is a distant light.")
    intensity: NonNegative = Field(description="Irradiance relative to ambient = 1, mean of the channels.")
    color_linear: tuple[Number, Number, Number] = Field(
        (1.0, 1.0, 1.0), description="Red, green, blue of its light, of mean 1."
    )
    radius_deg: Number = Field(0.0, ge=0, lt=90, description="Angular radius from the face; 0 is a point.")


class EnvironmentRecord(Record):
    """The soft light, in spherical harmonics, as records hold an `EnvironmentLight`."""

    coefficients: tuple[tuple[Number, Number, Number], ...] = Field(
        min_length=9,
        max_length=9,
        description="Of the radiance sum c_k Y_k / Y_0, a row a harmonic, a column a channel; a constant "
        "white light of 1 is 1, 1, 1 and then zeros.",
    )
    occluded: bool = Field(description="Whether the surface hides part of it from itself.")
    fill: Share = Field(0.0, description="Part of the hidden constant light that comes back.")
    bounce: NonNegative = Field(0.0, description="Albedo of the surface that throws light onto itself.")


def _read_light(value: Any) -> PointLight:
    if isinstance(value, PointLight):
        return value
    light = LightRecord.model_validate(value)
    azimuth_rad, elevation_rad = math.radians(light.azimuth_deg), math.radians(light.elevation_deg)
    distance_mm = math.inf if light.distance_mm is None else light.distance_mm
    looks = (light.intensity, light.color_linear, light.radius_deg)
    return PointLight(azimuth_rad, elevation_rad, distance_mm, *looks)


Light = Annotated[
    PointLight,
    PlainValidator(_read_light),
    PlainSerializer(
        lambda light: LightRecord(
            azimuth_deg=math.degrees(light.azimuth_rad),
            elevation_deg=math.degrees(light.elevation_rad),
            **{name: getattr(light, name) for name in LightRecord.model_fields if hasattr(light, name)},
        ),
        return_type=LightRecord,
    ),
]
Environment = Annotated[
    EnvironmentLight,
    PlainValidator(
        lambda value: (
            value
            if isinstance(value, EnvironmentLight)
            else EnvironmentLight(**dict(EnvironmentRecord.model_validate(value)))
        )
    ),
    PlainSerializer(
        lambda light: EnvironmentRecord(**vars(light) | {"coefficients": light.coefficients.tolist()}),
        return_type=EnvironmentRecord,
    ),
]


class RunRecord(Record):
    """What the record of a run begins with."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    versions: dict[str, str] = Field(description="Of Python and the numerical libraries.")


class ResultRecord(RunRecord):
    """The content of `result.json`."""

    name: Name = Field(description="Name of the scan.")
    seed: int
    options: CalledWith
    input: InputRecord
    plan: tuple[PlanStep, ...]
    metrics: Figures = Field(description="Figures of each stage; null is not finite or not measured.")
    lights: tuple[Light, ...] = ()
    environment: Environment | None = Field(
        None, description="The soft light beside the lamps; null is a constant white ambient light of 1."
    )
    parameters: Figures = Field(description="Of the reflectance model; null is infinite, as a distance.")
    timings_s: dict[str, Number] = Field(description="Wall-clock seconds of each stage.")
    notes: Texts = Field((), description="What loading repaired, and warnings of the stages.")
    template_from_model: Matrix | None = Field(
        None,
        description="Row-major 4x4 acting on column vectors: points of template.obj into the axes, origin "
        "and unit of the template's own file.",
    )
    files: OwnFileNames = ()


class RegistrationRecord(Record):
    """The content of `registration.json`."""

    format_version: Literal[1] = 1
    model_from_scan: Matrix = Field(
        description="Row-major 4x4 acting on column vectors: scan points in mm into the model's frame, which "
        "is that of fitted.glb; the pose with which the fit ended."
    )
    fitted_from_scan: Matrix | None = Field(
        None, description="The same pose, under the name it had beside that of the search."
    )
    rmse_mm: Number = Field(
        ge=0, description="Root mean square distance of the rigid model to the scan at model_from_scan."
    )
    depth_error: OptionalNumber = Field(
        None, description="Depth-derivative objective at the pose of the search; null when not measured."
    )
    converged: bool
    confidence: Share
    iterations: Count


Vector = tuple[Number, Number, Number]


class LinearModelRecord(Record):
    """The content of `coefficients.json`; deviations are standard deviations of the posterior."""

    format_version: Literal[1] = 1
    model: str = Field(description="Name of the linear model's file without its ending.")
    model_sha256: str = Field(pattern=SHA256)
    shape: tuple[Number, ...] = Field(description="Coefficients of identity, in standard deviations.")
    shape_deviation: tuple[Number, ...]
    expression: tuple[Number, ...] = Field(description="The same of expression.")
    expression_deviation: tuple[Number, ...]
    blendshapes: dict[str, Number] = Field(
        description="Weights from 0 to 1 of the model's named expressions, ARKit's names where it has them."
    )
    joint_rotations_rad: dict[str, Vector] = Field(description="Axis times angle; joints not fitted are 0.")
    joint_deviations_rad: dict[str, Vector] = Field(description="Of the joints that were fitted.")
    joint_positions: dict[str, Vector] = Field(description="At rest, in the model's own frame and unit.")
    scan_from_model: Matrix = Field(
        description="Row-major 4x4 with the scale acting on column vectors: points in the model's own frame "
        "and unit, posed by its joints, into the frame and unit of the scan's file."
    )
    mm_per_unit: Positive = Field(description="Of the model's unit, decided from its size.")
    scale: Positive = Field(description="Of the posed model in mm to the scan.")
    pose_deviation: tuple[Number, ...] = Field(description="Of a turn [rad], a shift [mm], the log scale.")
    noise_mm: Number = Field(description="Scale of the distances between scan and model.")
    observations: Number = Field(description="Independent observations that these count as.")
    residual_mean_mm: Number
    converged: bool


class ApplicationRecord(Record):
    """The content of `application.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    name: Name = Field(description="Name of the face that came of it.")
    application: str = Field(description="swap, blend or transfer-expression.")
    inputs: Texts = Field(description="Names of the faces it was made from, in order.")
    options: Figures = Field(description="What the application was called with.")
    model: str = Field(description="Name of the face model whose chart this is.")
    chart_mesh: bool = Field(description="The surface is the geometry image's texels: there is no mesh.")
    casts_shadows: bool
    view_direction: tuple[float, float, float] = Field(description="Unit, toward the viewer.")
    shadow_offset_mm: float = Field(ge=0)
    reflectance: Figures = Field(
        description="Under the names that result.json has for its parameters; empty for a shape alone."
    )
    lights: tuple[Light, ...] = ()
    environment: Environment | None = Field(None, description="As in result.json.")
    landmarks: tuple[tuple[Number, Number, Number], ...] | None = Field(
        None, description="68 in iBUG order, in mm, where they are known."
    )
    notes: Texts = Field((), description="What was decided in making it, one sentence each.")
    files: OwnFileNames = ()


def flat_figures(figures: Mapping[str, Any], prefix: str) -> Values:
    """Return the leaves of nested figures by their names joined with "_"; of a list of numbers its greatest.

    >>> flat_figures({"fit": {"residual_mean_mm": 0.1, "deviations": [1, 2], "kind": "soft"}}, "metrics")
    {'metrics_fit_residual_mean_mm': 0.1, 'metrics_fit_deviations': 2, 'metrics_fit_kind': 'soft'}
    """
    leaves: Values = {}
    for key, value in figures.items():
        name = f"{prefix}_{column_name(key)}"
        if isinstance(value, Mapping):
            leaves |= flat_figures(value, name)
        elif not isinstance(value, list | tuple):
            leaves[name] = value
        elif numbers := [entry for entry in value if isinstance(entry, int | float)]:
            leaves[name] = max(numbers)
    return leaves


def metric_columns(metrics: Mapping[str, Any]) -> dict[str, float | bool]:
    """Return the metrics of a result as columns of a table of scans: its numbers and truths."""
    leaves = flat_figures(metrics, "metrics")
    return {name: value for name, value in leaves.items() if isinstance(value, bool | int | float)}


def column_name(name: str) -> str:
    """Return a name with "_" for what is neither a letter nor a digit."""
    return re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_")
