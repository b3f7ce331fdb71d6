"""Whether the best candidate is accepted as a face: refusals with their figures, and doubts."""

from collections.abc import Iterator
from functools import lru_cache
from importlib.resources import as_file, files

import numpy as np
from scipy.special import expit

from scan2albedo.core import Meter, Plan, PlanStep
from scan2albedo.core.arrays import FloatArray, dots, norms
from scan2albedo.errors import InsideOutError, NoFaceError, RegistrationError
from scan2albedo.face_model import AnnotatedSurface, default_model
from scan2albedo.geometry.alignment import Alignment
from scan2albedo.geometry.rigid import Similarity, invert_rigid, procrustes
from scan2albedo.io.npz import Arrays, read_npz
from scan2albedo.registration.candidates import (
    CONVINCING,
    LEAST_RANKING,
    Candidate,
    Candidates,
    CandidateSearch,
)
from scan2albedo.registration.coarse_search import coarse_poses
from scan2albedo.registration.evidence import Evidence
from scan2albedo.registration.icp import loosely_shaped, residuals, shaped_icp
from scan2albedo.registration.inputs import PreparedScan, RegistrationOptions, Template, box_text

LEAST_PROBABILITY = 0.4
"""Of a face, below which a scan is refused: 2 or 3 of 100 scraps of heads reach it."""
_CLEARLY_OUTWARD = 0.12
"""Bulge of a surface whose normals certainly point outward: whole faces with hair and shoulders have 0.24 and
more, half a face with them about 0."""
_FACING_AWAY = 0.35
"""Part of the near samples whose normals may disagree: where one side of a face is inside out it is half."""
_MIXED_SHARE = 0.02
"""A greater share of triangles wound against their neighbours is the reason to name."""
_OTHER_FACE_MM = 100.0
"""Poses farther apart than a face is wide are of another one."""
_FACE_LIKENESS = 0.55
"""Likeness at which a pose that was not looked at closely is reported as another face."""

NAMES = ("width", "height", "depth", "size")


def accepted(
    scan: PreparedScan,
    template: Template,
    candidates: Candidates,
    pose_count: int,
    options: RegistrationOptions,
    meter: Meter,
) -> Plan:
    """Accept the first candidate, of those of `pose_count` poses that were refined, or refuse the scan.

    Where the budget has ended nothing is refused. Returns the search's row of the plan, and a doubt when
    there is a second face. Raises `RegistrationError` when there is no face, or it is inside out.
    """
    best, name, chance = candidates[0], scan.raw.name, probability(candidates)
    figures, found = f"likeness {best.ranking:.2f} (needed: {LEAST_RANKING})", best.evidence
    if found is not None:
        figures = (
            f"correlation of the relief {found.relief.whole:.2f}, in windows of 3 cm "
            f"{found.relief.local:.2f}, {found.rms_mm:.1f} mm RMS over {100 * found.share:.0f} % of the face "
            f"with {found.relief.noise_mm:.1f} mm of noise"
        )
        for cue, odds in (("colours", best.color_log_odds), ("landmarks", best.landmark_log_odds)):
            if odds:
                side = "for" if odds > 0 else "against"
                figures += f", its {cue} speak {side} it by {abs(odds):.1f} in the log odds"
    if not meter.exhausted:
        # Fitting and shading go wrong where all triangles face inward. The reversed scan is searched
        # where the best pose is in doubt and the surface does not bulge outward: sum a n.(p - c) / sum a
        # |p - c| about the centroid c, -1 ... 1, changes its sign with the normals.
        samples = scan.samples
        offset = samples.points - samples.areas @ samples.points / samples.areas.sum()
        outward = samples.areas @ dots(offset, samples.normals)
        if best.log_odds < CONVINCING and outward < _CLEARLY_OUTWARD * (samples.areas @ norms(offset)):
            # The turned scan is another problem than the scan, so its rows stay out of the trace.
            turned, unseen = scan.inside_out(), meter.untraced()
            poses = coarse_poses(turned, template, options, unseen, 0)
            search = CandidateSearch(turned, template, poses, options.candidates, unseen)
            other = search.until_convinced()[0]
            meter.count(unseen.evaluations)
            if other.log_odds > max(best.log_odds, 0.0):
                raise _inside_out_error(scan, other)
        if chance < LEAST_PROBABILITY:
            raise NoFaceError(
                f"{name}: no face found. The best of {len(candidates)} poses is one with a probability of "
                f"{chance:.2f} (needed: {LEAST_PROBABILITY:.2f}): {figures}; "
                f"the scan's box is {box_text(scan.raw.vertices)}. "
                "Give a scan of a face in its true size (check the unit), or process it without a model",
                confidence=chance,
                model_from_scan=invert_rigid(best.pose.rigid(template.front)) @ scan.prepared_from_scan,
            )
    # Depth images do not show normals that disagree.
    measured = residuals(scan.samples, template.samples, best.pose)
    near = measured.near
    if near.any() and np.mean(measured.agreement[near] < 0) > _FACING_AWAY:
        raise _inside_out_error(scan, best)
    evidence = (
        f"{len(candidates)} of {pose_count} candidates refined; probability {chance:.2f} "
        f"(needed: {LEAST_PROBABILITY:.2f}), {figures}, "
        f"face {100 * best.pose.scale:.0f} % of the model's size"
    )
    if stray := len(scan.raw.faces) - len(scan.faces):
        evidence += f"; {stray} triangles that reach far away left out"
    reason = "the pose at which the scan is most probably a face is taken"
    steps = [PlanStep("register.search", True, reason, evidence)]
    # Once one is found the others are not looked at closely.
    apart = [_distance_mm(c, best) for c in candidates[1:] if c.log_odds > 0 or c.likeness > _FACE_LIKENESS]
    if best.log_odds > 0 and max(apart, default=0.0) > _OTHER_FACE_MM:
        text = "the one that resembles the model more was taken: cut the other off to choose"
        text = f"there is a second face {max(apart):.0f} mm away; {text}"
        steps.append(PlanStep.doubt("register.second_face", text))
    return Plan(tuple(steps))


def _inside_out_error(scan: PreparedScan, best: Candidate) -> RegistrationError:
    name, count = scan.raw.name, len(scan.raw.faces)
    if scan.turned_faces > _MIXED_SHARE * count:
        return RegistrationError(
            f"{name}: {scan.turned_faces} of {count} triangles are wound against their neighbours, so "
            "that the face is inside out in part. Reverse the order of their vertices (load_scan does it; "
            "scan2albedo.geometry.mesh.turned_against_neighbours names them) and try again"
        )
    return InsideOutError(
        f"{name}: the scan is inside out: with its {count} triangles reversed there is a "
        f"face (probability {expit(best.log_odds):.2f}). Reverse the order of every triangle's "
        "vertices (scan.inside_out()) and try again; if the export was mirrored, so that left and right are "
        "swapped, mirror it back instead"
    )


def _distance_mm(candidate: Candidate, other: Candidate) -> float:
    return float(np.linalg.norm(candidate.pose.translation - other.pose.translation))


def probability(candidates: Candidates) -> float:
    """Return the probability that the best candidate is the pose of a face, 0 ... 1.

    Against it stand that there is no face, and every other pose of it.
    """
    best, *others = candidates
    rivals = [c.log_odds for c in others if c.is_apart(best) and _distance_mm(c, best) <= _OTHER_FACE_MM]
    return float(expit(best.log_odds - np.logaddexp.reduce([0.0, *rivals])))


@lru_cache(maxsize=1)
def people() -> Arrays:
    """Return what `tools/build/proportions.py` learned of people's faces.

    `weights` (4, K + 1) of a shape (see `shape_of`) give the logarithms by which it is stretched along the
    axes, and of its size, relative to the `mean` (4,) of people; their standard `deviation` (4,), and the
    lowest and highest (2, 4) that people `reach`; and of how many `heads` and `synthetic` people.
    """
    with as_file(files("scan2albedo.registration") / "data" / "proportions.npz") as path:
        return read_npz(path, what="people's proportions", advice="install it again", error=RegistrationError)


def shape_of(scan: PreparedScan, model: AnnotatedSurface, found: Evidence, seed: int) -> FloatArray | None:
    """Return the shape of a face, by the default model's modes whatever the model; None without landmarks.

    That is (K + 1,) the logarithm of its scale, and the coefficients with the stretches hardly held.
    """
    default, start = default_model(), Alignment(found.pose, found.coefficients)
    template = Template.of(default, seed)
    if model.control_vertices is not default.control_vertices:
        if model.landmarks is None or default.landmarks is None:
            return None
        own, pose = procrustes(default.landmarks, model.landmarks), found.pose
        placed = Similarity(pose.rotation @ own[:3, :3], pose.apply(own[:3, 3]), pose.scale)
        start = shaped_icp(scan.samples, template, placed, Meter("icp", "mm"))
    shape = loosely_shaped(scan.samples, template, start)
    return np.concatenate([[np.log(shape.pose.scale)], shape.coefficients])


def proportion_doubts(shape: FloatArray) -> Iterator[PlanStep]:
    """Yield a row where a face's proportions are beyond people's, and one where its size is (`shape_of`).

    A stretch g s of the shape by the logarithm s has the likeliest value g^T C^-1 (x - m) / g^T C^-1 g beside
    people's mean m and covariance C: what is stretched alike differs from how people differ.
    """
    learned = people()
    off = learned["weights"] @ shape - learned["mean"]
    excess = np.maximum(off / learned["reach"][1], off / learned["reach"][0])
    axis = int(np.argmax(excess[:3]))
    for number, reason in {
        axis: "the scan may be stretched along an axis: its proportions are beyond those of faces measured",
        3: "the unit or scale of the scan may be wrong: its face has another size than adults'",
    }.items():
        if excess[number] > 1:
            ratio, low, high = np.exp([off[number], *learned["reach"][:, number]])
            text = (
                f"{NAMES[number]} {ratio:.2f} times the mean of {learned['heads']} heads and "
                f"{learned['synthetic']} synthetic people, {low:.2f} to {high:.2f} expected; it is "
                f"{abs(off[number]) / learned['deviation'][number]:.1f} standard deviations from the mean"
            )
            yield PlanStep.doubt("register.size" if number == 3 else "register.proportions", reason, text)
