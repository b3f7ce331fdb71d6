"""One light at a time: the flash's light alone, from pictures with the flash and with the room's light."""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2albedo.core.arrays import BoolArray, Float32Array, FloatArray, NDArray
from scan2albedo.errors import ReflectanceError

Pictures = NDArray | Sequence[NDArray]

_BRIGHTER_ROOM_PART = 0.02
"""Part of a pair's pixels, brighter in the room's light, from which it is reported: it is left out when more
are so than the other way round."""


@dataclass(frozen=True)
class OlatOptions:
    """How displayed values become light; `ValueError` for values outside their range."""

    gamma: float = 1.2
    """Light is value^gamma; 1 for pictures that are linear already."""
    noise: float = 0.01
    """Standard deviation of the values, white = 1."""
    saturation: float = 0.98
    """Values from here on are clipped, or may be; inf for pictures that cannot clip."""

    def __post_init__(self) -> None:
        for name in ("gamma", "noise"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected > 0 and finite")
        if not self.saturation > 0:
            raise ValueError(f"saturation is {self.saturation}, expected > 0")


@dataclass(frozen=True)
class CaptureDiagnostic:
    """Something wrong with a `part` of the pixels of a `pair` of pictures, in words: `message`."""

    name: str
    """One of "room_brighter_than_flash", "saturated", "not_finite"."""
    pair: int
    part: float
    left_out: bool
    """Whether the whole pair is."""
    message: str


@dataclass(frozen=True)
class OlatImages:
    """Light that the flash of each of J pairs added."""

    linear: Float32Array
    """(J, H, W, 3) float32: negative where noise made it so; 0 where not valid."""
    sigma: Float32Array
    """(J, H, W, 3) float32: standard deviation."""
    valid: BoolArray
    """(J, H, W, 3): finite, not saturated, of a pair that is not left out."""
    saturated: BoolArray
    """(J, H, W, 3): in either picture."""
    diagnostics: tuple[CaptureDiagnostic, ...] = ()
    """Pair by pair."""

    def __len__(self) -> int:
        return len(self.linear)


def extract_olat(flash: Pictures, room: Pictures, *, options: OlatOptions = OlatOptions()) -> OlatImages:
    """Return the flash's light alone: pictures with it less the room's light, in linear space.

    I = F^g - R^g with g = `gamma` and, to first order in the noise s (Han, Wang, Xu, supplement, Eq. 2),

        sigma^2 = (g s)^2 (F^(2 g - 2) + m R^(2 g - 2)).

    m is the number of pairs that share the picture of the room's light (are given equal ones), and its noise.
    Values count as at least s, for the slope is 0 in the dark. Negative differences stay: cut off, they would
    bias dark skin upwards. A clipped channel is lost, the other two are not. Raises `ValueError` when shapes
    disagree; `ReflectanceError` when there are no pairs, when values are beyond white, or when every pair is
    darker with its flash.

    Parameters
    ----------
    flash, room : (J, H, W, 3) array or sequence of (H, W, 3) arrays
        Displayed values: floats, white = 1, or integers of 8 or 16 bits; NaN where there is nothing. One
        picture of the room's light serves all.
    options : OlatOptions

    Examples
    --------
    >>> pair = extract_olat(np.full((1, 2, 2, 3), 0.5), np.full((2, 2, 3), 0.1))
    >>> print(pair.linear[0, 0, 0, 0].round(4), pair.sigma[0, 0, 0, 0].round(4))
    0.3722 0.0129
    """
    rooms, pictures = _pictures(room, "room"), _pictures(flash, "flash")
    shapes = {picture.shape for picture in (*pictures, *rooms)}
    if len(rooms) not in (1, len(pictures)) or len(shapes) != 1 or len(pictures[0].shape) != 3:
        raise ValueError(
            f"there are {len(pictures)} flash and {len(rooms)} room pictures of shapes {sorted(shapes)}, "
            "expected (H, W, 3) all, and as many of each or one of the room"
        )
    height, width, channels = pictures[0].shape
    if channels != 3 or 0 in (height, width):
        raise ValueError(f"pictures are {pictures[0].shape}, expected (H, W, 3)")
    # How many pairs have a picture of the room equal to each pair's own, itself among them.
    digests = [hashlib.blake2b(one.tobytes()).digest() for one in rooms]
    count = Counter(digests)
    sharing = [count[one] for one in digests] if len(rooms) > 1 else [len(pictures)] * len(pictures)
    shape = (len(pictures), height, width, 3)
    (linear, sigma), (saturated, valid) = np.zeros((2, *shape), np.float32), np.zeros((2, *shape), bool)
    diagnostics: list[CaptureDiagnostic] = []
    for j in range(len(pictures)):
        flash_picture = picture_values(pictures[j], f"flash picture {j}", options.saturation)
        ambient = picture_values(rooms[j % len(rooms)], f"room picture {j}", options.saturation)
        finite = np.isfinite(flash_picture) & np.isfinite(ambient)
        flash_picture, ambient = np.where(finite, flash_picture, 0.0), np.where(finite, ambient, 0.0)
        difference = linear_values(flash_picture, options.gamma) - linear_values(ambient, options.gamma)
        slopes = (
            options.gamma * np.maximum(np.abs(one), options.noise) ** (options.gamma - 1)
            for one in (flash_picture, ambient)
        )
        noise, noise_of_room = ((options.noise * slope) ** 2 for slope in slopes)
        saturated[j] = finite & ((flash_picture >= options.saturation) | (ambient >= options.saturation))
        usable = (finite & ~saturated[j]).all(-1)
        # Four standard deviations in every channel are a change.
        changed = (np.abs(difference) > 4 * np.sqrt(noise + noise_of_room)).all(-1) & usable
        darker, brighter = changed & (difference < 0).all(-1), changed & (difference > 0).all(-1)
        missing = 1 - float(finite.all(-1).mean())
        swapped, advice = bool(darker.sum() > brighter.sum()), "did head or exposure change between them?"
        if swapped:
            advice = "left out, were the pictures exchanged?"
        darker_said = f"are brighter in the room's light than with the flash: {advice}"
        darker_part = float(darker.sum() / max(usable.sum(), 1))
        clipped = float(saturated[j].any(-1).mean())
        faults = (
            ("not_finite", missing, 0, missing == 1, "have no number and are left out"),
            ("saturated", clipped, 0, False, "are saturated and their channels left out"),
            ("room_brighter_than_flash", darker_part, _BRIGHTER_ROOM_PART, swapped, darker_said),
        )
        found = [
            CaptureDiagnostic(name, j, part, left, f"pair {j}: {100 * part:.3g} % of the pixels {said}")
            for name, part, most, left, said in faults
            if part > most
        ]
        diagnostics += found
        valid[j] = finite & ~saturated[j] & (not any(one.left_out for one in found))
        linear[j], sigma[j] = np.where(valid[j], difference, 0.0), np.sqrt(noise + sharing[j] * noise_of_room)
    left_out = [one for one in diagnostics if one.left_out]
    if len({one.pair for one in left_out}) == len(pictures):
        raise ReflectanceError(f"no pair of pictures can be used; {left_out[0].message}")
    return OlatImages(linear, sigma, valid, saturated, tuple(diagnostics))


def _pictures(values: Pictures, name: str) -> list[NDArray]:
    pictures = [values] if isinstance(values, np.ndarray) and values.ndim == 3 else list(values)
    if not pictures:
        raise ReflectanceError(f"{name} holds no pictures: there are no pairs, give one at least")
    return [np.asarray(picture) for picture in pictures]


def picture_values(picture: NDArray, name: str, saturation: float) -> FloatArray:
    """Return values (H, W, 3), white = 1, of floats or of integers of 8 or 16 bits."""
    array = np.asarray(picture)
    if array.dtype in (np.uint8, np.uint16):
        return array / float(np.iinfo(array.dtype).max)
    if not np.issubdtype(array.dtype, np.floating):
        raise ReflectanceError(f"{name} is {array.dtype}, expected floats with white = 1, uint8 or uint16")
    values = array.astype(float)
    largest = np.max(values, where=np.isfinite(values), initial=0.0)
    if largest > 2 * saturation:
        raise ReflectanceError(
            f"{name} reaches {largest:.4g}, expected values with white = 1: divide by the largest value the "
            "camera can give, or set `saturation` in the options for pictures beyond white"
        )
    return values


def linear_values(values: FloatArray, gamma: float) -> FloatArray:
    """Return values^gamma, odd, so that noise around 0 keeps its mean."""
    return np.copysign(np.abs(values) ** gamma, values)
