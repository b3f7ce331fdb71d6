"""What a lens is made of, and settings of the pictures it is put into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.lenses.lens_shading import blend_lens


@dataclass(frozen=True)
class LensMaterial:
    """A lens's power, tint and reflection; the default is clear window glass.

    Raises
    ------
    EyeglassesError
        When a number is out of range or not finite.

    Examples
    --------
    >>> shortsighted = LensMaterial(dioptres=-4.0, beta=0.04, fresnel=True)
    >>> sunglasses = LensMaterial(tint_linear=(0.1, 0.07, 0.03), alpha=0.85, tinting="filter")
    """

    dioptres: float = 0.0
    """1/m, the optician's sign: negative for the shortsighted, 0 is plane."""
    tint_linear: ArrayLike = (0.0, 0.0, 0.0)
    """(3,) linear colour of the glass."""
    alpha: float = 0.0
    """Share of the tint."""
    beta: float = 0.0
    """Share of the reflection; with `fresnel`, at right angles. alpha + beta is at most 1."""
    front_radius_mm: float = 130.0
    """Of the sphere that mirrors; 130 mm is a usual front of 4 D, infinity a flat one."""
    fresnel: bool = False
    """Whether the reflection grows towards glancing angles (Schlick), at the cost of all other shares."""
    tinting: Literal["paint", "filter"] = "paint"
    """`paint` adds the tint as a matte colour, the paper's way; `filter` multiplies what lies behind with it,
    as dyed glass does."""

    def __post_init__(self) -> None:
        tint = np.asarray(self.tint_linear, np.float64)
        if tint.shape != (3,):
            raise ValueError(f"tint_linear must have shape (3,), got {tint.shape}")
        if not (np.isfinite(tint).all() and (tint >= 0).all() and np.isfinite(self.dioptres)):
            raise EyeglassesError(f"a lens needs finite dioptres and a finite tint of 0 or more, got {self}")
        if self.tinting == "filter" and tint.max() > 1:
            raise EyeglassesError(f"a filter passes at most all light: tint_linear is up to {tint.max():g}")
        if self.tinting not in ("paint", "filter"):
            raise ValueError(f"tinting must be 'paint' or 'filter', got {self.tinting!r}")
        if not self.front_radius_mm > 0:
            raise EyeglassesError(f"a lens's front needs a positive radius, got {self.front_radius_mm} mm")
        blend_lens(tint, tint, tint, self.alpha, self.beta)  # checks the shares

    @property
    def clear(self) -> bool:
        """Whether no light is lost on the way through."""
        return self.alpha == 0 and self.beta == 0 and not self.fresnel

    @property
    def transmission(self) -> NDArray[np.float64]:
        """(3,) share of light that passes at right angles: 1 - alpha - beta, and alpha tint of a filter."""
        passed = np.full(3, max(1 - self.alpha - self.beta, 0.0))
        return passed + self.alpha * np.asarray(self.tint_linear) if self.tinting == "filter" else passed


@dataclass(frozen=True)
class LensPictureOptions:
    """Settings of `insert_lenses`."""

    supersampling: int = 3
    """n x n rays for pixels on edges; one for all others."""
    light_count: int = 64
    """Distant lights that stand for an environment; time grows with them."""
    background: Literal["environment", "black"] = "environment"
    """What rays see that miss all surfaces. In a photograph it is always the photograph's own background."""
    hidden: Literal["nearest", "albedo"] = "nearest"
    """Colour of points that the photograph does not show: of the nearest point of the same surface that it
    shows, or the surface's albedo in the photograph's brightness."""
    fringe_px: int = 1
    """Pixels around the frame, and of the background around surfaces, that a photograph's colours are not
    taken from: they may hold some of both."""
    rim_points: int = 128
    """Points of a lens's outline."""
    seat_mm: float = 0.3
    """How far lenses reach into their rims: outlines are exact to 0.2 mm, and no light shall pass between."""
    shadow_offset_mm: float = 0.2
    """Shadow rays start this far off the surface."""
    shadows: Literal["shared", "every pixel"] = "shared"
    """Whether a pixel takes over what four neighbours on the same smooth surface agree on, which may lose
    shadows less than two pixels wide, or shoots rays of its own."""
    relightable: bool = False
    """Whether the picture keeps what `LensPicture.under` needs: some 150 bytes a pixel, and one a light."""

    def __post_init__(self) -> None:
        counts = {"supersampling": self.supersampling, "light_count": self.light_count}
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"{name} must be 1 or more, got {count}")
        if self.fringe_px < 0 or not self.seat_mm >= 0 or not self.shadow_offset_mm >= 0:
            raise ValueError("fringe_px, seat_mm and shadow_offset_mm must be 0 or more")
        if self.hidden not in ("nearest", "albedo"):
            raise ValueError(f"hidden must be 'nearest' or 'albedo', got {self.hidden!r}")
        if self.shadows not in ("shared", "every pixel"):
            raise ValueError(f"shadows must be 'shared' or 'every pixel', got {self.shadows!r}")
        if self.background not in ("environment", "black"):
            raise ValueError(f"background must be 'environment' or 'black', got {self.background!r}")
