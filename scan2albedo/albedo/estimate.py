"""`estimate_albedo`: find the light in a geometry image and divide it out."""

import math
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from scan2albedo.albedo.division import divide_light
from scan2albedo.albedo.levels import Level, build_level, cell_field, usable_texels
from scan2albedo.albedo.light_search import LightSearch
from scan2albedo.albedo.options import EstimateOptions
from scan2albedo.albedo.paper_search import paper_search
from scan2albedo.albedo.prior import AlbedoPrior
from scan2albedo.albedo.result import AlbedoEstimate
from scan2albedo.albedo.saturation import inpainted
from scan2albedo.albedo.shaded_image import LightFound, ShadedImage
from scan2albedo.albedo.shadows import FEWEST
from scan2albedo.albedo.soft_terms import DARKEST
from scan2albedo.albedo.texel_light import TexelLight, light_on_texels
from scan2albedo.albedo.uncertainty import expected_error
from scan2albedo.core import (
    BudgetLike,
    GeometryImage,
    Meter,
    OnProgress,
    Plan,
    PlanStep,
)
from scan2albedo.core.arguments import require_type
from scan2albedo.core.arrays import FloatArray, on_grid
from scan2albedo.core.geometry_image import NO_CAMERA
from scan2albedo.geometry.fields import continued_smoothly
from scan2albedo.geometry.mesh import lengths
from scan2albedo.lighting.environment_light import environment_of_shading, open_shading
from scan2albedo.lighting.harmonics import harmonics
from scan2albedo.lighting.shading import DIFFUSE_MODELS, Reflectance

_CAMERAS = "albedo.cameras"
SPHERICAL_HARMONICS = "spherical-harmonics"
"""The `brdf` that fits the shading by harmonics of order 2, without lamps."""


def check_light_options(lights: object, brdf: str) -> None:
    """Raise ValueError unless `lights` are "auto" or 1 to 4, and `brdf` of `DIFFUSE_MODELS` or harmonics."""
    if lights != "auto" and (
        isinstance(lights, bool) or not isinstance(lights, Integral) or not 1 <= int(lights) <= 4
    ):
        raise ValueError(f"lights is {lights!r}, expected 'auto' or a whole number from 1 to 4")
    known = (*DIFFUSE_MODELS, SPHERICAL_HARMONICS)
    if brdf not in known:
        raise ValueError(f"brdf is {brdf!r}, expected one of {', '.join(known)}")


def estimate_albedo(
    image: GeometryImage,
    lights: str | int = "auto",
    brdf: str = "oren-nayar",
    view_direction: Sequence[float] = (0.0, 0.0, 1.0),
    budget: BudgetLike = None,
    seed: int = 0,
    *,
    options: EstimateOptions = EstimateOptions(),
    prior: AlbedoPrior | None = None,
    on_progress: OnProgress = None,
) -> AlbedoEstimate:
    """Estimate the lights of a textured geometry image and return the texture without them.

    Light and albedo have one posterior. V of HSV of the linear texture is

        M_T = M_A I + I_s,    I = A + D + rho B(D),    A = t_0 + f (1 - t_0),
        D = sum_l V_l E_l r(n, l, v) + sum_k c_k t_k,

    with ambient light A of strength 1, its occlusion t_0 and fill f; lamps l with visibility V, strength E
    and reflectance r; an environment in harmonics k of orders 1 and 2, whose light t_k passes the surface's
    own shadows; one bounce B at the mean albedo rho; and Phong's highlights I_s. log M_A has the prior of a
    face, or a stationary one (`prior`), each parameter of the light its own; lamps are counted by their
    evidence, and explanations that it cannot separate are averaged. Each part of I has its own colour. Where
    light ends, the albedo goes to what the prior and its surroundings say. Raises LightingError for an image
    without texture, with an empty mask, or with too few usable texels; ValueError for an unknown `brdf`,
    `lights` that is neither "auto" nor 1 to 4, a zero `view_direction`, or roughness asked of a Lambertian
    surface; TypeError for another object than a geometry image.

    Parameters
    ----------
    image : GeometryImage
        With `texture_linear`. Texels not seen, black, saturated or without a normal (0) do not count, but get
        an albedo.
    lights : "auto" or int
        Number of lamps; "auto" compares numbers of them by their evidence, and may find none.
    brdf : {"oren-nayar", "lambert", "minnaert", "spherical-harmonics"}
        Diffuse model, an entry of `lighting.shading.DIFFUSE_MODELS`; or spherical harmonics (27 parameters),
        which know neither shadows nor lamps nor highlights: neither `lights` nor `options` touch them, and
        their light has a mean of 1, not an ambient part of 1.
    view_direction : (3,) sequence of float
        Toward the viewer, for roughness and highlights. Texels whose camera the image knows have their own.
    budget : Budget or float, optional
        Seconds, or a `Budget`; when it ends the best so far is returned with ``converged=False``.
    seed : int
        Of simulated annealing and of inpainting; the default search draws nothing.
    options : EstimateOptions
    prior : AlbedoPrior, optional
        Of the albedo, in place of that which `options.prior` names.
    on_progress : callable, optional
        Called with each trace row.

    Returns
    -------
    AlbedoEstimate

    Notes
    -----
    The plan names each part of the model, and the log odds for it. `albedo.view` is a doubt where less than
    5 % of the texels face `view_direction`. The trace's error is the perplexity of a cell: one over the
    geometric mean of its probability density. Light of one colour over the whole surface is told from pigment
    only by what is known of skin, and by highlights: the mean light is nearly white. Texels that are not skin
    weigh a quarter in the search. White noise is filtered.

    References
    ----------
    .. [1] G. Toderici, G. Passalis, T. Theoharis, I. Kakadiaris, "An automated method for human face
       modeling and relighting with application to face recognition", section 3.2.
    """
    advice = "geometry_image(fitted, scan) and read_geometry_image(path) return one"
    require_type(image, GeometryImage, "estimate_albedo: image", advice)
    check_light_options(lights, brdf)
    toward = np.asarray(view_direction, float)
    length = float(np.linalg.norm(toward)) if toward.shape == (3,) else 0.0
    if not 0 < length < math.inf:
        raise ValueError(f"view_direction is {view_direction!r}, expected three finite numbers, not all zero")
    x, y, z = (toward / length).tolist()
    if brdf == "lambert" and options.choice("albedo.roughness"):
        raise ValueError("albedo.roughness is forced, but a Lambertian surface has none: choose another brdf")
    meter = Meter("albedo", "perplexity a cell", budget, on_progress)
    scene, plan = shaded_image(image, brdf, (x, y, z), options, meter, prior)
    # The systems are small: further threads of BLAS would wait for work and burn as much time again.
    with threadpool_limits(1, "blas"):
        if brdf == "spherical-harmonics":
            return divided(scene, harmonic_light(scene), None, plan, seed)
        count = None if lights == "auto" else int(lights)
        paper = options.objective == "albedo-deviation"
        found = paper_search(scene, count, seed) if paper else LightSearch(scene).run(count)
        return divided(scene, light_on_texels(scene, found), found, plan, seed)


def shaded_image(
    image: GeometryImage,
    brdf: str,
    view: tuple[float, float, float],
    options: EstimateOptions,
    meter: Meter,
    prior: AlbedoPrior | None = None,
) -> tuple[ShadedImage, Plan]:
    """Return an image as a search takes it, seen from the unit vector `view`; see `estimate_albedo`."""
    usable = usable_texels(image)
    known = lengths(image.normal) > 0.5
    if not known[image.mask].all():
        # Normals that are not known (0) are those of the nearest texels that have one.
        at = distance_transform_edt(~(known & image.mask), return_distances=False, return_indices=True)
        image = replace(image, normal=np.where(known[..., None], image.normal, image.normal[tuple(at)]))
    if options.objective == "albedo-deviation" or options.choice(_CAMERAS) is False:
        image = replace(image, camera=None, camera_positions=None)
    facing, plan = float(np.mean((image.normal @ view)[usable] > 0)), Plan()
    if facing < FEWEST:
        reason = (
            f"only {100 * facing:.1f} % of the texels face view_direction {np.round(view, 3).tolist()}, "
            "around which lights are sought, so they will be wrong; point it at the viewer, or turn the "
            "normals outward"
        )
        plan += [PlanStep.doubt("albedo.view", reason)]
    assumed = prior or AlbedoPrior.by_name(options.prior, face=image.face_chart is not None)
    return ShadedImage(image, usable, brdf, view, options, meter, assumed), plan


def divided(
    scene: ShadedImage, texel_light: TexelLight, found: LightFound | None, plan: Plan, seed: int
) -> AlbedoEstimate:
    """Remove the light from the full-size image; `found` is None for spherical harmonics."""
    image, usable, options, meter = scene.image, scene.usable, scene.options, scene.meter
    assert image.texture_linear is not None
    mask, deviation, reflectance = image.mask, None, texel_light.reflectance
    specular, shading = on_grid(mask, texel_light.specular), on_grid(mask, texel_light.light_linear)
    if found is not None and found.explanation is not None:
        best = found.explanation.best
        cells = cell_field(best.problem.level, best.light_deviation()[:, None], mask)[:, 0]
        deviation = on_grid(mask, np.hypot(cells, texel_light.deviation))
    division = divide_light(image.texture_linear, shading, specular, mask, usable)
    color = division.albedo.astype(np.float32)
    if found is None:
        plan += [PlanStep("albedo.lights", False, "spherical harmonics stand for all light", "27 parameters")]
    else:
        color, inpainting = inpainted(color, image, usable, options, seed, late=meter.out_of_time)
        plan += [*found.steps, _cameras_step(scene, reflectance), inpainting]
    color = continued_smoothly(color, mask & ~image.seen, image.seen)
    return AlbedoEstimate(
        albedo_linear=color,
        lights=texel_light.lights,
        parameters=_parameters(texel_light, harmonic=found is None),
        shading=shading.astype(np.float32),
        specular=specular.mean(-1).astype(np.float32),
        shadow=on_grid(mask, texel_light.visible.astype(np.float32)),
        confidence=division.confidence.astype(np.float32),
        plan=plan,
        trace=meter.trace,
        converged=not meter.exhausted,
        iterations=meter.evaluations,
        residual=meter.rows[-1].error,
        image=image,
        view_direction=scene.view,
        reflectance=reflectance,
        casts_shadows=found is None or scene.shadows[0] is not None,
        uncertainty=None if found is None else found.uncertainty,
        albedo_deviation=None if deviation is None else deviation.astype(np.float32),
        environment=texel_light.environment,
        expected_error=expected_error(division.deviation, deviation, mask, image.skin),
    )


def _parameters(texel_light: TexelLight, harmonic: bool) -> dict[str, object]:
    """Return the parameters of `AlbedoEstimate`."""
    if harmonic and texel_light.environment is not None:
        coefficients = open_shading(texel_light.environment)
        return {"brdf": SPHERICAL_HARMONICS, "sh_coefficients": coefficients.tolist()}
    far = not texel_light.lights or math.isinf(texel_light.lights[0].distance_mm)
    distance = None if far else texel_light.lights[0].distance_mm
    return {"ambient": 1.0, **texel_light.reflectance.parameters(), "light_distance_mm": distance}


def _cameras_step(scene: ShadedImage, reflectance: Reflectance) -> PlanStep:
    image = scene.image
    if scene.options.choice(_CAMERAS) is False:
        return PlanStep(_CAMERAS, False, "left out by the caller")
    if image.camera is None or image.camera_positions is None:
        return PlanStep(_CAMERAS, False, "no camera is known: one view direction serves", "no camera")
    known = image.camera[image.mask] != NO_CAMERA
    angle = math.degrees(math.acos(float(np.clip((scene.toward @ np.asarray(scene.view)).min(), -1, 1))))
    took = f"{len(image.camera_positions)} camera(s) took {100 * known.mean():.1f} % of the texels"
    evidence = f"{took}, from up to {angle:.0f} deg off the view direction"
    if reflectance.specular_strength == 0 and reflectance.roughness == reflectance.model.plain:
        return PlanStep(_CAMERAS, False, "what is found of the light looks alike from everywhere", evidence)
    return PlanStep(_CAMERAS, True, "each texel is seen from its camera", evidence)


def harmonic_light(scene: ShadedImage) -> TexelLight:
    """Return light as harmonics that nothing hides, of each channel's mean 1 over the usable texels.

    Minimises sum rho(w (T - a_b Y c) / mean T) over each channel's coefficients c, with the block albedos a_b
    eliminated and rho the soft L1 loss. The colours of light and albedo cannot be separated: hence the mean.

    .. [1] R. Basri, D. Jacobs, "Lambertian reflectance and linear subspaces", IEEE TPAMI 25(2), 2003.
    """
    image, size = scene.image, scene.options.sizes[2]
    assert image.texture_linear is not None
    channels = np.moveaxis(image.texture_linear, -1, 0)
    levels = [build_level(image, scene.usable, size, channel) for channel in channels]
    coefficients = np.stack([_fit_channel(level, scene.meter) for level in levels], 1)
    light = np.maximum(harmonics(image.normal[image.mask], 2) @ coefficients, DARKEST)
    nothing, environment = np.zeros_like(light), environment_of_shading(coefficients)
    seen, deviation = np.ones(len(light)), np.zeros(len(light))
    return TexelLight(light, nothing, seen, deviation, (), environment, Reflectance("lambert"))


def _fit_channel(level: Level, meter: Meter) -> FloatArray:
    """Return (9,) the coefficients of one channel."""
    basis = harmonics(level.normal, 2)
    mean = np.average(basis, axis=0, weights=level.weight)
    root, (blocks, count) = np.sqrt(level.weight), level.blocks()

    def complete(free: FloatArray) -> FloatArray:
        # The constant is chosen so that the mean shading is 1.
        return np.concatenate([[(1 - mean[1:] @ free) / mean[0]], free])

    def residual(free: FloatArray) -> FloatArray:
        meter.count()
        light = np.maximum(basis @ complete(free), DARKEST)
        parts = []
        for block in blocks:
            top = np.bincount(block, level.weight * level.value * light, count)
            bottom = np.bincount(block, level.weight * light**2, count)
            parts.append(root * (level.value - light * (top / np.maximum(bottom, 1e-12))[block]))
        return np.concatenate(parts)

    found = least_squares(residual, np.zeros(basis.shape[1] - 1), loss="soft_l1", f_scale=0.05)
    meter.record(np.mean(np.abs(found.fun)))
    return complete(found.x)
