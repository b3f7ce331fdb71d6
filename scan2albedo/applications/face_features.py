"""Which texels are eyes, brows, nostrils and mouth, unseen or hair; from which face each is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, grey_opening, label, maximum_filter
from skimage.morphology import disk

from scan2albedo.albedo.inpainting import continued_smoothly
from scan2albedo.applications.processed_face import ProcessedFace
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.face_model.appearance import CLASSES

FEATURES = {
    "eyes": ("eye", "left_eye", "right_eye"),
    "brows": ("brow", "left_brow", "right_brow"),
    "nostrils": ("nostril", "left_nostril", "right_nostril"),
    "mouth": ("lip", "upper_lip", "lower_lip", "between_lips"),
}
"""Labels and regions that are of one person or of another, never half and half: both eyes have one colour."""
UNLIKE = "{} open in one face and shut in the other: those of {} as a whole"
SIDES = ("left_temple", "right_temple", "left_cheek", "right_cheek")
JAWS = ("left_jaw", "right_jaw")
_WHOLE = 0.05
"""A feature of which less is missing is whole."""
_OPEN = 0.25
"""From this share on an eye or mouth is open: half way between none and that of open ones."""
AROUND = 0.012
"""Part of the image's side by which a feature, or hair, reaches beyond its texels."""
FLOOR = 1e-3
"""Part of the level below which albedo has no logarithm."""


def feature_texels(face: ProcessedFace, model: AnnotatedSurface | None = None) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` that labels or annotation by `model` know."""
    found = {name: named_texels(face, parts, model) for name, parts in FEATURES.items()}
    return {name: texels for name, texels in found.items() if texels.any()}


def named_texels(
    face: ProcessedFace, names: Sequence[str], model: AnnotatedSurface | None = None
) -> BoolArray:
    """Return (H, W) the texels in the named classes of `face_model.appearance` or regions of the model.

    A face without labels has no classes, a face of another model no regions.
    """
    template, image, found = default_model() if model is None else model, face.image, np.zeros_like(face.mask)
    if image.labels is not None:
        found |= np.isin(image.labels, [k for k, name in enumerate(CLASSES) if name in names])
    if image.region is not None and face.model_name == template.name:
        known = [template.regions[name].index for name in names if name in template.regions]
        found |= np.isin(image.region, known)
    return np.asarray(face.mask & found)


def open_features(face: ProcessedFace, model: AnnotatedSurface | None = None) -> dict[str, bool]:
    """Return whether the eyes, and the mouth, are open; without a name that the annotation does not know.

    Eyes are where more of their region is likelier of any colour than of the face's own skin around it (both
    Gaussian in log albedo), a mouth where more of its surface lies between the lips, than `_OPEN`.
    """
    found: dict[str, bool] = {}
    eyes = named_texels(face, FEATURES["eyes"][1:], model)
    inside, around = eyes & face.image.seen, grown(eyes, 2 * AROUND) & ~grown(eyes, 0) & face.bare
    if inside.any() and around.sum() > len(CLASSES):
        floor = FLOOR * face.level()
        lids, shown = (np.log(np.maximum(face.albedo_linear[t], floor)) for t in (around, inside))
        odds, own = np.zeros(len(shown)), np.cov(lids.T) + FLOOR * np.eye(3)
        for sign, spread in ((1, own + np.eye(3) / 2), (-1, own)):
            away = np.linalg.solve(np.linalg.cholesky(spread), (shown - np.median(lids, axis=0)).T)
            odds -= sign * ((away**2).sum(0) + np.linalg.slogdet(spread)[1])
        found["eyes"] = bool(np.mean(odds > 0) > _OPEN)
    mouth = named_texels(face, FEATURES["mouth"][1:], model)
    if mouth.any():
        area = np.linalg.norm(np.cross(*np.gradient(face.image.position, axis=(0, 1))), axis=-1)
        between = grown(named_texels(face, ["between_lips"], model), 0)
        found["mouth"] = bool(area[between].sum() > _OPEN * area[mouth].sum())
    return found


def unlike_features(a: ProcessedFace, b: ProcessedFace, model: AnnotatedSurface | None = None) -> list[str]:
    """Return which of eyes and mouth are open in one of two faces and shut in the other."""
    states = [open_features(face, model) for face in (a, b)]
    return [name for name in states[0] if states[0][name] != states[1].get(name, states[0][name])]


def taken_features(
    face: ProcessedFace, other: ProcessedFace, model: AnnotatedSurface | None = None, wins: bool = True
) -> tuple[BoolArray, BoolArray]:
    """Return (H, W) texels of the features that `other` gives as a whole, and those that stay.

    It gives those of which part was seen in `face` neither there nor on the other side, and at most half as
    much in `other`, with what is close to them; of `unlike_features` all where it `wins`, else none. Other
    eyes and mouths stay as they are; brows and nostrils are continued.
    """
    taken, kept = np.zeros((2, *face.mask.shape), bool)
    unlike, theirs = unlike_features(face, other, model), feature_texels(other, model)
    shown = [f.image.seen | (f.image.seen[:, ::-1] & mirrored(f)) for f in (face, other)]
    for name, texels in feature_texels(face, model).items():
        missing, others = (float(np.mean(~seen[texels])) for seen in shown)
        if wins if name in unlike else missing > _WHOLE and others < missing / 2:
            taken |= texels | theirs.get(name, texels)
        elif name in ("eyes", "mouth"):
            kept |= texels
    return face.mask & grown(taken, AROUND) & ~kept, kept


def mirrored(face: ProcessedFace) -> bool:
    """Return whether the left half of the chart is the mirrored right one, as the default model's is."""
    return face.image.region is not None and np.array_equal(face.mask, face.mask[:, ::-1])


def without_catchlights(face: ProcessedFace, model: AnnotatedSurface | None = None) -> FloatArray:
    """Return (H, W, 3) the albedo without reflections of lamps on the eyes: V lowered to its opening."""
    albedo, eyes = face.albedo_linear.astype(np.float64), named_texels(face, FEATURES["eyes"], model)
    if not eyes.any():
        return albedo
    side, around = max(eyes.shape), face.mask & grown(eyes, AROUND)
    value, radius = albedo.max(-1), max(1, round(1.5 * AROUND * side / 2))
    opened = gaussian_filter(grey_opening(value, footprint=disk(radius)), (2 * radius + 1) / 3, mode="mirror")
    # Small spots on eyes are reflections if they are half as bright again as skin.
    most = np.maximum(opened, 1.5 * face.level())
    factor = np.where(around, np.minimum(1.0, most / np.maximum(value, 1e-12)), 1.0)
    return np.asarray(albedo * factor[..., None])


def without_gaps(face: ProcessedFace, model: AnnotatedSurface | None = None) -> ProcessedFace:
    """Return the face with Laplace's smooth log albedo where none was seen, and on `dark_sides`."""
    kept = np.logical_or.reduce([named_texels(face, FEATURES[n], model) for n in ("eyes", "brows", "mouth")])
    gaps = (face.mask & ~face.image.seen & ~kept) | dark_sides(face, model)
    if not gaps.any() or not (known := face.mask & ~gaps).any():
        return face
    return replace(face, albedo_linear=continued_smoothly(face.albedo_linear, gaps, known))


def dark_sides(face: ProcessedFace, model: AnnotatedSurface | None = None) -> BoolArray:
    """Return (H, W) hair and what else is not skin on temples and cheeks along the chart's rim.

    Each connected part is one thing: a beard, which stays, where it covers more of the jaws than of temples
    and cheeks. Faces without labels have no such texels.
    """
    sides, jaws = (named_texels(face, names, model) for names in (SIDES, JAWS))
    part, count = label(named_texels(face, ["hair", "cloth", "beard"]), np.ones((3, 3)))
    covered = [np.bincount(part[t], minlength=count + 1) / max(t.sum(), 1) for t in (sides, jaws)]
    at_rim = np.setdiff1d(part[sides & face.image.border], [0])
    hair = np.isin(part, at_rim[covered[0][at_rim] > covered[1][at_rim]])
    return np.asarray(grown(hair, AROUND) & (sides | jaws))


def grown(texels: BoolArray, part: float) -> BoolArray:
    """Return `texels` (H, W) with those closer than this part of the image's side."""
    side = 2 * max(1, round(part * max(texels.shape))) + 1
    return np.asarray(maximum_filter(texels, side, mode="constant"))
