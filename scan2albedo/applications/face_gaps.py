"""Texels whose colour is no skin that was seen: filled smoothly from their neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scan2albedo.albedo.poisson import integrate_gradients
from scan2albedo.applications.face_features import JAWS, SIDES, feature_texels, grown, region_texels
from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray
from scan2albedo.face_model import AnnotatedSurface

_DARK, _DARKEST, _NOT_SKIN = 0.6, 0.35, 0.5
"""Part of the skin's level below which a side is dark, and what goes on from there over the jaw; and below
which part it is not skin."""
_BLUR, _BESIDE, _ONTO_JAW = 0.006, 0.015, 0.2
"""Of the image's side: the deviation of the mean that is compared, what is filled beside dark texels, and how
far a patch goes on over the jaw."""
_FLOOR = 1e-3


def without_gaps(face: ProcessedFace, model: AnnotatedSurface | None = None) -> ProcessedFace:
    """Return the face with smooth skin where none was seen, and on `dark_sides`.

    Log albedo is interpolated from around: Laplace's equation. Eyes, brows and lips stay as they are.
    `model` is that of the face, the default model when None.
    """
    features = feature_texels(face, model)
    kept = np.logical_or.reduce([features[name] for name in features if name != "nostrils"] or [~face.mask])
    gaps = (face.mask & ~face.image.seen & ~kept) | dark_sides(face, model)
    if not gaps.any() or not (known := face.mask & ~gaps).any():
        return face
    floor = _FLOOR * max(face.level(), 1e-12)
    field = np.log(np.maximum(face.albedo_linear.astype(np.float64), floor))
    across, down = np.zeros_like(field[:, 1:]), np.zeros_like(field[1:])
    filled = np.exp(integrate_gradients(field, gaps, known, across, down))
    return replace(face, albedo_linear=np.where(gaps[..., None], filled, face.albedo_linear))


def dark_sides(face: ProcessedFace, model: AnnotatedSurface | None = None) -> BoolArray:
    """Return (H, W) dark texels of temples and cheeks along the chart's rim that are no skin.

    Hair before the ears, or what was too dark to be seen there: cut out by the face's outline it is a black
    patch. What goes on over the jaw is a beard and stays.
    """
    nothing = np.zeros(face.mask.shape, bool)
    skin, side = face.image.skin, region_texels(face, SIDES, model)
    if skin is None or not side.any() or not (skin > _NOT_SKIN).any():
        return nothing
    import cv2

    value = face.albedo_linear.max(-1).astype(np.float64)
    usual = float(np.median(value[skin > _NOT_SKIN]))
    inside = face.mask.astype(np.float64)
    sigma = _BLUR * max(face.mask.shape)
    weight = np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-6)
    mean, sure = (cv2.GaussianBlur(field * inside, (0, 0), sigma) / weight for field in (value, skin))
    around = side | region_texels(face, JAWS, model)
    darkest = around & (mean < _DARKEST * usual)
    dark = darkest | (around & (mean < _DARK * usual) & (sure < _NOT_SKIN))
    patches = _touching(dark & side, face.image.border)
    patches |= _touching(darkest, patches) & grown(patches, _ONTO_JAW)
    return np.asarray(grown(patches, _BESIDE) & around)


def _touching(texels: BoolArray, others: BoolArray) -> BoolArray:
    """Return the connected parts of `texels` (H, W) that hold one of `others`."""
    import cv2

    _, part = cv2.connectedComponents(texels.astype(np.uint8))
    return np.asarray(np.isin(part, np.setdiff1d(part[others], [0])))
