"""The inner rim of a frame around a lens centre: by rays, from its key points, as pictures show it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    checked_array,
    norms,
)
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses.keypoints import checked_mesh, checked_points
from scan2albedo.eyeglasses.on_face.objective import BIAS_PX, ROBUST, VOTE
from scan2albedo.eyeglasses.on_face.outline import REACH_PX, MaskDistance, search_edges
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import normalized, vertex_components
from scan2albedo.geometry.pinhole import normalized_cameras, projected
from scan2albedo.geometry.rays import RayCaster

Gaps = Literal["none", "interpolated", "subdivided"]

_POINTS = 128
"""Of a rim."""
_GUESS = 0.15
"""Lens radius as a part of the mesh's longest side: 0.16 to 0.2 for a front, more for a rim alone."""
_DEPTH = 0.6
"""Lens radii in front of the plane and behind it within which a part is a lens; temples are farther off."""
_AT_RIM = 0.25
"""Lens radii between a rim's key points and its surface, at most."""
_ENOUGH = 0.75
"""Share of the places at which a lens is met; what crosses fewer is a strut or a nose pad."""
_FLAT = 0.05
"""Spread of rim points across their longest direction below which they are a line and hold no plane."""
_REACH = 0.16
"""Heights looked at over and under the plane, in lens radii: a curved rim leaves the plane by about 0.1."""
_REFINEMENTS = (0.006, 0.002)
"""Then heights around the neighbourhood's: single rays meet ends of bridges that poke through."""
_INNER = 0.4
"""Lens radii: what is nearer to the centre is a nose pad, and a lens reaches farther."""
_OUTER = 1.5
"""Lens radii: what is farther off is the other rim or a temple, or a pane for both eyes."""
_WINDOW_RAD = 0.2
_DENT = 0.0025
"""Part of the radius by which the edge may lie inside a chord between its neighbours."""
_STEP = 0.05
"""Lens radii between neighbouring hits that part two surfaces, such as the outer wall seen in a cut tube."""
_PULL = 0.25
"""Part of an edge's length within which a vertex draws its middle: farther off is another piece of frame."""
_OPEN = 0.12
"""Lens radii that an edge which no ray met is off in all (3 mm: a rim's width)."""
_BEND = 0.02
"""Lens radii by which a control point's error differs from its neighbours' mean."""


@dataclass(frozen=True)
class LensPlane:
    """A plane through a lens centre (3,), by unit vectors; the normal points towards the viewer.

    Angles run from `across` to `up`, counterclockwise for the viewer.
    """

    center: FloatArray
    across: FloatArray
    up: FloatArray
    normal: FloatArray

    @classmethod
    def at(cls, center: FloatArray, normal: FloatArray) -> Self:
        """Return the plane across `normal` (3,) of any length."""
        axis = normalized(normal)
        if not all_finite(axis) or not axis.any():
            raise EyeglassesError(f"a lens plane needs a finite normal, not zero, got {normal.tolist()}")
        across = normalized(np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis))
        return cls(center, across, np.cross(axis, across), axis)

    def directions(self, angles: FloatArray) -> FloatArray:
        """Return (N, 3) unit vectors in the plane."""
        return np.cos(angles)[:, None] * self.across + np.sin(angles)[:, None] * self.up

    def points(self, angles: FloatArray, profile: FloatArray) -> FloatArray:
        """Return (N, 3) points of an outline at angles (N,), of a `profile` (2, N) of radius and height."""
        radius, height = profile[..., None]
        return self.center + radius * self.directions(angles) + height * self.normal

    def angles(self, points: FloatArray) -> FloatArray:
        """Return (N,) rad."""
        offset = points - self.center
        return np.arctan2(offset @ self.up, offset @ self.across)

    def profile(self, points: FloatArray) -> FloatArray:
        """Return (2, N) radius and height over the plane of points (N, 3)."""
        offset = points - self.center
        return np.stack([np.hypot(offset @ self.across, offset @ self.up), offset @ self.normal])


def fit_normal(rim_points: FloatArray, vertices: FloatArray) -> FloatArray:
    """Return the unit normal (3,) of the plane nearest to rim points (K, 3), towards the viewer.

    The temples are behind the lenses, so the viewer is on the side that holds less of the frame.
    """
    _, spread, axes = np.linalg.svd(rim_points - rim_points.mean(0), full_matrices=False)
    if len(rim_points) < 3 or spread[1] <= _FLAT * spread[0]:
        raise EyeglassesError("rim points on one line hold no lens plane; give three or more around the lens")
    behind = (vertices - rim_points.mean(0)) @ axes[2]
    return -axes[2] if behind.mean() > 0 else axes[2]


def pane_faces(
    vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray | None
) -> BoolArray:
    """Return (F,) True for the faces of parts that lie across the lens's axis, never all of them.

    Without rim points (K, 3) a small lens is guessed from the mesh's size.
    """
    if rim_points is None:
        radius = _GUESS * np.ptp(vertices[faces.ravel()], axis=0).max()
    else:
        radius = plane.profile(rim_points)[0].mean()
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    kept = np.ones(len(faces), bool)
    while kept.any():
        left = np.flatnonzero(kept)
        met = _met(vertices, faces[left], plane, radius)
        numbers, counts = np.unique(part[left[met[met >= 0]]], return_counts=True)
        panes = np.isin(part, numbers[counts >= _ENOUGH * len(met)]) & kept
        rest = kept & ~panes
        if not panes.any() or not rest.any():
            break
        reach = norms(vertices[faces[panes].ravel()] - plane.center).max()
        if rim_points is not None and reach > _OUTER * radius:
            # The frame itself is larger than one lens, and without it there is no rim.
            apart = ClosestPointQuery(vertices, faces[rest]).query(rim_points).distance
            if (apart > _AT_RIM * radius).mean() > 0.5:
                break
        kept = rest
    return ~kept


def is_covered(vertices: FloatArray, faces: IntArray, plane: LensPlane, rim_points: FloatArray) -> bool:
    """Return whether a surface, joined to the rim or not, fills most of the lens's opening."""
    met = _met(vertices, faces, plane, plane.profile(rim_points)[0].mean())
    return (met >= 0).mean() >= _ENOUGH


def _met(vertices: FloatArray, faces: IntArray, plane: LensPlane, radius: float) -> IntArray:
    """Return the face that is met at each of some places of the lens, -1 for none near it."""
    places = plane.center + _INNER * radius * plane.directions(np.linspace(0, 2 * np.pi, 13))
    places[-1] = plane.center
    corners = ((vertices - plane.center) @ np.stack([plane.across, plane.up, plane.normal], 1))[faces]
    reach = radius * np.array([_INNER, _INNER, _DEPTH])
    near = np.flatnonzero(((corners.min(1) <= reach) & (corners.max(1) >= -reach)).all(1))
    if len(near) == 0:
        return np.full(len(places), -1)
    caster = RayCaster(vertices, faces[near])
    hits = caster.first_hit(places + _DEPTH * radius * plane.normal, -plane.normal)
    return np.where(hits.distance < 2 * _DEPTH * radius, near[hits.face], -1)


@dataclass(frozen=True)
class LensRim:
    """The inner edge of a rim."""

    points: FloatArray
    """(R, 3) at even angles around the centre, counterclockwise seen from the viewer; in the frame's unit."""
    measured: BoolArray
    gaps: Gaps
    """How points were filled in that no ray `measured` (R,): from both sides, or from key points."""
    center: FloatArray
    normal: FloatArray
    """`center` (3,) and unit `normal` (3,) of the lens plane, towards the viewer."""
    deviation: FloatArray | None = None
    """(R,) root mean square distance that each point may be off, of a rim refined by pictures."""

    @property
    def plane(self) -> LensPlane:
        """The lens plane."""
        return LensPlane.at(self.center, self.normal)


def find_lens_rim(
    vertices: ArrayLike,
    faces: ArrayLike,
    center: ArrayLike,
    *,
    rim_points: ArrayLike | None = None,
    normal: ArrayLike | None = None,
) -> LensRim:
    """Return the inner edge of the rim around a lens centre.

    Rays from the axis outward meet the rim's inner edge. Gaps of up to 30 degrees are bridged between their
    ends; wider ones take their shape from the rim's key points. Lenses that are parts of their own are looked
    through. Raises EyeglassesError when the mesh is empty or not finite, or rim points are needed and not
    given; ValueError when an array has the wrong shape.

    Parameters
    ----------
    vertices : (V, 3) array_like of float
        The frame; any unit, any number of parts, any winding.
    faces : (F, 3) array_like of int
    center : (3,) array_like of float
        Inside the rim, about in the lens plane.
    rim_points : (K, 3) array_like of float, optional
        Three or more key points on or at the rim, in any order.
    normal : (3,) array_like of float, optional
        Of the lens plane, towards the viewer; otherwise of the plane nearest to the rim points.

    Examples
    --------
    >>> from scan2albedo.synthetic import eyeglasses
    >>> frame = eyeglasses(seed=1)
    >>> left = [i for i, name in enumerate(frame.names) if name.startswith("left_rim")]
    >>> rim = find_lens_rim(
    ...     frame.vertices, frame.faces, frame.lens_centers[0], rim_points=frame.keypoints[left])
    >>> rim.points.shape, rim.gaps
    ((128, 3), 'none')
    """
    xyz, index = checked_mesh(vertices, faces, "the frame")
    middle = checked_array(center, (3,), "center", finite=EyeglassesError)
    marks = None if rim_points is None else checked_points("rim_points", rim_points)
    if normal is None:
        if marks is None:
            raise EyeglassesError("a lens plane needs rim_points, three or more around the lens, or a normal")
        normal = fit_normal(marks, xyz)
    plane = LensPlane.at(middle, checked_array(normal, (3,), "normal", finite=EyeglassesError))
    angles = np.linspace(-np.pi, np.pi, _POINTS, endpoint=False)
    lens_radius = None if marks is None else plane.profile(marks)[0].mean()
    # A domed lens would stop the rays before they reach the rim.
    rims = index[~pane_faces(xyz, index, plane, marks)]
    shot = shoot_rim(RayCaster(xyz, rims), plane, angles, lens_radius)
    measured = np.isfinite(shot[0])
    gaps: Gaps = "none"
    if not measured.all():
        hits = np.flatnonzero(measured)
        runs = np.diff(np.append(hits, hits[:1] + _POINTS)) - 1
        # Wider gaps are not holes in a scan but an open rim, which a straight line would cut off.
        small = len(hits) > 0 and runs.max() * 360 / _POINTS <= 30
        if not small and marks is None:
            said = f"{(~measured).sum()} of {_POINTS} rays meet nothing near"
            where = f"no closed rim around the centre {middle.round(2).tolist()}"
            raise EyeglassesError(f"{where}: {said}; give rim_points, or check centre and normal")
        gaps, filled = "interpolated", np.zeros((2, _POINTS))
        if not small and marks is not None:
            gaps, filled = "subdivided", subdivide_rim(xyz, plane, marks, angles)
        # Gaps get the outline's shape, joined to what was measured at both their ends.
        if measured.any():
            for values, shape in zip(shot, filled, strict=True):
                shape += np.interp(angles, angles[measured], (values - shape)[measured], period=2 * np.pi)
        shot = np.where(measured, shot, filled)
    return LensRim(plane.points(angles, shot), measured, gaps, middle, plane.normal)


def shoot_rim(
    caster: RayCaster, plane: LensPlane, angles: FloatArray, lens_radius: float | None
) -> FloatArray:
    """Return the profile (2, R) of the inner edge at ascending even angles (R,), NaN where there is none.

    Of rays at several heights the one that meets the rim first meets its inner edge; its surroundings are
    searched then. The lens radius is roughly known, or the median of what rays in the plane hit.
    """
    if lens_radius is None:
        flat = caster.first_hit(np.tile(plane.center, (len(angles), 1)), plane.directions(angles)).distance
        if not np.isfinite(flat).any():
            return np.full((2, len(angles)), np.nan)
        lens_radius = np.median(flat[np.isfinite(flat)])
    count, level = len(angles), np.zeros(len(angles))
    half = max(1, round(_WINDOW_RAD * count / (2 * np.pi)))
    radius, height = _nearest(caster, plane, angles, level, lens_radius, _REACH)
    # A plane some degrees off leaves the rim on two sides: sweep again around the tilt that was found.
    known = np.isfinite(radius)
    if known.sum() >= count / 2:
        basis = np.stack([np.ones(count), np.cos(angles), np.sin(angles)], 1)
        level = basis @ np.linalg.lstsq(basis[known], height[known], rcond=None)[0]
    radius, height = _nearest(caster, plane, angles, level, lens_radius, _REACH)
    around = (np.arange(count)[:, None] + np.arange(-half, half + 1)) % count
    opposite = around[:, ::-1]
    for reach in _REFINEMENTS:
        # Medians of means of two known heights at equal distance leave a steady slope unchanged.
        known = np.isfinite(radius)
        lacking = ~(known[around] & known[opposite])
        pairs = np.ma.masked_array((height[around] + height[opposite]) / 2, lacking)
        level = np.ma.median(pairs, axis=1).filled(0.0)
        radius, height = _nearest(caster, plane, angles, level, lens_radius, reach)
    found = np.isfinite(radius)
    # Hits on pieces that less than half the window sees are something in the way.
    outline = np.where(found, radius, np.nan)
    steepest = lens_radius * max(_STEP, 2 * np.pi / count)
    starts = np.flatnonzero(~(np.abs(outline - np.roll(outline, 1)) <= steepest))
    for first, following in zip(starts, np.append(starts[1:], starts[:1] + count), strict=True):
        if following - first < half:
            found[np.arange(first, following) % count] = False
    # The ray beside a gap may have met the cut instead of the edge.
    found &= np.roll(found, 1) & np.roll(found, -1)
    # Rims are convex over a short way: ends of bridges and solder poke through chords between neighbours.
    outline = np.where(found, radius, np.nan)
    for k in range(1, half + 1):
        before, after = np.roll(outline, k), np.roll(outline, -k)
        chord = 2 * before * after * np.cos(2 * np.pi * k / count) / (before + after)
        found &= ~(outline < (1 - _DENT) * chord)
    return np.where(found, [radius, height], np.nan)


def _nearest(
    caster: RayCaster, plane: LensPlane, angles: FloatArray, level: FloatArray, radius: float, reach: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least distance (R,) within `reach` of heights `level` (R,), inf for none, and its height."""
    heights = level[:, None] + radius * np.linspace(-reach, reach, 33)
    origins = plane.center + heights[..., None] * plane.normal
    headings = np.repeat(plane.directions(angles), heights.shape[1], axis=0)
    distance = caster.first_hit(origins.reshape(-1, 3), headings).distance.reshape(heights.shape)
    # What is far too near is in the way: the rim may be seen past it at other heights.
    distance[(distance < _INNER * radius) | (distance > _OUTER * radius)] = np.inf
    first = distance.argmin(1)[:, None]
    return np.take_along_axis(distance, first, 1)[:, 0], np.take_along_axis(heights, first, 1)[:, 0]


def four_point_middles(outline: FloatArray) -> FloatArray:
    """Return (N, D) middles of a closed curve's edges from its points (N, D): (9 (b + c) - a - d) / 16."""
    following = np.roll(outline, -1, 0)
    return (9 * (outline + following) - np.roll(outline, 1, 0) - np.roll(outline, -2, 0)) / 16


def subdivide_rim(
    vertices: FloatArray, plane: LensPlane, rim_points: FloatArray, angles: FloatArray
) -> FloatArray:
    """Return the profile (2, R) of an outline through rim points (K, 3), K >= 3, at ascending angles (R,).

    Each level puts a point into the middle of every edge, by the four-point rule (9 (b + c) - a - d) / 16
    [1]_, and moves it to the closest vertex of the frame if one is near: up to 4.5 mm off on drawn frames.

    .. [1] N. Dyn, D. Levin, J. A. Gregory, "A 4-point interpolatory subdivision scheme for curve design",
       Computer Aided Geometric Design 4, 1987, equation 1.2 with w = 1/16.
    """
    outline = rim_points[np.argsort(plane.angles(rim_points))]
    tree = cKDTree(vertices)
    for _ in range(5):
        following = np.roll(outline, -1, 0)
        middle = four_point_middles(outline)
        distance, nearest = tree.query(middle)
        pulled = distance <= _PULL * norms(following - outline)
        middle[pulled] = vertices[nearest[pulled]]
        outline = np.stack([outline, middle], 1).reshape(-1, 3)
        # Two middles drawn to one vertex would leave an edge without length.
        outline = outline[norms(outline - np.roll(outline, 1, 0)) > 0]
    at = plane.angles(outline)
    return np.stack([np.interp(angles, at, own, period=2 * np.pi) for own in plane.profile(outline)])


def refine_lens_rim(
    rim: LensRim,
    masks: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    rim_points: ArrayLike | None = None,
    deviation_px: float = 1.0,
) -> LensRim:
    """Return the inner edge of a rim as pictures show it, where the mesh lacks pieces of the rim.

    The edge is a closed four-point subdivision curve; radii and heights of its 32 control points minimise

        sum rho((n_ci . (e_ci - project_c(T x_i)) - b_c) / s) + sum rho((ray_j - x_j) / r) + priors,

    x_i the curve, e_ci where along the inward normal n_ci of its image the mask of view c ends, T a small
    motion of the frame, left out of the result, b_c by how much the mask is too wide, rho Cauchy's. Wide gaps
    start as the curve through the rim points. A mask whose edge is far from what rays met, by the median, is
    left out. Where none shows half of the edge, as with dark lenses, the rim is returned as it is.

    Parameters
    ----------
    rim : LensRim
        From `find_lens_rim`.
    masks : sequence of ((3, 4), (H, W)) array_like
        Cameras, in the rim's frame and unit, and masks: nonzero where the view shows the frame, not lenses.
    rim_points : (K, 3) array_like of float, optional
        Those that `find_lens_rim` had.
    deviation_px : float
        Of the masks' outlines.

    Notes
    -----
    Li et al. (supplement, section S4) subdivide between key points; most of ours are on the rim's outside.
    """
    plane = rim.plane
    angles, profile = plane.angles(rim.points), plane.profile(rim.points)
    # A quarter as many control points: their curve follows rims of all shapes to 0.05 mm rms.
    basis = np.eye(len(rim.points) // 4)
    count = len(basis)
    for _ in range(2):
        basis = np.stack([basis, four_point_middles(basis)], 1).reshape(-1, count)
    smooth, outline = basis @ np.linalg.pinv(basis), profile
    # What rays met errs by three times what the curve cannot follow of it.
    noise = 3 * np.sqrt(((profile - profile @ smooth.T) ** 2).mean(1))
    if rim.gaps == "subdivided" and rim_points is not None:
        # What rays met may be other pieces of the frame: the gaps' shape shall not hang on it.
        marks = checked_points("rim_points", rim_points)
        outline = subdivide_rim(marks, plane, marks, angles)
    first = outline @ smooth.T
    wide = _OPEN * outline[0].mean()
    curve = _rim_curve(plane, angles, first, basis, wide, len(masks))
    parts = curve.radii, curve.heights
    met, state = np.flatnonzero(rim.measured), np.zeros(len(curve.prior))
    matrices = normalized_cameras(np.reshape([np.asarray(camera) for camera, _ in masks], (-1, 3, 4)))
    covered = [np.asarray(mask) != 0 for _, mask in masks]
    fields = [MaskDistance.of(mask) if mask.any() and not mask.all() else None for mask in covered]
    off_px = np.full(len(masks), np.nan)
    for _ in range(12):
        precision, pull = curve.prior.copy(), np.zeros(len(state))
        for part, off, deviation in zip(parts, (profile - first)[:, met], noise, strict=True):
            # Rays between two control points err alike.
            weight = count / len(basis) / deviation**2
            weight /= 1 + ((off - basis[met] @ state[part]) / (ROBUST * deviation)) ** 2
            precision[part, part] += (basis[met] * weight[:, None]).T @ basis[met]
            pull[part] += basis[met].T @ (weight * off)
        for number, (matrix, field) in enumerate(zip(matrices, fields, strict=True)):
            edge = None
            if field is not None:
                edge = _find_edge(curve, state, curve.widths.start + number, matrix, field, deviation_px)
            if edge is None:
                off_px[number] = np.nan
                continue
            point, off, rows, weight = edge
            # A few hits may be of other pieces of the frame.
            trusted = rim.measured[point]
            off_px[number] = np.median(np.abs(off[trusted] if trusted.sum() >= count else off))
            precision += (rows * weight[:, None]).T @ rows
            pull += rows.T @ (weight * (off + rows @ state))
        state = np.asarray(np.linalg.solve(precision, pull), float)
    if np.isnan(off_px).all():
        return rim
    if off_px[worst := np.nanargmax(off_px)] > ROBUST * deviation_px:
        others = [view for number, view in enumerate(masks) if number != worst]
        return refine_lens_rim(rim, others, rim_points=rim_points, deviation_px=deviation_px)
    covariance = np.linalg.inv(precision)
    points = plane.points(angles, first + np.stack([basis @ state[part] for part in parts]))
    variance = sum(np.einsum("np,pq,nq->n", basis, covariance[p, p], basis) for p in parts)
    return replace(rim, points=points, deviation=np.sqrt(variance))


@dataclass(frozen=True)
class _RimCurve:
    """Points of a closed curve, start + moves @ u, by P unknowns u with the precision `prior` (P, P).

    `radii`, `heights`, `shift` and `widths` are their places in u: errors of control points, shift of the
    frame, then after its turn by how much each mask is too wide. Each point of the curve (R,) may be
    `open_mm` off beforehand.
    """

    center: FloatArray
    start: FloatArray
    moves: FloatArray
    prior: FloatArray
    open_mm: FloatArray
    radii: slice
    heights: slice
    shift: slice
    widths: slice


def _rim_curve(
    plane: LensPlane,
    angles: FloatArray,
    profile: FloatArray,
    basis: FloatArray,
    wide: float,
    mask_count: int,
) -> _RimCurve:
    """Return the curve of a `profile` (2, R) known to `wide`, whose control points have a basis (R, N)."""
    count = basis.shape[1]
    ends = np.cumsum(sizes := np.array([count, count, 3, 3, mask_count]))
    radii, heights, shift, turn, widths = map(slice, ends - sizes, ends)
    # A place is known to a quarter of a rim's width.
    prior = np.diag(np.repeat([1, 1, wide / 4, _OPEN / 4, BIAS_PX], sizes) ** -2.0)
    one = np.eye(count)
    bend = one - (np.roll(one, 1, 0) + np.roll(one, -1, 0)) / 2
    stiff = bend.T @ bend * (_OPEN / _BEND / wide) ** 2 + (count * wide) ** -2.0
    prior[radii, radii] = prior[heights, heights] = stiff
    start = plane.points(angles, profile)
    moves = np.zeros((len(basis), 3, len(prior)))
    moves[..., radii] = plane.directions(angles)[:, :, None] * basis[:, None]
    moves[..., heights] = plane.normal[:, None] * basis[:, None]
    moves[..., shift] = np.eye(3)
    moves[..., turn] = np.cross(np.eye(3), (start - plane.center)[:, None]).transpose(0, 2, 1)
    open_mm = np.sqrt(np.einsum("np,pq,nq->n", basis, np.linalg.inv(stiff), basis))
    return _RimCurve(plane.center, start, moves, prior, open_mm, radii, heights, shift, widths)


def _find_edge(
    curve: _RimCurve,
    state: FloatArray,
    column: int,
    camera: FloatArray,
    field: MaskDistance,
    deviation_px: float,
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray] | None:
    """Return where a mask ends near n points of the curve; None where half of the edge is missing.

    The points' numbers (n,), how far inward the edge is (n,) px, its derivatives (n, P) and weights (n,). The
    mask's width is unknown number `column`.
    """
    pixels, slopes, front = projected(camera[None], curve.start + curve.moves @ state)
    if not front.all():
        return None
    along = np.roll(pixels, -1, 0) - np.roll(pixels, 1, 0)
    inward = normalized(np.stack([-along[:, 1], along[:, 0]], 1))
    toward = projected(camera[None], curve.center[None])[0] - pixels
    inward *= np.sign((toward * inward).sum(1, keepdims=True))
    rows = np.einsum("ni,nij,njp->np", inward, slopes, curve.moves)
    reach = 3 * np.hypot(curve.open_mm * norms(rows[:, curve.shift]), deviation_px)
    found = search_edges(field, pixels, inward, np.minimum(reach, REACH_PX))
    kept = np.isfinite(found)
    if kept.mean() < 0.5:
        return None
    rows[:, column] = 1.0
    off = (found - state[column])[kept]
    weight = np.minimum(VOTE * norms(along[kept]) / 2, 1.0) / deviation_px**2
    weight /= 1 + (off / (ROBUST * deviation_px)) ** 2
    return np.flatnonzero(kept), off, rows[kept], weight
