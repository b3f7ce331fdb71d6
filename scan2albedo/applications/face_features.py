"""Which texels are eyes, brows, nostrils and mouth, unseen or dark; from which face each is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_opening, label, maximum_filter
from skimage.morphology import disk

from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.optimization.poisson import integrate_gradients

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
AROUND = 0.012
"""Part of the image's side by which a feature, or what is dark, reaches beyond its texels, for lashes and the
red of lips. Means of skin have half of it as their deviation."""
_ONTO_JAW = 0.2
"""Part of the image's side over which a dark patch goes on over the jaw."""
_BRIGHTEST = 1.5
"""Small spots on eyes are reflections if they are so many times brighter than skin."""
_DARK = 0.6
_DARKEST = 0.35
"""Part of the skin's level below which a side is dark, and below which it goes on over the jaw."""
FLOOR = 1e-3
"""Part of the level below which albedo has no logarithm."""


def feature_texels(face: ProcessedFace, model: AnnotatedSurface | None = None) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` that the face's annotation by `model` knows."""
    found = {name: region_texels(face, parts, model) for name, parts in FEATURES.items()}
    return {name: texels for name, texels in found.items() if texels.any()}


def region_texels(
    face: ProcessedFace, names: Sequence[str], model: AnnotatedSurface | None = None
) -> BoolArray:
    """Return (H, W) the texels in the named regions of the model; none where the face is of another."""
    template = default_model() if model is None else model
    if face.image.region is None or face.model_name != template.name:
        return np.zeros(face.mask.shape, bool)
    known = [template.regions[name].index for name in names if name in template.regions]
    return np.asarray(face.mask & np.isin(face.image.region, known))


def taken_features(
    face: ProcessedFace, other: ProcessedFace, model: AnnotatedSurface | None = None
) -> tuple[BoolArray, BoolArray]:
    """Return (H, W) texels of the features that `other` gives as a whole, and those that stay.

    It gives those of which part was not seen in `face`, and at most half as much in `other`, with what is
    close to them. Other eyes and mouths stay as they are; brows and nostrils are continued like skin.
    """
    taken, kept = np.zeros((2, *face.mask.shape), bool)
    for name, texels in feature_texels(face, model).items():
        missing, others = (float(np.mean(~given.image.seen[texels])) for given in (face, other))
        if missing > _WHOLE and others < missing / 2:
            taken |= texels
        elif name in ("eyes", "mouth"):
            kept |= texels
    return face.mask & grown(taken, AROUND) & ~kept, kept


def without_catchlights(face: ProcessedFace, model: AnnotatedSurface | None = None) -> FloatArray:
    """Return (H, W, 3) the albedo without reflections of lamps on the eyes: V lowered to its opening."""
    albedo, eyes = face.albedo_linear.astype(np.float64), region_texels(face, FEATURES["eyes"], model)
    if not eyes.any():
        return albedo
    side, around = max(eyes.shape), face.mask & grown(eyes, AROUND)
    value, radius = albedo.max(-1), max(1, round(1.5 * AROUND * side / 2))
    opened = gaussian_filter(grey_opening(value, footprint=disk(radius)), (2 * radius + 1) / 3, mode="mirror")
    most = np.maximum(opened, _BRIGHTEST * face.level())
    factor = np.where(around, np.minimum(1.0, most / np.maximum(value, 1e-12)), 1.0)
    return np.asarray(albedo * factor[..., None])


def without_gaps(face: ProcessedFace, model: AnnotatedSurface | None = None) -> ProcessedFace:
    """Return the face with Laplace's smooth log albedo where none was seen, and on `dark_sides`."""
    features = feature_texels(face, model)
    kept = np.logical_or.reduce([features[name] for name in features if name != "nostrils"] or [~face.mask])
    gaps = (face.mask & ~face.image.seen & ~kept) | dark_sides(face, model)
    if not gaps.any() or not (known := face.mask & ~gaps).any():
        return face
    floor = FLOOR * max(face.level(), 1e-12)
    field = np.log(np.maximum(face.albedo_linear.astype(np.float64), floor))
    across, down = np.zeros_like(field[:, 1:]), np.zeros_like(field[1:])
    filled = np.exp(integrate_gradients(field, gaps, known, across, down))
    return replace(face, albedo_linear=np.where(gaps[..., None], filled, face.albedo_linear))


def dark_sides(face: ProcessedFace, model: AnnotatedSurface | None = None) -> BoolArray:
    """Return (H, W) dark texels of temples and cheeks along the chart's rim that are not skin.

    They are hair before the ears, or unlit; what goes on over the jaw is a beard and stays.
    """
    skin, side = face.image.skin, region_texels(face, SIDES, model)
    if skin is None or not side.any() or not (skin > 0.5).any():
        return np.zeros(face.mask.shape, bool)
    value = face.albedo_linear.max(-1).astype(np.float64)
    usual = float(np.median(value[skin > 0.5]))
    sigma = AROUND / 2 * max(face.mask.shape)
    mean, sure = blurred_inside(value, face.mask, sigma), blurred_inside(skin, face.mask, sigma)
    around = side | region_texels(face, JAWS, model)
    darkest = around & (mean < _DARKEST * usual)
    dark = darkest | (around & (mean < _DARK * usual) & (sure < 0.5))
    patches = _touching(dark & side, face.image.border)
    patches |= _touching(darkest, patches) & grown(patches, _ONTO_JAW)
    return np.asarray(grown(patches, AROUND) & around)


def _touching(texels: BoolArray, others: BoolArray) -> BoolArray:
    """Return the connected parts of `texels` (H, W) that hold one of `others`."""
    part = label(texels, np.ones((3, 3)))[0]
    return np.asarray(np.isin(part, np.setdiff1d(part[others], [0])))


def grown(texels: BoolArray, part: float) -> BoolArray:
    """Return `texels` (H, W) with those closer than this part of the image's side."""
    return np.asarray(
        maximum_filter(texels, 2 * max(1, round(part * max(texels.shape))) + 1, mode="constant")
    )


def blurred_inside(field: NDArray[np.floating], mask: BoolArray, sigma: float) -> FloatArray:
    """Return the Gaussian means of a field (H, W) over the texels of `mask` (H, W) alone."""
    inside = mask.astype(np.float64)
    weight = np.maximum(gaussian_filter(inside, sigma, mode="mirror"), 1e-6)
    return np.asarray(gaussian_filter(field * inside, sigma, mode="mirror") / weight)
