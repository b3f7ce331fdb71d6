"""White balance: one factor for each channel of a scan, so that grey, or skin, has its colour."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.core import GeometryImage, PlanStep, RawScan
from scan2albedo.core.arrays import Float32Array


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
        red, green, blue = np.log(texture[skin], dtype=float).T
        prior_mean = np.array([0.0, *AlbedoPrior.faces().chroma[0]])
        gain = np.exp(prior_mean - [0.0, np.median(green - red), np.median(blue - red)])
        gain, reason = gain / gain[1], "skin has the mean colour of people's"

    def times(color: Float32Array | None) -> Float32Array | None:
        return None if color is None else color * gain.astype(np.float32)

    textures = times(scan.texture_linear), times(scan.vertex_color_linear)
    scan = replace(scan, texture_linear=textures[0], vertex_color_linear=textures[1])
    evidence = "red x {:.3f}, green x {:.3f}, blue x {:.3f}".format(*gain)
    step = PlanStep("white_balance", True, reason, evidence)
    return scan, replace(image, texture_linear=times(texture)), step
