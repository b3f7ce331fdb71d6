"""Frames without pose and bend: each in its own shape, or with all key points on the mean's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from scan2albedo.core import Budget, BudgetLike, Meter, OnProgress, Plan, PlanStep, Trace
from scan2albedo.core.arrays import ArrayLike, FloatArray, IntArray, checked_array, finite_rows
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses import mean_keypoints as means, unbending
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES, checked_keypoints, checked_weights
from scan2albedo.eyeglasses.skinning import skin, translations, turned_translations
from scan2albedo.eyeglasses.weights import solve_weights
from scan2albedo.geometry.rigid import transform_points

CanonicalMode = Literal["unbend", "mean"]


@dataclass(frozen=True)
class CanonicalizationOptions:
    """Settings of `canonicalize`."""

    mode: CanonicalMode = "unbend"
    """"unbend": the frame's own shape and sizes stay. "mean" (the paper's S2): it takes the mean's."""
    handles: Literal["turned", "translated"] = "turned"
    """In "mean": whether key points turn their surroundings, or only shift them (the paper's)."""
    widths_mm: tuple[float, float] = means.WIDTHS_MM
    """Least and greatest width of a front; a frame that no decimal unit brings between them is refused."""
    skip_failed: bool = False
    """Whether a frame that cannot be done is left out and named in the result, instead of ending the call."""


@dataclass(frozen=True)
class CanonicalEyeglasses:
    """A frame in canonical pose and shape, and the way there and back; see `canonicalize`.

    `vertices` (V, 3) and `faces` (F, 3) are its mesh, `weights` (V, 20) zero for key points that it lacks,
    which are NaN in `keypoints` (20, 3): canonical ones, its own, unbent, or in mode "mean" the mean's.
    `canonical_from_frame` (4, 4) is rigid, after the factor `scale`, 1 unless units differ.
    """

    vertices: FloatArray
    faces: IntArray
    weights: FloatArray
    keypoints: FloatArray
    canonical_from_frame: FloatArray
    scale: float
    handle_transforms: FloatArray
    """(20, 4, 4) from the frame as given to canonical space, scale and rigid part included."""
    residual: float
    """Root mean square distance of the key points from `keypoints` after the rigid part: how bent it was."""
    unbent: bool
    """Whether it keeps its own shape and sizes (mode "unbend")."""
    converged: bool
    plan: Plan
    """How its weights were found, whether they `converged` or were given, and its bend was taken away."""

    def apply(self, vertices: ArrayLike) -> FloatArray:
        """Return the frame's vertices (V, 3), as given or edited, in canonical space."""
        return skin(vertices, self.weights, self.handle_transforms)

    def uncanonicalize(self, vertices: ArrayLike) -> FloatArray:
        """Return canonical vertices (V, 3), edited or not, back in the frame's pose, bend and unit.

        The exact inverse of `apply`. Raises ValueError when there are not as many vertices as weights.
        """
        xyz = checked_array(vertices, (len(self.weights), 3), "vertices")
        blended = (self.weights @ self.handle_transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        back = np.linalg.solve(blended[:, :, :3], (xyz - blended[:, :, 3])[:, :, None])
        return np.asarray(back[:, :, 0])


@dataclass(frozen=True)
class CanonicalSet:
    """`frames` on common ground, in the order of the meshes; see `canonicalize`."""

    frames: tuple[CanonicalEyeglasses, ...]
    mean_keypoints: FloatArray
    """(20, 3) in the frames' unit; unless given, x to the wearer's left, z to the front, centroid at 0."""
    converged: bool
    """Whether the mean's iteration settled and the weights that were solved converged."""
    iterations: int
    """Of the mean; 0 when it was given."""
    numbers: tuple[int, ...]
    """Of each of the `frames` among the meshes given: all, unless some failed."""
    failures: Mapping[int, str]
    outliers: Mapping[int, str]
    """By the number of a mesh, why it was left out (`failures`) or what is unusual about it."""
    plan: Plan
    trace: Trace
    """`plan` and `trace` hold the steps of each frame, by number, then those of the set."""


def canonicalize(
    meshes: Sequence[Any],
    keypoints: Sequence[ArrayLike],
    *,
    weights: Sequence[ArrayLike] | None = None,
    mean_keypoints: ArrayLike | None = None,
    spacing: str | float = "auto",
    budget: BudgetLike = None,
    options: CanonicalizationOptions = CanonicalizationOptions(),
    on_progress: OnProgress = None,
) -> CanonicalSet:
    """Return frames without pose and bend, in their own shape or in the proportions of their mean.

    Each frame is aligned rigidly to the mean, then its key points p are moved to targets x and the surface
    follows by its bounded biharmonic weights w, v' = sum over k of w_k (R_k (v - p_k) + x_k). In mode
    "unbend" each half of the frame is moved half the way to the other, which leaves a bend that both sides
    share. In mode "mean" (equation S2) the targets are the mean's key points and R_k the skeleton's turn at
    each, or 1 for v' = v + W (x - p): rims and temples take the mean's widths, heights and lengths. Raises
    EyeglassesError when there is no frame; or, named, one without a pose, of another width, or without
    weights; ValueError when shapes do not fit together.

    Parameters
    ----------
    meshes : sequence of n
        Pairs (vertices (V, 3), faces (F, 3)), or objects with these attributes; any unit.
    keypoints : sequence of n (20, 3) array_like
        In the mesh's unit and the order of `KEY_POINT_NAMES`; NaN for missing ones.
    weights : sequence of n (V, 20) array_like, optional
        From an earlier run; solved here otherwise, which takes nearly all the time.
    mean_keypoints : (20, 3) array_like, optional
        Where frames are placed and, in mode "mean", what they are brought to; their own mean otherwise.
    spacing : "auto" or float
        Of the weights' lattice, in the meshes' unit.
    budget, on_progress : optional
        Seconds, or evaluations: Newton steps of the weights and rounds of the mean. Frames share it evenly;
        when it ends, weights and mean so far are used, with `converged` False; called with each row.
    options : CanonicalizationOptions

    Notes
    -----
    Equation S2 of Li et al., read literally, collapses the frame; turns halve the error of R_k = 1. Frames of
    different units, told by the front's width, are brought to that of the mean, or to mm, by powers of ten.

    Examples
    --------
    >>> from scan2albedo.synthetic import GlassesBend, eyeglasses
    >>> bent = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    >>> found = canonicalize([bent], [bent.keypoints], mean_keypoints=bent.rest_keypoints, spacing=2.5,
    ...                      options=CanonicalizationOptions(mode="mean"))
    >>> bool(np.abs(found.frames[0].vertices - bent.rest_vertices).max() < 0.6)
    True
    """
    if options.mode == "unbend" and options.handles != "turned":
        raise ValueError('handles="translated" is for mode="mean": shifts alone would bend the rims')
    meter = Meter("eyeglasses.canonicalize", "", budget, on_progress)
    if len(meshes) == 0:
        raise EyeglassesError("there is no frame to canonicalise; give one mesh or more")
    for name, each in (("keypoints", keypoints), ("weights", weights)):
        if each is not None and len(each) != len(meshes):
            raise ValueError(f"{name} must have one entry for each of {len(meshes)} meshes, got {len(each)}")
    shares = [None] * len(meshes) if weights is None else weights
    checked = [_Frame.checked(i, *one) for i, one in enumerate(zip(meshes, keypoints, shares, strict=True))]
    reference, common = None, None
    if mean_keypoints is not None:
        reference = checked_keypoints("mean_keypoints", mean_keypoints)
        means.require_posable(reference, "mean_keypoints")
        with errors_of("mean_keypoints", EyeglassesError):
            common = means.unit_exponent(reference, options.widths_mm)
    anchor = means.fullest([frame.points for frame in checked]) if reference is None else reference
    frames, failures = list[_Frame](), dict[int, str]()
    called = [f"frame {frame.number}{f', {frame.name}' if frame.name else ''}" for frame in checked]
    for i, frame in enumerate(checked):
        # Key points that the reference lacks do not count.
        shared = np.where(np.isfinite(anchor), frame.points, np.nan)
        try:
            means.require_posable(shared)
            width = means.front_width(frame.points, frame.vertices)
            exponent = means.unit_exponent(frame.points, options.widths_mm, width)
            used = frame if reference is None else replace(frame, points=shared)
            used = replace(used, unit_exponent=exponent, width=width)
            frames.append(used.weighted(spacing, len(checked) - i, meter))
        except EyeglassesError as error:
            if not options.skip_failed:
                raise EyeglassesError(f"{called[i]}: {error}") from error
            failures[i] = str(error)
    if not frames:
        raise EyeglassesError("; ".join(map(": ".join, zip(called, failures.values(), strict=True))))
    scales = means.unit_factors([f.unit_exponent for f in frames], common)
    points = [scale * f.points for scale, f in zip(scales, frames, strict=True)]
    widths = scales * [f.width for f in frames]
    mean, settled = reference, True
    rounds = 0
    if mean is None:
        own = meter.sub_meter("eyeglasses.mean", "bones")
        mean, settled, rounds = means.mean_key_points(points, own)
        meter.merge(own)
    place = mean
    if options.mode == "unbend":
        place = unbending.symmetric_key_points(place)
        place = means.in_own_axes(place) if reference is None else place
    done = [f.moved(place, float(s), options) for f, s in zip(frames, scales, strict=True)]
    steps = {f.number: frame.plan for f, frame in zip(frames, done, strict=True)}
    steps |= {i: Plan((PlanStep("eyeglasses.weights", False, why),)) for i, why in failures.items()}
    rows = [replace(s, reason=f"frame {i}: {s.reason}") for i, part in sorted(steps.items()) for s in part]
    names = [f.name or f"frame {f.number}" for f in frames]
    rows.append(_unit_step(scales, widths))
    unusual = means.outliers(points, widths)
    single = means.single_bridges(points, widths, reference) if options.mode == "mean" else ()
    rows += _doubts(names, points, unusual, single)
    evidence = f"{'' if settled else 'not '}settled after {rounds} round{'s' if rounds != 1 else ''}"
    found = PlanStep("eyeglasses.mean", True, f"mean of {len(done)} frame{'s' * (len(done) > 1)}", evidence)
    rows.append(found if reference is None else PlanStep("eyeglasses.mean", False, "given"))
    return CanonicalSet(
        frames=tuple(done),
        mean_keypoints=mean,
        converged=settled and all(frame.converged for frame in done),
        iterations=rounds,
        numbers=tuple(f.number for f in frames),
        failures=failures,
        outliers={frames[i].number: why for i, why in unusual.items()},
        plan=Plan(tuple(rows)),
        trace=meter.trace,
    )


def _unit_step(scales: FloatArray, widths: FloatArray) -> PlanStep:
    """Return the step that brings frames to one unit by `scales` (n,), where the fronts' widths differ."""
    wide = f"fronts {', '.join(f'{width:.4g}' for width in widths)} wide"
    if (scales == 1).all():
        return PlanStep("eyeglasses.units", False, "widths agree: one unit", wide)
    factors = f"factors {', '.join(f'{s:.6g}' for s in scales)}; then {wide}"
    return PlanStep("eyeglasses.units", True, "widths are those of different units", factors)


def _doubts(
    names: Sequence[str], points: Sequence[FloatArray], unusual: Mapping[int, str], single: Sequence[int]
) -> list[PlanStep]:
    """Return doubts about a set: `unusual` frames, `single` bridges among double ones, missing temples."""
    rows = [
        PlanStep.doubt("eyeglasses.outliers", f"{names[i]} is unlike the others: {why}")
        for i, why in unusual.items()
    ]
    if not unusual:
        among = f"none among {len(names)} frame{'s' * (len(names) > 1)}"
        rows.append(PlanStep("eyeglasses.outliers", False, among))
    if single:
        reason = (
            f"{', '.join(names[i] for i in single)}: one bridge, while other frames or the "
            "mean given have two: bridge_top of the mean lies between both kinds and draws the single bridge "
            "out into a spike; leave bridge_top out of the key points of frames with one bridge, or bring "
            "the two kinds to means of their own"
        )
        rows.append(PlanStep.doubt("eyeglasses.bridges", reason))
    bare = [n for n, p in zip(names, points, strict=True) if np.isnan(p[means.BEHIND]).any(1).all()]
    if bare:
        reason = f"{', '.join(bare)}: without temples, left and right cannot be checked reliably"
        rows.append(PlanStep.doubt("eyeglasses.sides", reason))
    return rows


@dataclass(frozen=True)
class _Frame:
    """A mesh with its key points (20, 3) in its unit; its coordinates times ten to `unit_exponent` are mm."""

    number: int
    name: str | None
    vertices: FloatArray
    faces: IntArray
    points: FloatArray
    weights: FloatArray | None
    converged: bool = True
    plan: Plan = Plan((PlanStep("eyeglasses.weights", False, "given"),))
    unit_exponent: int = 0
    width: float = np.nan

    @classmethod
    def checked(cls, number: int, mesh: Any, keypoints: ArrayLike, weights: ArrayLike | None) -> Self:
        """Return what a caller gave as one frame; raises ValueError for shapes and numbers not finite."""
        vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "vertices") else mesh
        xyz = checked_array(vertices, ("V", 3), f"vertices of frame {number}", finite=ValueError)
        shares = None if weights is None else checked_weights(f"weights {number}", weights, len(xyz))
        marks = checked_keypoints(f"keypoints {number}", keypoints)
        return cls(number, getattr(mesh, "name", None), xyz, np.asarray(faces, int), marks, shares)

    def weighted(self, spacing: str | float, left: int, meter: Meter) -> Self:
        """Return it with weights, solved, unless given, in an even share of the budget for `left` frames."""
        if self.weights is not None:
            return self
        seen = np.flatnonzero(finite_rows(self.points))
        own = meter.sub_meter(f"eyeglasses.weights.{self.number}", "scaled KKT residual")
        seconds, evaluations = own.budget.seconds, own.budget.evaluations
        own.budget = Budget(seconds and seconds / left, evaluations and max(evaluations // left, 1))
        names, mesh = [KEY_POINT_NAMES[k] for k in seen], (self.vertices, self.faces)
        try:
            found = solve_weights(*mesh, self.points[seen], spacing, names=names, meter=own)
        finally:
            meter.merge(own)
        weights = np.zeros((len(self.vertices), len(KEY_POINT_NAMES)))
        weights[:, seen] = found.weights
        how = "cut short by the budget" if own.exhausted else "did not settle"
        how = "solved" if found.converged else how
        got = f"residual {found.residual.max():.1e} after {own.evaluations} steps on {found.node_count} nodes"
        plan = Plan((PlanStep("eyeglasses.weights", True, how, got),)) + found.plan
        return replace(self, weights=weights, converged=found.converged, plan=plan)

    def moved(self, place: FloatArray, scale: float, options: CanonicalizationOptions) -> CanonicalEyeglasses:
        """Return it with its key points at `place` (20, 3), or unbent with its plane of symmetry there."""
        assert self.weights is not None
        points, stays = scale * self.points, ""
        if options.mode == "mean":
            rigid = means.align_key_points(points, place)
            aligned = transform_points(rigid, points)
            seen = np.isfinite((aligned + place).sum(1))
            carriers = (turned_translations if options.handles == "turned" else translations)(aligned, place)
            # Key points that the frame lacks weigh nothing; NaN times nothing would still be NaN.
            carriers[~seen] = np.eye(4)
            carriers, targets = carriers @ rigid, np.where(seen[:, None], place, np.nan)
            step = PlanStep("eyeglasses.to_mean", True, "all key points on the mean's")
        else:
            halves = unbending.front_halves(scale * self.vertices, self.faces, self.weights, points)
            carriers = unbending.unbent_transforms(points, halves)
            straight = np.einsum("kij,kj->ki", carriers[:, :3, :3], points) + carriers[:, :3, 3]
            even = straight if halves is None else unbending.symmetric_key_points(straight, halves.reflection)
            pose = means.align_key_points(even, place)
            carriers, targets = pose @ carriers, transform_points(pose, straight)
            reason = "too few key points are known on both sides to compare them: only the pose is taken away"
            evidence = ""
            if halves is not None:
                reason = "own shape kept, halves compared by key points"
                evidence = f"halves turned against each other by {halves.bend_deg:.2f} degrees"
                if not np.isnan(halves.apart):
                    reason = "own shape kept, halves compared by their surfaces"
                    evidence += f"; rims then {halves.apart:.3g} apart, rms"
                points_mm = straight * (10.0**self.unit_exponent / scale)
                stays = unbending.common_bend(points_mm, halves.reflection)
            step = PlanStep("eyeglasses.unbend", halves is not None, reason, evidence)
        reason = "a bend common to both sides stays, as it cannot be told from the design"
        rows = [step, PlanStep("eyeglasses.common_bend", False, reason, stays)] if stays else [step]
        rigid = means.align_key_points(points, targets)
        transforms = carriers @ np.diag([scale, scale, scale, 1.0])
        off = transform_points(rigid, points) - targets
        return CanonicalEyeglasses(
            vertices=skin(self.vertices, self.weights, transforms),
            faces=self.faces,
            weights=self.weights,
            keypoints=targets,
            canonical_from_frame=rigid,
            scale=scale,
            handle_transforms=transforms,
            residual=float(np.sqrt((off[finite_rows(off)] ** 2).sum(1).mean())),
            unbent=options.mode == "unbend",
            converged=self.converged,
            plan=self.plan + rows,
        )
