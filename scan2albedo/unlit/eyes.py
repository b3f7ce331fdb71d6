"""Eyeballs behind a face's lids: the outline of each opening, the globe in it, its colours and its mesh.

.. [1] I. Bekerman, P. Gottlieb, M. Vaiman, "Variations in eyeball diameters of the healthy adults", Journal
   of Ophthalmology, 2014.
.. [2] F. Rüfer, A. Schröder, C. Erb, "White-to-white corneal diameter", Cornea 24(3), 2005.
.. [3] A. Gullstrand's eye, in D. Atchison, G. Smith, "Optics of the Human Eye", 2000.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial import cKDTree
from scipy.special import expit

from scan2albedo.core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, grid_faces, norms, smoothstep
from scan2albedo.geometry.mesh import normalized
from scan2albedo.io.glb import GlbPart
from scan2albedo.statistics.robust import normal_deviation
from scan2albedo.unlit.face_features import FLOOR, without_catchlights
from scan2albedo.unlit.processed_face import Eyeball, ProcessedFace

LID_LANDMARKS = {"right": slice(36, 42), "left": slice(42, 48)}
"""Of iBUG-68 around each eye: a corner, two of the upper lid, a corner, two of the lower lid."""
GLOBE_MM = 12.0
"""Radius of an adult's eyeball [1]_."""
_GLOBE_SD_MM = 0.5
"""Its deviation among people [1]_."""
IRIS_MM = 5.85
"""Radius of an iris [2]_; its deviation among people is a quarter of a millimetre."""
CORNEA_MM = 7.8
"""Radius of the cornea's curvature [3]_."""
PUPIL_MM = 1.75
"""Radius of a pupil in a room."""
RING_MM = 0.25
"""Steps of an eyeball's colours away from the gaze."""
LID_MM = 1.0
"""How far a lid's rim, as a scan shows it, lies above the eyeball."""
LID_SD_MM = 0.7
"""Deviation of that among scans."""
_EDGE_MM = 0.35
"""Width over which a texture goes from one thing to the next."""
_OUTLINE_SD_MM = (0.8, 0.8, 0.8, 0.8, 1.5, 1.0, 1.2, 1.0, 2.5, 1.5, 0.15)
"""Deviations of an outline, see `_inside`, from that of its landmarks."""
_WHITE = ((-0.3, 0.1, -0.1), (0.4, 0.15, 0.2))
"""Of an eye's white: means and deviations of mean log albedo relative to skin, log R/G and log B/G."""
_IRIS = ((-1.3, 0.1, -0.1), (0.6, 0.25, 0.3))
"""The same of an iris; both learn from the scan."""
_SOCKET = ((-0.3, 0.1, -0.1), (0.6, 0.3, 0.3))
"""The same of what a scan has in place of an eye, relative to skin in all three."""
_LASHES = ((-0.8, 0, 0), (0.6, 0.25, 0.25))
"""The same of lashes."""
_LASHED = 0.1
"""Part of the skin that is lashes."""
_UNSEEN = 0.01
"""Part of skin, and of painted eyes, that a scan does not show."""
_UNSEEN_HOLE = 0.7
"""Part of a hole between lids that a scan does not show."""
_SHADE = 0.45
"""How much of the light, as a logarithm, lids keep from an eye."""
_BROWN = (0.17, 0.09, 0.055)
"""Albedo of most people's irises, as parts of the white's."""
_PUPIL = 0.03
"""Albedo of a pupil, as a part of the white's."""
_LIMBUS = 0.5
"""Albedo of an iris's rim, as a part of the iris's."""
WET_REFLECTANCE = 0.025
"""Reflectance of tears, of an index of 1.376, at normal incidence."""
WET_EXPONENT = 200.0
"""Phong's exponent of what tears wet."""
_TEXELS = 700
"""Texels around an eye that its outline is sought with, at most."""
_PRIOR_TEXELS = 20
"""Texels of white, or iris, for which their usual colours count."""


def eyeball_mesh(eye: Eyeball) -> GlbPart:
    """Return an eyeball as a mesh: a sphere with the cornea's cap on it, one surface."""
    edge = math.asin(eye.iris_mm / eye.radius_mm)
    behind = np.linspace(1.6 * edge, math.pi - 1e-4, 20)
    polar = np.concatenate([np.linspace(1e-4, 1.6 * edge, 48), behind[1:]])
    around = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    # Where the cornea, a sphere about a point on the gaze, stands out of the eyeball.
    axial = math.sqrt(eye.radius_mm**2 - eye.iris_mm**2) - math.sqrt(CORNEA_MM**2 - eye.iris_mm**2)
    out = axial * np.cos(polar) + np.sqrt(np.maximum(CORNEA_MM**2 - (axial * np.sin(polar)) ** 2, 0.0))
    radius = np.where(polar < edge, out, eye.radius_mm)
    off, along = radius * np.sin(polar), radius * np.cos(polar)
    places = [np.outer(off, np.cos(around)), np.outer(off, np.sin(around)), along[:, None]]
    across = normalized(np.cross([0.0, 1.0, 0.0], eye.gaze))
    frame = np.stack([across, np.cross(eye.gaze, across), eye.gaze])
    vertices = eye.center_mm + np.stack(np.broadcast_arrays(*places), -1).reshape(-1, 3) @ frame
    steps = np.arange(len(eye.rings_linear)) * RING_MM
    colors = [np.interp(np.where(along > 0, off, steps[-1]), steps, c) for c in eye.rings_linear.T]
    faces = grid_faces(len(polar), len(around), wrap=True)
    return wet_part(f"eye_{eye.side}", vertices, faces, np.repeat(np.stack(colors, -1), len(around), 0))


def wet_part(
    name: str, vertices: FloatArray, faces: IntArray, colors: FloatArray, follows: FloatArray | None = None
) -> GlbPart:
    """Return a wet mesh (V, 3), (F, 3) with colours (V, 3), which `follows` landmarks by shares (V, 68)."""
    # Phong's exponent as the roughness of a GGX lobe of the same width, see `engine_maps`.
    return GlbPart(name, vertices, faces, colors, 1.0, (2 * WET_EXPONENT + 1) ** (-1 / 4), follows)


@dataclass(frozen=True)
class _Texels:
    """Some of the texels (N,) around an eye."""

    xy: FloatArray
    """(N, 2): mm from the middle between the eye's corners."""
    color: FloatArray
    """(N, 3): mean log albedo, log R/G and log B/G."""
    seen: BoolArray
    weight: float
    """Independent observations that each texel stands for."""

    def log_likelihood(self, classes: FloatArray, unseen: float) -> FloatArray:
        """Return that (N,) of a class, mean and deviation (2, 3), of which a part is unseen."""
        shown = _log_normal(self.color, classes) + math.log(1 - unseen)
        return np.where(self.seen, shown, math.log(unseen))


@dataclass(frozen=True)
class _Explanation:
    """What an eye's texels are, if it is open."""

    outline: FloatArray
    """(11,): the likeliest, see `_inside`."""
    log_likelihood: float
    shares: FloatArray
    """(2, N): of white and iris."""


@dataclass(frozen=True)
class EyeOpening:
    """What a chart shows around one eye."""

    middle: FloatArray
    """(3,): between the eye's corners."""
    rows: IntArray
    columns: IntArray
    """`rows`, `columns`: the texels (N,) around it."""
    place: FloatArray
    """(N, 3): mm from the middle."""
    color: FloatArray
    """(N, 3): mean log albedo, log R/G and log B/G."""
    skin: FloatArray
    """(2, 3): mean and deviation of the colours of the skin beside the eye."""
    white: FloatArray
    """(3,): mean of the colours of the eye's white, where an eye is shown."""
    outlines: FloatArray
    """(2, 11): the likeliest of an eye that is shown, and of one that was left out as a hole."""
    odds: FloatArray
    """(2,): log odds of each against lids that are shut."""

    @classmethod
    def of(cls, face: ProcessedFace, landmarks: FloatArray) -> Self:
        """Return the opening at landmarks (6, 3), see `LID_LANDMARKS`, of a face's chart."""
        middle = landmarks[[0, 3]].mean(0)
        near = np.abs(face.image.position - middle) < (20, 12, 25)
        rows, columns = np.nonzero(face.mask & near.all(-1))
        place = face.image.position[rows, columns] - middle
        floor = FLOOR * max(face.level(), FLOOR)
        log_albedo = np.log(np.maximum(without_catchlights(face)[rows, columns], floor))
        color = np.stack([log_albedo.mean(1), *(log_albedo[:, [0, 2]] - log_albedo[:, [1]]).T], 1)
        seen = face.image.seen[rows, columns]
        start = _outline_through(landmarks[:, :2] - middle[:2])
        # Skin is what lies beside the eye.
        wide = start + [-3, 0, 3, 0, 3, 0, 3, 0, 0, 0, 0]
        outside = _inside(wide, place[:, :2])[:2].min(0) < 0
        fallback = [[math.log(floor / FLOOR), 0, 0]]  # also where no skin is seen
        skin_colors = np.concatenate([color[seen & outside], fallback])
        middle_color = np.median(skin_colors, axis=0)
        skin = np.stack([middle_color, normal_deviation(skin_colors - middle_color, 0)])
        skin[1] = np.maximum(skin[1], (0.12, 0.05, 0.05))
        # As much of the skin is unseen between the lids as beside them: a part not scanned is no hole.
        lacking = max(_UNSEEN, 1 - ((seen & outside).sum() + 1) / (outside.sum() + 1))
        chosen = np.random.default_rng(0).permutation(len(rows))[:_TEXELS]
        weight = float(np.median(face.image.texel_areas_mm2())) / 5 * len(rows) / max(len(chosen), 1)
        texels = _Texels(place[chosen, :2], color[chosen], seen[chosen], weight)
        bare = _skin_log_likelihood(texels, skin, lacking)
        tone = np.stack([skin[0] * (1, 0, 0), np.zeros(3)])
        painted = np.array([_WHITE, _IRIS]) + tone
        socket = np.tile(_SOCKET + skin[0] * [[1], [0]], (2, 1, 1))
        found = []
        for unseen, classes in ((lacking, painted), (_UNSEEN_HOLE, socket)):
            one = _Explanation(start, 0.0, np.zeros((2, len(chosen))))
            for _ in range(2):  # expectation maximisation of colours and outline
                one = _likeliest(
                    texels, bare, [texels.log_likelihood(c, unseen) for c in classes], start, one
                )
                classes[:] = _learned(texels, classes, one.shares)
            found.append(one)
        # Schwarz's criterion: each number of an outline costs half the log of the observations.
        shut = weight * bare.sum() + len(start) / 2 * math.log(max(weight * len(chosen), 1.0))
        outlines = np.array([one.outline for one in found])
        odds = np.array([one.log_likelihood for one in found]) - shut
        return cls(middle, rows, columns, place, color, skin, painted[0, 0], outlines, odds)

    def globe(self, hole: int) -> FloatArray:
        """Return centre and radius (4,) of the eyeball on which the lids' rims lie."""
        ax, ay, bx, by, up, up_slant, down, down_slant = self.outlines[hole][:8]
        along = np.linspace(0.3, 0.7, 5)
        bulge, level = (4 * along * (1 - along)) ** 0.5, ay + along * (by - ay)
        rims = [
            level + bulge * (up + up_slant * (along - 0.5)),
            level - bulge * (down + down_slant * (along - 0.5)),
        ]
        on_rims = np.stack([np.tile(ax + along * (bx - ax), 2), np.concatenate(rims)], 1)
        rim = self.place[cKDTree(self.place[:, :2]).query(on_rims)[1]]
        middle = np.array([(ax + bx) / 2, (ay + by) / 2])

        def off(globe: FloatArray) -> FloatArray:
            above = norms(rim - globe[:3]) - globe[3] - LID_MM
            above[above < 0] /= 3  # scans have dents at eyes, and no bumps
            unusual = (globe[3] - GLOBE_MM) * LID_SD_MM / _GLOBE_SD_MM
            return np.array([*above, *globe[:2] - middle, unusual]) / LID_SD_MM

        return least_squares(off, [*middle, rim[:, 2].mean() - GLOBE_MM, GLOBE_MM]).x

    def rings(self, hole: int, iris_mm: float) -> FloatArray:
        """Return (K, 3) the eyeball's albedo away from the middle of its iris, as far as it is known."""
        away = RING_MM * np.arange(math.ceil((iris_mm + 1) / RING_MM) + 1)
        # Lids shade the eye, and no light that was found does: what the white lacks all of the eye lacks.
        mean_white = self.skin[0] * (1, 0, 0) + _WHITE[0] + (_SHADE, 0, 0)
        brighter = not hole and self.white[0] > mean_white[0]
        white = np.exp(log_rgb(self.white if brighter else mean_white))
        outline = self.outlines[hole]
        off = np.hypot(*(self.place[:, :2] - outline[8:10]).T)
        within = _inside(outline, self.place)
        colored = (off > PUPIL_MM) & (off < iris_mm - 1) & (within[:2].min(0) > 1)
        iris = white * _BROWN
        if not hole and colored.any():
            shade = max(mean_white[0] - self.white[0], 0.0)
            iris = np.exp(log_rgb(np.median(self.color[colored], axis=0)) + shade)
        made = _PUPIL * white + np.zeros((len(away), 1))
        changes = (PUPIL_MM, iris), (iris_mm - 3 * RING_MM, iris * _LIMBUS), (iris_mm, white)
        for edge, color in changes:
            made += smoothstep(0.5 + (away - edge) / (2 * RING_MM))[:, None] * (color - made)
        return made

    def inside_mm(self, hole: int) -> FloatArray:
        """Return `_inside` (3, N) of the texels around the eye, by its likeliest outline."""
        return _inside(self.outlines[hole], self.place)


def mean_eye_white(skin_level: float) -> FloatArray:
    """Return the usual albedo (3,) of the white of an eye beside skin of a mean log albedo."""
    return math.exp(skin_level) * np.exp(log_rgb(np.array(_WHITE[0])))


def _outline_through(corners: FloatArray) -> FloatArray:
    """Return the outline (11,), see `_inside`, through an eye's landmarks (6, 2) about its middle."""
    (ax, ay), (bx, by) = corners[[0, 3]]
    x, y = corners[[1, 2, 4, 5]].T
    along = np.clip((x - ax) / (bx - ax), 0.1, 0.9)
    high = (y - ay - along * (by - ay)) / (4 * along * (1 - along)) ** 0.5
    up, down = max(high[:2].mean(), 1.0), max(-high[2:].mean(), 1.0)
    return np.array([ax, ay, bx, by, up, 0, down, 0, 0, (up - down) / 3, IRIS_MM])


def _skin_log_likelihood(texels: _Texels, skin: FloatArray, unseen: float) -> FloatArray:
    """Return that (N,) of skin with its lashes, of which a part is unseen."""
    bare = math.log(1 - _LASHED) + _log_normal(texels.color, skin)
    lashes = _log_normal(texels.color, _LASHES + skin[0] * [[1], [0]])
    bare = np.logaddexp(bare, math.log(_LASHED) + lashes)
    return np.where(texels.seen, bare + math.log(1 - unseen), math.log(unseen))


def _likeliest(
    texels: _Texels,
    bare: FloatArray,
    of_eye: list[FloatArray],
    prior_mean: FloatArray,
    before: _Explanation,
) -> _Explanation:
    """Return the likeliest outline near the `prior_mean` one, sought from around the one `before`.

    `bare` and `of_eye` are log likelihoods (N,) of texels as skin, and as white and iris.
    """
    top = np.maximum.reduce([bare, *of_eye])
    likelihood = np.exp(np.stack([bare, *of_eye]) - top)

    def cost(outlines: FloatArray) -> FloatArray:
        mixed = (_members(outlines, texels.xy) * likelihood).sum(-2)
        fits = texels.weight * (np.log(mixed + 1e-12) + top).sum(-1)
        return (((outlines - prior_mean) / _OUTLINE_SD_MM) ** 2).sum(-1) / 2 - fits

    def with_slope(outline: FloatArray) -> tuple[float, FloatArray]:
        values = cost(np.vstack([outline, outline + 1e-4 * np.eye(len(outline))]))
        return values[0], (values[1:] - values[0]) / 1e-4

    shifts = [(*np.zeros(8), dx, dy, 0) for dx in range(-6, 7, 2) for dy in range(-2, 3)]
    tried = before.outline + np.array(shifts)
    start, options = tried[np.argmin(cost(tried))], {"maxiter": 20}
    best = minimize(with_slope, start, jac=True, method="L-BFGS-B", options=options)
    shares = _members(best.x, texels.xy) * likelihood
    return _Explanation(best.x, -best.fun, shares[1:] / shares.sum(0))


def _learned(texels: _Texels, classes: FloatArray, shares: FloatArray) -> FloatArray:
    """Return means and deviations (2, 2, 3) of the colours of white and iris, by shares (2, N) of texels."""
    counted = texels.weight * texels.seen * shares
    total = _PRIOR_TEXELS + counted.sum(1)[:, None]
    mean = (_PRIOR_TEXELS * classes[:, 0] + counted @ texels.color) / total
    square = np.einsum("kn,knc->kc", counted, (texels.color - mean[:, None]) ** 2)
    return np.stack([mean, np.sqrt((_PRIOR_TEXELS * classes[:, 1] ** 2 + square) / total)], 1)


def _inside(outline: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (3, ..., N) how many mm points are below the upper lid, above the lower, and inside the iris.

    An `outline` (..., 11) has the corners (x, y), a parabola's height and slant of the upper and of the lower
    lid, and middle and radius of the iris; of it (..., 3, N).
    """
    ax, ay, bx, by, up, up_slant, down, down_slant, *iris = np.moveaxis(outline, -1, 0)[..., None]
    along = (xy[:, 0] - ax) / (bx - ax)
    level, bulge = ay + along * (by - ay), 4 * along * (1 - along)
    bulge = np.sign(bulge) * np.abs(bulge) ** 0.5
    below = level + bulge * (up + up_slant * (along - 0.5)) - xy[:, 1]
    above = xy[:, 1] - level + bulge * (down + down_slant * (along - 0.5))
    return np.stack([below, above, iris[2] - np.hypot(xy[:, 0] - iris[0], xy[:, 1] - iris[1])])


def _members(outline: FloatArray, xy: FloatArray) -> FloatArray:
    """Return (..., 3, N) how far points are skin, an eyeball's white, and iris, by an outline (..., 11)."""
    below, above, iris = expit(_inside(outline, xy) / _EDGE_MM)
    inside = below * above
    return np.stack([1 - inside, inside * (1 - iris), inside * iris], -2)


def _log_normal(values: FloatArray, mean_and_deviation: ArrayLike) -> FloatArray:
    """Return (N,) the log density of values (N, 3), but for a constant."""
    mean, deviation = np.asarray(mean_and_deviation)
    return -0.5 * (((values - mean) / deviation) ** 2).sum(-1) - np.log(deviation).sum()


def log_rgb(color: FloatArray) -> FloatArray:
    """Return log R, G, B (3,) of mean log albedo, log R/G and log B/G."""
    level, red, blue = color
    green = level - (red + blue) / 3
    return np.array([green + red, green, green + blue])
