"""First poses of a frame, from labels, its head or pictures; key points triangulated; sides exchanged."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from scipy.special import xlogy

from scan2albedo.core import Meter
from scan2albedo.core.arrays import (
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    checked_array,
    finite_rows,
    norms,
)
from scan2albedo.errors import EyeglassesError, needs_extra
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, MIRROR
from scan2albedo.eyeglasses.mean_keypoints import BEHIND, is_posable, own_axes
from scan2albedo.eyeglasses.on_face.frame_motion import FrameMotion, FrameState
from scan2albedo.eyeglasses.on_face.inputs import FaceRegistrationOptions, RegistrationInputs
from scan2albedo.eyeglasses.on_face.lens_panes import rim_openings
from scan2albedo.eyeglasses.on_face.objective import VOTE, RegistrationObjective, descend
from scan2albedo.eyeglasses.on_face.outline import FrameMesh, ObservedView, Views, hidden_by
from scan2albedo.eyeglasses.on_face.report import WORN_MM
from scan2albedo.face_model import default_model
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.pinhole import normalized_cameras, projected
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.geometry.rigid import compose, procrustes, rotation_from_vector, transform_points
from scan2albedo.rendering.pictures import seen_samples

_SEAT_MM = (2.0, 6.0, 5.0)
"""How far frames sit from the middle between the eyes: sideways, up or down, forward of where they touch."""
LEANS_RAD = (-0.1, 0.04, 0.18)
"""How far a frame's temples may slope: turns about the way to the left that are tried in pictures."""


def poses_on_face(inputs: RegistrationInputs) -> list[FrameState]:
    """Return states of a frame worn by a head in the face model's frame, one for each slope of its temples.

    It looks ahead as the face does, its rims' middle before that of the model's eyes, and is moved back until
    its front touches. Raises EyeglassesError without a head, or where the head does not lie in that frame.
    """
    advice = "label 4 or more key points in one view, 3 or more in two, or give a start"
    if inputs.head is None:
        raise EyeglassesError(f"no key point is labelled, and there is no head to put the frame on: {advice}")
    # The model is in mm, the head in the caller's unit, which glasses tell to a power of ten.
    mm = 10.0 ** -np.round(np.log10(inputs.unit)) * inputs.unit
    landmarks = default_model().landmarks
    assert landmarks is not None
    away = ClosestPointQuery(*inputs.head).query(landmarks / mm).distance
    if not np.median(away) * mm <= WORN_MM / 2:
        where = "is not in the face model's frame, mm, looking along +z"
        raise EyeglassesError(f"no key point is labelled, and the head to put the frame on {where}: {advice}")
    eyes = landmarks[36:48].mean(0) / mm
    rims = np.array(["rim_top" in name or "rim_bottom" in name for name in KEY_POINT_NAMES])
    middle = np.nanmean(inputs.keypoints[rims if inputs.known[rims].any() else inputs.known], axis=0)
    nearest = cKDTree(inputs.keypoints[inputs.known]).query(inputs.vertices)[1]
    front = inputs.vertices[~BEHIND[np.flatnonzero(inputs.known)[nearest]]]
    caster, found = RayCaster(*inputs.head), []
    far = 2 * np.ptp(inputs.vertices, axis=0).max()
    for lean in LEANS_RAD:
        turn = rotation_from_vector(np.array([lean, 0, 0])) @ own_axes(inputs.keypoints)
        start = compose(turn, eyes + [0.0, 0.0, far] - turn @ middle)
        hits = caster.first_hit(transform_points(start, front), np.tile([0.0, 0.0, -1.0], (len(front), 1)))
        start[2, 3] -= hits.distance.min() if np.isfinite(hits.distance).any() else far
        found.append(start)
    return states_of(found, inputs.keypoints)


def place_in_pictures(
    states: Sequence[FrameState], mesh: FrameMesh, keypoints: FloatArray, views: Views, head: RayCaster | None
) -> tuple[FrameState, FloatArray, float]:
    """Return the state, shifted, whose projections part the pictures' colours best, and how sure that is.

    For each state and shift t the colours where the frame is projected, n_k of group k, and those around it,
    m_k, have the log likelihood of two materials over one,

        L(t) = sum over k of n_k log(n_k / n) + m_k log(m_k / m) - (n_k + m_k) log((n_k + m_k) / (n + m)),

    summed over the views with `colors`, less t^2 / 2 in the deviations of seats. Rims are taken with and
    without their openings filled. Also the mean gain (nats a view) and deviations of t (3,), mm.
    """
    steps = [np.arange(-round(3 * s), round(3 * s) + 1.0, max(1.0, s / 4)) for s in _SEAT_MM]
    shifts = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    prior = ((shifts / _SEAT_MM) ** 2).sum(1) / 2
    openings = rim_openings(mesh.points.rest, mesh.faces, keypoints)
    rims = np.delete(
        mesh.faces, np.concatenate([np.zeros(0, int), *(panes for *_, panes, _ in openings)]), axis=0
    )
    # The key points lie behind the mesh's own vertices.
    fans = [rim[[[0, 1, 2], [0, 2, 3], [0, 3, 4]]] + len(mesh.points.rest) for _, rim, *_ in openings]
    filled = np.concatenate([rims, *fans])
    tried = []
    used = [view for view in views if view.colors is not None]
    for state in states:
        motion = FrameMotion(keypoints, state)
        vertices = np.concatenate([motion.positions(mesh.points), motion.positions(motion.marks)])
        middle = vertices[len(mesh.points.rest) :][motion.known].mean(0)
        for faces in (rims, filled) if openings else (rims,):
            gain = np.zeros(len(shifts))
            for view in used:
                gain += _color_gain(view, vertices, faces, head, middle, shifts)
            score = gain - prior
            top = score.max()
            chance = np.exp(score - top)
            evidence = top + np.log(chance.sum())
            mean = chance @ shifts / chance.sum()
            spread = np.sqrt(chance @ (shifts - mean) ** 2 / chance.sum() + 1 / 12)
            moved = replace(state, origin=state.origin + mean)
            tried.append((evidence, moved, spread, gain[score.argmax()] / len(used)))
    return max(tried, key=lambda trial: trial[0])[1:]


def _color_gain(
    view: ObservedView,
    vertices: FloatArray,
    faces: IntArray,
    head: RayCaster | None,
    middle: FloatArray,
    shifts: FloatArray,
) -> FloatArray:
    """Return L (T,) of one view for `shifts` (T, 3) of a frame whose `middle` (3,) goes with it."""
    assert view.colors is not None
    pixels, slopes, ahead = projected(view.camera[None], np.concatenate([middle[None], middle + shifts]))
    # A cell of about a millimetre.
    step = max(1, round(np.linalg.norm(slopes[0], axis=0).max()))
    coarse = np.diag([1 / step, 1 / step, 1.0]) @ view.camera
    colors = view.colors[::step, ::step]
    seen = seen_samples(vertices, faces, coarse, colors.shape)
    seen = seen.chosen(~hidden_by(head, coarse, seen.interpolated(vertices)))
    if not ahead.all() or len(seen.index) == 0:
        return np.zeros(len(shifts))
    frame = np.zeros(colors.shape, bool)
    frame.flat[seen.index] = True
    around = binary_dilation(frame, iterations=8) & ~frame
    way = np.round((pixels[1:] - pixels[0]) / step).astype(int)
    size = tuple(next_fast_len(n + 2 * np.abs(way).max(), real=True) for n in colors.shape)
    masks = [np.conj(rfft2(where.astype(float), size)) for where in (frame, around)]
    counts = np.zeros((2, colors.max() + 1, len(shifts)))
    for k in range(counts.shape[1]):
        spectrum = rfft2((colors == k).astype(float), size)
        for count, mask in zip(counts, masks, strict=True):
            count[k] = np.maximum(irfft2(spectrum * mask, size)[way[:, 1], way[:, 0]], 0.0)

    def entropy(n: FloatArray) -> FloatArray:
        return (xlogy(n, n).sum(1) - xlogy(n.sum(1), n.sum(1))).sum(0)

    # A cell is several pixels wide, whose colours are alike over the rim's width.
    return VOTE * (entropy(counts) - entropy(counts.sum(0)[None]))


def starting_poses(
    keypoints: FloatArray, views: Views, noise_px: float, start: FloatArray | None
) -> list[FrameState]:
    """Return at least one unbent state to start from, of a frame with key points (K, 3) at rest.

    Raises EyeglassesError when there is none, or the units of frame and cameras differ.
    """
    poses = [] if start is None else [start]
    labels, cameras = np.stack([v.labels for v in views]), np.stack([v.camera for v in views])
    placed = triangulate(labels, cameras, noise_px=noise_px)
    good = finite_rows(placed.points) & finite_rows(keypoints) & (placed.inliers.sum(0) >= 2)
    if good.sum() >= 3:
        world, rest = placed.points[good], keypoints[good]
        away = (norms(points - np.median(points, axis=0)) for points in (world, rest))
        large, small = (np.median(distance) for distance in away)
        # More or less cannot be in the same unit.
        if not 1 / 3 < large / small < 3:
            said = f"the labels make a frame {large / small:.3g} times as large as the one given"
            raise EyeglassesError(f"{said}: bring glasses and cameras to the same unit")
        # A line of key points leaves a turn open.
        if is_posable(rest):
            poses.append(procrustes(rest, world))
    poses += [pose for view in views if (pose := _from_one_view(keypoints, view, noise_px)) is not None]
    if not poses:
        labelled = [finite_rows(view.labels).sum() for view in views]
        remedy = "label 4 or more in one view, 3 or more in two, or give a start"
        if max(labelled) >= 4:
            remedy = "they contradict one another or the cameras; check labels and cameras, or give a start"
        said = f"the key points labelled in the views ({', '.join(map(str, labelled))}) fix no pose"
        raise EyeglassesError(f"{said}: {remedy}")
    return states_of(poses, keypoints)


def states_of(poses: Sequence[FloatArray], keypoints: FloatArray) -> list[FrameState]:
    """Return the unbent states of poses (4, 4) of a frame with key points (K, 3) at rest."""
    center = np.nanmean(keypoints, axis=0)
    still = np.zeros_like(keypoints)
    return [FrameState(pose[:3, :3], pose[:3, :3] @ center + pose[:3, 3], still) for pose in poses]


def _from_one_view(keypoints: FloatArray, view: ObservedView, noise_px: float) -> FloatArray | None:
    """Return the pose that most labels of one view agree with, by RANSAC; None for fewer than four."""
    seen = finite_rows(view.labels) & finite_rows(keypoints)
    if seen.sum() < 4:
        return None
    with needs_extra("opencv"):
        import cv2
    intrinsic, rotation = cv2.decomposeProjectionMatrix(view.camera)[:2]
    plane = np.linalg.solve(intrinsic, np.column_stack([view.labels[seen], np.ones(seen.sum())]).T).T
    cv2.setRNGSeed(0)
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            np.ascontiguousarray(keypoints[seen]),
            np.ascontiguousarray(plane[:, :2] / plane[:, 2:]),
            np.eye(3),
            None,
            iterationsCount=300,
            reprojectionError=float(4 * noise_px / np.sqrt(abs(np.linalg.det(intrinsic[:2, :2])))),
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        # Labels in one spot, or seen from very far: this view alone fixes no pose.
        return None
    if not found or not (all_finite(turn) and all_finite(shift)):
        return None
    camera_from_frame = compose(cv2.Rodrigues(turn)[0], shift[:, 0])
    world_from_camera = compose(rotation.T, -rotation.T @ np.linalg.solve(intrinsic, view.camera[:, 3]))
    return world_from_camera @ camera_from_frame


def require_unmirrored(inputs: RegistrationInputs, options: FaceRegistrationOptions, error_px: float) -> None:
    """Raise EyeglassesError where exchanging left and right explains labels far better than `error_px`."""
    views = tuple(replace(view, labels=view.labels[MIRROR]) for view in inputs.views)
    objective = RegistrationObjective(inputs.keypoints, views, options)
    rigid = partial(objective.linearize, samples=None, rigid=True)
    try:
        starts = starting_poses(inputs.keypoints, views, options.label_noise_px, None)
    except EyeglassesError:
        return
    first = min(starts, key=lambda state: rigid(state).cost)
    mirrored_px = descend(rigid, first, Meter("mirrored", "px"), error="median_label_px").at.median_label_px
    if mirrored_px < error_px / 2:
        said = "left and right of the labels, or of the glasses' key points, seem to be exchanged"
        advice = f"the pose fits to {mirrored_px:.1f} px with them swapped, to {error_px:.1f} px as they are"
        raise EyeglassesError(f"{said}: {advice}")


@dataclass(frozen=True)
class TriangulatedPoints:
    """K points from C views; see `triangulate`."""

    points: FloatArray
    """(K, 3) in the unit of the cameras; NaN rows where fewer than two views see a point."""
    errors_px: FloatArray
    inliers: BoolArray
    """(C, K) labels whose distance from their reprojected point, `errors_px`, is within thrice the noise."""


def triangulate(labels_2d: ArrayLike, cameras: ArrayLike, *, noise_px: float = 2.0) -> TriangulatedPoints:
    """Return key points placed where labels in two views or more agree.

    Each point minimises, over its labels l_c,

        sum over c of rho(|project(P_c, x) - l_c|),  rho(r) = log(1 + (r / 2 s)^2),

    the Cauchy loss. Of the linear solutions of all pairs of views (Hartley, Zisserman, "Multiple View
    Geometry", section 12.2) the one of least loss is refined by Gauss-Newton steps. Raises ValueError
    when shapes do not fit together, or `noise_px` is not positive.

    Parameters
    ----------
    labels_2d : (C, K, 2) array_like of float
        Pixels; NaN for a missing label.
    cameras : (C, 3, 4) array_like of float
        Projection matrices, pixels from points, of any scale and sign.
    noise_px : float
        s, how far labels are usually off.

    Notes
    -----
    Views from one centre see no depth: their points are NaN. Cost: C (C - 1) / 2 linear systems a point.

    Examples
    --------
    >>> cameras = [[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0]] for x in (0.0, -1.0)]
    >>> found = triangulate([[[0.1, 0.2]], [[0.0, 0.2]]], cameras, noise_px=0.01)
    >>> found.points.round(6).tolist()
    [[1.0, 2.0, 10.0]]
    """
    labels = checked_array(labels_2d, ("C", "K", 2), "labels_2d")
    matrices = checked_array(normalized_cameras(cameras), (len(labels), 3, 4), "cameras")
    if not noise_px > 0:
        raise ValueError(f"noise_px must be > 0, got {noise_px}")
    points = np.full((labels.shape[1], 3), np.nan)
    errors = np.full(labels.shape[:2], np.nan)
    for k in range(len(points)):
        seen = np.flatnonzero(finite_rows(labels[:, k]))
        if len(seen) < 2:
            continue
        own, cams = labels[seen, k], matrices[seen]
        starts = []
        for pair in map(list, itertools.combinations(range(len(seen)), 2)):
            # u (p3 x) = p1 x and v (p3 x) = p2 x, each as a plane of unit normal: rays count, not pixels.
            rows = (own[pair][:, :, None] * cams[pair][:, 2:] - cams[pair][:, :2]).reshape(-1, 4)
            rows = rows / np.maximum(np.linalg.norm(rows[:, :3], axis=1, keepdims=True), SMALLEST)
            place, _, rank, _ = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=1e-9)
            if rank == 3 and (cams[pair][:, 2, :3] @ place + cams[pair][:, 2, 3] > 0).all():
                starts.append((*_seen_at(place, own, cams, noise_px), place))
        if starts:
            cost, off_px, step, place = min(starts, key=lambda start: start[0])
            before = np.inf
            while cost < before:
                before, points[k], errors[seen, k] = cost, place, off_px
                place = place + step
                cost, off_px, step = _seen_at(place, own, cams, noise_px)
    with np.errstate(invalid="ignore"):
        inliers = errors <= 3 * noise_px
    return TriangulatedPoints(points, errors, inliers)


def _seen_at(
    place: FloatArray, labels: FloatArray, cameras: FloatArray, noise_px: float
) -> tuple[float, FloatArray, FloatArray]:
    """Return the Cauchy loss at a place (3,), distances (C,) px, infinite behind a camera, and a step (3,).

    The step is that of Gauss and Newton, with the loss's weights.
    """
    pixels, slopes, front = projected(cameras, np.tile(place, (len(cameras), 1)))
    errors = np.where(front[:, None], pixels - labels, np.inf)
    square = np.minimum((errors**2).sum(1) / (2 * noise_px) ** 2, np.finfo(float).max)
    root = 1 / np.sqrt(1 + square[front, None])
    rows, off = (root[..., None] * slopes[front]).reshape(-1, 3), (root * errors[front]).ravel()
    step = -np.linalg.lstsq(rows, off, rcond=None)[0]
    return np.log1p(square).sum(), norms(errors), step
