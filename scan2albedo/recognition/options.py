"""Options of templates and of their comparison; their defaults hold everywhere that persons are compared."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Literal, get_args

Channel = Literal["value", "luminance", "red-to-green"]


@dataclass(frozen=True, kw_only=True)
class TemplateOptions:
    """How an image becomes a template.

    Raises `ValueError` when a value is outside its range.
    """

    size: int | None = 256
    """Longest side in pixels to which larger images are averaged down; smaller ones stay as they are, and
    with None all do."""
    scales: int = 3
    """Scales of the pyramid; the coarsest, a factor of 2^(scales - 1) smaller than the image, is kept."""
    orientations: int = 10
    """Orientations of the pyramid, 2 to 16."""
    channel: Channel = "luminance"
    """How three channels become one: their maximum, V of HSV, on which the albedo is estimated; the luminance
    0.2126 R + 0.7152 G + 0.0722 B of linear colour; or R over G, which does not change with shading under
    lamps of one colour, in textures as well as in albedos. V of skin is its red, which pigment and blood
    hardly darken; luminance separates persons better (`tools/bench_recognition.py --faces`), and R over G
    better still on synthetic people (`tools/experiment_recognition.py`), for cameras that record colour as
    accurately as brightness."""
    hole_radius: float = 0.024
    """Holes of the mask up to this radius, in sides of the image, are filled from around and count; otherwise
    a hole that a scanner left would exclude every window that touches it. 0 fills none."""
    unit_mean: bool = True
    """Divide by the mean over the mask: an albedo is known up to a scale, and the index depends on it."""

    def __post_init__(self) -> None:
        for name in ("scales", "orientations", "size"):
            value = getattr(self, name)
            if not (isinstance(value, Integral) or (name == "size" and value is None)):
                raise ValueError(f"{name} is {value!r}, expected a whole number")
        if self.scales < 1:
            raise ValueError(f"scales is {self.scales}, expected >= 1")
        if not 2 <= self.orientations <= 16:
            raise ValueError(f"orientations is {self.orientations}, expected 2 to 16")
        if self.channel not in get_args(Channel):
            raise ValueError(f"channel is {self.channel!r}, expected one of {', '.join(get_args(Channel))}")
        if not 0 <= self.hole_radius < 0.5:
            raise ValueError(f"hole_radius is {self.hole_radius}, expected within [0, 0.5)")
        if self.size is not None and self.size < 1:
            raise ValueError(f"size is {self.size}, expected >= 1 or None")

    @property
    def step(self) -> int:
        """Pixels of the image between coefficients of the coarsest scale."""
        return 2 ** (self.scales - 1)


@dataclass(frozen=True, kw_only=True)
class SimilarityOptions:
    """How templates are compared.

    Raises `ValueError` when a value is outside its range.
    """

    window: int = 3
    """Side of the square windows in coefficients. Charts of fitted faces are misaligned unevenly, and within
    a small window the phases still turn alike: 3 tells people who are alike apart better than the usual 7
    (`tools/experiment_recognition.py --other-templates`)."""

    def __post_init__(self) -> None:
        if not (isinstance(self.window, Integral) and self.window >= 1):
            raise ValueError(f"window is {self.window}, expected a whole number >= 1")
