"""Reflectance of an unknown face from one photograph, believed only where parts left out are predicted."""

import warnings
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
from scipy import sparse
from scipy.special import softmax

from scan2albedo.core import BudgetLike, OnProgress, Plan, PlanStep
from scan2albedo.core.arrays import EPSILON, ArrayLike, BoolArray, FloatArray, IntArray, checked_mesh
from scan2albedo.errors import ReflectanceError
from scan2albedo.geometry.mesh import edges_with_faces
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.reflectance.environment_shading import diffuse_response, shading_gradient
from scan2albedo.reflectance.image_fit import MOST_UNEXPLAINED, ImageFit, common_vertices, fit_image
from scan2albedo.reflectance.lighting_model import LightingModel
from scan2albedo.reflectance.morphable_model import PEOPLE_DIFFER, MorphableReflectanceModel
from scan2albedo.reflectance.photograph import ImageObservation
from scan2albedo.reflectance.vertex_reflectance import VertexReflectance, among_all, require_one_topology

_BLOCK_MM = 12.0
"""Edge of the cubes whose vertices are left out together, for errors of a shape are alike over such a length.
So an error of the normals goes with one of positions, of the length times the angle: 2 mm along each axis in
shapes from landmarks."""
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
    beats_mean: bool
    """False when the reflectance is the model's mean."""
    badly_explained: bool
    """Whether light and coefficients leave so much of the photograph unexplained that nothing is believed."""
    details: FloatArray | None
    """(V, 3): logarithms of the factors on the albedo; None where they were not accepted."""
    plan: Plan
    """What was believed of details, of the person and, last, of the skin's hue, and why."""


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
    ending = "+details" if details.ran else ""
    if normal_error:
        off = f"the normals may be wrong by {np.degrees(normal_error):.0f} degrees"
        person = _plan_step("person", False, f"{off}; {_TESTED['person']} would imitate it")
    else:
        person = _judged(errors, "person", f"mean{ending}", f"person{ending}")
    mean = fit_image(observation, model.mean_only(), lighting, budget=budget, on_progress=on_progress)
    mean = replace(mean, face=replace(mean.face, coefficients=np.zeros(model.components)))
    fit = mean
    if person.ran:
        fit = fit_image(observation, model, lighting, budget=budget, on_progress=on_progress)
        objectives = f"objective of all blocks {mean.objective:.4g} -> {fit.objective:.4g}"
        person = replace(person, evidence=f"{person.evidence}; {objectives}")
        if fit.objective > mean.objective:
            # The model contains the mean face, so a larger objective is a search gone astray.
            worse = f"{_TESTED['person']} explain the whole photograph worse than the mean face does"
            fit, person = mean, replace(person, ran=False, reason=worse)
    if person.ran and details.ran:
        # The person may explain all that the details did.
        details = _judged(errors, "details", "person", "person+details")
    left = fit.relative_rmse
    divided = ShadingDivided.from_observation(observation, model, fit.face.reflectance, fit.light)
    tilt = np.trace(divided.by_tilt[divided.usable], axis1=1, axis2=2)
    shading_error = normal_error * np.sqrt(np.median(tilt) / 3) if len(tilt) else 0.0
    badly_explained = left > np.hypot(MOST_UNEXPLAINED, shading_error)
    if badly_explained:
        fit = mean
        details, person = (_unbelieved(step, left) for step in (details, person))
    hue, why = np.ones(3), "no details are believed"
    if person.ran:
        why = "the person's coefficients have it"
    elif details.ran:
        why = "a part of the photograph's hue is probably the skin's"
        hue = skin_hue(observation.response(np.flatnonzero(divided.lit)).diffuse @ fit.light)
        fit = fit_image(observation, model.mean_only(hue), lighting, budget=budget)
        fit = replace(fit, face=replace(fit.face, coefficients=mean.face.coefficients))
        divided = ShadingDivided.from_observation(observation, model, fit.face.reflectance, fit.light)
    factors = "factors of red, green, blue: " + ", ".join(f"{one:.2f}" for one in hue)
    plan = Plan((details, person, _plan_step("hue", bool((hue != 1).any()), why, factors)))
    better = person.ran or details.ran
    reflectance, radiance, rmse = fit.face.reflectance, fit.radiance_linear, fit.relative_rmse
    if not details.ran:
        return FaceFit(reflectance, fit, radiance, rmse, better, badly_explained, None, plan)
    field = detail_field(divided, xyz, index, normal_error)
    factor = np.where(reflectance.known[:, None], np.exp(field), 1.0)
    reflectance = replace(reflectance, diffuse_linear=reflectance.diffuse_linear * factor)
    made = observation.response(used).shade(reflectance.chosen(used), fit.light).radiance_linear
    observed = observation.observed_linear[used]
    radiance = among_all(used, len(xyz), made)
    rmse = float(np.linalg.norm(made - observed) / np.linalg.norm(observed))
    return FaceFit(reflectance, fit, radiance, rmse, better, badly_explained, field, plan)


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
    count = int(block.max(initial=-1)) + 1
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
            tested = np.flatnonzero(held_out & divided.lit)
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
    gains, count = (one - two)[common], int(common.sum())
    if count < _LEAST_BLOCKS:
        reason = f"too little of the face is seen to test {_TESTED[step]}"
        return _plan_step(step, False, reason, f"{count} blocks, {_LEAST_BLOCKS} are needed")
    gain, spread = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(count))
    first, last = float(one[common].mean()), float(two[common].mean())
    accepted = gain > max(2 * spread, least * first)  # two standard errors
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


_BANDS = {4.0: 0.05, 8.0: 0.02, 16.0: 0.01, 32.0: 0.01}
"""Standard deviations in mm of the blurs that divide the residual into bands, and of the logarithm of the
light's error in each, from wrong normals, shadows and interreflection; what is wider than all is light."""
_GREY = 0.9
"""Share of the variance of the light's error that is common to the three channels."""
_LEAST_OPEN = 0.4
"""Least share of the light around that a fold leaves to a vertex that counts."""
_LEAST_LIGHT = 0.2
"""Least light on a vertex that counts, over the median."""
_LEAST_DIFFUSE = 0.5
"""Least share of a counting vertex's observed light that is no highlight: its errors look like albedo."""


@dataclass(frozen=True)
class ShadingDivided:
    """An image divided by what a reflectance sends back under a light."""

    log_ratio: FloatArray
    """(V, 3): logarithm of the observed over the predicted diffuse light, highlights taken off; 0 where not
    seen."""
    usable: BoolArray
    """(V,): where it depends on the albedo."""
    lit: BoolArray
    """(V,): where enough light arrives that predictions can be compared; contains `usable`."""
    highlight_share: FloatArray
    """(V, 3): of the predicted light; 0 where not seen."""
    log_whole: FloatArray
    """(V, 3): logarithm of the observed over the whole predicted light; 0 where not seen."""
    by_tilt: FloatArray
    """(V, 3, 3): covariance of the logarithms of the channels' light by a normal's tilt of one radian; 0
    where not usable."""
    log_received: FloatArray
    """(V, 3): logarithm of the light that arrives; NaN where not seen."""

    @classmethod
    def from_observation(
        cls,
        observation: ImageObservation,
        model: MorphableReflectanceModel,
        reflectance: VertexReflectance,
        light: FloatArray,
    ) -> Self:
        """Divide an image by a reflectance under a light (81, 3)."""
        used = common_vertices(observation, model)
        response = observation.response(used)
        received = response.diffuse @ light
        made = response.shade(reflectance.chosen(used), light)
        diffuse, highlight = made.diffuse_linear, made.specular_linear
        observed = observation.observed_linear[used]
        floor = EPSILON + 1e-3 * float(np.median(diffuse))
        spread = partial(among_all, used, len(model.known))

        def log_ratio(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
            ratio = np.log(np.maximum(numerator, floor) / np.maximum(denominator, floor))
            # Larger residuals are holes, hair or other surfaces.
            return spread(np.clip(ratio, -1.5, 1.5), 0.0)

        free = diffuse_response(observation.normals[used])[:, 0]
        open_share = response.diffuse[:, 0] / np.maximum(free, EPSILON)
        usable, lit = np.zeros((2, len(model.known)), bool)
        bright = received.min(1) > _LEAST_LIGHT * np.median(received)
        lit[used] = bright & (open_share > _LEAST_OPEN)
        usable[used] = lit[used] & (observed - highlight > _LEAST_DIFFUSE * observed).all(1)
        part = replace(reflectance.chosen(used), known=lit[used])
        ways = observation.normals[used], observation.toward_camera[used]
        by_normal, _ = shading_gradient(part, *ways, light)
        slopes = by_normal / np.maximum(diffuse + np.maximum(highlight, 0), floor)[..., None]
        by_tilt = np.where(usable[used, None, None], slopes @ slopes.transpose(0, 2, 1) / 2, 0.0)
        return cls(
            log_ratio=log_ratio(observed - highlight, diffuse),
            usable=usable,
            lit=lit,
            highlight_share=spread(np.clip(highlight / np.maximum(diffuse + highlight, floor), 0, 1), 0.0),
            log_whole=log_ratio(observed, diffuse + highlight),
            by_tilt=spread(by_tilt, 0.0),
            log_received=spread(np.log(np.maximum(received, floor))),
        )

    def left_over(self, field: FloatArray | float = 0.0) -> FloatArray:
        """Return the logarithm (V, 3) of the observed over the predicted light with details (V, 3)."""
        share = self.highlight_share
        return self.log_whole - np.log(share + (1 - share) * np.exp(field))

    def by_shift(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """Return (V, 3, 3) as `by_tilt`, by a shift of positions (V, 3) of one unit along each axis."""
        edges, _ = edges_with_faces(faces)
        ends = edges[np.isfinite(self.log_received[edges]).all((1, 2))].T
        entry, shape = (ends.ravel(), np.tile(np.arange(ends.shape[1]), 2)), (len(vertices), ends.shape[1])
        at = sparse.csr_matrix((np.ones(ends.size), entry), shape=shape)
        change, length = (values[ends[0]] - values[ends[1]] for values in (self.log_received, vertices))
        steep = at @ (2 * change[:, :, None] * change[:, None, :]).reshape(-1, 9)
        square = np.where(self.usable, np.maximum(at @ (length**2).sum(1), EPSILON), np.inf)
        return (steep / square[:, None]).reshape(-1, 3, 3)


def detail_field(
    divided: ShadingDivided, vertices: ArrayLike, faces: IntArray, normal_error: float = 0.0
) -> FloatArray:
    """Return the logarithm (V, 3) of the factor by which the albedo differs from the model's.

    Blurs of growing width divide the residual of the photograph into bands. In each, with R the residual's
    covariance (3, 3) over the channels and S that of the light's error, the best linear estimate of the
    albedo's part is (R - S) R^-1 times the residual (Wiener); R - S is cut at 0. Normals that are off by an
    angle (radians), and positions with them, add an equal part of what that does to the light to S of each
    band. Both are means over the usable vertices around each one, within the last blur. What is wider than
    that is left to the light, and the field fades far from usable vertices (V, 3), mm.
    """
    usable = divided.usable
    field = np.zeros_like(divided.log_ratio)
    if not usable.any():
        return field
    xyz = np.asarray(vertices, float)
    blurs = [surface_diffusion(xyz, faces, width) for width in _BANDS]
    near = np.maximum(blurs[-1](usable.astype(float)), EPSILON)

    def around(covariance: FloatArray) -> FloatArray:
        return blurs[-1](np.where(usable[:, None, None], covariance, 0.0)) / near[:, None, None]

    wrong = divided.by_tilt + (_BLOCK_MM**2 * divided.by_shift(xyz, faces) if normal_error else 0.0)
    tilted = normal_error**2 / len(_BANDS) * around(wrong)
    cover = blurs[0](usable.astype(float))
    coarser = blurs[0](np.where(usable[:, None], divided.log_ratio, 0.0)) / np.maximum(cover, 1e-6)[:, None]
    finer = np.where(usable[:, None], divided.log_ratio, coarser)
    for blur, error in zip(blurs, _BANDS.values(), strict=True):
        coarser = coarser if blur is blurs[0] else blur(finer)
        band = finer - coarser
        total = around(band[:, :, None] * band[:, None, :]) + EPSILON * np.eye(3)
        light = error**2 * (_GREY * np.ones((3, 3)) + (1 - _GREY) * np.eye(3)) + tilted
        value, vector = np.linalg.eigh(total)
        size, turned = np.sqrt(np.maximum(value, EPSILON))[:, None], vector.transpose(0, 2, 1)
        root, inverse = vector * size @ turned, vector / size @ turned
        kept, axis = np.linalg.eigh(np.eye(3) - inverse @ light @ inverse)
        gain = root @ (axis * np.maximum(kept, 0.0)[:, None]) @ axis.transpose(0, 2, 1) @ inverse
        field += np.einsum("vij,vj->vi", gain, band)
        finer = coarser
    return field * np.clip(cover, 0.0, 1.0)[:, None]
