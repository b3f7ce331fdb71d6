"""What each place of a face is made of: skin, brow, eye, lip, nostril, beard, hair, or a thing before it.

One mixture model labels the nodes of a `Graph`: texels of a chart of about a millimetre (`chart_materials`),
or a mesh's vertices around the face (`materials_beyond_chart`). A node has three or four features, all
relative to this face's own skin: how much darker, redder and bluer it is (logarithms), and how much stronger
its grain is. Of each class there are the distribution of the features and the places on a face's chart,
learned by ``tools/build/appearance.py`` from heads in many lights. The colour of the skin turns with the
light: it is a quadratic in the normal [1]_, fitted together with the classes by expectation maximisation.
Neighbours are likely of one class (a Potts model, by mean fields). The two entrances differ in their priors.

.. [1] R. Ramamoorthi, P. Hanrahan, "An efficient representation for irradiance environment maps",
   SIGGRAPH 2001.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np
from scipy import sparse
from scipy.ndimage import map_coordinates, median_filter, uniform_filter

from scan2albedo.core.arrays import BoolArray, ByteArray, Float32Array, FloatArray, RealArray, norms, row_sums
from scan2albedo.geometry.rasterization import area_mean
from scan2albedo.statistics.robust import student_t_weights

CLASSES = ("unseen", "skin", "brow", "eye", "lip", "nostril", "beard", "hair", "cloth")
"""By number in `Materials.labels`. Cloth is whatever else lies before a face: a cap, a mask, glints."""
_FEATURES = slice(CLASSES.index("brow") - 1, CLASSES.index("hair") - 1)
"""The classes that only a face has, among those of a mixture, which has no "unseen"."""
_HAIR = CLASSES.index("hair") - 1
_CLOTH = CLASSES.index("cloth") - 1
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
_LIGHT_SD = np.array([[3.0, 3.0, 3.0], *[[1.0, 0.3, 0.3]] * 3, *[[1.0, 0.15, 0.15]] * 5])
"""(9, 3): standard deviations of skin's log brightness and chroma in the functions of `light_basis`."""
_FREEDOM = 15.0
"""Degrees of freedom of the features' t distributions."""
_POWER = 0.6
"""Power of their likelihood, for features of one texel are not independent of its neighbours'."""
PATCH_MM = 30.0
"""Nodes nearer than this speak together, not each for itself, of the whole face."""
_HIDDEN = 0.1
"""Probability of a face that shows no features in its colours."""
_NEIGHBOUR_ODDS = 2.0
"""Log odds of the class that all neighbours have."""
_PLACES_COUNT = 3
"""Places weigh so many times as much as the colours' own evidence, by right and wrong textures."""
_LEARNING_TEXELS = 1000
"""So many texels show the light of the skin."""
_LEARNING_VERTICES = 2000
"""So many vertices of a scan do."""
_FEWEST_TEXELS = 64
"""Fewer texels with colour show no face."""
_LEAST_PART = 0.25
"""Of a texel that is seen has a colour."""
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
_RIM_MM = 10.0
"""Over so much of the surface beyond the chart the odds of a face's features fall by e."""
_HAIR_PER_MM = np.array([0.0, 0.8, -0.6]) / 30
"""By how much log odds of hair grow in a mm along x, y and z of the model's frame: a guess."""
_CLOTH_PER_MM = np.array([0.0, -1.0, 0.0]) / 30
"""The same of cloth: a guess."""

Image = Float32Array


@dataclass(frozen=True)
class MaterialModel:
    """Of the classes but the first: `share` (C, n, n) by place on the chart, `mean` (C + 1, K), `covariance`
    (C + 1, K, K) of the features; the last ones are of skin in cast shadow, which `shaded` of it is."""

    share: FloatArray
    mean: FloatArray
    covariance: FloatArray
    shaded: float

    @classmethod
    @cache
    def default(cls) -> MaterialModel:
        """Return the one that the package ships; K = 4."""
        with files("scan2albedo.face_model").joinpath("data/appearance.npz").open("rb") as file:
            arrays = np.load(file)
            share, mean, covariance = (arrays[n].astype(float) for n in ("share", "mean", "covariance"))
            return cls(share, mean, covariance, float(arrays["shaded"]))

    def without_grain(self) -> MaterialModel:
        """Return the model of the first three features."""
        return replace(self, mean=self.mean[:, :3], covariance=self.covariance[:, :3, :3])

    def at_places(self, place: RealArray) -> FloatArray:
        """Return the shares (C, ...) of the classes at places (..., 2), before they sum to one."""
        spot = (np.moveaxis(place, -1, 0) * len(self.share[0])) - 0.5
        return np.maximum([map_coordinates(one, spot, order=1, mode="nearest") for one in self.share], 1e-6)

    def log_likelihood(self, features: FloatArray, wider: float = 1.0) -> FloatArray:
        """Return (C, N) of features (N, K), where the skin's spread is `wider` times as large."""
        wide = np.where(np.arange(len(self.mean)) == 0, wider**2, 1.0)[:, None, None]
        off, spread = features - self.mean[:, None], self.covariance * wide
        square = ((off @ np.linalg.inv(spread)) * off).sum(-1)
        width = (_FREEDOM + self.mean.shape[1]) * np.log1p(square / _FREEDOM)
        found = -(np.linalg.slogdet(spread)[1][:, None] + width) / 2
        found[0] += np.log1p(-self.shaded)
        found[0] = np.logaddexp(found[0], found[-1] + np.log(self.shaded))
        return found[:-1]

    def skin_trust(self, features: FloatArray, wider: float) -> FloatArray:
        """Return the weights (N,) of features (N, K) as skin, by its t distribution (`log_likelihood`)."""
        square = _square(features - self.mean[0], wider**2 * self.covariance[0])
        return student_t_weights(square, _FREEDOM, features.shape[1])

    def with_own(self, number: int, features: FloatArray, patches: FloatArray) -> MaterialModel:
        """Return the model with a person's own class, known of `patches` (N,) beside one usual patch."""
        mean, covariance, total = self.mean.copy(), self.covariance.copy(), patches.sum() + 1
        mean[number] = (patches @ features + mean[number]) / total
        off = features - mean[number]
        covariance[number] = ((patches * off.T) @ off + covariance[number]) / total
        return replace(self, mean=mean, covariance=covariance)


@dataclass(frozen=True)
class Graph:
    """Nodes (N,) whose materials are to be found: what is known of each, and which are neighbours."""

    log_prior: FloatArray
    """(C, N): of the classes of `MaterialModel`."""
    known: BoolArray
    """(N,): which nodes have a colour; of others only the prior and the neighbours decide."""
    features: FloatArray
    """(N, K): log brightness, log R/G, log B/G and, with K = 4, log grain."""
    basis: FloatArray
    """(N, 9): `light_basis` of the normals."""
    neighbours: sparse.csr_matrix
    """(N, N): means over the nodes around each; rows sum to 1."""
    independent: float
    """As how much of an independent node each counts, see `PATCH_MM`."""

    def thinned(self, most: int) -> Graph:
        """Return the graph of some, at `most`, of the known nodes, which count as much as all."""
        known = np.flatnonzero(self.known)
        step = -(-len(known) // most)
        some = known[::step]
        return Graph(
            self.log_prior[:, some],
            self.known[some],
            self.features[some],
            self.basis[some],
            self.neighbours[some][:, some],
            self.independent * step,
        )

    def posterior(self, log_likelihood: FloatArray) -> FloatArray:
        """Return the shares (C, N) of the classes, for neighbours that likely agree."""
        logs = self.log_prior + log_likelihood
        shares = _shares(logs)
        for _ in range(5):
            shares = _shares(logs + _NEIGHBOUR_ODDS * (self.neighbours @ shares.T).T)
        return shares


@dataclass(frozen=True)
class Mixture:
    """What the colours of a graph's nodes are explained by."""

    model: MaterialModel
    """With what was learned of the person's own classes."""
    light: FloatArray
    """(9, 3): log brightness and chroma of skin, by `light_basis`."""
    log_often: FloatArray
    """(C,): how much more often the classes are here."""

    @classmethod
    def fitted(cls, graph: Graph, skin_colors: Sequence[FloatArray], model: MaterialModel) -> Mixture:
        """Return the mixture of known nodes with the greatest evidence, sought from `skin_colors` (3,)."""
        fits = [cls._sought(graph, start, model) for start in skin_colors]
        return max(fits, key=lambda fit: fit.evidence(graph))

    @classmethod
    def _sought(cls, graph: Graph, start: FloatArray, model: MaterialModel) -> Mixture:
        """Return the mixture that expectation maximisation finds from one colour of skin."""
        found = cls(model, np.zeros_like(_LIGHT_SD), np.zeros(len(graph.log_prior)))
        found.light[0] = start
        prior_count = graph.independent * np.exp(graph.log_prior).sum(1) + 1
        precision = graph.independent / model.covariance[0, 1, 1]
        # Skin is wider in the first rounds: light is known the less at first.
        for wider in (2.0, 1.5, 1.0, 1.0, 1.0):
            shares = _shares(graph.log_prior + found.log_likelihood(graph, wider))
            trust = shares[0] * found.model.skin_trust(found.relative_to_skin(graph), wider)
            light = fit_light(graph.basis, graph.features[:, :3], precision * trust, start)
            # A cap or a beard is one event, however large: its share is learned, against one usual patch.
            log_often = np.log((graph.independent * shares.sum(1) + 1) / prior_count)
            log_often -= np.logaddexp.reduce(log_often + np.log(prior_count / prior_count.sum()))
            found = cls(model, light, log_often)
        return found

    def with_own(self, graph: Graph, number: int) -> Mixture:
        """Return the mixture where a class has the distribution of this person's, beside one usual patch."""
        found, relative = self, self.relative_to_skin(graph)
        for _ in range(2):
            shares = _shares(graph.log_prior + found.log_likelihood(graph))
            model = self.model.with_own(number, relative, graph.independent * shares[number])
            found = replace(self, model=model)
        return found

    def evidence(self, graph: Graph) -> float:
        """Return the log evidence of the mixture by a graph whose nodes are all known."""
        explained = np.logaddexp.reduce(graph.log_prior + self.log_likelihood(graph)).sum()
        turned = (self.light[1:] ** 2 / _LIGHT_SD[1:] ** 2).sum()
        return float(explained * graph.independent + self.hue_log_odds - turned / 2)

    @property
    def hue_log_odds(self) -> float:
        """How much likelier the skin's chroma is of skin in some light than of any thing."""
        chroma = self.light[0, 1:]
        skin = _square(chroma - TYPICAL_CHROMA, np.diag(TYPICAL_SPREAD**2))
        thing = _square(chroma, np.eye(2) * ANY_SPREAD**2)
        return float((thing - skin) / 2 + np.log(ANY_SPREAD**2 / TYPICAL_SPREAD.prod()))

    def relative_to_skin(self, graph: Graph) -> FloatArray:
        """Return the features (N, K) less those of skin in this light."""
        relative = graph.features.copy()
        relative[:, :3] -= graph.basis @ self.light
        return relative

    def log_likelihood(self, graph: Graph, wider: float = 1.0) -> FloatArray:
        """Return (C, N) of the nodes' features, and of how often classes are; 0 without a colour.

        Skin's spread is `wider` times as large.
        """
        likelihood = self.model.log_likelihood(self.relative_to_skin(graph), wider)
        return np.where(graph.known, self.log_often[:, None] + _POWER * likelihood, 0.0)


@dataclass(frozen=True)
class Materials:
    """What the texels (H, W) of an image are."""

    skin: Image
    """How surely skin, 0 to 1; 0 where the surface was not seen."""
    labels: ByteArray
    """The likeliest of `CLASSES`."""
    log_odds: float
    """Of a texture that belongs to the places where it lies on a face, against one that does not; 0 where
    there is no colour or no place, or all is one material."""


def chart_materials(
    position: FloatArray,
    normal: FloatArray,
    seen: BoolArray,
    texture_linear: Float32Array | None = None,
    *,
    place: RealArray | None = None,
    share: RealArray | None = None,
    residual_mm: FloatArray | None = None,
) -> Materials:
    """Return what the texels of a sampled surface are; O(H W), 0.2 s at 512 x 512.

    `position`, `normal` (H, W, 3) are in mm and of length 1; only texels `seen` (H, W), with texture or scan
    near, are read. Without `texture_linear` (H, W, 3) places and relief decide. `place` (H, W, 2) is row and
    column, 0 to 1, on the default model's chart (`GeometryImage.face_chart`); without it counts `share`
    (H, W), the part of each texel's region that is skin, 1 when None. `residual_mm` (H, W) is the distance to
    the scan, NaN where there is none.
    """
    model = MaterialModel.default()
    seen = seen if residual_mm is None else seen & np.isfinite(residual_mm)
    if not seen.any():
        return Materials(np.zeros(seen.shape, np.float32), np.zeros(seen.shape, np.uint8), 0.0)
    grid = _Grid.of(position, seen)
    if place is not None:
        prior = model.at_places(grid.mean(place))
    else:
        skin = SURE * (np.ones(grid.part.shape) if share is None else np.clip(grid.mean(share), 0.05, 1.0))
        others = len(model.share) - 1
        prior = np.concatenate([skin[None], np.repeat((1 - skin)[None] / others, others, axis=0)])
    graph = grid.graph(prior, normal, texture_linear)
    log_likelihood = np.zeros_like(graph.log_prior)
    log_odds = 0.0
    enough = np.count_nonzero(grid.known) >= _FEWEST_TEXELS
    if enough and texture_linear is not None:
        mixture = _chart_mixture(graph)
        log_likelihood += mixture.log_likelihood(graph)
        log_odds = mixture.hue_log_odds
        if place is not None:
            fits = _fit_to_places(graph, mixture)
            log_odds = float(np.logaddexp(fits[0], fits[1]) - np.logaddexp(0.0, fits[1]))
    if enough and residual_mm is not None:
        log_likelihood[0] += grid.smooth_log_odds(residual_mm, prior[0])
    shares = graph.posterior(log_likelihood).reshape(-1, *grid.part.shape).astype(np.float32)
    likeliest, labels = _resized(shares[0], seen.shape), seen.astype(np.uint8)
    weight = np.where(seen, np.minimum(likeliest / SURE, 1), np.float32(0))
    for number, one in enumerate(shares[1:], 2):
        fine = _resized(one, seen.shape)
        labels[seen & (fine > likeliest)] = number
        likeliest = np.maximum(likeliest, fine)
    if residual_mm is not None:
        weight *= np.clip((_FAR_MM - np.nan_to_num(residual_mm)) / (_FAR_MM - _CLOSE_MM), 0, 1)
    return Materials(weight.astype(np.float32), labels, log_odds)


def fit_to_places(
    position: FloatArray, normal: FloatArray, seen: BoolArray, place: Image, texture_linear: Image
) -> FloatArray:
    """Return how well a texture fits the places where it lies (3,); arguments of `chart_materials`.

    Log odds of the classes there, and of skin's hue, against any other thing's texture; of one material
    everywhere, which says nothing of places, against the same; and the log likelihood of the colours
    themselves, to be compared between parts of one texture.
    """
    model, grid = MaterialModel.default(), _Grid.of(position, seen)
    graph = grid.graph(model.at_places(grid.mean(place)), normal, texture_linear)
    return _fit_to_places(graph, _chart_mixture(graph))


def _fit_to_places(graph: Graph, mixture: Mixture) -> FloatArray:
    log_prior, likelihood = (of[:, graph.known] for of in (graph.log_prior, mixture.log_likelihood(graph)))
    anywhere = np.logaddexp.reduce(np.log(np.exp(log_prior).mean(1))[:, None] + likelihood)
    here = np.logaddexp.reduce(log_prior + likelihood)
    sums = np.array([_PLACES_COUNT * (here - anywhere), likelihood[0] - anywhere, here]).sum(1)
    return graph.independent * sums + (mixture.hue_log_odds, np.log(_HIDDEN), 0.0)


def materials_beyond_chart(
    log_color: FloatArray,
    normal: FloatArray,
    skin: FloatArray,
    place: FloatArray,
    offset_mm: FloatArray,
    neighbours: sparse.csr_matrix,
    edge_mm: float,
) -> FloatArray:
    """Return the shares (C, N) of the classes at points of a surface that goes on beyond a face's chart.

    The likelihood is that of the chart without grain, relative to the face's own skin, and of hair to the
    person's own. The prior is that of the nearest point of the chart, and of where hair and clothes are from
    there: features end within a centimetre, hair lies above and behind, cloth below.

    Parameters
    ----------
    log_color : (N, 3)
        Logarithms of linear colours less those of a model's light; what is left of the light is fitted.
    normal, skin
        (N, 3), and how surely (N,) skin by the chart's labels, where it reaches.
    place, offset_mm
        Nearest place (N, 2) on the chart (`chart_materials`), and offset (N, 3) from there in the model's
        frame.
    neighbours : (N, N)
        `geometry.mesh.neighbour_mean` of the surface.
    edge_mm : float
        Distance between neighbours.
    """
    model = MaterialModel.default().without_grain()
    log_prior = np.log(model.at_places(place))
    log_prior[_FEATURES] -= norms(offset_mm) / _RIM_MM
    log_prior[_HAIR] += offset_mm @ _HAIR_PER_MM
    log_prior[_CLOTH] += offset_mm @ _CLOTH_PER_MM
    log_prior -= np.logaddexp.reduce(log_prior)
    graph = Graph(
        log_prior,
        np.ones(len(skin), bool),
        np.column_stack([log_color.max(-1), log_color[:, ::2] - log_color[:, 1:2]]),
        light_basis(normal),
        neighbours,
        (edge_mm / PATCH_MM) ** 2,
    )
    start = np.median(graph.features[skin >= skin.max() / 2], axis=0)
    mixture = Mixture.fitted(graph.thinned(_LEARNING_VERTICES), [start], model).with_own(graph, _HAIR)
    return graph.posterior(mixture.log_likelihood(graph))


def chart_features(
    texture_linear: Image, part: Image, weight: FloatArray, texel_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Return log brightness, log R/G and log B/G (H, W, 3), and log grain (H, W) relative to the skin's.

    `part` (H, W) of each texel is seen; `weight` (H, W) says how surely it is skin.
    """
    known = part > _LEAST_PART
    white = float(np.percentile(texture_linear[known].max(-1), 95))
    logarithm = np.log(np.maximum(texture_linear, max(_DARKEST * white, 1e-9))).astype(float)
    bright = np.where(known, logarithm.max(-1), 0)
    colors = np.stack([bright, *(logarithm[..., c] - logarithm[..., 1] for c in (0, 2))], axis=-1)
    # Contrast is against the mean and the median around: edges, of shadows or of moles, have it against one.
    filled = np.where(known, bright, _local_mean(bright, part, 3 * _GRAIN_MM / texel_mm))
    edgeless = np.abs(filled - median_filter(filled, 5, mode="nearest"))
    contrast = np.minimum(edgeless, np.abs(filled - _local_mean(filled, part, 3)))
    # Skin is never smoother than an even one, nor rougher than a noisy picture's; hair counts up to 0.5.
    own = float(np.median(contrast[known & (weight >= np.median(weight[known]))]))
    grain = _local_mean(np.minimum(contrast, 0.5), part, _GRAIN_MM / texel_mm)
    return colors, np.log((grain + _FAINT) / (1.3 * np.clip(own, _FAINT, 0.06) + _FAINT))


def light_basis(normal: RealArray) -> FloatArray:
    """Return (..., 9) the constant, linear and quadratic functions of normals (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(normal, float), -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=-1)


def fit_light(basis: FloatArray, colors: FloatArray, weight: FloatArray, start: FloatArray) -> FloatArray:
    """Return (9, 3): what `colors` (N, 3) of skin owe to the light, ridge regression about `start` (3,).

    Colours are those of `Graph.features`, `weight` (N,) their precisions, `basis` (N, 9) is `light_basis`.
    """
    weighted = basis.T * weight
    ridge = np.eye(len(_LIGHT_SD)) * (_LIGHT_SD.T**-2.0)[:, None]
    right = (weighted @ (colors - start)).T[..., None]
    found = np.asarray(np.linalg.solve(weighted @ basis + ridge, right), float)[..., 0].T
    found[0] += start
    return found


def _chart_mixture(graph: Graph) -> Mixture:
    """Return the mixture of a chart, whose skin has a colour that most texels have which may be skin."""
    few = graph.thinned(_LEARNING_TEXELS)
    colors, likely = few.features[:, :3], np.exp(few.log_prior[0])
    candidates = colors[np.argsort(-likely, kind="stable")[: max(len(likely) // 2, 1)]]
    candidates = candidates[:: -(-len(candidates) // 32)]
    distance = ((candidates[:, None, 1:] - colors[:, 1:]) ** 2).sum(-1)
    near = np.exp(-0.5 * distance / _SAME_MATERIAL**2) * likely
    typical = _square(candidates[:, 1:] - TYPICAL_CHROMA, np.diag(TYPICAL_SPREAD**2))
    order = np.argsort(-near.sum(1) * np.exp(-0.5 * typical))
    # The first colour, and the next one apart from it.
    apart = norms(candidates[order, 1:] - candidates[order[0], 1:]) > 3 * _SAME_MATERIAL
    starts = [
        np.array([np.average(colors[:, 0], weights=near[k] + 1e-9), *candidates[k, 1:]])
        for k in (order[0], *order[apart][:1])
    ]
    return Mixture.fitted(few, starts, MaterialModel.default())


def _shares(logs: FloatArray) -> FloatArray:
    """Return the shares (C, N) of classes with log likelihoods (C, N)."""
    return np.exp(logs - np.logaddexp.reduce(logs))


@dataclass(frozen=True)
class _Grid:
    """A grid of texels of about `TEXEL_MM` over an image: `part` (h, w) of each that is `seen` (H, W)."""

    seen: BoolArray
    part: Image
    texel_mm: float

    @classmethod
    def of(cls, position: FloatArray, seen: BoolArray) -> _Grid:
        every = max(1, len(seen) // 32)
        steps = (position[::every, 1:] - position[::every, :-1])[seen[::every, 1:] & seen[::every, :-1]]
        side = float(np.median(norms(steps))) if len(steps) else TEXEL_MM
        factor = max(1, round(TEXEL_MM / max(side, TEXEL_MM / min(seen.shape))))
        shape = tuple(-(-texels // factor) for texels in seen.shape)
        return cls(seen, _resized(seen.astype(np.float32), shape), side * factor)

    @property
    def known(self) -> BoolArray:
        """(h, w): of which texels enough is seen."""
        return self.part > _LEAST_PART

    def mean(self, field: RealArray) -> Image:
        """Return the means over the seen texels of each coarse one; 0 where there is none."""
        flat = field.ndim == 2
        kept = np.where(self.seen if flat else self.seen[..., None], field, 0).astype(np.float32)
        weight = np.maximum(self.part, np.float32(1e-6))
        means = _resized(kept, self.part.shape) / (weight if flat else weight[..., None])
        return np.asarray(means, np.float32)

    def graph(self, prior: FloatArray, normal: FloatArray, texture_linear: Image | None) -> Graph:
        """Return the texels as a graph; of a prior (C, h, w), normals and colours (H, W, 3)."""
        known = self.known if texture_linear is not None else np.zeros_like(self.known)
        prior = (prior / prior.sum(0)).reshape(len(prior), -1)
        features = np.zeros((known.size, 4))
        if texture_linear is not None and known.any():
            likely = prior[0].reshape(known.shape)
            colors, grain = chart_features(self.mean(texture_linear), self.part, likely, self.texel_mm)
            features = np.dstack([colors, grain]).reshape(-1, 4)
        # Neighbours are the texels of 3 x 3, each as far as it is seen.
        tridiagonal = [sparse.diags([1.0, 1.0, 1.0], [-1, 0, 1], shape=(side, side)) for side in known.shape]
        around = sparse.kron(*tridiagonal, format="csr") @ sparse.diags(self.part.ravel().astype(float))
        neighbours = sparse.diags(1 / np.maximum(row_sums(around), 1e-6)) @ around
        independent = (self.texel_mm / PATCH_MM) ** 2
        basis = light_basis(self.mean(normal).reshape(-1, 3))
        return Graph(np.log(prior), known.ravel(), features, basis, neighbours, independent)

    def smooth_log_odds(self, residual_mm: FloatArray, likely_skin: FloatArray) -> FloatArray:
        """Return log odds of skin (h w,) by how rough the scan is, beside the parts that are `likely_skin`.

        The fitted surface is smooth: residuals (H, W) show the relief of hair.
        """
        error_mm = self.mean(np.minimum(residual_mm, _CLOSE_MM))
        rough = _local_mean(error_mm, self.part, _RELIEF_MM / self.texel_mm)
        likely = self.known & (likely_skin >= np.median(likely_skin[self.known]))
        typical_mm = max(float(np.median(rough[likely])), _SMOOTH_MM)
        # Skin itself shows up to 1.5 times its median.
        return -2.0 * np.maximum(rough / typical_mm - 1.5, 0).ravel()


def _square(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distance of `off` (..., K)."""
    return np.einsum("...i,ij,...j->...", off, np.linalg.inv(covariance), off)


def _resized(field: Image, shape: tuple[int, ...]) -> Image:
    """Return the means of `field` (H, W) or (H, W, C) over the texels of a coarser grid, or between those."""
    from skimage.transform import resize

    if shape[0] < field.shape[0]:
        return area_mean(field, (shape[0], shape[1])).astype(np.float32)
    return np.asarray(resize(field, shape[:2], order=1, mode="edge", anti_aliasing=False), np.float32)


def _local_mean(field: RealArray, weight: Image, texels: float) -> FloatArray:
    """Return the weighted mean of `field` (H, W) over squares of an odd number of texels, at least 3."""
    side = max(3, 2 * round((texels - 1) / 2) + 1)
    sums, total = (uniform_filter(f, side, mode="constant") for f in (field * weight, weight))
    return sums / np.maximum(total, np.float32(1e-6 / side**2))
