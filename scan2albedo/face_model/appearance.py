"""What each texel of a face is: skin, a brow, an eye, a lip, a nostril, beard, hair, or a thing before it.

Texels of about a millimetre have four features, all relative to this face's own skin: how much darker,
redder and bluer they are (logarithms), and how much stronger their grain is. Of each class there are the
distribution of the features and the places on a face's chart, learned by ``tools/build/appearance.py`` from
heads in many lights. The colour of the skin turns with the light: it is a quadratic in the normal [1]_,
fitted together with the classes by expectation maximisation. Neighbours are likely alike (a Potts model).

.. [1] R. Ramamoorthi, P. Hanrahan, "An efficient representation for irradiance environment maps",
   SIGGRAPH 2001.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np
from scipy import sparse
from scipy.ndimage import map_coordinates, median_filter, uniform_filter

from scan2albedo.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, RealArray, norms
from scan2albedo.geometry.rasterization import area_mean

CLASSES = ("unseen", "skin", "brow", "eye", "lip", "nostril", "beard", "hair", "cloth")
"""By number in `Appearance.labels`. Cloth is whatever else lies before a face: a cap, a mask, glints."""
SURE = 0.95
"""Share of skin where nothing is known of a place."""
TEXEL_MM = 1.4
"""Pores and a picture's noise are averaged at this size, hairs are not."""
TYPICAL_CHROMA = np.array([0.5, -0.35])
"""log R/G and log B/G (linear) of skin, pale to dark, under lamps, skies, in rooms."""
TYPICAL_SPREAD = np.array([0.35, 0.4])
"""Standard deviations of these."""
ANY_SPREAD = 0.7
"""Standard deviation of the chroma of things."""
_SAME_MATERIAL = 0.12
"""Chroma [log] within which texels are one material under one light."""
_LIGHT_SD = np.array([3.0] + [1.0] * 8), np.array([3.0] + [0.3] * 3 + [0.15] * 5)
"""Standard deviations of how skin's log brightness and chroma turn with the normal; first their own."""
_FREEDOM = 15.0
"""Degrees of freedom of the features' t distributions."""
_POWER = 0.6
"""Power of their likelihood, for features of one texel are not independent of its neighbours'."""
PATCH_MM = 30.0
"""Texels nearer than this speak together, not each for itself, of the whole face."""
_HIDDEN = 0.1
"""Probability of a face that shows no features in its colours."""
_FEWEST_TEXELS = 64
"""Fewer texels with colour show no face."""
_DARKEST = 1e-3
"""Part of white below which there is no colour."""
_GRAIN_MM = 7.0
"""Side over which grain is averaged."""
_FAINT = 0.004
"""Contrast of even skin."""
_CLOSE_MM = 1.0
"""Residuals of a good fit."""
_FAR_MM = 3.0
"""Residuals of hair or glasses over it."""
_RELIEF_MM = 12.0
"""Side of the squares over which residuals are averaged to relief."""
_SMOOTH_MM = 0.05
"""Relief of skin without noise."""
_HAIR_AND_CLOTH = np.array([[0, 0.8, -0.6], [0, -1, 0]]) / 30
"""By how much log odds of hair, and of cloth, grow in a mm along x, y and z of the model's frame: a guess."""

Image = Float32Array


@dataclass(frozen=True)
class AppearanceModel:
    """Of the classes but the first: `share` (C, n, n) by place on the chart, `mean` (C + 1, 4), `covariance`
    (C + 1, 4, 4) of the features; the last ones are of skin in cast shadow, which `shaded` of it is."""

    share: FloatArray
    mean: FloatArray
    covariance: FloatArray
    shaded: float

    @classmethod
    @cache
    def default(cls) -> AppearanceModel:
        """Return the one that the package ships."""
        with files("scan2albedo.face_model").joinpath("data/appearance.npz").open("rb") as file:
            arrays = np.load(file)
            share, mean, covariance = (arrays[n].astype(float) for n in ("share", "mean", "covariance"))
            return cls(share, mean, covariance, float(arrays["shaded"]))

    def at_places(self, place: RealArray) -> FloatArray:
        """Return the shares (C, ...) of the classes at places (..., 2), before they sum to one."""
        spot = (np.moveaxis(place, -1, 0) * len(self.share[0])) - 0.5
        return np.maximum([map_coordinates(one, spot, order=1, mode="nearest") for one in self.share], 1e-6)

    def log_likelihood(self, features: FloatArray, wider: float = 1.0) -> FloatArray:
        """Return (C, N) of features (N, 4), where the skin's spread is `wider` times as large."""
        wide = np.where(np.arange(len(self.mean)) == 0, wider**2, 1.0)[:, None, None]
        off, spread = features - self.mean[:, None], self.covariance * wide
        square = ((off @ np.linalg.inv(spread)) * off).sum(-1)
        width = (_FREEDOM + self.mean.shape[1]) * np.log1p(square / _FREEDOM)
        found = -(np.linalg.slogdet(spread)[1][:, None] + width) / 2
        found[0] += np.log1p(-self.shaded)
        found[0] = np.logaddexp(found[0], found[-1] + np.log(self.shaded))
        return found[:-1]


@dataclass(frozen=True)
class Appearance:
    """What the texels (H, W) of an image are."""

    skin: Image
    """How surely skin, 0 to 1; 0 where the surface was not seen."""
    labels: ByteArray
    """The likeliest of `CLASSES`."""
    log_odds: float
    """Of a texture that belongs to the places where it lies on a face, against one that does not; 0 where
    there is no colour or no place, or all is one material."""


def appearance(
    position: FloatArray,
    normal: FloatArray,
    seen: BoolArray,
    texture_linear: Float32Array | None = None,
    *,
    place: RealArray | None = None,
    share: RealArray | None = None,
    residual_mm: FloatArray | None = None,
    model: AppearanceModel | None = None,
) -> Appearance:
    """Return what the texels of a sampled surface are; O(H W), 0.2 s at 512 x 512.

    `position`, `normal` (H, W, 3) are in mm and of length 1; only texels `seen` (H, W), with texture or scan
    near, are read. Without `texture_linear` (H, W, 3) places and relief decide. `place` (H, W, 2) is row and
    column, 0 to 1, on the default model's chart (`GeometryImage.face_chart`); without it counts `share`
    (H, W), the part of each texel's region that is skin, 1 when None. `residual_mm` (H, W) is the distance to
    the scan, NaN where there is none; `model` the package's own when None.
    """
    learned = AppearanceModel.default() if model is None else model
    seen = seen if residual_mm is None else seen & np.isfinite(residual_mm)
    if not seen.any():
        return Appearance(np.zeros(seen.shape, np.float32), np.zeros(seen.shape, np.uint8), 0.0)
    grid = _Grid.of(position, seen)
    known = grid.part > 0.25
    if place is not None:
        prior = learned.at_places(grid.mean(place))
    else:
        skin = SURE * (np.ones(known.shape) if share is None else np.clip(grid.mean(share), 0.05, 1.0))
        others = len(learned.share) - 1
        prior = np.concatenate([skin[None], np.repeat((1 - skin)[None] / others, others, axis=0)])
    log_prior = np.log(prior / prior.sum(0))
    told = np.zeros_like(log_prior)
    log_odds = 0.0
    if np.count_nonzero(known) >= _FEWEST_TEXELS:
        if texture_linear is not None:
            color, turned = grid.mean(texture_linear), grid.mean(normal)
            told, log_odds = _explained(grid, known, color, turned, log_prior, learned)
            if place is not None:
                fits = _fitting(log_prior[:, known], told[:, known], log_odds, grid.independent)
                log_odds = float(np.logaddexp(fits[0], fits[1]) - np.logaddexp(0.0, fits[1]))
        if residual_mm is not None:
            # How rough the scan is around, in parts of the face's own skin: the fitted surface is smooth.
            error_mm = grid.mean(np.minimum(residual_mm, _CLOSE_MM))
            rough = local_mean(error_mm, grid.part, odd_side(_RELIEF_MM / grid.texel_mm))
            likely = known & (prior[0] >= np.median(prior[0][known]))
            usual_mm = max(float(np.median(rough[likely])), _SMOOTH_MM)
            # Skin itself shows up to 1.5 times its median.
            told[0] -= 2.0 * np.maximum(rough / usual_mm - 1.5, 0)
    shares = _agreeing(log_prior + told, lambda own: np.stack([local_mean(one, grid.part, 3) for one in own]))
    likeliest, labels = _resized(shares[0].astype(np.float32), seen.shape), seen.astype(np.uint8)
    weight = np.where(seen, np.minimum(likeliest / SURE, 1), np.float32(0))
    for number, one in enumerate(shares[1:].astype(np.float32), 2):
        fine = _resized(one, seen.shape)
        labels[seen & (fine > likeliest)] = number
        likeliest = np.maximum(likeliest, fine)
    if residual_mm is not None:
        weight *= np.clip((_FAR_MM - np.nan_to_num(residual_mm)) / (_FAR_MM - _CLOSE_MM), 0, 1)
    return Appearance(weight.astype(np.float32), labels, log_odds)


def placed(
    position: FloatArray, normal: FloatArray, seen: BoolArray, place: Image, texture_linear: Image
) -> FloatArray:
    """Return how well a texture fits the places where it lies (3,); arguments of `appearance`.

    Log odds of the classes there, and of skin's hue, against any other thing's texture; of one material
    everywhere, which says nothing of places, against the same; and the log likelihood of the colours
    themselves, to be compared between parts of one texture.
    """
    model, grid = AppearanceModel.default(), _Grid.of(position, seen)
    known, prior = grid.part > 0.25, model.at_places(grid.mean(place))
    log_prior, color = np.log(prior / prior.sum(0)), grid.mean(texture_linear)
    told, hue = _explained(grid, known, color, grid.mean(normal), log_prior, model)
    return _fitting(log_prior[:, known], told[:, known], hue, grid.independent)


def beyond_chart(
    log_color: FloatArray,
    normal: FloatArray,
    skin: FloatArray,
    place: FloatArray,
    offset_mm: FloatArray,
    neighbour_mean: sparse.csr_matrix,
    patch: float,
) -> FloatArray:
    """Return the shares (C, N) of the classes at points of a surface that goes on beyond a face's chart.

    The likelihood is that of the chart without grain, relative to the face's own skin, and then to the
    person's own hair. The prior is that of the nearest point of the chart, and of where hair and clothes are
    from there: features end within a centimetre, odds of hair grow by e in 30 mm up and back, those of cloth
    in 30 mm down.

    Parameters
    ----------
    log_color : (N, 3)
        Logarithms of linear colours less those of a model's light; what is left of the light is fitted.
    normal, skin
        (N, 3), and how surely (N,) skin by the chart's labels, where it reaches.
    place, offset_mm
        Nearest place (N, 2) on the chart (`appearance`), and offset (N, 3) from there in the model's frame.
    neighbour_mean : (N, N)
        `geometry.mesh.neighbour_mean` of the surface.
    patch : float
        Part of a `PATCH_MM` square that a point stands for.
    """
    learned = AppearanceModel.default()
    mean, covariance = learned.mean[:, :3].copy(), learned.covariance[:, :3, :3].copy()
    model = replace(learned, mean=mean, covariance=covariance)
    prior = np.log(model.at_places(place))
    prior[1:6] -= norms(offset_mm) / 10
    prior[6:] += _HAIR_AND_CLOTH @ offset_mm.T
    prior -= np.logaddexp.reduce(prior)
    colors = np.column_stack([log_color.max(-1), log_color[:, ::2] - log_color[:, 1:2]])
    basis, every = light_basis(normal), -(-len(colors) // 2000)
    start = np.median(colors[skin >= skin.max() / 2], axis=0)
    few = colors[::every], basis[::every], prior[:, ::every]
    light, often, _ = _fitted(*few, start, patch * every, model)
    colors -= basis @ light
    any_mean, any_covariance = mean[6].copy(), covariance[6].copy()
    for _ in range(3):
        logs = prior + often[:, None] + _POWER * model.log_likelihood(colors)
        # The person's own hair, beside one patch of any hair.
        weight = patch * _shares(logs)[6]
        mean[6] = (weight @ colors + any_mean) / (weight.sum() + 1)
        off = colors - mean[6]
        covariance[6] = ((weight * off.T) @ off + any_covariance) / (weight.sum() + 1)
    return _agreeing(logs, lambda shares: (neighbour_mean @ shares.T).T)


def _shares(logs: FloatArray) -> FloatArray:
    """Return the shares (C, N) of classes with log likelihoods (C, N)."""
    return np.exp(logs - np.logaddexp.reduce(logs))


def _agreeing(logs: FloatArray, around: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return the shares (C, N) of classes, for neighbours that likely agree.

    Log odds of 2 for the class of all of them; `around` returns the neighbours' mean of shares.
    """
    shares = _shares(logs)
    for _ in range(5):
        shares = _shares(logs + 2 * around(shares))
    return shares


def _fitting(log_prior: FloatArray, likelihood: FloatArray, hue: float, independent: float) -> FloatArray:
    """Return what `placed` does of log likelihoods (C, N)."""
    anywhere = np.logaddexp.reduce(np.log(np.exp(log_prior).mean(1))[:, None] + likelihood)
    here = np.logaddexp.reduce(log_prior + likelihood)
    # Places weigh three times as much as the colours' own evidence, by right and wrong textures.
    told = np.array([3 * (here - anywhere), likelihood[0] - anywhere, here]).sum(1)
    return independent * told + (hue, np.log(_HIDDEN), 0.0)


def features_of(
    texture_linear: Image, normal: Image, part: Image, weight: FloatArray, texel_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Return log brightness, log R/G and log B/G (H, W, 3), and log grain (H, W) relative to the skin's.

    `part` (H, W) of each texel is seen; `weight` (H, W) says how surely it is skin.
    """
    known = part > 0.25
    white = float(np.percentile(texture_linear[known].max(-1), 95))
    logarithm = np.log(np.maximum(texture_linear, max(_DARKEST * white, 1e-9))).astype(float)
    bright = np.where(known, logarithm.max(-1), 0)
    colors = np.stack([bright, *(logarithm[..., c] - logarithm[..., 1] for c in (0, 2))], axis=-1)
    # Contrast is against the mean and the median around: edges, of shadows or of moles, have it against one.
    filled = np.where(known, bright, local_mean(bright, part, odd_side(3 * _GRAIN_MM / texel_mm)))
    edgeless = np.abs(filled - median_filter(filled, 5, mode="nearest"))
    contrast = np.minimum(edgeless, np.abs(filled - local_mean(filled, part, 3)))
    # Skin is never smoother than an even one, nor rougher than a noisy picture's; hair counts up to 0.5.
    own = float(np.median(contrast[known & (weight >= np.median(weight[known]))]))
    grain = local_mean(np.minimum(contrast, 0.5), part, odd_side(_GRAIN_MM / texel_mm))
    return colors, np.log((grain + _FAINT) / (1.3 * np.clip(own, _FAINT, 0.06) + _FAINT))


def light_basis(normal: RealArray) -> FloatArray:
    """Return (..., 9) the constant, linear and quadratic functions of normals (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(normal, float), -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=-1)


def skin_in_light(basis: FloatArray, colors: FloatArray, weight: FloatArray, start: FloatArray) -> FloatArray:
    """Return (9, 3): what `colors` (N, 3) of skin owe to the light, ridge regression about `start` (3,)."""
    found = np.zeros((basis.shape[1], 3))
    for c, scale in enumerate((_LIGHT_SD[0], _LIGHT_SD[1], _LIGHT_SD[1])):
        found[:, c] = np.linalg.solve(
            (basis.T * weight) @ basis + np.diag(scale**-2.0), basis.T @ (weight * (colors[:, c] - start[c]))
        )
    found[0] += start
    return found


def _explained(
    grid: _Grid, seen: BoolArray, texture: Image, normal: Image, log_prior: FloatArray, model: AppearanceModel
) -> tuple[FloatArray, float]:
    """Return (C, h, w) the log likelihood of the classes, and the log odds of the skin's colour.

    That is the colour of skin which explains most.
    """
    weight = np.exp(log_prior[0])
    colors, grain = features_of(texture, normal, grid.part, weight, grid.texel_mm)
    basis, values = light_basis(normal)[seen], np.column_stack([colors[seen], grain[seen]])
    step = -(-len(values) // 1000)  # so many show the skin's light
    few = values[::step], basis[::step], log_prior[:, seen][:, ::step]
    # Brightness and chroma that most texels have which may be skin, and the next ones apart.
    shown, likely = few[0][:, :3], weight[seen][::step]
    candidates = shown[np.argsort(-likely, kind="stable")[: max(len(likely) // 2, 1)]]
    candidates = candidates[:: -(-len(candidates) // 32)]
    distance = ((candidates[:, None, 1:] - shown[:, 1:]) ** 2).sum(-1)
    near = np.exp(-0.5 * distance / _SAME_MATERIAL**2) * likely
    typical = _square(candidates[:, 1:] - TYPICAL_CHROMA, np.diag(TYPICAL_SPREAD**2))
    order = np.argsort(-near.sum(1) * np.exp(-0.5 * typical))
    apart = norms(candidates[order, 1:] - candidates[order[0], 1:]) > 3 * _SAME_MATERIAL
    fits = []
    for k in (order[0], *order[apart][:1]):
        bright = np.average(shown[:, 0], weights=near[k] + 1e-9)
        start = np.array([bright, *candidates[k, 1:]])
        fits.append(_fitted(*few, start, grid.independent * step, model))
    light, often, _ = max(fits, key=lambda fit: fit[2])
    values[:, :3] -= basis @ light
    found = np.zeros_like(log_prior)
    found[:, seen] = often[:, None] + _POWER * model.log_likelihood(values)
    return found, _hue_odds(light[0, 1:])


def _fitted(
    values: FloatArray,
    basis: FloatArray,
    prior: FloatArray,
    start: FloatArray,
    independent: float,
    model: AppearanceModel,
) -> tuple[FloatArray, FloatArray, float]:
    """Return skin in the light (9, 3), how much more often the classes are here (C,), and their evidence.

    Expectation maximisation on brightness, chroma and grain (N, 4) from a colour of skin `start` (3,).
    """
    light, often = np.zeros((basis.shape[1], 3)), np.zeros(len(prior))
    light[0], precision = start, 1 / model.covariance[0, 1, 1]

    def explained(wider: float = 1.0) -> tuple[FloatArray, FloatArray]:
        features = values - np.pad(basis @ light, ((0, 0), (0, values.shape[1] - 3)))
        return features, (prior + often[:, None]) + _POWER * model.log_likelihood(features, wider)

    # Skin is wider in the first rounds: light is known the less at first.
    for wider in (2.0, 1.5, 1.0, 1.0, 1.0):
        features, logs = explained(wider)
        shares = _shares(logs)
        # A cap or a beard is one event, however large: its share is learned here, against one usual patch.
        here, usual = (independent * one.sum(1) + 1 for one in (shares, np.exp(prior)))
        often = np.log(here / usual)
        often -= np.logaddexp.reduce(often + np.log(usual / usual.sum()))
        square = _square(features - model.mean[0], wider**2 * model.covariance[0])
        trust = shares[0] * (_FREEDOM + features.shape[1]) / (_FREEDOM + square)
        light = skin_in_light(basis, values[:, :3], trust * independent * precision, start)
    _, logs = explained()
    turned = sum(float((light[1:, c] ** 2 / _LIGHT_SD[c > 0][1:] ** 2).sum()) for c in range(3))
    evidence = np.logaddexp.reduce(logs).sum() * independent + _hue_odds(light[0, 1:]) - turned / 2
    return light, often, float(evidence)


def _hue_odds(chroma: FloatArray) -> float:
    """Return how much likelier log R/G and log B/G (2,) are of skin in some light than of any thing."""
    skin = _square(chroma - TYPICAL_CHROMA, np.diag(TYPICAL_SPREAD**2))
    thing = _square(chroma, np.eye(2) * ANY_SPREAD**2)
    return float((thing - skin) / 2 + np.log(ANY_SPREAD**2 / TYPICAL_SPREAD.prod()))


@dataclass(frozen=True)
class _Grid:
    """A grid of texels of about `TEXEL_MM` over an image: `part` (h, w) of each that is seen."""

    seen: BoolArray
    part: Image
    texel_mm: float

    @property
    def independent(self) -> float:
        """As how much of an independent one each texel counts."""
        return (self.texel_mm / PATCH_MM) ** 2

    @classmethod
    def of(cls, position: FloatArray, seen: BoolArray) -> _Grid:
        every = max(1, len(seen) // 32)
        steps = (position[::every, 1:] - position[::every, :-1])[seen[::every, 1:] & seen[::every, :-1]]
        side = float(np.median(norms(steps))) if len(steps) else TEXEL_MM
        factor = max(1, round(TEXEL_MM / max(side, TEXEL_MM / min(seen.shape))))
        shape = tuple(-(-texels // factor) for texels in seen.shape)
        return cls(seen, _resized(seen.astype(np.float32), shape), side * factor)

    def mean(self, field: RealArray) -> Image:
        """Return the means over the seen texels of each coarse one; 0 where there is none."""
        flat = field.ndim == 2
        kept = np.where(self.seen if flat else self.seen[..., None], field, 0).astype(np.float32)
        weight = np.maximum(self.part, np.float32(1e-6))
        means = _resized(kept, self.part.shape) / (weight if flat else weight[..., None])
        return np.asarray(means, np.float32)


def _square(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distance of `off` (..., K)."""
    return np.einsum("...i,ij,...j->...", off, np.linalg.inv(covariance), off)


def _resized(field: Image, shape: tuple[int, ...]) -> Image:
    """Return the means of `field` (H, W) or (H, W, C) over the texels of a coarser grid, or between those."""
    from skimage.transform import resize

    if shape[0] < field.shape[0]:
        return area_mean(field, (shape[0], shape[1])).astype(np.float32)
    return np.asarray(resize(field, shape[:2], order=1, mode="edge", anti_aliasing=False), np.float32)


def odd_side(texels: float) -> int:
    """Return the odd number of texels nearest to `texels`, at least 3."""
    return max(3, 2 * round((texels - 1) / 2) + 1)


def local_mean(field: RealArray, weight: Image, side: int) -> FloatArray:
    """Return the weighted mean of `field` (H, W) over squares of `side` texels; 0 without any weight."""
    sums, total = (uniform_filter(f, side, mode="constant") for f in (field * weight, weight))
    return sums / np.maximum(total, np.float32(1e-6 / side**2))
