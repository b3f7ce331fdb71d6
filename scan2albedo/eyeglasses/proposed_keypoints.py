"""The 20 key points of a frame proposed from its shape alone, in any pose and unit, each with a deviation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from skimage.morphology import convex_hull_image

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import (
    KEY_POINT_COUNT,
    KEY_POINT_NAMES,
    checked_mesh,
    typical_key_points,
)
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import (
    in_principal_frame,
    invert_rigid,
    procrustes,
    rotation_from_vector,
    super_fibonacci_rotations,
    transform_points,
)

_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
_SLAB = 7.0


class ProposedKeyPoints(NamedTuple):
    """Key points that a frame's own shape proposes."""

    points: FloatArray
    """(20, 3) in the mesh's own axes and unit, NaN where none was found."""
    deviation: FloatArray
    """(20,) standard deviation in mm; infinite where none was found."""
    mm_per_unit: float
    unit: str
    """"mm", "cm", "m", "inch", or "unknown" for a size that is a usual frame's in none of them."""
    log_odds: float
    """How like a frame's they are; below -30 something else may have been taken for a frame."""


@dataclass(frozen=True)
class _Seen:
    """A frame seen along its z-axis, about in mm; row 0 is lowest, the middle column at x = 0.

    `from_axes` maps axes to mesh; `depth` (H, W) is z of the foremost surface, -inf where there is none,
    `front` (H, W) what belongs to the front, `openings` the left's and the right's (score, pixels, gap).
    """

    axes: FloatArray
    origin: FloatArray
    depth: FloatArray
    front: BoolArray
    openings: tuple[tuple[float, BoolArray, float], ...]
    pixel: float
    low: FloatArray

    def place(self, pixels: FloatArray) -> FloatArray:
        """Return (N, 2) x and y of rows and columns (N, 2)."""
        return self.low + self.pixel * pixels[:, ::-1]

    def score(self) -> float:
        return sum(found[0] for found in self.openings)


def symmetry_planes(points: FloatArray, size: float, count: int = 3) -> list[tuple[FloatArray, float, float]]:
    """Return planes (normal, offset, misfit) in which points (N, 3) are most nearly their own mirror image."""
    tree, few = cKDTree(points), points[:: max(len(points) // 300, 1)]

    def refined(
        normal: FloatArray, offset: float, own: FloatArray, steps: int
    ) -> tuple[FloatArray, float, float]:
        for step in range(steps):
            away, nearest = tree.query(own - 2 * (own @ normal - offset)[:, None] * normal)
            weight = 1 / (1 + (away / (0.015 * size * max(1, 6 - step))) ** 2) ** 2
            there = points[nearest]
            a, b = (weight @ p / weight.sum() for p in (own, there))
            # The reflection I - 2 n n^T that leaves least: n spans the least of p q^T + q p^T.
            both = ((own - a) * weight[:, None]).T @ (there - b)
            normal = np.linalg.eigh(both + both.T)[1][:, 0]
            offset = float(normal @ (a + b) / 2)
        away = tree.query(own - 2 * (own @ normal - offset)[:, None] * normal)[0]
        return normal, offset, float(np.mean(away**2 / (away**2 + (0.015 * size) ** 2)))

    middle = points.mean(0)
    axes = [*np.linalg.eigh(np.cov(points.T))[1].T, *super_fibonacci_rotations(30)[:, 0]]
    # A temple that is missing or open draws the centroid to its side.
    starts = [(n, float(n @ middle) + away * size) for n in axes for away in (-0.12, 0.0, 0.12)]
    rough = sorted((refined(*start, few, 9) for start in starts), key=lambda plane: plane[2])
    kept: list[tuple[FloatArray, float, float]] = []
    for normal, offset, _ in rough:
        if len(kept) < count and all(abs(normal @ other[0]) < 0.95 for other in kept):
            kept.append(refined(normal, offset, points[:: max(len(points) // 2000, 1)], 12))
    return sorted(kept, key=lambda plane: plane[2])


class _Frame:
    """Surface and rays of a frame of about 150 mm; panes apart."""

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        # The longest principal extent, as that of usual spectacles.
        turned, own = in_principal_frame(vertices, faces)
        low, high = turned[faces.ravel()].min(0), turned[faces.ravel()].max(0)
        self.unit, self.middle = (
            float((high - low).max()) / 150.0,
            transform_points(invert_rigid(own), (low + high)[None] / 2)[0],
        )
        xyz = (vertices - self.middle) / self.unit
        pane = _panes(xyz, faces)
        self.rims = RayCaster(xyz, faces[~pane])
        self.panes = RayCaster(xyz, faces[pane]) if pane.any() else None
        self.points = oriented_points(xyz, faces[~pane], 0.8).points

    def seen(self, axes: FloatArray, origin: FloatArray, half: tuple[float, float], pixel: float) -> _Seen:
        """Return the frame along axes[2], x by y within `half` of the origin."""
        x, y = ((np.arange(2 * round(h / pixel)) + 0.5) * pixel - round(h / pixel) * pixel for h in half)
        grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        start = origin + grid @ axes[:2] + 200.0 * axes[2]
        shape = len(y), len(x)
        depth = 200.0 - self.rims.first_hit(start, -axes[2]).distance.reshape(shape)
        glass = np.zeros(shape, bool)
        if self.panes is not None:
            glass = np.isfinite(self.panes.first_hit(start, -axes[2]).distance).reshape(shape)
        front, openings = _openings(depth, glass, pixel)
        return _Seen(axes, origin, depth, front, openings, pixel, np.array([x[0], y[0]]))


def _panes(xyz: FloatArray, faces: IntArray) -> BoolArray:
    """Return (F,) True for the faces of parts that are sheets, broader than rims and temples are."""
    pane = np.zeros(len(faces), bool)
    joined = np.unique(np.round(xyz, 3), axis=0, return_inverse=True)[1].ravel()
    # As the mesh joins its faces, and as places do: panes may touch rims, and files may part all faces.
    parts = [
        vertex_components(len(xyz), faces)[faces[:, 0]],
        vertex_components(len(xyz), joined[faces])[joined[faces[:, 0]]],
    ]
    for part in parts:
        if part.max() < 1000:
            pane |= _sheets(xyz, faces, part)
    return pane & ~pane.all()


def _sheets(xyz: FloatArray, faces: IntArray, part: IntArray) -> BoolArray:
    pane = np.zeros(len(faces), bool)
    for number in np.unique(part):
        own = np.flatnonzero(part == number)
        corners = xyz[np.unique(faces[own])]
        _, spread, axes = np.linalg.svd(corners - corners.mean(0), full_matrices=False)
        flat = (corners - corners.mean(0)) @ axes.T
        low, high = flat.min(0), flat.max(0)
        if (high - low)[1] < 20:
            continue
        grid = np.stack(
            np.meshgrid(*(np.arange(a, b, 1.0) for a, b in zip(low[:2], high[:2], strict=True))), -1
        )
        start = corners.mean(0) + grid.reshape(-1, 2) @ axes[:2] + 200.0 * axes[2]
        hit = np.isfinite(RayCaster(xyz, faces[own]).first_hit(start, -axes[2]).distance)
        # The widest disc in it: of lenses 10 mm and more, of what holds them a third of it.
        pane[own] = ndimage.distance_transform_edt(np.pad(hit.reshape(grid.shape[:2]), 1)).max() > 9
    return pane


def _openings(
    depth: FloatArray, glass: BoolArray, pixel: float
) -> tuple[BoolArray, tuple[tuple[float, BoolArray, float], ...]]:
    """Return a front's pixels (H, W), and on either side the likeliest opening: (score, pixels, gap).

    A hole that the rim encloses, a pane, or a hole of a rim that is closed by so many mm or by its convex
    hull; each mm costs a quarter of a log odd, a larger area is likelier.
    """
    # Of what lies in a column the foremost; temples seen beside the front are far behind.
    front = depth > np.maximum(depth.max(0), depth.max() - 30) - _SLAB
    middle, found = front.shape[1] // 2, []
    for turn in (1, -1):
        own, pane = front[:, ::turn], (glass & ~front)[:, ::turn]
        half = own | pane
        half[:, : middle + 2] = False
        best = -np.inf, np.zeros_like(front), np.inf
        # No opening is larger than the front's half.
        most = np.log(max(float(half.any(0).sum() * half.any(1).sum()), 1.0) * pixel**2)
        tries = [(own, gap, gap / 3) for gap in (0.0, 1.5, 3.0, 6.0)]
        tries += [(own | own[:, ::-1], gap, 0.7 + gap / 3) for gap in (0.0, 1.5, 3.0, 6.0)]
        tries += [(~pane, 0.0, 0.3), (own | ~half, -1.0, 3.0)]
        for mask, gap, cost in sorted(tries, key=lambda row: row[2]):
            if most - cost < best[0] or not half.any():
                break
            if gap < 0:
                mask = ~convex_hull_image(half) | own
                mask[:, : middle + 2] = True
            label = ndimage.label(ndimage.distance_transform_edt(~mask) * pixel > gap if gap > 0 else ~mask)[
                0
            ]
            area = np.bincount(label.ravel())
            area[
                np.unique(np.concatenate([label[:, : middle + 1].ravel(), *label[[0, -1]], label[:, -1]]))
            ] = 0
            area[0] = 0
            if area.max() * pixel**2 > 100 and (score := np.log(area.max() * pixel**2) - cost) > best[0]:
                region = label == area.argmax()
                if gap > 0:
                    region = (ndimage.distance_transform_edt(~region) * pixel <= gap) & ~own
                best = float(score), region, cost
        found.append((best[0], best[1][:, ::turn], best[2]))
    return front, tuple(found)


def _fronts(frame: _Frame) -> Iterator[_Seen]:
    """Yield how the frame looks where two openings are seen on both sides of a plane of symmetry."""
    looks: list[_Seen] = []
    for normal, offset, _ in symmetry_planes(frame.points, 150.0):
        origin = frame.points.mean(0)
        origin = origin - (origin @ normal - offset) * normal
        across = np.linalg.svd(normal[None])[2][1:]
        coarse = []
        for angle in np.linspace(0, 2 * np.pi, 36, endpoint=False):
            z = np.cos(angle) * across[0] + np.sin(angle) * across[1]
            coarse.append(frame.seen(np.stack([normal, np.cross(z, normal), z]), origin, (90, 90), 1.5))
        scores = np.array([seen.score() for seen in coarse])
        best = [
            k
            for k in range(36)
            if np.isfinite(scores[k]) and scores[k] >= max(scores[k - 1], scores[(k + 1) % 36])
        ]
        looks += [coarse[k] for k in best]
    looks.sort(key=_Seen.score, reverse=True)
    for seen in looks[:6]:
        if seen.score() > looks[0].score() - 4:
            tries = [_levelled(frame, seen)]
            tries += [_levelled(frame, tries[-1])]
            tries += [_levelled(frame, tries[-1])]
            yield max(tries, key=_Seen.score)


def _ring(seen: _Seen) -> FloatArray:
    """Return (N, 3) places of the front around both openings."""
    near = ndimage.binary_dilation(
        seen.openings[0][1] | seen.openings[1][1], iterations=max(2, round(1.5 / seen.pixel))
    )
    at = np.argwhere(near & seen.front)
    return np.column_stack([seen.place(at.astype(float)), seen.depth[tuple(at.T)]])


def _surface_terms(xy: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(xy)), np.abs(xy[:, 0]), xy[:, 0] ** 2, xy[:, 1]])


def _surface(ring: FloatArray) -> FloatArray:
    """Return the coefficients (4,) of the surface nearest to most of some places (N, 3)."""
    terms, weight = _surface_terms(ring[:, :2]), np.ones(len(ring))
    for _ in range(6):
        found = np.linalg.lstsq(terms * weight[:, None], ring[:, 2] * weight, rcond=None)[0]
        weight = 1 / (1 + ((ring[:, 2] - terms @ found) / 2.0) ** 2)
    return found


def _levelled(frame: _Frame, seen: _Seen) -> _Seen:
    """Return the frame seen so that both rims stand upright, around their middle."""
    ring = _ring(seen)
    if len(ring) < 30:
        return seen
    turn = rotation_from_vector(np.array([-np.clip(np.arctan(_surface(ring)[3]), -0.15, 0.15), 0, 0]))
    middle = np.array(
        [0.0, *(np.percentile(ring[:, 1:], 5, axis=0) + np.percentile(ring[:, 1:], 95, axis=0)) / 2]
    )
    return frame.seen(turn @ seen.axes, seen.origin + middle @ seen.axes, (85, 45), 0.4)


def _edge(seen: _Seen, opening: BoolArray, sign: int) -> tuple[FloatArray, FloatArray, float]:
    """Return an opening's edge (360, 2), the rim's outside there (360, 2), and the rim's usual width.

    Both run counterclockwise from the temple's side at half height, with x outward from the middle.
    """
    line = seen.place(max(find_contours(opening.astype(float), 0.5), key=len)) * [sign, 1]
    line = line[:-1]
    if np.cross(line, np.roll(line, -1, 0)).sum() < 0:
        line = line[::-1]
    half = (line[:, 1].min() + line[:, 1].max()) / 2
    line = np.roll(line, -int((line[:, 0] - 9 * np.abs(line[:, 1] - half)).argmax()), 0)
    run = np.cumsum(np.linalg.norm(np.diff(line, axis=0, append=line[:1]), axis=1))
    place = np.linspace(0, run[-1], 360, endpoint=False)
    edge = np.stack([np.interp(place, [0, *run], [*line[:, k], line[0, k]]) for k in range(2)], 1)
    edge = ndimage.gaussian_filter1d(edge, 2, axis=0, mode="wrap")
    along = np.roll(edge, -1, 0) - np.roll(edge, 1, 0)
    out = np.stack([along[:, 1], -along[:, 0]], 1) / np.linalg.norm(along, axis=1)[:, None]
    steps = np.arange(0.0, 15, 0.1)
    places = (edge[:, None] + steps[:, None] * out[:, None]) * [sign, 1]
    at = np.moveaxis((places - seen.low) / seen.pixel, -1, 0)[::-1]
    solid = ndimage.map_coordinates(seen.front.astype(float), at, order=1) > 0.5
    solid[:, steps < 2 * seen.pixel] |= solid.any(1)[:, None]
    width = steps[np.argmin(np.column_stack([solid, np.zeros(360, bool)]), 1) - 1]
    width[~solid[:, 10]] = 0.0
    usual = float(np.median(width[width > 0])) if (width > 0).any() else 0.0
    width = np.where(width > 2 * usual, usual, width)
    return edge, edge + width[:, None] * out, usual


def _extreme(outer: FloatArray, sign: int) -> tuple[int, float]:
    """Return which of the outside's points (N, 2) is its highest or lowest, and how unsure x is.

    A flat top is as high in many places: of those designs have the key point over the lens's middle.
    """
    height = sign * outer[:, 1]
    weight = np.exp((height - height.max()) / 0.15)
    weight /= weight.sum()
    x = float(weight @ outer[:, 0])
    precision = 1 / max(float(weight @ (outer[:, 0] - x) ** 2), 0.01)
    usual = (outer[:, 0].min() + outer[:, 0].max()) / 2
    x = (x * precision + usual / 16) / (precision + 1 / 16)
    upper = height > np.median(height)
    return int(np.where(upper, np.abs(outer[:, 0] - x), np.inf).argmin()), (precision + 1 / 16) ** -0.5


def _bridge(seen: _Seen, low: float, high: float) -> list[tuple[float, float]]:
    """Return from below (bottom, top) of what crosses the middle between two heights."""
    middle = seen.front.shape[1] // 2
    y = seen.place(np.column_stack([np.arange(len(seen.front)), np.zeros(len(seen.front))]))[:, 1]
    column = seen.front[:, middle - 1 : middle + 1].any(1) & (y > low) & (y < high)
    label, count = ndimage.label(column)
    return [
        (y[label == k].min() - seen.pixel / 2, y[label == k].max() + seen.pixel / 2)
        for k in range(1, count + 1)
    ]


def _key_points(frame: _Frame, seen: _Seen) -> tuple[FloatArray, FloatArray]:
    """Return key points (20, 3) in the axes of how the frame is seen, and deviations (20,), about in mm."""
    points, deviation = np.full((KEY_POINT_COUNT, 3), np.nan), np.full(KEY_POINT_COUNT, np.inf)
    ring = _ring(seen)
    if len(ring) < 30 or not np.isfinite(seen.score()):
        return points, deviation
    fit = _surface(ring)
    cloud = (frame.points - seen.origin) @ seen.axes.T
    height = cloud[:, 2] - _surface_terms(np.clip(cloud[:, :2], ring[:, :2].min(0), ring[:, :2].max(0))) @ fit
    front = cloud[np.abs(height) < _SLAB]
    tree = cKDTree(front[:, :2])

    def put(name: str, place: FloatArray, sd: float) -> None:
        k = KEY_POINT_NAMES.index(name)
        if len(place) == 2:
            away, near = tree.query(place, 6)
            if away[0] > 3:
                return
            place = np.append(place, front[near, 2].mean())
        points[k], deviation[k] = place, sd

    edges = [_edge(seen, found[1], sign) for found, sign in zip(seen.openings, (1, -1), strict=True)]
    crossing = _bridge(seen, min(e[0][:, 1].min() for e in edges), max(e[0][:, 1].max() for e in edges) + 10)
    if crossing:
        put("bridge_top", np.array([0, crossing[-1][1]]), 0.7)
        put("bridge_bottom", np.array([0, crossing[0][0]]), 0.7)
    for side, sign, (edge, outer, width), (*_, cost) in zip(
        ("left", "right"), (1, -1), edges, seen.openings, strict=True
    ):
        turn = np.array([sign, 1, 1])

        def own(name: str, place: FloatArray, sd: float) -> None:
            put(f"{side}_{name}", place * turn[: len(place)], float(np.hypot(sd, cost * ("rim" in name))))

        for name, up in (("rim_top", 1), ("rim_bottom", -1)):
            at, sd = _extreme(outer, up)
            own(name, outer[at], np.hypot(sd, 0.4))
        half = (edge[:, 1].min() + edge[:, 1].max()) / 2
        inner = int((-edge[:, 0] - 9 * np.abs(edge[:, 1] - half)).argmax())
        own("rim_inner", outer[(inner + 30) % 360], 1.5)
        own("rim_outer", outer[330], 1.5)
        if crossing:
            at, sd = _joint(seen, edge, crossing[0], width, sign)
            own("rim_bridge", edge[at], sd)
        _put_temple(frame, seen, cloud * turn, height, outer, sign, own)
    return points, deviation


def _joint(
    seen: _Seen, edge: FloatArray, run: tuple[float, float], width: float, sign: int
) -> tuple[int, float]:
    """Return at which of an opening's edge points (N, 2) the bridge meets the rim, and how unsure it is."""
    middle = seen.front.shape[1] // 2
    front = seen.front[:, middle:] if sign > 0 else seen.front[:, middle - 1 :: -1]
    y = seen.place(np.column_stack([np.arange(len(front)), np.zeros(len(front))]))[:, 1]
    first, place = run[1] - run[0], np.array([0.0, sum(run) / 2])
    for column in range(int(max(edge[:, 0].min() - width, 0) / seen.pixel)):
        label = ndimage.label(front[:, column])[0]
        at = int(np.abs(y - place[1]).argmin())
        if not label[at] or (label == label[at]).sum() * seen.pixel > 1.6 * first + width:
            break
        place = np.array([(column + 0.5) * seen.pixel, y[label == label[at]].mean()])
    away = np.linalg.norm(edge - place, axis=1)
    return int(away.argmin()), float(np.hypot(1.0, (away.min() - width) / 4))


def _put_temple(
    frame: _Frame,
    seen: _Seen,
    cloud: FloatArray,
    height: FloatArray,
    outer: FloatArray,
    sign: int,
    put: Callable[[str, FloatArray, float], None],
) -> None:
    """Put the key points from the hinge on; `cloud` (N, 3) is mirrored so that the temple is at x > 0."""
    edge = float(outer[:, 0].max())
    low, high = outer[:, 1].min() - 5, outer[:, 1].max() + 5
    behind = (height < -12) & (cloud[:, 0] > 0.6 * edge)
    near = behind & (height > -30) & (cloud[:, 1] > low) & (cloud[:, 1] < high)
    level = float(cloud[:, 2][np.abs(height) < _SLAB].max())
    depth = -height[behind].min(initial=0.0)
    if depth < 45 or not near.any():
        end = cloud[(np.abs(height) < 2 * _SLAB) & (cloud[:, 0] > 0.6 * edge)]
        if len(end) == 0:
            return
        tip = end[end[:, 0] > end[:, 0].max() - 1]
        put("hinge", tip.mean(0), np.hypot(2.0, tip[:, 1].std()))
        return
    at = float(np.median(cloud[near, 1]))
    tall = max(float(np.percentile(np.abs(cloud[near, 1] - at), 90)), 1.0)
    corner = cloud[(height > -16) & (cloud[:, 0] > edge - 8) & (np.abs(cloud[:, 1] - at) < tall)]
    if len(corner) == 0:
        return
    outward = corner @ [1.0, 0, 1]
    hinge = corner[outward > outward.max() - 0.7].mean(0)
    hinge[1] = at
    put("hinge", hinge, 1.5)
    temple = cloud[behind]
    reach = np.linalg.norm(temple - hinge, axis=1)
    bins = np.arange(6.0, reach.max(), 2.0)
    which = np.digitize(reach, bins)
    line = np.array([temple[which == k].mean(0) for k in range(1, len(bins)) if (which == k).sum() > 2])
    if len(line) < 12:
        return
    along = temple @ (line[-1] - line[-6]) / np.linalg.norm(line[-1] - line[-6])
    tip = temple[(along > along.max() - 0.8) & (reach > reach.max() - 8)].mean(0)
    put("temple_tip", tip, 0.8)
    line = np.concatenate([hinge[None] + [[0, 0, -1.0]], line])
    run = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    knee, sd = _knee(run, line, run[-1] + np.linalg.norm(tip - line[-1]))

    def outside(s: float) -> FloatArray:
        center = np.array([np.interp(s, run, line[:, k]) for k in range(3)])
        mine = temple[np.linalg.norm(temple[:, 1:] - center[1:], axis=1) < 1.2]
        return np.array([mine[:, 0].max() if len(mine) else center[0], *center[1:]])

    put("ear_bend", outside(knee), float(np.hypot(sd, 0.5)))
    put("temple_middle", outside(knee / 2), float(np.hypot(sd / 2, 0.8)))


def _knee(run: FloatArray, line: FloatArray, length: float) -> tuple[float, float]:
    """Return where along a temple's middle line (N, 3), at `run` (N,), it turns down, and how unsure.

    The posterior mean of the corner of two straight lines, before designs: two thirds of the way.
    """
    z, y = -line[:, 2], line[:, 1]
    misfit = np.full(len(run), np.inf)
    for k in range(3, len(run) - 2):
        terms = np.column_stack([np.ones(len(z)), z, np.maximum(z - z[k], 0)])
        misfit[k] = ((y - terms @ np.linalg.lstsq(terms, y, rcond=None)[0]) ** 2).sum()
    noise = max(misfit.min() / len(run), 0.1**2)
    odds = -misfit / (2 * 5 * noise) - ((run / length - 0.69) / 0.06) ** 2 / 2
    weight = np.exp(odds - odds[np.isfinite(odds)].max())
    weight /= weight.sum()
    mean = float(weight @ run)
    return mean, float(np.sqrt(weight @ (run - mean) ** 2))


def _likeness(points: FloatArray) -> float:
    """Return log odds of key points (20, 3), NaN where unknown, against those of a typical frame."""
    known, typical = np.isfinite(points).all(1), typical_key_points()
    if known.sum() < 6:
        return -np.inf
    laid = transform_points(procrustes(points[known], typical[known], scale=True), points[known])
    away = ((laid - typical[known]) ** 2).sum(1)
    return float(-1.5 * np.log1p(away / (2 * 5.0**2)).sum() - 1.0 * (~known).sum())


def propose_keypoints(mesh: Any) -> ProposedKeyPoints:
    """Return the 20 key points of a frame found from its shape, each with its deviation.

    The frame is mirrored onto itself; along the directions of its plane of symmetry the two largest openings
    that a rim encloses, or panes fill, are its front. Key points are extremes, joints and bends of the rims,
    the bridge and the temples. Which way is up and which is forward, and how far all of it is in doubt, is
    decided by the likeness to a typical frame's key points: other explanations widen the deviations by their
    odds. The unit is the one in which a mean face wears the frame.

    Parameters
    ----------
    mesh : RawScan, or vertices (V, 3) and faces (F, 3)
        Any pose, any unit, any number of parts, panes among them or not.

    Raises
    ------
    EyeglassesError
        When it is empty or not finite, or shows no two openings on both sides of a plane of symmetry.

    Examples
    --------
    >>> from scan2albedo.synthetic import eyeglasses
    >>> frame = eyeglasses(seed=1)
    >>> found = propose_keypoints((frame.vertices / 25.4, frame.faces))
    >>> found.unit, bool(abs(25.4 * found.points - frame.keypoints).max() < 4)
    ('inch', True)
    """
    vertices, faces = checked_mesh(*((mesh.vertices, mesh.faces) if hasattr(mesh, "vertices") else mesh))
    frame, tried = _Frame(vertices, faces), []
    for seen in _fronts(frame):
        for turned in (seen, frame.seen(seen.axes * [[-1], [-1], [1]], seen.origin, (85, 45), 0.4)):
            points, deviation = _key_points(frame, turned)
            odds = _likeness(points) + turned.score()
            tried.append((odds, seen.origin + points @ turned.axes, deviation))
    if not tried or not np.isfinite(odds := max(row[0] for row in tried)):
        raise EyeglassesError(
            "no front with two openings for lenses, alike on both sides, was found: place the key points"
        )
    _, points, deviation = max(tried, key=lambda row: row[0])
    share = np.exp([row[0] - odds for row in tried])
    apart = np.nan_to_num([((p - points) ** 2).sum(1) for _, p, _ in tried])
    deviation = np.sqrt(deviation**2 + share @ apart / share.sum())
    world = frame.middle + frame.unit * points
    scale, unit = _unit(world)
    return ProposedKeyPoints(world, deviation * frame.unit * scale, scale, unit, float(odds))


def _unit(points: FloatArray) -> tuple[float, str]:
    """Return mm a unit, and the unit's name, by which key points (20, 3) are as large as glasses that a mean face wears."""
    logs = []
    for a, b, length in (
        ("left_hinge", "right_hinge", 138.0),
        ("left_rim_bottom", "right_rim_bottom", 68.0),
        ("left_hinge", "left_ear_bend", 108.0),
    ):
        away = float(np.linalg.norm(points[KEY_POINT_NAMES.index(a)] - points[KEY_POINT_NAMES.index(b)]))
        if away > 0:
            logs.append(np.log(length / away))
    usual = float(np.mean(logs))
    best = min(_UNITS_MM, key=lambda unit: abs(np.log(_UNITS_MM[unit]) - usual))
    odds = -(((np.log(_UNITS_MM[best]) - usual) / 0.06) ** 2) / 2 + 6.9
    return (_UNITS_MM[best], best) if odds > 0 else (float(np.exp(usual)), "unknown")
