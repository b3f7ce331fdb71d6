"""Reflectance of an unknown face from one photograph, believed only where parts left out are predicted."""

import warnings
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from scan2albedo.core import BudgetLike, OnProgress, Plan, PlanStep
from scan2albedo.core.arrays import EPSILON, ArrayLike, FloatArray, IntArray, checked_mesh
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.albedo_details import SHAPE_ERROR_MM, ShadingDivided, detail_field
from scan2albedo.reflectance.image_fit import MOST_UNEXPLAINED, ImageFit, common_vertices, fit_image
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import PEOPLE_DIFFER, MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance, among_all, require_one_topology

_BLOCK_MM = SHAPE_ERROR_MM
"""Edge of the cubes whose vertices are left out together."""
_LEAST_BLOCKS = 12
"""With fewer cubes there is no evidence."""
_LEAST_GAIN = 0.07
"""A gain must exceed this share of the error: light that skin reflects onto skin is coloured, and gains a
little."""
_LIGHT_HUES = ((0.75, 0.0, 0.1), (0.2, 0.3, 0.2), (0.05, 0.0, 1.0))
"""Light in photographs: how often, how warm (logarithm of red, and of blue with the other sign, less their
mean), and standard deviation. White balance errs by two degrees (Cheng, Prasad, Brown, JOSA A 2014), 0.05,
and what is reflected adds as much; of a bulb's 0.6 cameras leave about half; few lights are of any colour."""


_TESTED = {"person": "the person's coefficients", "details": "details of the albedo"}
"""What the plan calls the steps: the model's coefficients instead of its mean, and the smooth residuals."""


@dataclass(frozen=True)
class FaceFit:
    """A face's reflectance and the light of its photograph."""

    reflectance: VertexReflectance
    """The mean face's where nothing predicts the photograph better."""
    fit: ImageFit
    """Light and coefficients; its `face` is without details."""
    radiance_linear: FloatArray
    """(V, 3): colours with details; NaN where not seen or not known."""
    relative_rmse: float
    """Root mean square of the differences over that of the image, at the vertices used."""
    badly_explained: bool
    """Whether light and coefficients leave so much of the photograph unexplained that nothing is believed."""
    details: FloatArray | None
    """(V, 3): logarithms of the factors on the albedo; None where they were not accepted."""
    plan: Plan
    """What was believed of details, of the person and, last, of the skin's hue, and why."""

    @property
    def beats_mean(self) -> bool:
        """False when the reflectance is the model's mean."""
        return self.plan.ran("reflectance.image")


def fit_face(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    vertices: ArrayLike,
    faces: ArrayLike,
    lighting: LightingModel | None = None,
    *,
    normal_error: float = 0.0,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> FaceFit:
    """Return an unknown face's reflectance as far as its photograph proves it, the mean face otherwise.

    The face is divided into blocks. Without some of them, the light is fitted with the model's mean face, and
    with the person's coefficients (`fit_image`), each without and with details, a smooth field of residuals
    (`detail_field`); each is judged by all the light that what was left out sends. Only its colour counts,
    the ratios between channels: errors of the light are nearly grey, and a person can imitate them. Details
    must predict better than the mean face does under a light of its own, and the person better than the mean,
    by two standard errors and, where normals are right, 7 % of the error. Otherwise they are left out; if
    both are, the mean face is returned, and `plan` says so. The last fits are to all blocks; a person whose
    objective is then above the mean face's, which the model contains, is left out as well. If these leave
    more than a quarter of the photograph (relative RMSE; and what normals may be wrong by), both are left
    out: light or shape are wrong. Where details are believed and the person is not, the mean face gets the
    hue that its skin probably has (`skin_hue`). Raises `ReflectanceError` as `fit_image`, or when a vertex is
    not finite. Warns by `RuntimeWarning` when the last fit stops without having converged.

    Parameters
    ----------
    observation : ImageObservation
        Give it the transfer of `light_transfer`.
    model : MorphableReflectanceModel
    vertices, faces : (V, 3) array_like of float, (F, 3) array_like of int
        Millimetres.
    lighting : LightingModel, optional
    normal_error : float
        Usual angle, in radians, by which the normals may be wrong. Their light is then noise: what a normal,
        or the position that is off with it, could explain is left out of the details, and the person's
        coefficients are not tried.
    budget, on_progress : optional
        Of each of the fits, see `fit_image`.

    Notes
    -----
    On 16 path-traced photographs that share nothing with the fit the albedo is 0.120 off, that of the mean
    face 0.176, and that of `fit_image` 0.165 (`python tools/bench photographs/unknown`). A photograph without
    colour gives no evidence, and so the mean face.
    """
    lighting = LightingModel.default() if lighting is None else lighting
    xyz, index = checked_mesh(vertices, faces, "the mesh", ReflectanceError)
    require_one_topology("the mesh", len(xyz), "the model", len(model.known))
    used = common_vertices(observation, model)
    errors = errors_left_out(observation, model, xyz, index, lighting, normal_error, budget)
    # Details hold nothing that wrong normals could colour, so that any gain above chance counts.
    details = _judged(errors, "details", "mean", "mean+details", 0.0 if normal_error else _LEAST_GAIN)
    if normal_error:
        off = f"the normals may be wrong by {np.degrees(normal_error):.0f} degrees"
        person = _plan_step("person", False, f"{off}; {_TESTED['person']} would imitate it")
    else:
        ending = "+details" if details.ran else ""
        person = _judged(errors, "person", f"mean{ending}", f"person{ending}")

    def mean_fit(hue: ArrayLike, report: OnProgress) -> ImageFit:
        found = fit_image(observation, model.mean_only(hue), lighting, budget=budget, on_progress=report)
        return replace(found, face=replace(found.face, coefficients=np.zeros(model.components)))

    fit = mean = mean_fit(1.0, on_progress)
    if person.ran:
        fit = fit_image(observation, model, lighting, budget=budget, on_progress=on_progress)
        figures = f"{person.evidence}; objective of all blocks {mean.objective:.4g} -> {fit.objective:.4g}"
        person = replace(person, evidence=figures)
        if fit.objective > mean.objective:
            # The model contains the mean face, so a larger objective is a search gone astray.
            worse = f"{_TESTED['person']} explain the whole photograph worse than the mean face does"
            person = replace(person, ran=False, reason=worse)
            fit = mean
    if person.ran and details.ran:
        # The person may explain all that the details did.
        details = _judged(errors, "details", "person", "person+details")
    divided = ShadingDivided.from_observation(observation, model, fit.face.reflectance, fit.light)
    badly_explained = fit.relative_rmse > np.hypot(MOST_UNEXPLAINED, normal_error * divided.steepness())
    if badly_explained:
        details, person = (_unbelieved(step, fit.relative_rmse) for step in (details, person))
        fit = mean
    hue = np.ones(3)
    why = "the person's coefficients have it" if person.ran else "no details are believed"
    if details.ran and not person.ran:
        why = "a part of the photograph's hue is probably the skin's"
        hue = skin_hue(observation.response(np.flatnonzero(divided.illuminated)).diffuse @ fit.light)
        fit = mean_fit(hue, None)
        divided = ShadingDivided.from_observation(observation, model, fit.face.reflectance, fit.light)
    factors = "factors of red, green, blue: " + ", ".join(f"{one:.2f}" for one in hue)
    reflectance = fit.face.reflectance
    field = None
    if details.ran:
        field = detail_field(divided, xyz, index, normal_error)
        detailed = reflectance.diffuse_linear * np.exp(field)
        reflectance = replace(reflectance, diffuse_linear=detailed)
    made = observation.response(used).shade(reflectance.chosen(used), fit.light).radiance_linear
    observed = observation.observed_linear[used]
    return FaceFit(
        reflectance=reflectance,
        fit=fit,
        radiance_linear=among_all(used, len(xyz), made),
        relative_rmse=float(np.linalg.norm(made - observed) / np.linalg.norm(observed)),
        badly_explained=bool(badly_explained),
        details=field,
        plan=Plan((details, person, _plan_step("hue", bool((hue != 1).any()), why, factors))),
    )


def _plan_step(step: str, ran: bool, reason: str, evidence: str = "") -> PlanStep:
    return PlanStep(f"reflectance.image.{step}", ran, reason, evidence)


def _unbelieved(step: PlanStep, unexplained: float) -> PlanStep:
    """Return a step that is left out, for a fit to all blocks has too large a relative RMSE."""
    what = _TESTED[step.stage.rpartition(".")[2]]
    evidence = f"{step.evidence}; relative RMSE of all blocks {100 * unexplained:.1f} %".removeprefix("; ")
    reason = f"light and model explain the photograph too badly to believe {what}"
    return replace(step, ran=False, reason=reason, evidence=evidence)


def errors_left_out(
    observation: ImageObservation,
    model: MorphableReflectanceModel,
    vertices: FloatArray,
    faces: IntArray,
    lighting: LightingModel,
    normal_error: float,
    budget: BudgetLike,
) -> dict[str, FloatArray]:
    """Return errors (B,) of descriptions of the face, by blocks left out of fits; NaN where not judged.

    The descriptions are "mean" and, where normals are right, "person", and both with "+details". An error is
    the mean absolute logarithm of predicted over observed colours, less its mean over the channels.
    """
    used, block = observation.seen & model.known, np.full(len(vertices), -1)
    cells = np.floor(vertices[used] / _BLOCK_MM).astype(int)
    block[used] = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = block.max(initial=-1) + 1
    folds = 3
    fold_of = np.random.default_rng(0).permutation(count) % folds
    errors: dict[str, FloatArray] = {}
    tried = [("mean", model.mean_only()), ("person", model)][: 1 if normal_error else 2]
    for fold in range(folds):
        held_out = used & (fold_of[block] == fold)
        kept = used & ~held_out
        if not held_out.any() or not kept.any():
            continue
        shown = replace(observation, seen=kept)
        for name, one in tried:
            with warnings.catch_warnings():
                # One of several trials; what it predicts is measured.
                warnings.filterwarnings("ignore", "the image fit stopped", RuntimeWarning)
                fit = fit_image(shown, one, lighting, budget=budget)
            divided = ShadingDivided.from_observation(observation, model, fit.face.reflectance, fit.light)
            shown_part = replace(divided, usable=divided.usable & ~held_out)
            field = detail_field(shown_part, vertices, faces, normal_error)
            tested = np.flatnonzero(held_out & divided.illuminated)
            number = np.bincount(block[tested], minlength=count)
            for label, added in ((name, 0.0), (f"{name}+details", field)):
                off = divided.left_over(added)[tested]
                # Errors of the light are nearly grey, those of skin are not: only colour counts.
                error = np.abs(off - off.mean(1, keepdims=True)).mean(1)
                total = np.bincount(block[tested], error, minlength=count)
                means = errors.setdefault(label, np.full(count, np.nan))
                means[number > 0] = total[number > 0] / number[number > 0]
    return errors


def _judged(
    errors: dict[str, FloatArray], step: str, before: str, after: str, least: float = _LEAST_GAIN
) -> PlanStep:
    """Return whether one description predicts better than another, by more than a share of the error."""
    one, two = (errors.get(name, np.empty(0)) for name in (before, after))
    common = np.isfinite(one) & np.isfinite(two)
    gains, count = (one - two)[common], common.sum()
    if count < _LEAST_BLOCKS:
        reason = f"too little of the face is seen to test {_TESTED[step]}"
        return _plan_step(step, False, reason, f"{count} blocks, {_LEAST_BLOCKS} are needed")
    gain, spread = gains.mean(), gains.std(ddof=1) / np.sqrt(count)
    first, last = one[common].mean(), two[common].mean()
    accepted = bool(gain > max(2 * spread, least * first))  # two standard errors
    believed = "" if accepted else "do not "
    return _plan_step(
        step,
        accepted,
        f"{_TESTED[step]} {believed}predict parts of the photograph that were left out",
        f"colour of left-out blocks {100 * first:.2f} -> {100 * last:.2f} %, "
        f"gain {100 * gain:.2f} +- {100 * spread:.2f} %, {count} blocks",
    )


def skin_hue(received: FloatArray) -> FloatArray:
    """Return factors (3,) on the channels of the mean face's albedo, from the light (V, 3) that it receives.

    Of the log hue of a photograph, skin's plus light's, it is the posterior mean; the light's is a mixture.
    White lies between the hues of the lights that meet on a face, as sun and sky: dark parts count as bright.
    """
    cast = np.log(np.maximum(received, EPSILON)).mean(0)
    cast -= cast.mean()
    often, warm, deviation = np.array(_LIGHT_HUES).T
    variance = deviation**2 + PEOPLE_DIFFER**2
    off = cast - np.outer(warm, [1, 0, -1])
    # Two numbers of the three are free.
    odds = softmax(np.log(often / variance) - (off**2).sum(1) / (2 * variance))
    return np.exp(odds * PEOPLE_DIFFER**2 / variance @ off)
