"""Which texels are eyes, brows, nostrils and mouth, and from which of two faces each of them is taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface, default_model

FEATURES = {
    "eyes": ("left_eye", "right_eye"),
    "brows": ("left_brow", "right_brow"),
    "nostrils": ("left_nostril", "right_nostril"),
    "mouth": ("upper_lip", "lower_lip", "between_lips"),
}
"""Regions that are of one person or of another, never half and half: both eyes have one colour."""
SIDES = ("left_temple", "right_temple", "left_cheek", "right_cheek")
JAWS = ("left_jaw", "right_jaw")
_WHOLE = 0.05
"""A feature of which less is missing is whole."""
_AROUND = 0.012
"""Of the image's side: how far a feature reaches beyond its region, for lashes and the red of lips."""
_CATCHLIGHT, _BRIGHTEST = 0.018, 1.5
"""Of the image's side: bright spots on eyes that are smaller are reflections if they are so many times
brighter than skin."""


def feature_texels(face: ProcessedFace, model: AnnotatedSurface | None = None) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` that the face's annotation knows.

    `model` is that of the face, the default model when None; without regions, or of another model, a face has
    no known features.
    """
    found = {name: region_texels(face, parts, model) for name, parts in FEATURES.items()}
    return {name: texels for name, texels in found.items() if texels.any()}


def region_texels(
    face: ProcessedFace, names: Sequence[str], model: AnnotatedSurface | None = None
) -> BoolArray:
    """Return (H, W) the texels in the named regions of the model; none where they are not known."""
    template = default_model() if model is None else model
    if face.region is None or face.model_name != template.name:
        return np.zeros(face.mask.shape, bool)
    known = [template.regions[name].index for name in names if name in template.regions]
    return np.asarray(face.mask & np.isin(face.region, known))


def taken_features(
    face: ProcessedFace, other: ProcessedFace, model: AnnotatedSurface | None = None
) -> tuple[BoolArray, BoolArray]:
    """Return (H, W) texels of the features that `other` is to give as a whole, and those that stay.

    It gives those of which part was not seen in `face`, and at most half as much in `other`; with what is
    close to them. Of eyes and mouth all stays, for a gap is not worth another person's lashes; of brows and
    nostrils, which are continued like skin, only what was seen.
    """
    taken, kept = np.zeros((2, *face.mask.shape), bool)
    for name, texels in feature_texels(face, model).items():
        missing, others = (float(np.mean(~given.image.seen[texels])) for given in (face, other))
        if missing > _WHOLE and others < missing / 2:
            taken |= texels
        elif name in ("eyes", "mouth"):
            kept |= texels
    return face.mask & grown(taken, _AROUND) & ~kept, kept


def without_catchlights(face: ProcessedFace, model: AnnotatedSurface | None = None) -> FloatArray:
    """Return (H, W, 3) the albedo without small spots on the eyes that are brighter than skin.

    They are reflections of the scan's lamps, which are no albedo: V is lowered to its morphological opening.
    """
    import cv2

    albedo, eyes = face.albedo_linear.astype(np.float64), region_texels(face, FEATURES["eyes"], model)
    if not eyes.any():
        return albedo
    side, around = max(eyes.shape), face.mask & grown(eyes, _AROUND)
    value = albedo.max(-1)
    width = 2 * max(1, round(_CATCHLIGHT * side / 2)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    opened = cv2.GaussianBlur(cv2.morphologyEx(value, cv2.MORPH_OPEN, disc), (0, 0), width / 3)
    most = np.maximum(opened, _BRIGHTEST * face.level())
    factor = np.where(around, np.minimum(1.0, most / np.maximum(value, 1e-12)), 1.0)
    return np.asarray(albedo * factor[..., None])


def grown(texels: BoolArray, part: float) -> BoolArray:
    """Return `texels` (H, W) with those closer than this part of the image's side."""
    import cv2

    width = 2 * max(1, round(part * max(texels.shape))) + 1
    return np.asarray(cv2.dilate(texels.astype(np.uint8), np.ones((width, width), np.uint8)) > 0)
