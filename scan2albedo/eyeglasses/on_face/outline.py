"""Outlines of a frame in the pictures: the surface points that make them, and how far masks are from them."""

import warnings
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.special import expit, log_softmax, logsumexp, softmax

from scan2albedo.core.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    GridShape,
    IntArray,
    NDArray,
    RealArray,
    finite_rows,
    norms,
)
from scan2albedo.eyeglasses.mean_keypoints import BEHIND
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, focal_px, pixel_directions, project
from scan2albedo.geometry.rasterization import bilinear, bilinear_slopes, within
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.rendering.pictures import SeenSamples, seen_samples

REACH_PX = 40.0
"""Pixels of the outline farther from the observed one than this are left out."""
_AROUND = 3
"""Pixels each way whose uncovered ones show where outside is."""
_FACING = 0.3
"""Least cosine between where outside is for the frame's outline and for the observed one."""
_SIDE_PX = 12
"""How much of both sides of an outline is compared with a picture."""


@dataclass(frozen=True)
class MaskDistance:
    """Distance in pixels from a mask's outermost covered pixels: 0 there, positive outside.

    The `field` (h, w) is that of a window around the mask, whose first pixel is `corner` (column, row).
    """

    field: Float32Array
    corner: tuple[int, int]

    @classmethod
    def of(cls, mask: BoolArray) -> Self:
        """Return the distances of a mask (H, W) that has both covered and uncovered pixels."""
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        # No search reaches farther.
        margin = int(REACH_PX)
        top, left = max(0, rows[0] - margin), max(0, columns[0] - margin)
        window = mask[top : rows[-1] + margin + 1, left : columns[-1] + margin + 1]
        # Outside, a border pixel's neighbour is 1 away; inside, border pixels are 1 from the outside.
        field = np.where(window, 1 - distance_transform_edt(window), distance_transform_edt(~window))
        return cls(np.ascontiguousarray(field, np.float32), (int(left), int(top)))

    def sample(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances (N,) and slopes (N, 2) by column and row, bilinear; NaN outside the window."""
        place = pixels - np.array(self.corner)
        inside = within(place, self.field.shape)
        field, where = self.field[..., None], np.where(inside[:, None], place, 0.0)
        value, slope = bilinear(field, where)[:, 0], bilinear_slopes(field, where)[:, 0]
        value[~inside], slope[~inside] = np.nan, np.nan
        return value, slope


def search_edges(
    distance: MaskDistance, pixels: FloatArray, outward: FloatArray, reach_px: FloatArray
) -> FloatArray:
    """Return (N,) signed ways along `outward` (N, 2) from `pixels` to the mask's outermost ones, or NaN.

    The nearest edge within `reach_px` (N,) either way counts, among those where `outward` leaves the mask at
    a cosine of 0.3 or more to the mask's own. The mask's nearest border would never be the end of a bar.
    """
    result = np.full(len(pixels), np.nan)
    if not len(pixels):
        return result
    edge = 0.5  # from the middles of the mask's outermost pixels
    farthest = np.ceil(reach_px.max())
    ways = np.arange(-farthest, farthest + 1.0)
    value, slope = distance.sample((pixels[:, None] + ways[:, None] * outward[:, None]).reshape(-1, 2))
    value = value.reshape(len(pixels), -1)
    along = np.einsum("nki,ni->nk", slope.reshape(*value.shape, 2), outward)
    steep = along >= _FACING * norms(slope.reshape(*value.shape, 2))
    with np.errstate(invalid="ignore"):
        leaves = (value[:, :-1] <= edge) & (value[:, 1:] > edge) & (steep[:, :-1] | steep[:, 1:])
    share = (edge - value[:, :-1]) / np.where(leaves, value[:, 1:] - value[:, :-1], 1.0)
    way = np.where(leaves, ways[:-1] + share - edge, np.inf)
    found = way[np.arange(len(way)), np.abs(way).argmin(1)]
    within = np.abs(found) <= reach_px
    result[within] = found[within]
    return result


@dataclass(frozen=True)
class ObservedView:
    """One picture: its camera (3, 4), normalised, labels (K, 2), NaN for missing ones, and shape (H, W).

    `distance` is None without a usable mask, `shape` where neither a mask nor the caller says. `colors`
    (H, W) are groups of colours, only where a picture stands in for a mask.
    """

    camera: FloatArray
    labels: FloatArray
    distance: MaskDistance | None
    shape: GridShape | None
    colors: IntArray | None = None

    @property
    def outlined(self) -> bool:
        """Whether a mask or a picture shows where the frame ends."""
        return self.distance is not None or self.colors is not None


Views = tuple[ObservedView, ...]


@dataclass(frozen=True)
class OutlineSamples:
    """Points of the frame that make its outlines, and the `view` (N,) of each.

    `edges` (N, 2) are pixels where mask or picture have the outline, found along `outward` (N, 2), unit
    vectors away from the frame. `noise_px` (N,) are standard deviations of edges that were found in a
    picture, 0 for masks; `share` (C, K) is that of the outline nearest to each key point that was found, of
    what the head does not hide.
    """

    view: IntArray
    points: SkinnedPoints
    edges: FloatArray
    outward: FloatArray
    noise_px: FloatArray
    share: FloatArray

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True)
class FrameMesh:
    """A frame at rest."""

    points: SkinnedPoints
    faces: IntArray


def hidden_by(head: RayCaster | None, camera: FloatArray, points: FloatArray) -> BoolArray:
    """Return (N,) True for points that the head hides from a camera."""
    if head is None:
        return np.zeros(len(points), bool)
    toward = camera_centers(camera) - points
    # From 1 mm above, for frames rest on the skin.
    return head.occluded(points + normalized(toward), toward)


def trace_outline(seen: SeenSamples) -> tuple[IntArray, FloatArray]:
    """Return the samples, one a pixel, with an unseen 4-neighbour, and unit vectors (N, 2) to the outside.

    The picture's border is not an outline.
    """
    unseen = np.ones(seen.shape, np.bool_)
    unseen.flat[seen.index] = False
    which = np.flatnonzero(binary_dilation(unseen).flat[seen.index])
    rows, columns = np.divmod(seen.index[which], seen.shape[1])
    # What lies around each pixel, unseen or not, and the sums of the ways to what is.
    way = np.arange(-_AROUND, _AROUND + 1)
    padded = np.pad(unseen, _AROUND)
    around = padded[rows[:, None, None] + way[:, None] + _AROUND, columns[:, None, None] + way + _AROUND]
    outward = np.stack([around.sum(1) @ way, around.sum(2) @ way], 1)
    some = outward.any(1)
    return which[some], normalized(outward[some].astype(float))


def grouped_colors(picture: NDArray, around: FloatArray) -> IntArray:
    """Return (H, W) groups of the colours of a picture (H, W, 3), made for those near pixels (N, 2).

    k-means in the picture's own values, 24 means: frame, skin, eyes and hair, each in light and in shadow.
    """
    height, width = picture.shape[:2]
    inside = finite_rows(around)
    if not inside.any():
        return np.zeros((height, width), int)
    box = [around[inside].min(0), around[inside].max(0)]
    low, high = np.clip(box, 0, [width - 1, height - 1]).astype(int)
    values = np.asarray(picture, float).reshape(-1, 3)
    near = np.asarray(picture[low[1] : high[1] + 1, low[0] : high[0] + 1], float).reshape(-1, 3)
    some = near[:: max(1, len(near) // 8000)]
    some = some[np.argsort(some.sum(1), kind="stable")]
    centers = some[np.linspace(0, len(some) - 1, 24).astype(int)]
    with warnings.catch_warnings(action="ignore"):  # an empty group keeps its mean
        centers, _ = kmeans2(some, centers, 10, minit="matrix")
    return vq(values, centers)[0].reshape(height, width).astype(int)


def color_odds(colors: IntArray, frame: BoolArray, part: BoolArray | None = None) -> FloatArray:
    """Return (H, W) log odds that a pixel of its colour shows the frame rather than what is around it.

    Both are learned from the picture: from pixels where the `frame` (H, W) is projected to, and from those
    around it, or around a `part` (H, W) of it.
    """
    near = binary_dilation(frame if part is None else part, iterations=2 * _SIDE_PX) & ~frame
    counts = [1.0 + np.bincount(colors[where], minlength=colors.max() + 1) for where in (frame, near)]
    inside, outside = (np.log(count / count.sum()) for count in counts)
    return (inside - outside)[colors]


def search_colors(
    odds: FloatArray, frame: BoolArray, pixels: FloatArray, outward: FloatArray, reach_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where along `outward` (N, 2) a picture has the outline that the projection has at `pixels`.

    The frame's profile m(s) across the outline, 1 where it is seen, is laid on log odds o of the picture:

        p(d) ~ N(d; 0, reach / 3) exp(sum over |s| <= 12 px of (m(s) - 1/2) o(s + d)),

    so that a rim is met by both its sides. Returns mean and standard deviation (N,) of d in px, and the
    probability (N,) that the frame is there at all, as likely beforehand as that something hides it: the odds
    of the two are the mean over d of exp(sum of m(s) o(s + d)).
    """
    farthest = np.ceil(reach_px.max(initial=1.0))
    side, ways = np.arange(-_SIDE_PX, _SIDE_PX + 1.0), np.arange(-farthest, farthest + 1.0)
    along = np.arange(ways[0] + side[0], ways[-1] + side[-1] + 1)

    def across(image: RealArray, where: FloatArray) -> FloatArray:
        places = pixels[:, None] + where[:, None] * outward[:, None]
        return bilinear(image[..., None], places.reshape(-1, 2)).reshape(len(pixels), -1)

    # Over three pixels a picture is alike: together they say as much as one.
    profile, seen = across(frame.astype(float), side), across(odds / 3, along)
    windows = np.lib.stride_tricks.sliding_window_view(seen, len(side), axis=1)
    prior = log_softmax(-((ways / np.maximum(reach_px / 3, 0.5)[:, None]) ** 2) / 2, axis=1)
    # All in the frame's colours or all in others is no edge, and every frame is one against its surroundings.
    place, there = (np.einsum("ns,nds->nd", profile - less, windows) + prior for less in (0.5, 0.0))
    chance = softmax(place, axis=1)
    mean = chance @ ways
    spread = np.sqrt(np.maximum(chance @ ways**2 - mean**2, 0.0) + 1 / 12)
    return mean, spread, expit(logsumexp(there, axis=1))


@dataclass(frozen=True)
class OutlineSampler:
    """Traces the outlines of a moving frame, with the head, if any, in front of it.

    `shown` are the faces that each view's mask shows, all of them when omitted.
    """

    mesh: FrameMesh
    views: Views
    head: RayCaster | None
    shown: tuple[IntArray, ...] | None = None

    def sample(self, motion: FrameMotion, deviation_mm: FloatArray) -> OutlineSamples:
        """Return outline points that the head does not hide and whose observed outline is within reach.

        `deviation_mm` (K,) says how well the key points are known so far: an uncertain one reaches far.
        """
        vertices = motion.positions(self.mesh.points)
        parts = [self._sample_view(number, vertices, deviation_mm) for number in range(len(self.views))]
        rest = np.concatenate([part.points.rest for part in parts])
        weights = np.concatenate([part.points.weights for part in parts])
        names = ("view", "edges", "outward", "noise_px", "share")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return OutlineSamples(points=SkinnedPoints(rest, weights), **joined)

    def _sample_view(self, number: int, vertices: FloatArray, deviation_mm: FloatArray) -> OutlineSamples:
        """Return the samples of one view, their `share` (1, K), of a frame whose vertices are at (V, 3)."""
        view, points = self.views[number], self.mesh.points
        count = points.weights.shape[1]
        if not view.outlined or view.shape is None:
            nothing, nowhere = np.zeros(0), np.zeros((0, 2))
            unknown = np.full((1, count), np.nan)
            return OutlineSamples(nothing.astype(int), points[:0], nowhere, nowhere, nothing, unknown)
        camera = view.camera
        shown = self._seen(vertices, number)
        which, outward = trace_outline(shown)
        seen = shown.chosen(which)
        foremost = seen.corners[:, 0]
        owner = points.weights.argmax(1)[foremost]
        px_per_mm = focal_px(camera) / project(camera, vertices)[1][foremost]
        reach = np.minimum(5.0 + 3 * points.weights[foremost] @ deviation_mm * px_per_mm, REACH_PX)
        place = np.stack(np.divmod(seen.index, view.shape[1])[::-1], 1).astype(float)
        # Points nearer to the picture's border than to the observed outline may have it outside.
        border = np.minimum(place, [view.shape[1] - 1, view.shape[0] - 1] - place).min(1)
        limit = np.minimum(reach, border + 0.5)
        if view.distance is not None:
            way, noise = search_edges(view.distance, place, outward, limit), np.zeros(len(place))
            kept = np.flatnonzero(np.isfinite(way))
        else:
            shown = shown.chosen(~hidden_by(self.head, camera, shown.interpolated(vertices)))
            way, noise, chance = self._search_picture(view, shown, owner, place, outward, limit)
            kept = np.flatnonzero(chance > 0.5)
        edges = place + way[:, None] * outward
        hidden = self._hidden_near_head(camera, seen.interpolated(vertices), place)
        kept = kept[~hidden[kept]]
        found, visible = (np.bincount(which, minlength=count) for which in (owner[kept], owner[~hidden]))
        with np.errstate(invalid="ignore"):
            share = found / visible
        if view.distance is None:
            # A stretch of the frame is there or hidden: what is found of a hidden one is something else.
            kept = kept[share[owner[kept]] > 0.5]
        chosen = seen.chosen(kept)
        at_rest = SkinnedPoints(chosen.interpolated(points.rest), chosen.interpolated(points.weights))
        of_view = np.full(len(kept), number)
        return OutlineSamples(of_view, at_rest, edges[kept], outward[kept], noise[kept], share[None])

    def _seen(self, vertices: FloatArray, number: int) -> SeenSamples:
        view, faces = self.views[number], self.mesh.faces if self.shown is None else self.shown[number]
        assert view.shape is not None
        return seen_samples(vertices, faces, view.camera, view.shape)

    def _search_picture(
        self,
        view: ObservedView,
        shown: SeenSamples,
        owner: IntArray,
        pixels: FloatArray,
        outward: FloatArray,
        reach_px: FloatArray,
    ) -> FloatArray:
        """Return (3, N) as `search_colors` for outline pixels whose nearest key points are `owner` (N,)."""
        assert view.shape is not None
        assert view.colors is not None
        frame, found = np.zeros(view.shape, bool), np.zeros((3, len(pixels)))
        frame.flat[shown.index] = True
        behind = BEHIND[self.mesh.points.weights.argmax(1)][shown.corners[:, 0]]
        # Skin is around the front, hair around the temples: the same colour says another thing.
        for side in (False, True):
            mine, part = np.flatnonzero(BEHIND[owner] == side), np.zeros(view.shape, bool)
            part.flat[shown.index[behind == side]] = True
            if len(mine) and part.any():
                odds = color_odds(view.colors, frame, part)
                found[:, mine] = search_colors(odds, frame, pixels[mine], outward[mine], reach_px[mine])
        return found

    def _hidden_near_head(self, camera: FloatArray, points: FloatArray, pixels: FloatArray) -> BoolArray:
        """Return (N,) True for points that the head hides, or a ray four pixels beside them."""
        hidden = hidden_by(self.head, camera, points)
        if self.head is not None and len(points):
            center = camera_centers(camera)
            far = norms(points - center)[:, None]
            for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                ray = pixel_directions(camera, pixels + 4.0 * np.array(step))
                hidden |= hidden_by(self.head, camera, center + far * ray)
        return hidden

    def mask(self, motion: FrameMotion, number: int) -> tuple[BoolArray, IntArray]:
        """Return (H, W) True where a view should show the frame, the head in front, and a vertex there."""
        view = self.views[number]
        assert view.shape is not None
        vertices = motion.positions(self.mesh.points)
        seen = self._seen(vertices, number)
        seen = seen.chosen(~hidden_by(self.head, view.camera, seen.interpolated(vertices)))
        owner = np.full(view.shape, -1, int)
        owner.flat[seen.index] = seen.corners[:, 0]
        return owner >= 0, owner
