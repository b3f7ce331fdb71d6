"""White balance: one factor for each channel of a scan, so that grey, or skin, has its colour."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import GeometryImage, PlanStep, RawScan
from scan2albedo.core.arrays import Float32Array

NAMES = ("none", "grey-skin")


def checked_white_balance(asked: str | Sequence[float]) -> str | Sequence[float]:
    """Return one of `NAMES`, or the colour that grey has; numbers may be text, "R,G,B". May raise ValueError.

    >>> checked_white_balance("1, .9,.7")
    (1.0, 0.9, 0.7)
    """
    if isinstance(asked, str) and asked in NAMES:
        return asked
    try:
        grey = tuple(float(part) for part in (asked.split(",") if isinstance(asked, str) else asked))
    except (TypeError, ValueError):
        grey = ()
    if len(grey) != 3 or not all(0 < channel < np.inf for channel in grey):
        raise ValueError(
            f"white_balance is {asked!r}, expected {', '.join(NAMES)}, or the linear colour R,G,B, three "
            "numbers above 0, that something grey has in the scan"
        )
    return grey


def balanced(
    scan: RawScan, image: GeometryImage, asked: str | Sequence[float]
) -> tuple[RawScan, GeometryImage, PlanStep]:
    """Return scan and geometry image in balanced colours, as bright in green as before, and what was done.

    `asked` is as `checked_white_balance` returns it, not "none". "grey-skin" gives lit skin, in the median of
    its seen texels, the mean colour of the people that `AlbedoPrior.faces` was learned from; the light that
    is found then decides how much of it is the albedo's. Without skin nothing is done.
    """
    texture = image.texture_linear
    assert texture is not None
    if not isinstance(asked, str):
        gain, reason = asked[1] / np.array(asked), "something grey is grey"
    else:
        skin = image.seen & (texture > 0).all(-1) & (False if image.skin is None else image.skin > 0.5)
        if not skin.any():
            reason = "the colours are not balanced: no skin is known, so its colour is not either"
            return scan, image, PlanStep.wrong("white_balance", reason)
        red, green, blue = np.log(texture[skin], dtype=np.float64).T
        usual = np.array([0.0, *AlbedoPrior.faces().chroma[0]])
        gain = np.exp(usual - [0.0, np.median(green - red), np.median(blue - red)])
        gain, reason = gain / gain[1], "skin has the mean colour of people's"

    def times(color: Float32Array | None) -> Float32Array | None:
        return None if color is None else color * gain.astype(np.float32)

    textures = times(scan.texture_linear), times(scan.vertex_color_linear)
    scan = replace(scan, texture_linear=textures[0], vertex_color_linear=textures[1])
    evidence = "red x {:.3f}, green x {:.3f}, blue x {:.3f}".format(*gain)
    step = PlanStep("white_balance", True, reason, evidence)
    return scan, replace(image, texture_linear=times(texture)), step
