"""Albedo and highlights of each vertex from pictures lit by one flash each; how well they predict others."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scan2albedo.core import BudgetLike, Meter, OnProgress, Plan, PlanStep, Trace
from scan2albedo.core.arrays import (
    EPSILON,
    SMALLEST,
    ArrayLike,
    BoolArray,
    FloatArray,
    IntArray,
    checked_array,
)
from scan2albedo.errors import ReflectanceError
from scan2albedo.reflectance.olat import OlatOptions
from scan2albedo.reflectance.point_light_lobes import cosines_of_lobes, point_light_radiance, radiance_of
from scan2albedo.reflectance.robust_fit import Observations, ReflectanceFitOptions, RobustFit, normal_sigma
from scan2albedo.reflectance.vertex_kernels import add_normal_equations, solve_free
from scan2albedo.reflectance.vertex_reflectance import EXPONENTS, VertexReflectance, among_all
from scan2albedo.reflectance.vertex_samples import VertexSamples

PARAMETERS = ("red", "green", "blue", "weight_1", "weight_8", "weight_64")
"""Columns of everything (V, 6)."""
PRIOR_MEAN = (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
"""Mean of a vertex's Gaussian prior, in units of the albedos' level: keeps lobes that no picture shows from
fitting noise."""
PRIOR_STD = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3)
"""Its standard deviations, in the same units."""
_TWO_SIDED_95 = 1.959964
_IDENTIFIED_BELOW = 0.3
"""Posterior over prior standard deviation below which a number counts as identified."""
_BOUNCE_SIGMA = 0.1
"""Relative deviation of bounced light that is found by rays from vertices, against eight times as many."""
_LEAST_COSINE = 0.05
"""Where all light grazes more, intervals do not widen further."""
_GAIN_ROUNDS = 50
"""Most alternations between reflectance and gains."""
_GAIN_VERTICES = 2000
"""About how many vertices, evenly chosen, gains and bounced light are found from."""
_GAIN_TOLERANCE = 1e-5
"""A smaller change of the gains ends the alternations."""


@dataclass(frozen=True)
class ReflectanceFit:
    """Result of `fit_reflectance`; NaN where a vertex is not known, unless said otherwise."""

    reflectance: VertexReflectance
    """Of V vertices."""
    std: FloatArray
    """(V, 6): standard deviation of the posterior without bounds, columns `PARAMETERS`; larger by the misfit
    where residuals are above sigma."""
    low: FloatArray
    high: FloatArray
    """`low`, `high`: (V, 6): 95 % intervals, >= 0; they hold the estimate."""
    pair_count: IntArray
    condition: FloatArray
    """`pair_count`, `condition`: (V,): pictures used; condition number of their matrix, without prior."""
    activation: FloatArray
    """(V, 3): largest value over the pictures of each lobe over its peak, max(0, n.h)^s; 0 where unseen."""
    identifiability: FloatArray
    """(V, 6): posterior over prior standard deviation: 1 where pictures add nothing."""
    identified: BoolArray
    impossible: BoolArray
    """`identified`: (V, 6): identifiability is small enough, and no albedo `impossible`: (V,) above
    `most_albedo`."""
    misfit: FloatArray
    """(V,): root of the mean squared residual over sigma, robust; 1 is as the noise says. NaN also where
    there are not more observations than unknowns."""
    tilt: FloatArray
    normal_sigma_degrees: FloatArray
    """`tilt`: (V, 2): of the normals along the tangents of `lobe_slopes`, tangents of the angles;
    `normal_sigma_degrees`: (V,): their deviation that the fit assumed."""
    light_gain: FloatArray
    """(L, 3): strength of each flash, mean 1 over those used; NaN for flashes that lit nothing."""
    bounce_albedo: FloatArray
    """(3,): mean albedo by which the face lights itself, 0 where it does not."""
    plan: Plan
    """Whether bounced light is in the model, and why: "reflectance.bounce"."""
    level: float
    """Unit of the prior: the median albedo without highlights."""
    converged: bool
    """All known vertices and the gains are; False when the budget or the `iterations` ended the fit first."""
    iterations: int
    residual: float
    trace: Trace
    """`residual`, `trace`: robust loss per observation; 1/2 is pure noise."""

    @property
    def parameters(self) -> FloatArray:
        """(V, 6) albedos and weights, columns `PARAMETERS`."""
        return np.concatenate([self.reflectance.diffuse_linear, self.reflectance.weights], axis=1)

    @property
    def drawn(self) -> BoolArray:
        """(V,) vertices to draw as found: with identified albedos; all known if these are fewer than half."""
        known = self.reflectance.known
        sure = known & self.identified[:, :3].all(1)
        return sure if 2 * sure.sum() >= known.sum() else known


def fit_reflectance(
    samples: VertexSamples,
    *,
    options: ReflectanceFitOptions = ReflectanceFitOptions(),
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> ReflectanceFit:
    """Return the three albedos and weights of three lobes that fit each vertex best, all >= 0.

    With D and S of `point_light_lobes`, a vertex minimises over its pictures j and channels k

        sum rho((y_jk - c_k D_j - w.S_j) / sigma_jk) + prior(c, w),   c, w >= 0,

    (Han, Wang, Xu, supplement), rho robust, the channels of a picture together; the prior is Gaussian. Raises
    `ReflectanceError` when there are no pictures, or no vertex is seen in enough of them.

    Parameters
    ----------
    samples : VertexSamples
        J pictures of V vertices.
    options : ReflectanceFitOptions
    budget, on_progress : optional
        Evaluations are passes over all vertices still moving; called with every row of the trace.

    Notes
    -----
    Albedos are in units of the flashes' strength; the prior follows their level. Intervals come from the
    Gaussian posterior before the bounds, cut at 0. They account for noise, the prior and, where samples have
    slopes, wrong normals: two tilts of each normal are found with the six numbers, their prior Student's t.
    They widen with the misfit, by 1 / max n.l where no flash stands above the vertex, and with what is not
    known of the light that the face throws on itself, whose part of the model is in `plan`. ``python
    tools/bench flash_heads/heads`` counts how many hold the truth: 90 to 97 %.
    """
    rows = _rows_to_fit(samples, options)
    count = samples.lobes.shape[1]
    meter = Meter("reflectance", "loss per observation", budget, on_progress)
    data, level = _with_prior(samples, rows)
    gain, gains_settled = np.full((samples.light.max() + 1, 3), np.nan), True
    gain[samples.light[samples.valid[:, rows].any((1, 2))]] = 1.0
    if options.light_gains:
        gain, gains_settled = find_light_gains(data, samples.light, rows, options, meter)
        data = divided_by_gain(data, samples.light, gain)
    data, bounce_albedo, bounce_sigma, step = with_bounce(data, samples, rows, options, meter)
    if samples.slopes is not None and options.normal_sigma_degrees != 0:
        data = replace(data, slopes=samples.slopes)
        data = replace(data, tilt_sigma=normal_sigma(data, samples.normal_spread, rows, options, meter))
    fitted = RobustFit(data, options.loss).fit(rows, meter)
    estimate, misfit = fitted.estimate[rows], _misfit(fitted, samples.valid, rows)
    seen = np.asarray(samples.valid.any(-1))
    n_l, n_h = cosines_of_lobes(samples.lobes)
    steepest = np.max(n_l, axis=0, where=seen, initial=_LEAST_COSINE)
    deviation = fitted.deviation / np.minimum(steepest[rows], 1.0)[:, None]
    std = deviation * np.fmax(misfit, 1.0)[:, None]
    if len(data.bounce):
        std = np.hypot(std, bounce_sigma * _moved_by_bounce(fitted, rows))
    low = np.clip(fitted.center - _TWO_SIDED_95 * std, 0, estimate)
    high = np.fmax(fitted.center + _TWO_SIDED_95 * std, estimate)
    identifiability = np.minimum(deviation * np.sqrt(data.prior), 1.0)
    most = np.inf if options.most_albedo is None else options.most_albedo
    too_bright = estimate[:, :3].max(1) > most
    low[too_bright] = 0.0
    known, impossible = np.zeros((2, count), bool)
    identified = np.zeros((count, 6), bool)
    known[rows], impossible[rows] = True, too_bright
    identified[rows] = (identifiability < _IDENTIFIED_BELOW) & ~too_bright[:, None]
    over_peak = np.where(samples.lobes[..., 1:] > 0, n_h[..., None] ** EXPONENTS, 0.0)
    spread = partial(among_all, rows, count)
    return ReflectanceFit(
        reflectance=VertexReflectance(spread(estimate[:, :3]), spread(estimate[:, 3:]), known),
        std=spread(std),
        low=spread(low),
        high=spread(high),
        pair_count=samples.pair_count,
        condition=spread(_condition(fitted.normal[:, :, :6])),
        activation=np.max(over_peak, axis=0, where=seen[..., None], initial=0.0),
        identifiability=spread(identifiability),
        identified=identified,
        impossible=impossible,
        misfit=spread(misfit),
        tilt=spread(fitted.tilt[rows]),
        normal_sigma_degrees=np.zeros(count) if data.tilt_sigma is None else np.degrees(data.tilt_sigma),
        light_gain=gain,
        bounce_albedo=bounce_albedo,
        plan=Plan((step,)),
        level=level,
        converged=bool(fitted.settled.all()) and gains_settled,
        iterations=fitted.iterations,
        residual=fitted.residual,
        trace=meter.trace,
    )


def _rows_to_fit(samples: VertexSamples, options: ReflectanceFitOptions) -> IntArray:
    """Return the vertices (N,) that enough pictures show in every channel; ReflectanceError without any."""
    pictures, count = samples.observed_linear.shape[:2]
    if pictures == 0:
        raise ReflectanceError("there are no pictures, give one pair at least")
    if options.least_pairs > pictures:
        raise ReflectanceError(
            f"there are {pictures} pictures, but a vertex shall be seen in {options.least_pairs}: take more, "
            "or give a smaller least_pairs"
        )
    often = (samples.valid & (samples.lobes[..., :1] > 0)).sum(0).min(-1)
    rows = np.flatnonzero(often >= options.least_pairs)
    if len(rows) == 0:
        raise ReflectanceError(
            f"none of {count} vertices is seen in {options.least_pairs} or more of {pictures} pictures (at "
            f"most in {often.max(initial=0)}): do cameras, flashes and mesh share one frame and unit (mm), "
            "do masks show the face, are pictures saturated or missing?"
        )
    return rows


def _with_prior(samples: VertexSamples, rows: IntArray) -> tuple[Observations, float]:
    """Return the observations with their prior, and its level: the median albedo without highlights.

    It is that which squares without lobes give, over all channels.
    """
    precision = np.zeros(samples.observed_linear.shape)
    np.divide(1.0, samples.sigma**2, out=precision, where=samples.valid)
    diffuse = samples.lobes[..., :1]
    below = (precision * diffuse**2).sum(0)[rows]
    level = float(np.median((precision * samples.observed_linear * diffuse).sum(0)[rows] / below))
    level = level if level > 0 else 1.0
    mean, std = level * np.array(PRIOR_MEAN), level * np.array(PRIOR_STD)
    return Observations(samples.observed_linear, precision, samples.lobes, mean, 1 / std**2), level


def _misfit(fitted: RobustFit, valid: BoolArray, rows: IntArray) -> FloatArray:
    """Return (N,) root mean squared residuals over sigma; NaN without a degree of freedom left."""
    squares, weights = fitted.misfit[rows].T
    observations, freedom = valid[:, rows].sum((0, 2)), weights - 6
    enough = (observations > 6) & (freedom > 0)
    return np.sqrt(np.where(enough, squares / np.where(enough, freedom, 1.0), np.nan))


def _moved_by_bounce(fitted: RobustFit, rows: IntArray) -> FloatArray:
    """Return how far all numbers (N, 6) move with the strength of bounced light, which all pictures share."""
    data, normal = fitted.data, np.empty((len(rows), 6, 7))
    bounced = data.bounce * np.nan_to_num(fitted.estimate[:, :3])
    moved, unused = np.empty((2, len(rows), 6))
    add_normal_equations(bounced, data.precision, fitted.lobes, data.bounce, fitted.weight, rows, normal)
    solve_free(normal, np.zeros(6), data.prior, moved, unused)
    return moved


def _condition(matrices: FloatArray) -> FloatArray:
    """Return (N,) condition numbers of the observations, whose normal matrices are (N, 6, 6)."""
    smallest, largest = np.linalg.eigvalsh(matrices)[:, [0, -1]].T
    singular = smallest <= 64 * EPSILON * largest
    return np.sqrt(np.where(singular, np.inf, largest / np.where(singular, 1.0, smallest)))


def with_bounce(
    data: Observations, samples: VertexSamples, rows: IntArray, options: ReflectanceFitOptions, meter: Meter
) -> tuple[Observations, FloatArray, float, PlanStep]:
    """Return observations that expect bounced light, the albedo (3,) that sends it, its deviation, and why.

    B of `VertexSamples.bounced_light` joins D. It is sent by t times the mean albedo; the part t is that of
    the least robust loss of some vertices, at most 1, or an albedo of 1 where the strength of the flashes is
    not known. The deviation, relative to B, is that of the albedos among vertices and of what the rays leave.
    It joins the noise of each picture and, shared by all, the intervals.
    """
    from scipy.optimize import minimize_scalar

    stage, factors = "reflectance.bounce", samples.form_factors
    if factors is None or not factors.nnz:
        return data, np.zeros(3), 0.0, PlanStep(stage, False, "no part of the mesh is known to face another")
    few = rows[:: max(1, len(rows) // _GAIN_VERTICES)]

    def fit_few(sent: FloatArray) -> RobustFit:
        meter.count()
        observations = replace(data.of_vertices(few), bounce=samples.bounced_light(sent)[:, few])
        return RobustFit(observations, options.loss).fit(np.arange(len(few)), meter.untraced())

    albedo = fit_few(np.zeros(3)).estimate[:, :3]
    mean = np.maximum(np.median(albedo, axis=0), SMALLEST)
    most = 1 / max(1.0, mean.max()) if options.most_albedo is not None else 1 / mean.max()
    within = {"bounds": (0, most), "method": "bounded", "options": {"xatol": most / 20}}
    part = minimize_scalar(lambda part: fit_few(part * mean).residual, **within).x
    bounce = samples.bounced_light(part * mean)
    sigma = np.hypot(_BOUNCE_SIGMA, np.median(np.abs(albedo / mean - 1)))
    precision = data.precision / (1 + data.precision * (sigma * mean * bounce) ** 2)
    evidence = f"{100 * part:.0f} % of what its mean albedo would send, red {mean[0]:.2f}"
    step = PlanStep(stage, True, "the face lights itself", evidence)
    return replace(data, bounce=bounce, precision=precision), part * mean, sigma, step


def divided_by_gain(data: Observations, light: IntArray, gain: FloatArray) -> Observations:
    """Return observations as under flashes of gain 1: y / g, with precision g^2 / sigma^2."""
    factor = np.where(np.isfinite(gain), gain, 1.0)[light][:, None, :]
    return replace(data, observed=data.observed / factor, precision=data.precision * factor**2)


def find_light_gains(
    data: Observations, light: IntArray, rows: IntArray, options: ReflectanceFitOptions, meter: Meter
) -> tuple[FloatArray, bool]:
    """Return gains (L, 3) of mean 1, NaN for flashes that lit nothing, and whether they converged.

    Alternates between reflectance for fixed gains and gains for fixed reflectance, g = sum u p y m /
    sum u p m^2 over a flash's observations y of radiance m, with robust weights u. The mean fixes the scale.
    """
    few = rows[:: max(1, len(rows) // _GAIN_VERTICES)]
    subset = data.of_vertices(few)
    gain = np.ones((light.max() + 1, 3))
    for _ in range(_GAIN_ROUNDS):
        divided = RobustFit(divided_by_gain(subset, light, gain), options.loss)
        fitted = divided.fit(np.arange(len(few)), meter.untraced())
        meter.count()
        estimate, precision = fitted.estimate, subset.precision * fitted.weight[..., None]
        radiance = radiance_of(subset.lobes, estimate[:, :3], estimate[:, 3:])
        above, below = np.zeros((2, *gain.shape))
        np.add.at(above, light, (precision * subset.observed * radiance).sum(1))
        np.add.at(below, light, (precision * radiance**2).sum(1))
        # A flash that lit only black pixels would have no gain.
        least = EPSILON
        new = np.where(below > 0, np.maximum(above / np.where(below > 0, below, 1.0), least), np.nan)
        new /= np.nanmean(new, axis=0)
        step = np.nanmax(np.abs(new - gain))
        gain = new
        if step < _GAIN_TOLERANCE:
            return gain, True
        if meter.exhausted:
            break
    return gain, False


@dataclass(frozen=True)
class RelightingError:
    """Error over the observations of pictures left out of a fit, all channels together."""

    relative_rmse: float
    """Root mean square of observed minus predicted radiance, over that of the observed."""
    psnr_db: float
    """Of displayed values, radiance^(1 / 1.2) with the 99th percentile of the observed as white."""
    noise_part: float
    """The part of `relative_rmse` that the observations' own sigma explains."""
    fit: ReflectanceFit
    """Of the other pictures."""


def relighting_error(
    samples: VertexSamples, held_out: ArrayLike, *, options: ReflectanceFitOptions = ReflectanceFitOptions()
) -> RelightingError:
    """Return how well a fit to the pictures that are not `held_out` predicts those that are.

    Raises `ReflectanceError` when nothing is left to fit, or nothing to predict.

    Parameters
    ----------
    samples : VertexSamples
        J pictures.
    held_out : (J,) array_like of bool
        At least one, and not all.
    options : ReflectanceFitOptions
        With light gains, a flash that lit none of the others has gain 1.
    """
    hidden = checked_array(held_out, samples.light.shape, "held_out", ReflectanceError, kind=bool)
    if not 0 < hidden.sum() < len(hidden):
        raise ReflectanceError(f"{hidden.sum()} of {len(hidden)} pictures are held out, expected a part")
    fit = fit_reflectance(samples.of_pairs(~hidden), options=options)
    unseen = samples.of_pairs(hidden)
    gains = np.ones((unseen.light.max() + 1, 3))
    both = min(len(gains), len(fit.light_gain))
    gains[:both] = np.where(np.isfinite(fit.light_gain[:both]), fit.light_gain[:both], 1.0)
    radiance = point_light_radiance(fit.reflectance, unseen.turned_lobes(fit.tilt))
    radiance += fit.reflectance.diffuse_linear * unseen.bounced_light(fit.bounce_albedo)
    predicted = gains[unseen.light][:, None] * radiance
    seen = unseen.valid & fit.reflectance.known[:, None]
    if not seen.any():
        raise ReflectanceError("the pictures held out show no vertex that the others do: hold out others")
    observed, made = unseen.observed_linear[seen], predicted[seen]
    if not observed.any():
        raise ReflectanceError("pictures held out are black where the face is: there is nothing to predict")
    white = max(np.percentile(observed, 99), SMALLEST)
    displayed = [np.clip(linear / white, 0, 1) ** (1 / OlatOptions.gamma) for linear in (observed, made)]
    off = np.mean((displayed[0] - displayed[1]) ** 2)
    power = np.mean(observed**2)
    return RelightingError(
        float(np.sqrt(np.mean((observed - made) ** 2) / power)),
        float(-10 * np.log10(max(off, SMALLEST))),
        float(np.sqrt(np.mean(unseen.sigma[seen] ** 2) / power)),
        fit,
    )
