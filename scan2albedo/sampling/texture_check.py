"""Whether a texture belongs to the shape that it lies on; if not, which flip or order of channels does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from scan2albedo.core import PlanStep
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.core.raw_scan import RawScan
from scan2albedo.sampling.fitted_face import Fitted, geometry_image

WRONG = 0.03
"""Part of the scans whose texture does not belong to them as it is: turned by an exporter, or another's."""
_SIZE = 128


def texture_doubt(fitted: Fitted, scan: RawScan, image: GeometryImage) -> PlanStep | None:
    """Return the doubt that a scan's texture belongs to its shape, None where it most probably does.

    `image` is the scan's. Only where its odds are in doubt is the texture tried flipped, turned and with red
    and blue exchanged, which takes some .2 s each.
    """
    log_odds = image.texture_log_odds + np.log((1 - WRONG) / WRONG)
    if scan.texture_linear is None or image.texture_log_odds > -2 * np.log(WRONG):
        return None
    tried = list(_variants(scan))
    odds = [geometry_image(fitted, other, _SIZE).texture_log_odds for _, other in tried]
    best = int(np.argmax(odds))
    # Against it stand all others, as they are, and the texture of something else (odds of 1).
    each = np.array(odds) - np.log(len(odds))
    rivals = [*np.delete(each, best), log_odds, 0.0]
    if each[best] > logsumexp(rivals):
        reason = f"the texture fits the shape {tried[best][0]}: correct the export, or its coordinates"
        evidence = f"log odds {odds[best]:.1f}, as it is {image.texture_log_odds:.1f}"
        return PlanStep.doubt("texture", reason, evidence)
    if log_odds < 0:
        reason = (
            "brows, eyes and lips of the texture are not where the shape has them: is it another scan's, or "
            "shifted?"
        )
        return PlanStep.doubt("texture", reason, f"log odds {image.texture_log_odds:.1f}")
    return None


def _variants(scan: RawScan) -> Iterator[tuple[str, RawScan]]:
    """Yield what was done to the texture, and the scan with it so."""
    texture = scan.texture_linear
    assert texture is not None
    for name, changed in (
        ("with V flipped", texture[::-1]),
        ("with U flipped", texture[:, ::-1]),
        ("turned by 180 degrees", texture[::-1, ::-1]),
        ("with red and blue exchanged", texture[..., ::-1]),
    ):
        yield name, replace(scan, texture_linear=np.ascontiguousarray(changed))
