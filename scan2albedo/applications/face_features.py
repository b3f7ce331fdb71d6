"""Which texels of a face are eyes, brows, nostrils, mouth, or the sides that hair and shadow cover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray
from scan2albedo.face_model import AnnotatedFaceModel

FEATURES = {
    "eyes": ("left_eye", "right_eye"),
    "brows": ("left_brow", "right_brow"),
    "nostrils": ("left_nostril", "right_nostril"),
    "mouth": ("upper_lip", "lower_lip", "between_lips"),
}
"""Regions that are of one person or of another, never half and half: both eyes have one colour."""
SIDES = ("left_temple", "right_temple", "left_cheek", "right_cheek")
JAWS = ("left_jaw", "right_jaw")


def feature_texels(face: ProcessedFace, model: AnnotatedFaceModel | None = None) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` that the face's annotation knows.

    `model` is that of the face, the default model when None; without regions, or of another model, a face has
    no known features.
    """
    found = {name: region_texels(face, parts, model) for name, parts in FEATURES.items()}
    return {name: texels for name, texels in found.items() if texels.any()}


def region_texels(
    face: ProcessedFace, names: Sequence[str], model: AnnotatedFaceModel | None = None
) -> BoolArray:
    """Return (H, W) the texels in the named regions of the model; none where they are not known."""
    template = AnnotatedFaceModel.default() if model is None else model
    if face.region is None or face.model_name != template.name:
        return np.zeros(face.mask.shape, bool)
    known = [template.regions[name].index for name in names if name in template.regions]
    return np.asarray(face.mask & np.isin(face.region, known))
