"""`identification.json`: who probes were taken for, and how often that was right."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from scan2albedo.io.result_json import Figures, Number, OptionalNumber, Record

IDENTIFICATION_FILE = "identification.json"
Interval = tuple[Number, Number]


class ProbeRecord(Record):
    """One probe."""

    probe: str = Field(description="The result, as the file of probes names it.")
    person: str | None = Field(description="Who it shows; null where nobody knows.")
    predicted: str = Field(description="The most similar person of the gallery.")
    similarity: Number = Field(description="Of that person, 0 to 1.")
    rank: int | None = Field(ge=1, description="Place of the right person; null where nobody knows.")
    next_person: str | None = Field(description="The second; null in a gallery of one person.")
    next_similarity: OptionalNumber


class RatesRecord(Record):
    """Of the probes whose person is known."""

    probes: int = Field(ge=1)
    confidence: float = Field(gt=0, lt=1, description="Of the intervals.")
    rank_1_rate: Number = Field(ge=0, le=1)
    rank_1_interval: Interval = Field(description="Clopper and Pearson's.")
    equal_error_rate: OptionalNumber = Field(
        description="Of claims to be a person; null where nobody could be an impostor."
    )
    equal_error_interval: Interval | None = Field(description="By a bootstrap over persons.")


class IdentificationRecord(Record):
    """The content of `identification.json`."""

    format_version: Literal[1] = 1
    scan2albedo_version: str
    gallery: str = Field(description="The file that names it, as given.")
    probes: str = Field(description="The file that names them, as given.")
    gallery_images: int = Field(ge=1)
    persons: tuple[str, ...] = Field(min_length=1, description="Of the gallery.")
    combine: Literal["best", "mean"] = Field(description="What is taken of a person's several images.")
    template_options: Figures
    model: str | None = Field(description="Name of the face model on whose chart the albedos lie.")
    rates: RatesRecord | None = Field(description="Null when no probe's person is known.")
    results: tuple[ProbeRecord, ...] = Field(min_length=1, description="In the order of the probes.")
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = Field((), description="Names of the files beside this one.")
