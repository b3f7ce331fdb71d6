"""What callers hand over by mistake: other objects than expected, and colours that are not linear."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from scan2albedo.core.arrays import Float32Array

_FAR_ABOVE_WHITE = 8.0
"""Skin has no median brighter than that in linear light, where 1 is display white."""


def require_type(value: object, kinds: type | tuple[type, ...], name: str, advice: str) -> None:
    """Raise TypeError, saying what was given and what was expected, unless `value` is of one of the kinds.

    >>> require_type("face.obj", int, "register: scan", "count it")
    Traceback (most recent call last):
        ...
    TypeError: register: scan is the text 'face.obj', expected int; count it
    """
    allowed = kinds if isinstance(kinds, tuple) else (kinds,)
    if not isinstance(value, allowed):
        wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in allowed)
        raise TypeError(f"{name} is {described(value)}, expected {wanted}; {advice}")


def described(value: object) -> str:
    """Return what an argument is, in words."""
    if value is None:
        return "None"
    if isinstance(value, str):
        return f"the text {value[:100]!r}"
    if isinstance(value, Path):
        return f"the path {str(value)[:100]!r}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and {value.dtype}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"an object of {type(value).__name__}"


def require_linear(name: str, values: ArrayLike) -> None:
    """Raise TypeError for what are not numbers, and for integers, which are sRGB in nearly every file."""
    kind = np.asarray(values).dtype
    if kind.kind in "OSU":
        raise TypeError(f"{name} is {described(values)}, expected an array of linear colours")
    if kind.kind in "iub":
        said = f"{name} holds {kind}, expected floats of linear light, 1 = display white"
        raise TypeError(f"{said}; decode sRGB of 8 bits with scan2albedo.io.color.decode_srgb_integers")


def linear_doubt(name: str, values: Float32Array) -> str:
    """Return a sentence on colours that are hardly linear light, "" when there is no doubt."""
    if values.max(initial=0) <= _FAR_ABOVE_WHITE or (median := float(np.median(values))) <= _FAR_ABOVE_WHITE:
        return ""
    return (
        f"{name} has a median of {median:.3g} and reaches {values.max():.3g}, though 1 is display white: are "
        "these sRGB values up to 255? Then divide them by 255 and decode them with "
        "scan2albedo.io.color.srgb_to_linear"
    )
