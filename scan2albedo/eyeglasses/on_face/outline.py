"""Outlines of a frame in the pictures: the surface points that make them, and how far masks are from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, SkinnedPoints
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions, project
from scan2albedo.geometry.rasterization import bilinear, bilinear_slopes
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.rendering.pictures import SeenSamples, seen_samples

REACH_PX = 40.0
"""Pixels of the outline farther from the observed one than this are left out."""
_NEAR_PX = 5.0
"""Nearer ones are left out where the frame's place is known better: beyond this and three deviations."""
_MARGIN_PX = 96
"""How far around the mask distances are computed; points farther away are out of reach anyway."""
_AROUND = 3
"""Pixels each way whose uncovered ones show where outside is."""
_FACING = 0.3
"""Least cosine between where outside is for the frame's outline and for the observed one."""
_ABOVE_SKIN_MM = 1.0
"""The head hides points more than this behind its surface: frames rest on the skin."""
_HEAD_MARGIN_PX = 4.0
"""Pixels of the outline this near to where the head hides the frame are left out."""


@dataclass(frozen=True)
class MaskDistance:
    """Distance in pixels from a mask's outermost covered pixels: 0 there, positive outside.

    The `field` (h, w) is that of a window around the mask, whose first pixel is `corner` (column, row).
    """

    field: NDArray[np.float32]
    corner: tuple[int, int]

    @classmethod
    def of(cls, mask: BoolArray) -> MaskDistance:
        """Return the distances of a mask (H, W) that has both covered and uncovered pixels."""
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        top, left = max(0, rows[0] - _MARGIN_PX), max(0, columns[0] - _MARGIN_PX)
        window = mask[top : rows[-1] + _MARGIN_PX + 1, left : columns[-1] + _MARGIN_PX + 1]
        # Outside, a border pixel's neighbour is 1 away; inside, border pixels are 1 from the outside.
        field = np.where(window, 1 - distance_transform_edt(window), distance_transform_edt(~window))
        return cls(np.ascontiguousarray(field, np.float32), (int(left), int(top)))

    def sample(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances (N,) and slopes (N, 2) by column and row, bilinear; NaN outside the window."""
        height, width = self.field.shape
        place = pixels - np.array(self.corner)
        with np.errstate(invalid="ignore"):
            inside = ((place >= 0) & (place <= [width - 1, height - 1])).all(1)
        field, where = self.field[..., None], np.where(inside[:, None], place, 0.0)
        value, slope = bilinear(field, where)[:, 0], bilinear_slopes(field, where)[:, 0]
        value[~inside], slope[~inside] = np.nan, np.nan
        return value, slope


def search_edges(
    distance: MaskDistance, pixels: FloatArray, outward: FloatArray, reach_px: FloatArray
) -> FloatArray:
    """Return (N,) signed distances along `outward` (N, 2) from `pixels` to the mask's edge; NaN for none.

    The nearest edge within `reach_px` (N,) either way counts, among those where `outward` leaves the mask at
    a cosine of 0.3 or more to the mask's own. The mask's nearest border would never be the end of a bar.
    """
    result = np.full(len(pixels), np.nan)
    if not len(pixels):
        return result
    edge = 0.5  # from the mask's outermost pixels
    farthest = int(np.ceil(reach_px.max()))
    ways = np.arange(-farthest, farthest + 1.0)
    places = pixels[:, None] + ways[:, None] * outward[:, None]
    value, slope = distance.sample(places.reshape(-1, 2))
    value = value.reshape(len(pixels), -1)
    along = np.einsum("nki,ni->nk", slope.reshape(*value.shape, 2), outward)
    steep = along >= _FACING * np.linalg.norm(slope.reshape(*value.shape, 2), axis=2)
    with np.errstate(invalid="ignore"):
        leaves = (value[:, :-1] <= edge) & (value[:, 1:] > edge) & (steep[:, :-1] | steep[:, 1:])
    share = (edge - value[:, :-1]) / np.where(leaves, value[:, 1:] - value[:, :-1], 1.0)
    way = np.where(leaves, ways[:-1] + share - edge, np.inf)
    nearest = np.abs(way).argmin(1)
    found = way[np.arange(len(way)), nearest]
    within = np.abs(found) <= reach_px
    result[within] = found[within]
    return result


@dataclass(frozen=True)
class ObservedView:
    """One picture: its camera (3, 4), normalised, labels (K, 2), NaN for missing ones, and shape (H, W).

    `distance` is None without a usable mask, `shape` where neither a mask nor the caller says.
    """

    camera: FloatArray
    labels: FloatArray
    distance: MaskDistance | None
    shape: tuple[int, int] | None


@dataclass(frozen=True)
class OutlineSamples:
    """Points of the frame that make its outlines, and the `view` (N,) of each.

    `edges` (N, 2) are pixels where the mask ends beside the sample, NaN where its distance to the mask
    counts, `outward` (N, 2) unit vectors away from the frame.
    """

    view: IntArray
    points: SkinnedPoints
    edges: FloatArray
    outward: FloatArray

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
    toward = camera_centers(camera[None])[0] - points
    return head.occluded(points + _ABOVE_SKIN_MM * normalized(toward), toward)


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
    return which[some], normalized(outward[some].astype(np.float64))


class OutlineSampler:
    """Traces the outlines of a moving frame, with the head, if any, in front of it."""

    def __init__(
        self,
        mesh: FrameMesh,
        views: tuple[ObservedView, ...],
        head: RayCaster | None,
        shown: tuple[IntArray, ...] | None = None,
    ) -> None:
        """`shown` are the faces that each view's mask shows, all of them when omitted."""
        self.mesh, self.views, self.head = mesh, views, head
        self.shown = (mesh.faces,) * len(views) if shown is None else shown

    def sample(self, motion: FrameMotion, deviation_mm: FloatArray) -> OutlineSamples:
        """Return outline points that the head does not hide and whose observed outline is within reach.

        `deviation_mm` (K,) says how well the key points are known so far: an uncertain one reaches far.
        """
        points = self.mesh.points
        vertices = motion.positions(points)
        # View, places at rest, weights, edges, outward.
        none = np.zeros(0, np.int64), np.zeros((0, 3)), points.weights[:0], *np.zeros((2, 0, 2))
        parts: list[tuple[NDArray[Any], ...]] = [none]
        for number, (view, faces) in enumerate(zip(self.views, self.shown, strict=True)):
            if view.distance is None or view.shape is None:
                continue
            camera = view.camera
            seen = seen_samples(vertices, faces, camera, view.shape)
            which, outward = trace_outline(seen)
            seen = seen.chosen(which)
            foremost = seen.corners[:, 0]
            px_per_mm = np.sqrt(abs(np.linalg.det(camera[:, :3]))) / project(camera, vertices)[1][foremost]
            reach = 3 * points.weights[foremost] @ deviation_mm * px_per_mm
            reach = np.minimum(_NEAR_PX + reach, REACH_PX)
            # Where the nearest border of the mask has its outside on the same side, its distance counts;
            # elsewhere, such as at the end of a temple that is too short, a search across the outline does.
            place = np.stack(np.divmod(seen.index, view.shape[1])[::-1], 1).astype(np.float64)
            distance, slope = view.distance.sample(place)
            facing = np.einsum("ni,ni->n", slope, outward)
            # Points nearer to the picture's border than to the observed outline may have it outside.
            border = np.minimum(place, [view.shape[1] - 1, view.shape[0] - 1] - place).min(1)
            limit = np.minimum(reach, border + 0.5)
            with np.errstate(invalid="ignore"):
                near = np.abs(distance) <= limit
                near &= facing >= _FACING * np.linalg.norm(slope, axis=1)
            edges, lost = np.full((len(place), 2), np.nan), np.flatnonzero(~near)
            way = search_edges(view.distance, place[lost], outward[lost], limit[lost])
            edges[lost] = place[lost] + way[:, None] * outward[lost]
            kept = np.flatnonzero(near | np.isfinite(edges[:, 0]))
            # Points that the head hides, or a ray some pixels beside them.
            if self.head is not None and len(kept):
                world = seen.chosen(kept).interpolated(vertices)
                hidden = hidden_by(self.head, camera, world)
                center = camera_centers(camera[None])[0]
                far = np.linalg.norm(world - center, axis=1)[:, None]
                for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    ray = pixel_directions(camera, place[kept] + _HEAD_MARGIN_PX * np.array(step))
                    hidden |= hidden_by(self.head, camera, center + far * ray)
                kept = kept[~hidden]
            rest, weights = (seen.chosen(kept).interpolated(a) for a in (points.rest, points.weights))
            parts.append((np.full(len(kept), number), rest, weights, edges[kept], outward[kept]))
        number_of, rest, weights, edges, outward = (np.concatenate(part) for part in zip(*parts, strict=True))
        return OutlineSamples(number_of, SkinnedPoints(rest, weights), edges, outward)

    def mask(self, motion: FrameMotion, number: int) -> tuple[BoolArray, IntArray]:
        """Return (H, W) True where a view should show the frame, the head in front, and a vertex there."""
        view = self.views[number]
        assert view.shape is not None
        vertices = motion.positions(self.mesh.points)
        seen = seen_samples(vertices, self.shown[number], view.camera, view.shape)
        seen = seen.chosen(~hidden_by(self.head, view.camera, seen.interpolated(vertices)))
        owner = np.full(view.shape, -1, np.int64)
        owner.flat[seen.index] = seen.corners[:, 0]
        return owner >= 0, owner
