"""What persons are told apart by: the texture as scanned, cheap filters of it, and albedos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from benchmarks.light_normalization import histogram_equalized, multi_scale_retinex

from recognition_experiment.options import RecognitionExperimentOptions
from recognition_experiment.sessions import TEXTURE, Session
from scan2albedo.core.arrays import FloatArray
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.recognition import Templates, albedo_templates
from scan2albedo.recognition.templates import LUMINANCE

RAW, RAW_SRGB = "raw texture", "raw texture, sRGB"
RETINEX, EQUALIZED = "multi-scale retinex", "histogram equalisation"
CHROMATICITY = "raw red to green"
"""Free of shading where all lamps have one colour, as they have unless the options say otherwise."""


def method_names(options: RecognitionExperimentOptions) -> tuple[str, ...]:
    """Return the names of what is compared, raw texture first."""
    albedos = map(albedo_method, options.brdfs)
    return (RAW, RAW_SRGB, EQUALIZED, RETINEX, CHROMATICITY, *albedos, unlit_chromaticity(options))


def albedo_method(brdf: str) -> str:
    """Return the name under which the albedo of a reflectance is compared."""
    return f"albedo, {brdf}"


def unlit_chromaticity(options: RecognitionExperimentOptions) -> str:
    """Return the name under which red over green of the first reflectance's albedo is compared."""
    return f"red to green of {albedo_method(options.brdfs[0])}"


def red_to_green(color_linear: FloatArray) -> FloatArray:
    """Return red over green (H, W) of linear colour, which shading under lamps of one colour leaves alone."""
    lit = np.maximum(color_linear[..., :2], max(float(color_linear.max()), 1e-12) / 255)
    return np.asarray(lit[..., 0] / lit[..., 1])


def method_image(method: str, session: Session, options: RecognitionExperimentOptions) -> FloatArray:
    """Return what a method compares, (H, W) or (H, W, 3)."""
    for brdf in options.brdfs:
        if method == albedo_method(brdf):
            return session.images[brdf].astype(np.float64)
    if method == unlit_chromaticity(options):
        return red_to_green(session.images[options.brdfs[0]].astype(np.float64))
    texture = session.images[TEXTURE].astype(np.float64)
    if method == RAW:
        return texture
    if method == RAW_SRGB:
        return linear_to_srgb(texture)
    if method == CHROMATICITY:
        return red_to_green(texture)
    bright = texture @ LUMINANCE
    if method == EQUALIZED:
        return histogram_equalized(bright, session.seen)
    if method == RETINEX:
        return multi_scale_retinex(bright, session.seen)
    raise ValueError(f"{method!r} is not a method, expected one of {', '.join(method_names(options))}")


def session_templates(
    session: Session, name: str, options: RecognitionExperimentOptions
) -> dict[str, Templates]:
    """Return the template of a session by each method, all over the texels that were seen."""
    return {
        method: albedo_templates(
            [method_image(method, session, options)], [name], masks=[session.seen], options=options.templates
        )
        for method in method_names(options)
    }


def joined(parts: Sequence[Templates]) -> Templates:
    """Return the templates of several sets, made alike, in order."""
    names = tuple(name for part in parts for name in part.names)
    held: dict[str, Any] = {
        key: np.concatenate([part.arrays[key] for part in parts]) for key in parts[0].arrays
    }
    return replace(parts[0], names=names, chart=None, **held)
