"""`swap_texture`: one face's shape with another's skin, continued where it was badly seen."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import distance_transform_edt, label, maximum_filter, median

from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, brightest
from scan2albedo.face_model import AnnotatedSurface
from scan2albedo.geometry.fields import filled_over_grid
from scan2albedo.statistics.robust import geman_mcclure_weights
from scan2albedo.unlit import face_features
from scan2albedo.unlit.face_features import AROUND, blurred_inside, feature_texels, grown
from scan2albedo.unlit.processed_face import ProcessedFace, on_common_chart

_MARGIN = 2
"""Texels beside badly seen ones that are not trusted either, and over which a feature at the border fades."""
_UNLIKE = 0.25
"""Departure (of a logarithm) from which on a texel is a feature of one face only."""


@dataclass(frozen=True)
class SwapOptions:
    """Settings of `swap_texture`."""

    match_level: bool = True
    """Scale B's albedo to A's level: an albedo's level depends on its own scan's exposure, and A's lights are
    in A's unit."""
    match_color: bool = True
    """Scale each channel, so that B's skin gets the colour of A's: the tint of a scan's light stays in its
    albedo. Complexion goes with it. Without `match_level` nothing is scaled."""


def swap_texture(
    a: ProcessedFace,
    b: ProcessedFace,
    *,
    options: SwapOptions = SwapOptions(),
    model: AnnotatedSurface | None = None,
) -> ProcessedFace:
    """Return A's geometry with B's albedo and reflectance, under A's lights.

    Where B's texture was not seen, A's detail is continued in B's colours: its gradients of log albedo are
    integrated from the border of B's seen texels, so that no seam is left (Perez, Gangnet, Blake, "Poisson
    image editing", SIGGRAPH 2003). Where A's was not seen either the colour is continued smoothly. Eyes,
    brows, nostrils and mouth are whole: A's where B's scan lacks part of them on both sides and A's has it,
    or where eyes or mouth are open in one face alone, which `notes` then say; else B's. Light left in B's
    albedo is taken off as far as the expected errors of both allow.
    Raises `ApplicationError` when the faces do not share a chart; `TypeError` for other objects than
    processed faces, such as their folders.

    Parameters
    ----------
    a, b : ProcessedFace
        Of one model and size.
    options : SwapOptions
    model : AnnotatedSurface, optional
        With which the faces were processed; the default model when omitted.
    """
    for name, face in (("a", a), ("b", b)):
        require_type(face, ProcessedFace, f"swap_texture: {name}", "load_result(folder) returns one")
    require_type(options, SwapOptions, "swap_texture: options", "make them with SwapOptions()")
    shape, skin = on_common_chart(a, b, model=model)
    levels, gains = (skin.level(), shape.level()), np.ones(3)
    if options.match_level and options.match_color:
        gains = face_features.skin_gains(skin, shape)
    elif options.match_level and min(levels) > 0:
        gains *= levels[1] / levels[0]
    albedo = gains * continued_skin(skin, shape)
    unlike = face_features.unlike_features(skin, shape)
    strength = float(np.exp(np.log(gains).mean())) * skin.reflectance.specular_strength
    valid, scale = shape.mask, skin.image.specular_scale
    image = replace(shape.image, texture_linear=None, texture_valid=valid, specular_scale=scale, labels=None)
    return replace(
        shape,
        name=f"{shape.name}+{skin.name}",
        image=image,
        albedo_linear=albedo.astype(np.float32),
        reflectance=replace(skin.reflectance, specular_strength=strength),
        expected_error=skin.expected_error,
        notes=tuple(face_features.UNLIKE.format(name, shape.name) for name in unlike),
    )


def continued_skin(face: ProcessedFace, other: ProcessedFace, wins: bool = True) -> FloatArray:
    """Return (H, W, 3) the albedo of a face without catchlights and `without_light_left`; `continued` where
    it was not seen, features from its own other side, or as a whole the other face's, see `taken_features`.
    """
    taken, kept = face_features.taken_features(face, other, wins)
    own, detail = (face_features.without_catchlights(f) for f in (face, other))
    if np.allclose(own, detail, rtol=1e-6, atol=0):
        return own
    own = face_features.without_light_left(own, face, other)
    sure, theirs = trusted(face), trusted(other)
    # Where either has a feature, the other one's gradients are of another place.
    both = [texels for f in (face, other) for texels in feature_texels(f).values()]
    featured = grown(np.logical_or.reduce([*both, np.zeros_like(kept)]), AROUND) & ~taken
    from_mirror = featured & sure[:, ::-1] & face_features.mirrored(face)
    source = np.where(taken | (theirs & ~featured), 1, 0) + 2 * from_mirror
    detail = np.where(from_mirror[..., None], own[:, ::-1], detail)
    known = (sure | (kept & ~(from_mirror & ~face.image.seen))) & ~taken
    return continued(own, known, replace(other, albedo_linear=detail.astype(np.float32)), source, taken)


def trusted(face: ProcessedFace) -> BoolArray:
    """Return (H, W) texels that were seen, but for those close to others and for hair at the sides."""
    near = maximum_filter(face.mask & ~face.image.seen, 2 * _MARGIN + 1, mode="constant")
    return face.mask & ~near & ~face_features.dark_sides(face)


def continued(
    albedo: FloatArray, known: BoolArray, other: ProcessedFace, source: IntArray, whole: BoolArray
) -> FloatArray:
    """Return (H, W, 3) `albedo` with the texels not `known` (H, W) continued by the other face's gradients.

    Gradients of log albedo are integrated from the border of the known texels; they are 0 where `source`
    (H, W) is 0, not known, or changes. A feature of one face alone at the border, such as a wrinkle's end,
    would continue as a stain: its difference from its surroundings fades out within a few texels, but for
    that of `whole` (H, W) features. Detail of a sharper face is weakened to the contrast of the known texels.
    """
    missing = other.mask & ~known
    if not missing.any() or not known.any():
        return albedo
    floor = face_features.FLOOR * max(other.level(), 1e-12)
    field = np.log(np.maximum(albedo, floor))
    log_other = np.log(np.maximum(other.albedo_linear.astype(float), floor))
    distance, (row, column) = distance_transform_edt(~known, return_indices=True)
    # What the border would cut in two fades in from there; detail gets no stronger than the face's own is.
    sigma = AROUND * max(known.shape)
    fine = log_other - blurred_inside(log_other, other.mask, sigma)
    own = np.abs(field - blurred_inside(field, known, sigma))[known]
    share = np.median(own) / max(np.median(np.abs(fine[known])), np.finfo(np.float64).tiny)
    cut = 1 - min(share, 1.0) * (1 - np.exp(-((distance / sigma) ** 2)))
    log_other -= (cut * ~grown(whole, AROUND))[..., None] * fine
    across, down = np.diff(log_other, axis=1), np.diff(log_other, axis=0)
    across[(source[:, 1:] != source[:, :-1]) | (source[:, 1:] == 0)] = 0
    down[(source[1:] != source[:-1]) | (source[1:] == 0)] = 0
    feature = _feature_of_one(field - log_other, known & (source == 1) & ~grown(whole, AROUND))
    border, at_border = field[row, column], feature[row, column]
    # What is all around a gap, such as the edge of the other one's beard, is no feature that ends there.
    gaps, count = label(missing | ~other.mask)
    edges = np.where(missing & (distance <= 1), gaps, 0)
    around = [median(part, edges, np.arange(count + 1)) for part in np.moveaxis(at_border, -1, 0)]
    common = np.where((gaps != gaps[0, 0])[..., None], np.stack(around, -1)[gaps], 0.0)
    filled = filled_over_grid(field - feature, missing, known, across=across, down=down) + common
    raised = filled + (at_border - common) * np.exp(-((distance / _MARGIN) ** 2))[..., None]
    faded = np.clip(raised, np.minimum(filled, border), np.maximum(filled, border))
    return np.where(missing[..., None], np.exp(faded), albedo)


def _feature_of_one(difference: FloatArray, both: BoolArray) -> FloatArray:
    """Return two faces' difference (H, W, 3) on the texels of `both` (H, W), less its local mean; else 0.

    The mean is a Gaussian one, reweighted by Geman and McClure's weights.
    """
    sigma = face_features.LOCAL * max(both.shape)
    weight, feature = both.astype(float), np.zeros_like(difference)
    for _ in range(5):
        mean = blurred_inside(difference, weight, sigma)
        feature = np.where(both[..., None], difference - mean, 0.0)
        weight = both * geman_mcclure_weights(brightest(np.abs(feature)), _UNLIKE)
    return feature
