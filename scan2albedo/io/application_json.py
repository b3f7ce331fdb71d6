"""`application.json`: what a folder that an application wrote holds, beside images and mesh."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.io.result_json import Figures, LightRecord, Record

APPLICATION_FILE = "application.json"


class ApplicationRecord(Record):
    """The content of `application.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    name: str = Field(min_length=1, description="Name of the face that came of it.")
    application: str = Field(description="swap, blend or transfer-expression.")
    inputs: tuple[str, ...] = Field(description="Names of the faces it was made from, in order.")
    options: Figures = Field(description="What the application was called with.")
    model: str = Field(description="Name of the face model whose chart this is.")
    chart_mesh: bool = Field(
        description="The surface is the geometry image's texels; there is no other mesh."
    )
    casts_shadows: bool
    view_direction: tuple[float, float, float] = Field(description="Unit, toward the viewer.")
    shadow_offset_mm: float = Field(ge=0)
    reflectance: Figures = Field(description="Under the names that result.json has for its parameters.")
    lights: tuple[LightRecord, ...] = ()
    files: tuple[str, ...] = Field((), description="Names of the files beside this one.")
