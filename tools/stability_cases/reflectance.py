"""Named extremes of reflectance: flashes, vertex fits, the models, fits to photographs, fine-tuning."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
from bench.judging import relative_rmse
from worlds.two_balls import Scene, build_scene
from worlds.environments import generated_environment
from worlds.flash_captures import Capture, head_capture, of_pairs, samples_of

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    GeometryFit,
    ImageFit,
    ImageObservation,
    MorphableReflectanceModel,
    MorphableShapeModel,
    ReflectanceFit,
    ReflectanceFitOptions,
    VertexReflectance,
    VertexSamples,
    extract_olat,
    finetune,
    fit_image,
    fit_reflectance,
    observe_photograph,
    point_light_lobes,
    refine_geometry,
    sample_vertices,
    shade_environment,
)
from scan2albedo.synthetic import face_shape
from stability_cases.case import Cases, Measured, assert_finite, naming

CASES = Cases()
STAGE = "reflectance"


def _quiet(call: Callable[[], Any]) -> Any:
    """Return what `call` does, its word that it has not converged aside: the result says so too."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*without having converged", RuntimeWarning)
        return call()


# Light of single flashes.


def _pair(flash: float, room: float, side: int = 8) -> tuple[FloatArray, FloatArray]:
    return np.full((1, side, side, 3), flash), np.full((side, side, 3), room)


@CASES.extreme(STAGE, "olat: flash and room exchanged", "named error")
@naming("pair 0: 100 % .* exchanged")
def _exchanged() -> str:
    return str(len(extract_olat(*_pair(0.2, 0.6))))


@CASES.extreme(STAGE, "olat: one pair of three exchanged", "measured warning")
def _one_exchanged() -> str:
    flash = np.full((3, 8, 8, 3), 0.6)
    flash[1] = 0.05
    olat = extract_olat(flash, np.full((8, 8, 3), 0.2))
    assert olat.valid.all((1, 2, 3)).tolist() == [True, False, True]
    return Measured(olat.diagnostics[0].message)


@CASES.extreme(STAGE, "olat: saturated everywhere", "measured warning")
def _saturated_pair() -> str:
    olat = extract_olat(*_pair(1.0, 0.2))
    assert not olat.valid.any()
    assert_finite(olat.linear, olat.sigma)
    return Measured(olat.diagnostics[0].message)


@CASES.extreme(STAGE, "olat: black room")
def _black_room() -> str:
    olat = extract_olat(*_pair(0.5, 0.0))
    error = float(np.abs(olat.linear - 0.5**1.2).max())
    assert error < 1e-6
    assert olat.sigma.min() > 0
    return f"all of the light, within {error:.0e}"


@CASES.extreme(STAGE, "olat: flash as dark as the room", "measured warning")
def _no_flash() -> str:
    olat = extract_olat(*_pair(0.3, 0.3))
    signal = float(np.abs(olat.linear / olat.sigma).max())
    assert signal < 1e-6
    return Measured(f"light {signal:.0e} standard deviations: sigma {olat.sigma.max():.3f} says so")


@CASES.extreme(STAGE, "olat: NaN everywhere", "named error")
@naming("no number")
def _nan_pair() -> str:
    return str(len(extract_olat(*_pair(math.nan, 0.2))))


@CASES.extreme(STAGE, "olat: images of 1 pixel")
def _one_pixel() -> str:
    olat = extract_olat(*_pair(0.5, 0.1, 1))
    assert abs(float(olat.linear[0, 0, 0, 0]) - (0.5**1.2 - 0.1**1.2)) < 1e-6
    return "right"


for _name, _value, _says in (
    ("negative", -0.5, "pair 0: 100 % .* exchanged"),
    ("beyond white (HDR 1e6)", 1e6, r"flash picture 0 reaches 1e\+06.* white = 1"),
):

    @CASES.extreme(STAGE, f"olat: values {_name}", "named error")
    @naming(_says)
    def _odd_values(value: float = _value) -> str:
        return str(extract_olat(*_pair(value, 0.1)).linear.max())


# Reflectance of vertices.


@cache
def _capture() -> Capture:
    return head_capture(400)


@cache
def _samples(noise: float = 0.01) -> VertexSamples:
    return samples_of(_capture(), noise=noise)


def _sound(fit: ReflectanceFit) -> ReflectanceFit:
    known = fit.reflectance.known
    assert_finite(fit.parameters[known], fit.std[known], fit.low[known], fit.high[known], fit.residual)
    assert (fit.parameters[known] >= 0).all()
    assert (fit.low[known] <= fit.parameters[known] + 1e-12).all()
    assert (fit.parameters[known] <= fit.high[known] + 1e-12).all()
    return fit


def _albedo_error(fit: ReflectanceFit, truth: FloatArray | None = None) -> float:
    known = fit.reflectance.known
    wanted = _capture().truth.diffuse_linear if truth is None else truth
    return relative_rmse(fit.reflectance.diffuse_linear[known], wanted[known])


def _sure(fit: ReflectanceFit) -> float:
    return float(fit.identified[fit.reflectance.known].mean())


for _count in (1, 2, 5):

    @CASES.extreme(STAGE, f"{_count} pairs", "measured warning")
    def _few(count: int = _count) -> str:
        pairs = np.linspace(30, 60, count).astype(int)
        fit = _sound(fit_reflectance(samples_of(of_pairs(_capture(), pairs), noise=0.01)))
        truth, known = _capture().parameters, fit.reflectance.known
        inside = float(((fit.low <= truth) & (truth <= fit.high))[known].mean())
        assert inside > 0.75
        return Measured(
            f"albedo off by {100 * _albedo_error(fit):.0f} %, {100 * _sure(fit):.0f} % identified, "
            f"{100 * inside:.0f} % within the intervals"
        )


@CASES.extreme(STAGE, "99 pairs, all of one pose", "measured warning")
def _one_pose() -> str:
    fit = _sound(fit_reflectance(samples_of(of_pairs(_capture(), np.full(99, 49)), noise=0.01)))
    sure = float(fit.identified[fit.reflectance.known][:, 3:].mean())
    assert sure < 0.2
    return Measured(
        f"{100 * sure:.0f} % of the lobes identified, albedo off by {100 * _albedo_error(fit):.0f} %"
    )


@CASES.extreme(STAGE, "flash at grazing", "measured warning", slow=True)
def _grazing() -> str:
    capture = replace(_capture(), lights=np.tile([2000.0, 0.0, -200.0], (99, 1)))
    fit = _sound(fit_reflectance(samples_of(capture, noise=0.01)))
    known = float(fit.reflectance.known.mean())
    return Measured(
        f"{100 * known:.0f} % of the vertices known, {100 * _sure(fit):.0f} % of their numbers identified"
    )


@CASES.extreme(STAGE, "flash behind the head", "named error")
def _behind() -> str:
    capture, behind = _capture(), np.tile([0.0, 0.0, -1000.0], (99, 1))
    lobes = point_light_lobes(capture.vertices, capture.normals, capture.cameras, behind)
    return str(fit_reflectance(replace(_samples(), lobes=lobes)).residual)


@CASES.extreme(STAGE, "flash at the head itself")
def _touching() -> str:
    capture = replace(_capture(), lights=np.tile(_capture().vertices[0], (99, 1)))
    lobes = point_light_lobes(capture.vertices, capture.normals, capture.cameras, capture.lights)
    assert_finite(lobes)
    assert not lobes[:, 0].any()
    return "no light at the vertex it touches, finite elsewhere"


@CASES.extreme(STAGE, "noise 0 (sigma at its floor)")
def _noiseless() -> str:
    fit = _sound(fit_reflectance(_samples(0.0)))
    error = _albedo_error(fit)
    assert error < 1e-3
    return f"albedo off by {100 * error:.4f} %"


@CASES.extreme(STAGE, "sigma 0", "named error")
@naming("vertex 1 is said to be valid in picture 0.*sigma is not above")
def _no_sigma() -> str:
    return str(replace(_samples(), sigma=np.zeros_like(_samples().sigma)).sigma.max())


@CASES.extreme(STAGE, "sigma 1e-300", "named error")
@naming("sigma is not above")
def _tiny_sigma() -> str:
    return str(replace(_samples(0.0), sigma=np.full_like(_samples(0.0).sigma, 1e-300)).sigma.max())


@CASES.extreme(STAGE, "noise 100 %", "measured warning", slow=True)
def _noise() -> str:
    fit = _sound(fit_reflectance(_samples(1.0)))
    truth, known = _capture().parameters, fit.reflectance.known
    inside = float(((fit.low <= truth) & (truth <= fit.high))[known].mean())
    assert inside > 0.8
    return Measured(
        f"albedo off by {100 * _albedo_error(fit):.0f} %, {100 * inside:.0f} % within the intervals, "
        f"{100 * _sure(fit):.0f} % identified"
    )


@CASES.extreme(STAGE, "everything saturated", "named error")
@naming("none of 400 vertices is seen")
def _nothing_valid() -> str:
    return str(fit_reflectance(replace(_samples(), valid=np.zeros_like(_samples().valid))).residual)


@CASES.extreme(STAGE, "observations NaN where valid", "named error")
@naming("vertex 1 is said to be valid in picture 0")
def _nan_observed() -> str:
    observed = _samples().observed_linear.copy()
    observed[_samples().valid] = math.nan
    return str(replace(_samples(), observed_linear=observed).observed_linear.shape)


for _name, _scale in (("1e-9", 1e-9), ("1e9", 1e9)):

    @CASES.extreme(STAGE, f"pictures times {_name}")
    def _exposed(scale: float = _scale) -> str:
        given = _samples()
        fit = _sound(
            fit_reflectance(
                replace(given, observed_linear=scale * given.observed_linear, sigma=scale * given.sigma)
            )
        )
        error = _albedo_error(fit, scale * _capture().truth.diffuse_linear)
        assert error < 0.03
        return f"albedo off by {100 * error:.1f} %"


@CASES.extreme(STAGE, "black face")
def _black_face() -> str:
    given = _samples()
    fit = _sound(fit_reflectance(replace(given, observed_linear=np.zeros_like(given.observed_linear))))
    assert fit.reflectance.diffuse_linear[fit.reflectance.known].max() < 1e-4
    return "black"


@CASES.extreme(STAGE, "one vertex")
def _one_vertex() -> str:
    given = _samples()
    one = VertexSamples(
        given.observed_linear[:, :1], given.sigma[:, :1], given.valid[:, :1], given.lobes[:, :1], given.light
    )
    fit = _sound(fit_reflectance(one))
    error = _albedo_error(fit, _capture().truth.diffuse_linear[:1])
    assert error < 0.1
    return f"albedo off by {100 * error:.1f} %"


@CASES.extreme(STAGE, "normals zero: lobes zero", "named error")
def _no_lobes() -> str:
    capture = _capture()
    zero = np.zeros_like(capture.normals)
    lobes = point_light_lobes(capture.vertices, zero, capture.cameras, capture.lights)
    assert_finite(lobes)
    return str(fit_reflectance(replace(_samples(), lobes=lobes)).residual)


@CASES.extreme(STAGE, "normals flipped", "named error")
def _inside_out() -> str:
    capture = _capture()
    lobes = point_light_lobes(capture.vertices, -capture.normals, capture.cameras, capture.lights)
    return str(fit_reflectance(replace(_samples(), lobes=lobes)).residual)


for _angle in (1.0, 3.0, 10.0):

    @CASES.extreme(STAGE, f"normals off by {_angle:.0f} degrees")
    def _tilted(angle: float = _angle) -> str:
        fit = _sound(fit_reflectance(samples_of(_capture(), noise=0.01, normals_off_deg=angle)))
        truth, known = _capture().parameters, fit.reflectance.known
        inside = float(((fit.low <= truth) & (truth <= fit.high))[known].mean())
        error = _albedo_error(fit)
        assert error < 0.05
        assert inside > 0.9
        return f"albedo off by {100 * error:.1f} %, {100 * inside:.0f} % within the intervals"


@CASES.extreme(STAGE, "normals that hide full light, strength known", "measured warning")
def _impossible() -> str:
    given = _samples()
    lobes = given.lobes.copy()
    lobes[:, :100, 0] *= 0.1
    options = ReflectanceFitOptions(most_albedo=1.0)
    fit = _sound(fit_reflectance(replace(given, lobes=lobes, slopes=None), options=options))
    largest = float(fit.reflectance.diffuse_linear[fit.reflectance.known].max())
    assert largest > 1
    assert not fit.identified[fit.impossible].any()
    return Measured(f"albedo up to {largest:.1f}, {fit.impossible.sum()} vertices told as impossible")


for _name, _budget in (("1e-3 s", Budget(seconds=1e-3)), ("1 evaluation", Budget(evaluations=1))):

    @CASES.extreme(STAGE, f"vertex fit with a budget of {_name}", "measured warning")
    def _spent(budget: Budget = _budget) -> str:
        fit = _sound(fit_reflectance(_samples(), budget=budget))
        assert not fit.converged
        return Measured(f"converged=False, albedo off by {100 * _albedo_error(fit):.1f} %")


# Looking up vertices in pictures.


@cache
def _scene() -> Scene:
    return build_scene(16, 24)


def _looked_up(**changes: Any) -> VertexSamples:
    scene = _scene()
    given = {"vertices": scene.vertices, "faces": scene.faces, "normals": scene.normals} | changes
    olat = extract_olat(scene.flash, scene.room)
    return sample_vertices(olat, scene.rig, given["vertices"], given["faces"], normals=given["normals"])


for _name, _change, _says in (
    ("vertices NaN", {"vertices": np.full_like(_scene().vertices, math.nan)}, "vertices are NaN or infinite"),
    ("normals NaN", {"normals": np.full_like(_scene().normals, math.nan)}, "of length nan"),
    ("normals zero", {"normals": np.zeros_like(_scene().normals)}, "none of 1024 vertices is seen"),
):

    @CASES.extreme(STAGE, f"sampling: {_name}", "named error")
    @naming(_says)
    def _odd_sampling(change: dict[str, Any] = _change) -> str:
        return str(fit_reflectance(_looked_up(**change)).residual)


@CASES.extreme(STAGE, "sampling: head scaled by 1e3, out of all pictures", "named error")
def _giant() -> str:
    return str(fit_reflectance(_looked_up(vertices=1e3 * _scene().vertices)).residual)


# The morphable model.


def _albedo_off(model: MorphableReflectanceModel, sample: VertexReflectance) -> float:
    off = model.project(sample).reflectance.diffuse_linear - sample.diffuse_linear
    return float(np.sqrt(np.mean(off**2)))


def _faces(count: int, seed: int = 0, vertices: int = 60) -> list[VertexReflectance]:
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        weights = np.abs(0.1 + 0.02 * rng.normal(size=(vertices, 3)))
        diffuse = np.abs(0.4 + 0.05 * rng.normal(size=(vertices, 3)))
        made.append(VertexReflectance(diffuse, weights, np.ones(vertices, bool)))
    return made


for _count in (1, 2):

    @CASES.extreme(STAGE, f"model of {_count} subject(s)")
    def _small(count: int = _count) -> str:
        samples = _faces(count)
        model = MorphableReflectanceModel.from_samples(samples)
        error = max(_albedo_off(model, s) for s in samples)
        assert model.components == count - 1
        assert error < 1e-12
        return f"{model.components} direction(s), its subjects within {error:.0e}"


@CASES.extreme(STAGE, "model of identical subjects")
def _clones() -> str:
    model = MorphableReflectanceModel.from_samples(_faces(1) * 5)
    assert_finite(model.mean, model.deviation)
    error = _albedo_off(model, _faces(1)[0])
    assert model.components == 0
    assert error < 1e-12
    return f"0 directions, the subject within {error:.0e}"


@CASES.extreme(STAGE, "more directions asked than subjects tell")
def _too_many() -> str:
    model = MorphableReflectanceModel.from_samples(_faces(4), components=10)
    assert model.components == 3
    return "all there are: 3 of 4 subjects"


@CASES.extreme(STAGE, "subjects with gaps that are NaN")
def _gaps() -> str:
    samples = []
    for k, face in enumerate(_faces(8)):
        known = np.ones(60, bool)
        known[5 * k : 5 * k + 5] = False
        diffuse, weights = face.diffuse_linear.copy(), face.weights.copy()
        diffuse[~known], weights[~known] = math.nan, math.nan
        samples.append(VertexReflectance(diffuse, weights, known))
    model = MorphableReflectanceModel.from_samples(samples)
    assert_finite(model.diffuse.mean[model.known], model.diffuse.basis[:, model.known], model.deviation)
    return f"{model.components} directions, {int(model.known.sum())} of 60 vertices known to the model"


@CASES.extreme(STAGE, "subjects of which none shares a vertex", "measured warning")
def _strangers() -> str:
    samples = []
    for k, face in enumerate(_faces(2)):
        known = np.arange(60) % 2 == k
        samples.append(VertexReflectance(face.diffuse_linear, face.weights, known))
    model = MorphableReflectanceModel.from_samples(samples)
    assert_finite(model.diffuse.mean)
    assert model.components == 0
    assert model.support.max() == 1
    return Measured("0 directions; `support` says that each vertex was seen of one subject")


@CASES.extreme(STAGE, "model coefficients 1e6", "measured warning")
def _far_out() -> str:
    model = MorphableReflectanceModel.from_samples(_faces(6))
    found = model.reconstruct(np.full(model.components, 1e6))
    assert_finite(found.reflectance.diffuse_linear, found.reflectance.weights)
    assert found.reflectance.diffuse_linear.min() >= 0
    return Measured(f"{100 * found.clipped_share:.0f} % of its numbers clipped at 0: the result says so")


@CASES.extreme(STAGE, "model coefficients NaN", "named error")
@naming("NaN or infinite")
def _nan_coefficients() -> str:
    model = MorphableReflectanceModel.from_samples(_faces(6))
    return str(model.reconstruct(np.full(model.components, math.nan)).clipped_share)


# Photographs.

DIRECTIONS = distant_directions(300)
NORMALS = DIRECTIONS[DIRECTIONS[:, 2] > 0]
VIEW = np.array([0, 0, 3.0]) - NORMALS
VIEW /= np.linalg.norm(VIEW, axis=1, keepdims=True)
SEEN = np.einsum("vi,vi->v", NORMALS, VIEW) > 0.1


@cache
def _people(count: int, seed: int = 0) -> tuple[VertexReflectance, ...]:
    """Return smooth reflectances over a hemisphere, twelve ways to differ."""
    shapes = np.random.default_rng(7).normal(size=(8, 12, 81)) @ harmonics(NORMALS).T * 0.4
    rng, made = np.random.default_rng(seed), []
    for _ in range(count):
        fields = np.einsum("r,frv->fv", rng.normal(size=12) / np.sqrt(np.arange(1, 13)), shapes)
        diffuse = np.array([0.55, 0.38, 0.30]) * np.exp(0.1 * fields[0, :, None] + 0.03 * fields[1:4].T)
        lobes = np.exp(0.1 * fields[5:8].T) * [0.2, 0.4, 0.4]
        weights = 0.25 * np.exp(0.1 * fields[4])[:, None] * lobes / lobes.sum(1, keepdims=True)
        made.append(VertexReflectance(diffuse, weights, np.ones(len(NORMALS), bool)))
    return tuple(made)


@cache
def _model() -> MorphableReflectanceModel:
    return MorphableReflectanceModel.from_samples(_people(20), components=8)


def _shot(light: FloatArray | None = None, seed: int = 3) -> ImageObservation:
    given = project_environment(generated_environment(8)) if light is None else light
    color = shade_environment(_people(1, seed)[0], NORMALS, VIEW, given).radiance_linear
    return ImageObservation(color, NORMALS, VIEW, SEEN)


def _image_fit(shot: ImageObservation, **given: Any) -> ImageFit:
    fit = _quiet(lambda: fit_image(shot, _model(), **given))
    assert_finite(fit.face.coefficients, fit.light, fit.scale_rgb, fit.relative_rmse, fit.objective)
    return fit


def _image_error(fit: ImageFit, seed: int = 3) -> float:
    found, truth = fit.face.reflectance.diffuse_linear, _people(1, seed)[0].diffuse_linear
    scale = (found * truth).sum() / (found**2).sum()
    return relative_rmse(scale * found, truth)


@CASES.extreme(STAGE, "environment black")
def _night() -> str:
    lit = shade_environment(_people(1)[0], NORMALS, VIEW, np.zeros((81, 3)))
    assert not lit.radiance_linear.any()
    return "black"


@CASES.extreme(STAGE, "environment HDR 1e6 in one texel")
def _sun() -> str:
    sky = np.full((16, 32, 3), 0.1)
    sky[5, 16] = 1e6
    coefficients = project_environment(sky)
    lit = shade_environment(_people(1)[0], NORMALS, VIEW, coefficients)
    assert_finite(lit.radiance_linear)
    half = shade_environment(_people(1)[0], NORMALS, VIEW, 0.5 * coefficients)
    assert np.abs(lit.radiance_linear - 2 * half.radiance_linear).max() < 1e-6 * lit.radiance_linear.max()
    return f"finite and linear; the series of order 8 rings down to {lit.radiance_linear.min():.0f}"


@CASES.extreme(STAGE, "light with NaN", "named error")
@naming("light.* NaN or infinite")
def _nan_light() -> str:
    return str(shade_environment(_people(1)[0], NORMALS, VIEW, np.full((81, 3), math.nan)).diffuse_linear)


@CASES.extreme(STAGE, "photograph under one direction of light", "measured warning", slow=True)
def _one_direction() -> str:
    light = harmonics(np.array([[0.3, 0.3, 1.0]]) / np.sqrt(1.18)).T @ np.full((1, 3), 3.0)
    fit = _image_fit(_shot(light))
    return Measured(
        f"albedo off by {100 * _image_error(fit):.0f} %, colours off by {100 * fit.relative_rmse:.0f} %: "
        "the fit says so"
    )


for _name, _scale in (("1e-6", 1e-6), ("1e6", 1e6)):

    @CASES.extreme(STAGE, f"photograph times {_name}", slow=True)
    def _exposure(scale: float = _scale) -> str:
        plain = _shot()
        fit = _image_fit(replace(plain, observed_linear=scale * np.asarray(plain.observed_linear)))
        error, without = _image_error(fit), _image_error(_image_fit(plain))
        assert abs(error - without) < 1e-6
        assert error < 0.8 * relative_rmse(_model().diffuse.mean, _people(1, 3)[0].diffuse_linear)
        return f"albedo off by {100 * error:.1f} %, as without the factor"


@CASES.extreme(STAGE, "photograph black", "named error")
@naming("black where the face is")
def _black_shot() -> str:
    return str(replace(_shot(), observed_linear=np.zeros_like(NORMALS)).seen)


@CASES.extreme(STAGE, "photograph with NaN where seen", "named error")
@naming("vertex 10 holds NaN")
def _nan_shot() -> str:
    return str(replace(_shot(), observed_linear=np.full_like(NORMALS, math.nan)).seen)


@CASES.extreme(STAGE, "photograph of one colour channel", "measured warning", slow=True)
def _red_shot() -> str:
    color = np.asarray(_shot().observed_linear).copy()
    color[:, 1:] = 0
    fit = _image_fit(replace(_shot(), observed_linear=color))
    assert fit.scale_rgb[1] < 0.1 * fit.scale_rgb[0]
    return Measured(f"the light's colour takes it: scales {np.round(fit.scale_rgb / fit.scale_rgb[0], 3)}")


@CASES.extreme(STAGE, "photograph that shows one vertex", "measured warning", slow=True)
def _one_seen() -> str:
    seen = np.zeros(len(NORMALS), bool)
    seen[np.flatnonzero(SEEN)[10]] = True
    fit = _image_fit(replace(_shot(), seen=seen))
    return Measured(f"the mean face: coefficients up to {np.abs(fit.face.coefficients).max():.2f} deviations")


@CASES.extreme(STAGE, "photograph that shows nothing", "named error")
@naming("no vertex of the face")
def _none_seen() -> str:
    return str(replace(_shot(), seen=np.zeros(len(NORMALS), bool)).seen)


@CASES.extreme(STAGE, "photograph half negative", "named error")
@naming("black where the face is")
def _negative_shot() -> str:
    color = np.asarray(_shot().observed_linear).copy()
    color[::2] *= -1
    fit = _image_fit(replace(_shot(), observed_linear=color))
    return f"colours off by {100 * fit.relative_rmse:.0f} %"


for _name, _budget in (("1e-3 s", Budget(seconds=1e-3)), ("1 evaluation", Budget(evaluations=1))):

    @CASES.extreme(STAGE, f"image fit with a budget of {_name}", "measured warning", slow=True)
    def _image_spent(budget: Budget = _budget) -> str:
        fit = _image_fit(_shot(), budget=budget)
        assert not fit.converged
        return Measured(f"converged=False, colours off by {100 * fit.relative_rmse:.0f} %")


def _observed(image: FloatArray, **changes: Any) -> ImageObservation:
    scene = _scene()
    camera = changes.get("camera", look_at([0, 0, 900.0], [0, 0, 0], focal_px=100.0, shape=image.shape[:2]))
    return observe_photograph(image, camera, changes.get("vertices", scene.vertices), scene.faces)


GREY = np.full((64, 64, 3), 0.5)
AWAY = look_at([0, 0, 900.0], [0, 0, 2000.0], focal_px=100.0, shape=(64, 64))
NO_NUMBER = np.full_like(_scene().vertices, math.nan)

for _name, _image, _changes, _says in (
    ("of 1 pixel", np.full((1, 1, 3), 0.5), {}, "0 inside the picture"),
    ("saturated", np.ones((64, 64, 3)), {}, "0 not saturated"),
    ("black", np.zeros((64, 64, 3)), {}, "black where the face is"),
    ("NaN", np.full((64, 64, 3), math.nan), {}, "0 with finite colours"),
    ("HDR 1e6", np.full((64, 64, 3), 1e6), {}, "white = 1"),
    ("whose camera sees nothing", GREY, {"camera": AWAY}, "0 are seen by the camera"),
    ("whose camera is singular", GREY, {"camera": np.zeros((3, 4))}, "singular"),
    ("of a head scaled by 1e3", GREY, {"vertices": 1e3 * _scene().vertices}, "0 are seen by the camera"),
    ("of a head with NaN", GREY, {"vertices": NO_NUMBER}, "vertices are NaN or infinite"),
):

    @CASES.extreme(STAGE, f"observing a photograph {_name}", "named error")
    @naming(_says)
    def _odd_photograph(image: FloatArray = _image, changes: dict[str, Any] = _changes) -> str:
        return str(int(np.asarray(_observed(image, **changes).seen).sum()))


# Geometry from landmarks.

CAMERA = look_at([40.0, 20.0, 900.0], [0.0, 0.0, 0.0], focal_px=1000.0, shape=(260, 220))
BLANK = np.full((260, 220, 3), 0.5)


@cache
def _shapes() -> tuple[MorphableShapeModel, FloatArray]:
    """Return a model of ten people, and the vertices of one it does not know."""
    afm = AnnotatedFaceModel.default()
    to_surface, (rest, faces) = afm.subdivision(0).matrix, afm.surface(0)
    rng = np.random.default_rng(0)
    neutral = [to_surface @ face_shape.person(afm, rng) for _ in range(10)]
    smile = to_surface @ face_shape.person(afm, rng, strength=0.0, expression="smile") - rest
    nearest = np.linalg.norm(rest - afm.landmarks[:, None], axis=2).argmin(1)
    return MorphableShapeModel.from_samples(neutral, [smile], faces, nearest), neutral[3]


def _marks() -> FloatArray:
    model, truth = _shapes()
    return project(CAMERA, truth[model.landmark_vertices])[0]


def _geometry(marks: FloatArray, camera: FloatArray = CAMERA, **given: Any) -> GeometryFit:
    fit = _quiet(lambda: refine_geometry(BLANK, camera, marks, _shapes()[0], **given))
    assert_finite(fit.vertices, fit.identity, fit.expression, fit.scene_from_model)
    return fit


def _only(count: int) -> FloatArray:
    marks = np.full((68, 2), math.nan)
    chosen = np.linspace(0, 67, count).astype(int)
    marks[chosen] = _marks()[chosen]
    return marks


@CASES.extreme(STAGE, "geometry: no landmark", "named error")
@naming("give initial_scene_from_model")
def _no_marks() -> str:
    return str(_geometry(_only(0)).iterations)


@CASES.extreme(STAGE, "geometry: 3 landmarks", "named error")
def _three() -> str:
    return str(_geometry(_only(3)).landmark_rmse_px)


@CASES.extreme(STAGE, "geometry: 3 landmarks, pose given", "measured warning")
def _three_posed() -> str:
    fit = _geometry(_only(3), initial_scene_from_model=np.eye(4))
    off = np.linalg.norm(fit.vertices - _shapes()[1], axis=1).mean()
    return Measured(f"{np.isfinite(fit.landmark_error_px).sum()} landmarks used, shape off by {off:.1f} mm")


@CASES.extreme(STAGE, "geometry: landmarks coincident", "named error")
@naming("one point")
def _one_place() -> str:
    return str(_geometry(np.full((68, 2), 120.0)).landmark_rmse_px)


@CASES.extreme(STAGE, "geometry: landmarks on a line", "measured warning")
def _one_line() -> str:
    marks = _marks().copy()
    marks[:, 0] = 110.0
    fit = _geometry(marks)
    assert fit.landmark_rmse_px is not None
    assert fit.landmark_rmse_px > 2
    return Measured(f"landmarks off by {fit.landmark_rmse_px:.0f} px")


@CASES.extreme(STAGE, "geometry: landmarks 1e9 px off", "measured warning")
def _far_marks() -> str:
    fit = _geometry(_marks() + 1e9)
    assert fit.landmark_rmse_px is not None
    assert fit.landmark_rmse_px > 1e5
    return Measured(f"landmarks off by {fit.landmark_rmse_px:.0e} px")


@CASES.extreme(STAGE, "geometry: landmarks infinite", "named error")
def _infinite_marks() -> str:
    return str(_geometry(np.full((68, 2), math.inf)).landmark_rmse_px)


@CASES.extreme(STAGE, "geometry: start behind the camera", "named error")
@naming("behind the camera")
def _behind_camera() -> str:
    start = np.eye(4)
    start[2, 3] = 5000
    return str(_geometry(_marks(), initial_scene_from_model=start).landmark_rmse_px)


@CASES.extreme(STAGE, "geometry: camera NaN", "named error")
def _nan_camera() -> str:
    return str(_geometry(_marks(), np.full((3, 4), math.nan)).landmark_rmse_px)


@CASES.extreme(STAGE, "geometry: all landmarks")
def _all_marks() -> str:
    fit = _geometry(_marks())
    assert fit.landmark_rmse_px is not None
    assert fit.landmark_rmse_px < 1
    return f"landmarks within {fit.landmark_rmse_px:.2f} px"


for _name, _budget in (("1e-3 s", Budget(seconds=1e-3)), ("1 evaluation", Budget(evaluations=1))):

    @CASES.extreme(STAGE, f"geometry with a budget of {_name}", "measured warning")
    def _geometry_spent(budget: Budget = _budget) -> str:
        fit = _geometry(_marks(), budget=budget)
        assert not fit.converged
        return Measured(f"converged=False, landmarks off by {fit.landmark_rmse_px:.1f} px")


# Fine-tuning.


@cache
def _skin_faces() -> IntArray:
    from scipy.spatial import ConvexHull

    faces = ConvexHull(np.vstack([NORMALS, [0, 0, -0.01]])).simplices
    return np.asarray(faces[~(len(NORMALS) == faces).any(1)], np.int64)


def _tuned(observations: list[ImageObservation], held_out: list[ImageObservation], **given: Any) -> str:
    with patch("scan2albedo.reflectance.finetune.ROUNDS", 1):
        tuning = _quiet(
            lambda: finetune(_model(), observations, held_out, _skin_faces(), vertices=100 * NORMALS, **given)
        )
    assert_finite(tuning.model.diffuse.mean, tuning.model.deviation, tuning.held_out_after)
    assert tuning.held_out_after <= tuning.held_out_before
    return (
        f"{len(tuning.accepted_steps)} steps taken, held-out error {tuning.held_out_before:.4f} -> "
        f"{tuning.held_out_after:.4f}, converged={tuning.converged}"
    )


@CASES.extreme(STAGE, "fine-tuning with 1 picture, 1 held out", slow=True)
def _one_picture() -> str:
    return _tuned([_shot(seed=4)], [_shot(seed=5)])


@CASES.extreme(STAGE, "fine-tuning with a budget of 1 evaluation", "measured warning", slow=True)
def _tuning_spent() -> str:
    told = _tuned([_shot(seed=4)], [_shot(seed=5)], budget=Budget(evaluations=1))
    assert "converged=False" in told
    return Measured(told)
