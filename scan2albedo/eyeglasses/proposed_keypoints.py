"""The 20 key points of a frame proposed from its shape alone, in any pose and unit, each with a deviation.

Inside, frames are scaled to 150 mm, about their true size, so that lengths are about in mm.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import softmax
from skimage.measure import find_contours
from skimage.morphology import convex_hull_image

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, arc_lengths, finite_rows, norms
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, checked_mesh, typical_key_points
from scan2albedo.geometry import rigid
from scan2albedo.geometry.mesh import neighbouring_faces, normalized, vertex_components
from scan2albedo.geometry.oriented_points import oriented_points
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.units import MM_PER_UNIT

_SLAB = 7
"""How far behind the foremost place of its column a front reaches: folded temples lie behind it."""
_SPACING = 0.8
"""Of points; so many mm from where it is farthest a part still counts as its end."""
HARDLY_A_FRAME = -12
"""Log odds below which something else may have been taken for a frame, and its key points are anywhere:
frames were found at -5 or above."""
_Places = dict[str, tuple[FloatArray, float]]


class ProposedKeyPoints(NamedTuple):
    """Key points that a frame's own shape proposes."""

    points: FloatArray
    """(20, 3) in the mesh's own axes and unit, NaN where none was found."""
    deviation: FloatArray
    """(20,) standard deviation in mm; infinite where none was found."""
    mm_per_unit: float
    unit: str
    """"mm", "cm", "m", "inch", or "unknown": in none of them has it the size of a frame."""
    log_odds: float
    """How like a typical frame's they are; see `HARDLY_A_FRAME`."""


class _Frame:
    """Rays and evenly spread points of a frame, its panes apart: parts that hold a disc as no rim does."""

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        turned, own = rigid.in_principal_frame(vertices, faces)
        low, high = turned[faces.ravel()].min(0), turned[faces.ravel()].max(0)
        self.unit = (high - low).max() / 150
        self.middle = rigid.transform_points(rigid.invert_rigid(own), (low + high)[None] / 2)[0]
        xyz = (vertices - self.middle) / self.unit
        joined = np.unique(np.round(xyz, 3), axis=0, return_inverse=True)[1].ravel()[faces]
        # A pane that is sewn into a rim meets it where three faces share an edge.
        one, other, _ = neighbouring_faces(joined)
        part = vertex_components(len(faces), np.stack([one, other], 1))
        pane = np.zeros(len(faces), bool)
        for k in np.flatnonzero(np.bincount(part) >= 8):
            piece = faces[part == k]
            flat, _ = rigid.in_principal_frame(xyz, piece)
            (left, right), (low, high) = np.percentile(flat[piece.ravel(), :2], [0, 100], axis=0).T
            if high - low > 20:
                grid = np.stack(np.meshgrid(np.arange(left, right), np.arange(low, high), [200]), -1)
                hit = RayCaster(flat, piece).occluded(grid.reshape(-1, 3), np.array([0, 0, -1]))
                inside = ndimage.distance_transform_edt(np.pad(hit.reshape(grid.shape[:2]), 1))
                pane[part == k] = inside.max() > 9
        pane &= ~pane.all()
        self.rims = RayCaster(xyz, faces[~pane])
        self.panes = RayCaster(xyz, faces[pane]) if pane.any() else None
        self.points = oriented_points(xyz, faces[~pane], _SPACING).points

    def fronts(self) -> list[_Seen]:
        """Return how the frame looks where two openings are seen on both sides of a plane of symmetry."""
        looks: list[_Seen] = []
        for normal, offset in symmetry_planes(self.points):
            middle, across = self.points.mean(0), np.linalg.svd(normal[None])[2][1:]
            origin, around = middle - (middle @ normal - offset) * normal, []
            for angle in np.linspace(0, 2 * np.pi, 36, endpoint=False):
                z = np.array([np.cos(angle), np.sin(angle)]) @ across
                axes = np.stack([normal, np.cross(z, normal), z])
                around.append(_Seen(self, axes, origin, (90, 90), 1.5))
            score = np.array([seen.score for seen in around])
            peaks = np.isfinite(score) & (score >= np.roll(score, 1)) & (score >= np.roll(score, -1))
            looks += [around[k] for k in np.flatnonzero(peaks)]
        upright = []
        for seen in sorted(looks, key=lambda seen: -seen.score)[:6]:
            tries = [seen]
            while len(tries) < 4 and np.isfinite(seen.score):
                # Upright are rims whose depth does not change with height.
                turn = rigid.rotation_from_vector([-np.clip(_depth_of(seen.ring)[3], -1 / 6, 1 / 6), 0, 0])
                move = np.array([0, *np.percentile(seen.ring[:, 1:], [5, 95], axis=0).mean(0)])
                seen = _Seen(self, turn @ seen.axes, seen.origin + move @ seen.axes)
                tries.append(seen)
            upright.append(max(tries[1:], key=lambda seen: seen.score))
        return [seen for seen in upright if np.isfinite(seen.score)]


class _Seen:
    """A frame seen along axes[2] from an origin at x = 0, its middle column; row 0 is lowest.

    `front` (H, W) is what belongs to the front, `low` the place of pixel (0, 0), `openings` the left's and
    the right's (score, pixels (H, W), cost), `ring` (N, 3) places of the front around both.
    """

    def __init__(
        self,
        frame: _Frame,
        axes: FloatArray,
        origin: FloatArray,
        half: tuple[int, int] = (85, 45),
        pixel: float = _SPACING / 2,
    ) -> None:
        self.axes, self.origin, self.pixel = axes, origin, pixel
        x, y = ((np.arange(-round(h / pixel), round(h / pixel)) + 0.5) * pixel for h in half)
        start = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) @ axes[:2] + origin + 200 * axes[2]
        depth = (200 - frame.rims.first_hit(start, -axes[2]).distance).reshape(len(y), -1)
        # Temples that are seen beside the front are far behind it.
        self.front = depth > np.maximum(depth.max(0), depth.max() - 30) - _SLAB
        glass = np.zeros_like(self.front)
        if frame.panes is not None:
            glass = frame.panes.occluded(start, -axes[2]).reshape(depth.shape) & ~self.front
        left, right = (self.opening(self.front[:, ::turn], glass[:, ::turn]) for turn in (1, -1))
        self.openings = [left, (right[0], right[1][:, ::-1], right[2])]
        around = ndimage.binary_dilation(left[1] | self.openings[1][1], iterations=max(2, round(1.5 / pixel)))
        at = np.argwhere(around & self.front)
        self.low = np.array([x[0], y[0]])
        self.ring = np.column_stack([at[:, ::-1] * pixel + self.low, depth[tuple(at.T)]])
        self.score = left[0] + right[0] if len(at) > 30 else -np.inf

    def opening(self, own: BoolArray, pane: BoolArray) -> tuple[float, BoolArray, float]:
        """Return the likeliest opening at x > 0: its score, its pixels (H, W), and how much it is in doubt.

        A hole that the front `own` encloses by itself, with its mirror image, once gaps or its convex hull
        close it; or a pane. The log odds are those of its area, less a cost where it is not by itself.
        """
        middle, half = own.shape[1] // 2, own | pane
        half[:, : middle + 2] = False
        best = -np.inf, np.zeros_like(own), np.inf
        most = half.any(0).sum() * half.any(1).sum() * self.pixel**2

        def closed() -> Iterator[tuple[BoolArray, float]]:
            yield own, 0.0
            yield ~pane, 0.5
            yield ndimage.binary_closing(own, iterations=round(1.5 / self.pixel)), 0.5
            yield own | own[:, ::-1], 1.0
            yield own | ~convex_hull_image(half), 3.0

        for mask, cost in closed() if most else ():
            if np.log(most) - cost < best[0]:
                break
            label = ndimage.label(~mask)[0]
            area = np.bincount(label.ravel()) * self.pixel**2
            area[np.unique([0, *label[:, : middle + 1].flat, *label[[0, -1]].flat, *label[:, -1]])] = 0
            if area.max() > 100 and (score := np.log(area.max()) - cost) > best[0]:
                best = score, label == area.argmax(), cost
        return best

    def rim(self, opening: BoolArray, sign: int) -> tuple[FloatArray, FloatArray]:
        """Return an opening's edge (360, 2), and the rim's outside there (360, 2), with x > 0.

        Both run counterclockwise from the temple's side at half height.
        """
        line = max(find_contours(opening.astype(float)), key=len)[:-1, ::-1] * self.pixel + self.low
        line = (line * [sign, 1])[::sign]
        line = np.roll(line, -_side(line, 1), 0)
        run = arc_lengths(line := np.append(line, line[:1], 0))
        edge = _at_run(np.linspace(0, run[-1], 360, endpoint=False), run, line)
        edge = ndimage.gaussian_filter1d(edge, 2, axis=0, mode="wrap")
        out = normalized((np.roll(edge, -1, 0) - np.roll(edge, 1, 0))[:, ::-1]) * [1, -1]
        steps = np.arange(8, 60 / self.pixel) * self.pixel / 4
        at = ((edge[:, None] + steps[:, None] * out[:, None]) * [sign, 1] - self.low) / self.pixel
        solid = ndimage.map_coordinates(self.front.astype(float), np.moveaxis(at, -1, 0)[::-1], order=1) > 0.5
        width = np.append(0, steps)[np.argmin(np.column_stack([solid, np.zeros(360, bool)]), 1)]
        median_width = np.median(width[width > 0]) if width.any() else 0
        # Where bridge, temple and pads are joined the rim is as wide as elsewhere.
        return edge, edge + np.where(width > 2 * median_width, median_width, width)[:, None] * out

    def key_points(self, cloud: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return key points (20, 3), deviations (20,) and log odds of points (N, 3) in these axes."""
        within = np.clip(cloud[:, :2], *np.percentile(self.ring[:, :2], [0, 100], axis=0))
        height = cloud[:, 2] - _terms(within) @ _depth_of(self.ring)
        rims = [self.rim(pixels, sign) for (_, pixels, _), sign in zip(self.openings, (1, -1), strict=True)]
        low, high = min(edge[:, 1].min() for edge, _ in rims), max(outer[:, 1].max() for _, outer in rims) + 5
        middle = self.front.shape[1] // 2
        y = np.flatnonzero(self.front[:, middle - 1 : middle + 1].any(1)) * self.pixel + self.low[1]
        y = y[(y > low) & (y < high)]
        found: _Places = {}
        sizes: dict[str, list[Any]] = {}
        bridge = np.nan
        if len(y):
            found["bridge_top"] = np.array([0, y[-1] + self.pixel / 2]), 0.5
            found["bridge_bottom"] = np.array([0, y[0] - self.pixel / 2]), 0.5
            # What crosses the middle: a bridge, or two with a gap between them.
            bridge = np.split(y, np.flatnonzero(np.diff(y) > 1.5 * self.pixel) + 1)[0].mean()
        for sign, (edge, outer), (*_, cost) in zip((1, -1), rims, self.openings, strict=True):
            turn, side = np.array([sign, 1, 1]), "left_" if sign > 0 else "right_"
            half = _rim_points(edge, outer, bridge, cost) | _temple_points(cloud * turn, height, outer)
            for name, (p, sd) in half.items():
                found[side + name] = p * turn[: len(p)], sd
                # Bends do not change how far along a temple a point is.
                size = p - edge.mean(0) if "rim" in name else np.linalg.norm(p - half["hinge"][0])
                sizes.setdefault(name, []).append(size)
        points, deviation = np.full((len(KEY_POINT_NAMES), 3), np.nan), np.full(len(KEY_POINT_NAMES), np.inf)
        front = cloud[np.abs(height) < _SLAB]
        tree = cKDTree(front[:, :2])
        for name, (place, sd) in found.items():
            if len(place) == 2:
                away, near = tree.query(place, 6)
                # Where a piece is missing there is nothing near.
                if away[0] > 3:
                    continue
                place = np.append(place, front[near, 2].mean())
            apart = np.ptp(sizes.get(name.partition("_")[2], [0]), axis=0)
            k = KEY_POINT_NAMES.index(name)
            points[k], deviation[k] = place, np.hypot(sd, np.linalg.norm(apart) / 2)
        if (known := finite_rows(points)).sum() < 6:
            return points, deviation, -np.inf
        typical = typical_key_points()[known]
        laid = rigid.transform_points(rigid.procrustes(points[known], typical, scale=True), points[known])
        odds = -1.5 * np.log1p(((laid - typical) ** 2).sum(1) / 50).sum() - (~known).sum()
        # What stands off a front is behind it: pads, hinges, temples.
        behind, before = (height < -4).sum(), (height > 4).sum()
        odds += self.score + 6 * (behind - before) / (behind + before + 100)
        return points, deviation, float(odds)


def symmetry_planes(points: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return planes (normal, offset) in which most of a frame's points (N, 3) mirror each other."""
    tree = cKDTree(points)

    def refined(normal: FloatArray, offset: float, own: FloatArray) -> tuple[FloatArray, float, float]:
        for step in range(10):
            away, nearest = tree.query(own - 2 * (own @ normal - offset)[:, None] * normal)
            odds = (away / (2 * max(1, 6 - step))) ** 2
            weight = 1 / (1 + odds) ** 2
            a, b = (weight @ p / weight.sum() for p in (own, points[nearest]))
            # The reflection I - 2 n n^T that leaves least: n belongs to the least of p q^T + q p^T.
            both = ((own - a) * weight[:, None]).T @ (points[nearest] - b)
            normal = np.linalg.eigh(both + both.T)[1][:, 0]
            offset = normal @ (a + b) / 2
        return normal, offset, np.mean(odds / (1 + odds))

    few, middle = points[:: max(len(points) // 300, 1)], points.mean(0)
    axes = [*np.linalg.eigh(np.cov(points.T))[1].T, *rigid.super_fibonacci_rotations(30)[:, 0]]
    # A single temple draws the centroid to its side.
    starts = (refined(n, n @ middle + away, few) for n in axes for away in (-18, 0, 18))
    kept: list[tuple[FloatArray, float]] = []
    for normal, offset, _ in sorted(starts, key=lambda plane: plane[2]):
        if len(kept) < 3 and all(np.linalg.norm(np.cross(normal, n)) > 1 / 3 for n, _ in kept):
            kept.append(refined(normal, offset, points[:: max(len(points) // 2000, 1)])[:2])
    return kept


def _terms(xy: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(xy)), np.abs(xy[:, 0]), xy[:, 0] ** 2, xy[:, 1]])


def _depth_of(ring: FloatArray) -> FloatArray:
    """Return the coefficients (4,) of the surface on which most of a front's places (N, 3) lie."""
    terms, weight = _terms(ring[:, :2]), np.ones(len(ring))
    for _ in range(6):
        found = np.linalg.lstsq(terms * weight[:, None], ring[:, 2] * weight, rcond=None)[0]
        weight = 1 / (1 + ((ring[:, 2] - terms @ found) / 2) ** 2)
    return np.asarray(found)


def _at_run(place: FloatArray, run: FloatArray, line: FloatArray) -> FloatArray:
    return np.stack([np.interp(place, run, column) for column in line.T], -1)


def _side(line: FloatArray, sign: int) -> int:
    """Return which of an outline's points (N, 2) is at half height on the temple's side, or the nose's."""
    half = (line[:, 1].min() + line[:, 1].max()) / 2
    return int((sign * line[:, 0] - 9 * np.abs(line[:, 1] - half)).argmax())


def _rim_points(edge: FloatArray, outer: FloatArray, bridge: float, cost: float) -> _Places:
    """Return the rim's key points in x and y, and deviations, of its edge (360, 2) and outside (360, 2)."""
    found: _Places = {}
    middle = (outer.min(0) + outer.max(0)) / 2
    for name, up in (("rim_top", 1), ("rim_bottom", -1)):
        height = up * (outer[:, 1] - middle[1])
        weight = np.exp((height - height.max()) * 6)
        x = weight @ outer[:, 0] / weight.sum()
        flat = weight @ (outer[:, 0] - x) ** 2 / weight.sum()
        # A flat top is as high all along: designs have it within 4 mm of the lens's middle.
        x = (x * 16 + middle[0] * flat) / (16 + flat)
        at = np.where(height > 0, np.abs(outer[:, 0] - x), np.inf).argmin()
        found[name] = outer[at], np.hypot(2.5 * (flat / (16 + flat)) ** 0.5, 0.5)
    # Below the middle of the sides as on typical frames: a twelfth of the way around, and facing 30 degrees
    # down. People place these anywhere along the side.
    along = normalized(np.roll(edge, -12, 0) - np.roll(edge, 12, 0))
    for name, arc, up in (("rim_inner", (_side(edge, -1) + 30) % 360, -1), ("rim_outer", 330, 1)):
        turned = (along @ [1, up * 3**0.5]).argmax()
        at = norms(outer - (outer[arc] + outer[turned]) / 2).argmin()
        found[name] = outer[at], np.hypot(3.5, np.linalg.norm(outer[arc] - outer[turned]) / 2)
    if np.isfinite(bridge):
        nose = edge[90:270]
        near = nose[norms(nose - [0, bridge]).argmin()]
        level = nose[(nose[:, 0] + 9 * np.abs(nose[:, 1] - bridge)).argmin()]
        at = norms(nose - (near + level) / 2).argmin()
        found["rim_bridge"] = nose[at], np.hypot(1.0, np.linalg.norm(near - level) / 2)
    return {name: (place, np.hypot(sd, cost)) for name, (place, sd) in found.items()}


def _temple_points(cloud: FloatArray, height: FloatArray, outer: FloatArray) -> _Places:
    """Return key points from the hinge on, and deviations, of points (N, 3) `height` before the front.

    The temple is at x > 0, the rim's outside `outer` (360, 2).
    """
    side = cloud[:, 0] > outer[:, 0].mean()
    behind = side & (height < -12)
    near = behind & (height > -30) & (np.abs(cloud[:, 1] - outer[:, 1].mean()) < np.ptp(outer[:, 1]) / 2 + 5)
    if -height[behind].min(initial=0) < 45 or not near.any():
        end = cloud[side & (np.abs(height) < 2 * _SLAB)]
        end = end[end[:, 0] > end[:, 0].max(initial=0) - 1]
        return {"hinge": (end.mean(0), np.hypot(2, end[:, 1].std()))} if len(end) else {}
    level = np.median(cloud[near, 1])
    tall = max(np.percentile(np.abs(cloud[near, 1] - level), 90), 1)
    outmost = (height > -16) & (cloud[:, 0] > outer[:, 0].max() - 8)
    corner = cloud[outmost & (np.abs(cloud[:, 1] - level) < tall)]
    temple = cloud[behind]
    if len(corner) == 0:
        return {}
    # Half way around the corner between front and temple.
    outward = corner @ [1, 0, 1]
    hinge = corner[outward > outward.max() - _SPACING].mean(0)
    hinge[1] = level
    found: _Places = {"hinge": (hinge, 1.5)}
    reach = norms(temple - hinge)
    shell = np.digitize(reach, np.arange(6, reach.max(), 2))
    line = np.array([hinge - [0, 0, 1], *(temple[shell == k].mean(0) for k in np.unique(shell)[1:-1])])
    if len(line) < 12:
        return found
    along = temple @ (line[-1] - line[-6]) / np.linalg.norm(line[-1] - line[-6])
    tip = temple[along > along.max() - _SPACING].mean(0)
    run = arc_lengths(line)
    # Where the middle line turns down: the corner of two straight lines, before designs' two thirds.
    misfit = np.full(len(run), np.inf)
    z, y = -line[:, 2], line[:, 1]
    for k in range(3, len(run) - 2):
        terms = np.column_stack([np.ones(len(z)), z, np.maximum(z - z[k], 0)])
        misfit[k] = ((y - terms @ np.linalg.lstsq(terms, y, rcond=None)[0]) ** 2).sum()
    odds = -len(run) * misfit / (10 * misfit.min() + len(run) / 10) - (16 * (run / run[-1] - 2 / 3)) ** 2 / 2
    share = softmax(odds)
    knee = share @ run
    sd = np.sqrt(share @ (run - knee) ** 2)
    for name, part, own in (("temple_middle", 0.5, _SPACING), ("ear_bend", 1, 2)):
        at = _at_run(knee * part, run, line)
        at[0] = temple[norms(temple[:, 1:] - at[1:]) < 1.5 * _SPACING, 0].max(initial=at[0])
        found[name] = at, np.hypot(sd * part, own)
    return found | {"temple_tip": (tip, _SPACING)}


def propose_keypoints(mesh: Any) -> ProposedKeyPoints:
    """Return the 20 key points of a frame found from its shape, each with its deviation.

    The frame is mirrored onto itself; in a direction within its plane of symmetry the openings that rims
    enclose, or panes fill, are largest on both sides: its front. Key points are extremes, joints and bends of
    rims, bridge and temples; deviations say how sharp they are and how far both sides agree. Which way is
    up and which forward is decided by the likeness to a typical frame's key points; what other explanations
    say widens the deviations by their odds. The unit is the one in which it is as large as a typical frame.

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
    frame = _Frame(vertices, faces)
    tried: list[tuple[float, FloatArray, FloatArray]] = []
    for upright in frame.fronts():
        for seen in (upright, _Seen(frame, upright.axes * [[-1], [-1], [1]], upright.origin)):
            points, deviation, odds = seen.key_points((frame.points - seen.origin) @ seen.axes.T)
            tried.append((odds, seen.origin + points @ seen.axes, deviation))
    if not tried or not np.isfinite(most := max(odds for odds, *_ in tried)):
        raise EyeglassesError("no front with two openings on both sides was found: place the key points")
    _, points, deviation = max(tried, key=lambda row: row[0])
    share = np.exp([odds - most for odds, *_ in tried])
    apart = np.nan_to_num([((other - points) ** 2).sum(1) for _, other, _ in tried])
    none = np.exp(min(HARDLY_A_FRAME - most, 50.0))
    deviation = np.sqrt(deviation**2 + (share @ apart + none * 60**2) / (share.sum() + none))
    points = frame.middle + frame.unit * points
    known = finite_rows(points)
    worn = rigid.procrustes(points[known], typical_key_points()[known], scale=True)
    log_mm = np.log(np.linalg.norm(worn[0, :3]))
    units = {"inch": 25.4, **MM_PER_UNIT}
    unit = min(units, key=lambda name: abs(np.log(units[name]) - log_mm))
    scale = units[unit]
    # A typical frame fits the average face, and others differ by 7 % from it: a quarter is no frame's.
    if abs(np.log(scale) - log_mm) > 1 / 4:
        unit, scale = "unknown", float(np.exp(log_mm))
    return ProposedKeyPoints(points, deviation * frame.unit * scale, scale, unit, most)
