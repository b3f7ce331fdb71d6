"""One light at a time: the flash's light alone, from pictures with the flash and with the room's light."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.picture_samples import linear_values, picture_values

Pictures = NDArray[Any] | Sequence[NDArray[Any]]

_SIGMAS = 4.0
"""A pixel counts as brighter in the room's light when the difference is this far below 0 in every channel."""
_BRIGHTER_ROOM_PART = 0.02
"""Of a pair's pixels from which it is reported; it is left out when more are so than the other way round."""


@dataclass(frozen=True)
class OlatOptions:
    """How displayed values become light.

    Raises `ValueError` when a value is outside its range.
    """

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
    """Something wrong with a pair of pictures."""

    name: str
    """One of "room_brighter_than_flash", "saturated", "not_finite"."""
    pair: int
    """Its number."""
    part: float
    """Of the pair's pixels."""
    left_out: bool
    """Whether the whole pair is."""
    message: str
    """In words, with advice."""


@dataclass(frozen=True)
class OlatImages:
    """Light that the flash of each of J pairs added."""

    linear: NDArray[np.float32]
    """(J, H, W, 3) float32: negative where noise made it so; 0 where not valid."""
    sigma: NDArray[np.float32]
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

    m is the number of pairs that share the picture of the room's light (are given equal ones): its noise is
    the same in all of them, so that their mean has no less of it.

    Its slope is 0 in the dark, where first order does not hold; values count there as at least s. Negative
    differences stay: cut off, they would bias dark skin upwards. A clipped channel is lost, the other two are
    not.

    Parameters
    ----------
    flash : (J, H, W, 3) array or sequence of (H, W, 3) arrays
        Displayed values: floats, white = 1, or integers of 8 or 16 bits; NaN where there is nothing.
    room : (J, H, W, 3) or (H, W, 3) array, or sequence of arrays
        Likewise; one picture of the room's light serves all.
    options : OlatOptions

    Raises
    ------
    ValueError
        When shapes disagree.
    ReflectanceError
        When there are no pairs, when values are beyond white, or when every pair is darker with its flash.

    Examples
    --------
    >>> pair = extract_olat(np.full((1, 2, 2, 3), 0.5), np.full((2, 2, 3), 0.1))
    >>> print(pair.linear[0, 0, 0, 0].round(4), pair.sigma[0, 0, 0, 0].round(4))
    0.3722 0.0129
    """
    rooms = _pictures(room, "room")
    pictures = _pictures(flash, "flash")
    shape = _shape(pictures, rooms)
    linear, sigma = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    saturated, valid = np.zeros(shape, bool), np.zeros(shape, bool)
    diagnostics: list[CaptureDiagnostic] = []
    sharing = _sharing(rooms, shape[0])
    for j in range(shape[0]):
        lit = picture_values(pictures[j], f"flash picture {j}", options.saturation)
        ambient = picture_values(rooms[j % len(rooms)], f"room picture {j}", options.saturation)
        finite = np.isfinite(lit) & np.isfinite(ambient)
        lit, ambient = np.where(finite, lit, 0.0), np.where(finite, ambient, 0.0)
        difference = linear_values(lit, options.gamma) - linear_values(ambient, options.gamma)
        noise, noise_of_room = _variance(lit, options), _variance(ambient, options)
        deviation = np.sqrt(noise + noise_of_room)
        saturated[j] = finite & ((lit >= options.saturation) | (ambient >= options.saturation))
        usable = (finite & ~saturated[j]).all(-1)
        changed = (np.abs(difference) > _SIGMAS * deviation).all(-1) & usable
        darker, brighter = changed & (difference < 0).all(-1), changed & (difference > 0).all(-1)
        found = _diagnostics(j, finite, saturated[j])
        found += _room_diagnostics(j, usable.sum(), darker.sum(), brighter.sum())
        diagnostics += found
        valid[j] = finite & ~saturated[j] & (not any(one.left_out for one in found))
        linear[j], sigma[j] = np.where(valid[j], difference, 0.0), np.sqrt(noise + sharing[j] * noise_of_room)
    _check_some_pair_usable(diagnostics, shape[0])
    return OlatImages(linear, sigma, valid, saturated, tuple(diagnostics))


def _pictures(given: Pictures, name: str) -> list[NDArray[Any]]:
    """Return pictures (H, W, 3), one for an array of one."""
    pictures = [given] if isinstance(given, np.ndarray) and given.ndim == 3 else list(given)
    if not pictures:
        raise ReflectanceError(f"{name} holds no pictures: there are no pairs, give one at least")
    return [np.asarray(picture) for picture in pictures]


def _sharing(rooms: list[NDArray[Any]], pairs: int) -> list[int]:
    """Return for each pair how many have a picture of the room equal to its own, itself among them."""
    if len(rooms) == 1:
        return [pairs] * pairs
    digests = [hashlib.blake2b(room.tobytes()).digest() for room in rooms]
    count = Counter(digests)
    return [count[digest] for digest in digests]


def _shape(flash: list[NDArray[Any]], room: list[NDArray[Any]]) -> tuple[int, int, int, int]:
    shapes = {picture.shape for picture in (*flash, *room)}
    if len(room) not in (1, len(flash)) or len(shapes) != 1 or len(flash[0].shape) != 3:
        raise ValueError(
            f"there are {len(flash)} flash and {len(room)} room pictures of shapes {sorted(shapes)}, "
            "expected (H, W, 3) all, and as many of each or one of the room"
        )
    height, width, channels = flash[0].shape
    if channels != 3 or 0 in (height, width):
        raise ValueError(f"pictures are {flash[0].shape}, expected (H, W, 3)")
    return len(flash), height, width, channels


def _variance(values: FloatArray, options: OlatOptions) -> FloatArray:
    slope = options.gamma * np.maximum(np.abs(values), options.noise) ** (options.gamma - 1)
    return (options.noise * slope) ** 2


def _diagnostics(pair: int, finite: BoolArray, saturated: BoolArray) -> list[CaptureDiagnostic]:
    found = []
    missing, clipped = 1 - float(finite.all(-1).mean()), float(saturated.any(-1).mean())
    if missing > 0:
        text = f"pair {pair}: {100 * missing:.3g} % of the pixels have no number and are left out"
        found.append(CaptureDiagnostic("not_finite", pair, missing, missing == 1, text))
    if clipped > 0:
        text = f"pair {pair}: {100 * clipped:.3g} % of the pixels are saturated and their channels left out"
        found.append(CaptureDiagnostic("saturated", pair, clipped, False, text))
    return found


def _room_diagnostics(pair: int, usable: int, darker: int, brighter: int) -> list[CaptureDiagnostic]:
    part, swapped = float(darker / max(usable, 1)), bool(darker > brighter)
    if part <= _BRIGHTER_ROOM_PART:
        return []
    advice = (
        "left out, were the pictures exchanged?" if swapped else "did head or exposure change between them?"
    )
    text = (
        f"pair {pair}: {100 * part:.3g} % of the pixels are brighter in the room's light than "
        f"with the flash: {advice}"
    )
    return [CaptureDiagnostic("room_brighter_than_flash", pair, part, swapped, text)]


def _check_some_pair_usable(diagnostics: list[CaptureDiagnostic], count: int) -> None:
    left_out = [one for one in diagnostics if one.left_out]
    if len({one.pair for one in left_out}) == count:
        raise ReflectanceError(f"no pair of pictures can be used; {left_out[0].message}")
