"""Which texels are eyes, brows, nostrils, mouth or hair, and what two albedos differ by beside the skin."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, grey_opening, label, map_coordinates, maximum_filter, zoom

from scan2albedo.core.arrays import BoolArray, FloatArray, NDArray, RealArray, brightest, norms
from scan2albedo.face_model import default_model
from scan2albedo.face_model.materials import CLASSES
from scan2albedo.geometry.fields import continued_smoothly, surroundings
from scan2albedo.geometry.rasterization import area_interpolated, area_mean
from scan2albedo.unlit.processed_face import ProcessedFace

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


def feature_texels(face: ProcessedFace) -> dict[str, BoolArray]:
    """Return the (H, W) texels of each of `FEATURES` that labels or annotation know."""
    found = {name: texels_of_parts(face, parts) for name, parts in FEATURES.items()}
    return {name: texels for name, texels in found.items() if texels.any()}


def texels_of_parts(face: ProcessedFace, names: Sequence[str]) -> BoolArray:
    """Return (H, W) the texels in the named classes of `face_model.materials` or regions of the model.

    A face without labels has no classes, a face of another model no regions.
    """
    template, image, found = face.model or default_model(), face.image, np.zeros_like(face.mask)
    if image.labels is not None:
        found |= np.isin(image.labels, [k for k, name in enumerate(CLASSES) if name in names])
    if image.region is not None and face.model_name == template.name:
        known = [template.regions[name].index for name in names if name in template.regions]
        found |= np.isin(image.region, known)
    return face.mask & found


def open_features(face: ProcessedFace) -> dict[str, bool]:
    """Return whether the eyes, and the mouth, are open; without a name that the annotation does not know.

    Eyes are where more of their region is likelier of any colour than of the face's own skin around it (both
    Gaussian in log albedo), a mouth where more of its surface lies between the lips, than `_OPEN`.
    """
    found: dict[str, bool] = {}
    eyes = texels_of_parts(face, FEATURES["eyes"][1:])
    inside, around = eyes & face.image.seen, grown(eyes, 2 * AROUND) & ~grown(eyes, 0) & face.bare
    if inside.any() and around.sum() > len(CLASSES):
        floor = FLOOR * face.level()
        lids, shown = (np.log(np.maximum(face.albedo_linear[t], floor)) for t in (around, inside))
        odds, own = np.zeros(len(shown)), np.cov(lids.T) + FLOOR * np.eye(3)
        for sign, spread in ((1, own + np.eye(3) / 2), (-1, own)):
            away = np.linalg.solve(np.linalg.cholesky(spread), (shown - np.median(lids, axis=0)).T)
            odds -= sign * ((away**2).sum(0) + np.linalg.slogdet(spread)[1])
        found["eyes"] = bool(np.mean(odds > 0) > _OPEN)
    mouth = texels_of_parts(face, FEATURES["mouth"][1:])
    if mouth.any():
        area = norms(np.cross(*np.gradient(face.image.position, axis=(0, 1))))
        between = grown(texels_of_parts(face, ["between_lips"]), 0)
        found["mouth"] = bool(area[between].sum() > _OPEN * area[mouth].sum())
    return found


def unlike_features(a: ProcessedFace, b: ProcessedFace) -> list[str]:
    """Return which of eyes and mouth are open in one of two faces and shut in the other."""
    states = [open_features(face) for face in (a, b)]
    return [name for name in states[0] if states[0][name] != states[1].get(name, states[0][name])]


def taken_features(
    face: ProcessedFace, other: ProcessedFace, wins: bool = True
) -> tuple[BoolArray, BoolArray]:
    """Return (H, W) texels of the features that `other` gives as a whole, and those that stay.

    It gives those of which part was seen in `face` neither there nor on the other side, and at most half as
    much in `other`, with what is close to them; of `unlike_features` all where it `wins`, else none. Other
    eyes and mouths stay as they are; brows and nostrils are continued.
    """
    taken, kept = np.zeros((2, *face.mask.shape), bool)
    unlike, theirs = unlike_features(face, other), feature_texels(other)
    shown = [f.image.seen | (f.image.seen[:, ::-1] & mirrored(f)) for f in (face, other)]
    for name, texels in feature_texels(face).items():
        missing, others = (float(np.mean(~seen[texels])) for seen in shown)
        if wins if name in unlike else missing > _WHOLE and others < missing / 2:
            taken |= texels | theirs.get(name, texels)
        elif name in ("eyes", "mouth"):
            kept |= texels
    return face.mask & grown(taken, AROUND) & ~kept, kept


def mirrored(face: ProcessedFace) -> bool:
    """Return whether the left half of the chart is the mirrored right one, as the default model's is."""
    return face.image.region is not None and np.array_equal(face.mask, face.mask[:, ::-1])


def without_catchlights(face: ProcessedFace) -> FloatArray:
    """Return (H, W, 3) the albedo without reflections of lamps on the eyes: V lowered to its opening."""
    albedo, eyes = face.albedo_linear.astype(float), texels_of_parts(face, FEATURES["eyes"])
    if not eyes.any():
        return albedo
    around, radius = face.mask & grown(eyes, AROUND), max(1, round(1.5 * AROUND * max(eyes.shape) / 2))
    window = surroundings(around, 6 * radius)  # farther than both filters reach
    value = brightest(albedo[window])
    step = np.arange(-radius, radius + 1)
    disk = step[:, None] ** 2 + step**2 <= radius**2
    opened = gaussian_filter(grey_opening(value, footprint=disk), (2 * radius + 1) / 3, mode="mirror")
    # Small spots on eyes are reflections if they are half as bright again as skin.
    most = np.maximum(opened, 1.5 * face.level())
    factor = np.where(around[window], np.minimum(1.0, most / np.maximum(value, 1e-12)), 1.0)
    albedo[window] *= factor[..., None]
    return albedo


def without_gaps(face: ProcessedFace) -> ProcessedFace:
    """Return the face with Laplace's smooth log albedo where none was seen, and on `dark_sides`."""
    kept = np.logical_or.reduce([texels_of_parts(face, FEATURES[n]) for n in ("eyes", "brows", "mouth")])
    gaps = (face.mask & ~face.image.seen & ~kept) | dark_sides(face)
    if not gaps.any() or not (known := face.mask & ~gaps).any():
        return face
    return replace(face, albedo_linear=continued_smoothly(face.albedo_linear, gaps, known))


def dark_sides(face: ProcessedFace) -> BoolArray:
    """Return (H, W) hair and what else is not skin on temples and cheeks along the chart's rim.

    Each connected part is one thing: a beard, which stays, where it covers more of the jaws than of temples
    and cheeks. Faces without labels have no such texels.
    """
    sides, jaws = (texels_of_parts(face, names) for names in (SIDES, JAWS))
    part, count = label(texels_of_parts(face, ["hair", "cloth", "beard"]), np.ones((3, 3)))
    covered = [np.bincount(part[t], minlength=count + 1) / max(t.sum(), 1) for t in (sides, jaws)]
    at_rim = np.setdiff1d(part[sides & face.image.border], [0])
    hair = np.isin(part, at_rim[covered[0][at_rim] > covered[1][at_rim]])
    return grown(hair, AROUND) & (sides | jaws)


def grown(texels: BoolArray, part: float) -> BoolArray:
    """Return `texels` (H, W) with those closer than this part of the image's side."""
    side = 2 * max(1, round(part * max(texels.shape))) + 1
    return maximum_filter(texels, side, mode="constant")


_LEAST_TEXELS = 100
"""Of skin that both faces must have."""
LOCAL = 0.04
"""Part of the image's side over which the albedo's mean is taken away before features are matched; the
displacement is averaged over half as much."""


def skin_gains(source: ProcessedFace, target: ProcessedFace) -> FloatArray:
    """Return (3,) the factors that give the source's skin the target's median colour.

    The colour of a scan's light is left in its albedo, so two scans' skins differ by it. Texels count that
    are skin in both faces; seen ones where skin is not known. The factors are 1 for black albedos.
    """
    for texels in (source.bare & target.bare, source.image.seen & target.image.seen):
        if texels.sum() >= _LEAST_TEXELS:
            ours, theirs = (np.median(f.albedo_linear[texels], 0).astype(float) for f in (source, target))
            if min(*ours, *theirs) > 0:
                return theirs / ours
    return np.ones(3)


def without_light_left(albedo: FloatArray, face: ProcessedFace, other: ProcessedFace) -> FloatArray:
    """Return a face's albedo (H, W, 3) with the posterior mean of its smooth part, given the other's.

    Light that was left is smooth. With d the local mean of what the other's log albedo has more, s_1 and s_2
    the expected errors and t^2 = mean d^2 - s_1^2 - s_2^2, by which people differ, the mean moves by
    d s_1^2 / (s_1^2 + s_2^2 + t^2). Nothing moves where errors are not known.
    """
    errors = [each.expected_error for each in (face, other) if each.expected_error is not None]
    both = face.bare & other.bare & (albedo.min(-1) > 0) & (other.albedo_linear.min(-1) > 0)
    if len(errors) < 2 or both.sum() < _LEAST_TEXELS:
        return albedo
    more, sigma = np.zeros(albedo.shape), LOCAL * max(both.shape)
    more[both] = np.log(skin_gains(other, face) * other.albedo_linear[both] / albedo[both])
    d = blurred_inside(more, both, sigma)
    ours, others = (blurred_inside(error.astype(float) ** 2, both, sigma) for error in errors)
    people = max(np.mean(d[both] ** 2) - np.mean((ours + others)[both]), 0.0)
    share = np.divide(ours, ours + others + people, out=np.zeros_like(ours), where=ours > 0)
    return albedo * np.exp(d * share[..., None])


def displacement(
    a: FloatArray, b: FloatArray, mask: BoolArray, marks: Sequence[tuple[BoolArray, BoolArray]] = ()
) -> FloatArray:
    """Return (H, W, 2) by how many texels (across, down) the features of albedo `b` lie beside those of `a`.

    Albedos are (H, W, 3), 0 outside `mask` (H, W). Two fits put one nostril, or one brow, on texels that
    differ a little, and a mean of both shows it twice. The fields f are the local contrast of log V and the
    `marks`, texels (H, W) of one feature in either face. From coarse to fine, the most probable u of
    |f_a(x) - f_b(x + u)|^2 / s^2 + |u|^2 / t^2 over a neighbourhood is found by Gauss-Newton steps: s^2 is
    what a field differs by where it has slopes, t the reach of features (B. Lucas, T. Kanade, "An iterative
    image registration technique", IJCAI 1981).
    """
    # What departs by more than three deviations does not count more; a side of 128 texels is fine enough.
    contrasts = [np.clip(local_contrast(skin, mask) / 3, -1, 1) for skin in (a, b)]
    pairs = [contrasts, *(pair for pair in marks if pair[0].any() and pair[1].any())]
    coarse = min(128 / max(mask.shape), 1.0)
    shape = int(np.ceil(coarse * mask.shape[0])), int(np.ceil(coarse * mask.shape[1]))
    fields = np.array([[area_mean(field, shape) for field in pair] for pair in pairs])
    window, reach = LOCAL / 2 * max(shape), AROUND * max(shape)
    moved, places, tiny = np.zeros((2, *shape)), np.indices(shape), np.finfo(np.float64).eps
    for blur in (2 * reach, reach, reach / 2):
        ours, theirs = np.moveaxis(gaussian_filter(fields, (0, 0, blur, blur), mode="nearest"), 1, 0)
        layers = np.concatenate([theirs[None], np.gradient(theirs, axis=(1, 2))])
        for _ in range(10):
            at = places + moved
            seen = [[map_coordinates(f, at, order=1, mode="nearest") for f in layer] for layer in layers]
            rest, slopes = ours - seen[0], np.array(seen[1:])
            steep = (slopes**2).sum(0)
            noise = (np.sum(rest**2 * steep) + tiny) / (np.sum(steep) + tiny)
            # In a neighbourhood there are as many independent differences as blurred spots.
            weight = (window / blur) ** 2 / max(noise, tiny)
            products = np.concatenate([rest * slopes, slopes[:1] * slopes, slopes[1:] * slopes[1:]])
            means = gaussian_filter(weight * products.sum(1), (0, window, window))
            down, across = means[:2] - moved / reach**2
            yy, yx, xx = means[2:] + np.reshape([1, 0, 1], (3, 1, 1)) / reach**2
            step = np.array([xx * down - yx * across, yy * across - yx * down]) / (yy * xx - yx**2)
            moved = gaussian_filter(moved + step, (0, window / 2, window / 2))
    up = np.divide(mask.shape, shape)
    moved = zoom(moved, (1, *up), order=1, mode="nearest", grid_mode=True)
    return np.moveaxis(moved[::-1], 0, -1) * up[::-1]


def warped(field: FloatArray, flow: FloatArray) -> FloatArray:
    """Return the field (H, W) or (H, W, C) looked up `flow` (H, W, 2) texels beside each texel."""
    at = np.indices(flow.shape[:2]) + np.moveaxis(flow[..., ::-1], -1, 0)
    channels = np.moveaxis(np.atleast_3d(field), -1, 0)
    moved = np.stack([map_coordinates(channel, at, order=3, mode="nearest") for channel in channels], -1)
    return np.clip(moved, field.min(), field.max()).reshape(field.shape)


def local_contrast(albedo: FloatArray, mask: BoolArray) -> FloatArray:
    """Return (H, W) log V less its local mean, in its robust deviation; 0 outside the mask."""
    value = np.log(np.maximum(brightest(albedo), 1e-4 * max(float(albedo.max()), 1e-12)))
    rest = np.where(mask, value - blurred_inside(value, mask, LOCAL * max(mask.shape)), 0.0)
    return rest / max(float(np.std(rest[mask])), 1e-6)


def blurred_inside(field: RealArray, weight: NDArray, sigma: float) -> FloatArray:
    """Return the Gaussian means of a field (H, W) or (H, W, C), texels counting by `weight` (H, W)."""
    inside = weight.reshape(*weight.shape, *[1] * (field.ndim - 2)).astype(float)
    parts = [_blurred(part, sigma) for part in (field * inside, inside)]
    return parts[0] / np.maximum(parts[1], 1e-6)


def _blurred(field: FloatArray, sigma: float) -> FloatArray:
    """Return a field (H, W, ...) blurred by a Gaussian, mirrored at its edges.

    What is as smooth as a broad one leaves it is known by its means over blocks of a fifth of `sigma`.
    """
    side = round(sigma / 5)
    if side < 2:
        return gaussian_filter(field, sigma, mode="mirror", axes=(0, 1))
    small = area_mean(field, (-(-field.shape[0] // side), -(-field.shape[1] // side)))
    blurred = gaussian_filter(small, sigma * len(small) / len(field), mode="reflect", axes=(0, 1))
    return area_interpolated(blurred, field.shape[:2])
