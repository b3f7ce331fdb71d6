"""Extremes of reflectance: flashes, vertex fits, the models, fits to photographs, landmarks."""

import math
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
from bench.judging import relative_rmse
from helpers.half_ball import HalfBall
from worlds.environments import generated_environment
from worlds.flash_captures import head_capture, of_pairs, samples_of
from worlds.two_balls import build_scene

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import compose
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    ImageObservation,
    MorphableReflectanceModel,
    MorphableShapeModel,
    VertexSamples,
    extract_olat,
    fit_image,
    fit_reflectance,
    observe_photograph,
    point_light_lobes,
    refine_geometry,
    sample_vertices,
    shade_environment,
)
from scan2albedo.synthetic import face_shape
from stability.case import (
    BUDGETS,
    Measured,
    below,
    gap,
    measured,
    refuses,
    right,
    table,
    unfinished,
    warns,
)
from stability.scenes import with_one

NAN = math.nan


def quiet(call, *arguments, **options):
    """Call, and pass over the warning that it has not converged: the result says so too."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*without having converged", RuntimeWarning)
        return call(*arguments, **options)


# Light of single flashes.


def flashes(flash, room, side=8):
    """Return the light of one flash over pictures of one value each."""
    return extract_olat(np.full((1, side, side, 3), flash), np.full((side, side, 3), room))


def complaint(olat):
    """Return what the light of flashes says of itself."""
    return Measured(olat.diagnostics[0].message)


def no_light():
    """Return how many deviations the light of a flash is that adds nothing, and the deviation."""
    olat = flashes(0.3, 0.3)
    deviations = gap(olat.linear / olat.sigma, 0)
    assert deviations < 1e-6
    return deviations, olat.sigma.max()


# Reflectance of vertices.

capture = cache(head_capture)


@cache
def samples(noise=0.01, **options):
    """Return what pictures of a head of 400 vertices show."""
    return samples_of(capture(400), noise=noise, **options)


def lobes_of(lights=None, normals=1.0):
    """Return the samples of the head under other lights, or with its normals multiplied."""
    head = capture(400)
    lights = head.lights if lights is None else np.tile(lights, (99, 1))
    lobes = point_light_lobes(head.vertices, normals * head.normals, head.cameras, lights)
    return replace(samples(), lobes=lobes)


def judged(fit, least_inside=0, scale=1.0):
    """Return the albedo's error, the part of true numbers within their intervals, and of those identified.

    All in per cent, of the vertices that a fit knows, all of it finite and in order there.
    """
    mask = fit.reflectance.known
    value, low, high, std = (field[mask] for field in (fit.parameters, fit.low, fit.high, fit.std))
    assert np.isfinite(value + low + high + std).all()
    assert (value >= np.maximum(0, low - 1e-12)).all()
    assert (value <= high + 1e-12).all()
    albedo, truth = (
        scale * field[: len(mask)][mask]
        for field in (capture(400).truth.diffuse_linear, capture(400).parameters)
    )
    inside = 100 * float(((low <= truth) & (truth <= high)).mean())
    assert inside > least_inside
    off = 100 * relative_rmse(fit.reflectance.diffuse_linear[mask], albedo)
    return off, inside, 100 * fit.identified[mask].mean()


def one_pose():
    """Return the part of the lobes identified by 99 pairs of one pose, and the albedo's error."""
    fit = fit_reflectance(samples_of(of_pairs(capture(400), np.full(99, 49)), noise=0.01))
    off, *_ = judged(fit)
    sure = float(fit.identified[fit.reflectance.known][:, 3:].mean())
    assert sure < 0.2
    return 100 * sure, off


def exposed(scale):
    """Judge pictures multiplied."""
    plain = samples()
    pictures = replace(plain, observed_linear=scale * plain.observed_linear, sigma=scale * plain.sigma)
    return judged(fit_reflectance(pictures), scale=scale)


def one_vertex():
    """Judge one vertex alone."""
    names = ("observed_linear", "sigma", "valid", "lobes")
    one = VertexSamples(*(getattr(samples(), name)[:, :1] for name in names), samples().light)
    return judged(fit_reflectance(one))


# Looking up vertices in pictures.

scene = cache(lambda: build_scene(16, 24))


def looked_up(vertices=1.0, normals=1.0):
    """Look vertices of a ball up in its pictures; the ball and its normals are multiplied."""
    ball = scene()
    olat = extract_olat(ball.flash, ball.room)
    found = sample_vertices(
        olat, ball.rig, vertices * ball.vertices, ball.faces, normals=normals * ball.normals
    )
    return fit_reflectance(found)


def observed(picture=0.5, camera=None, scale=1.0, side=64):
    """Observe a photograph of one value of the ball."""
    if camera is None:
        camera = look_at([0, 0, 900.0], [0, 0, 0], focal_px=100.0, shape=(side, side))
    pixels = np.full((side, side, 3), picture)
    return observe_photograph(pixels, camera, scale * scene().vertices, scene().faces)


# The morphable model.


BALL = HalfBall.of(300)


def strangers():
    """Return the directions and the support of a model of two subjects that share no vertex."""
    odd = np.arange(len(BALL.points)) % 2 == 1
    one, other = BALL.people(2, 0)
    model = MorphableReflectanceModel.from_samples([replace(one, known=odd), replace(other, known=~odd)])
    assert np.isfinite(model.diffuse.mean).all()
    assert model.components == 0
    return model.components, model.support.max()


def at(coefficient):
    """Evaluate a model of four subjects."""
    model = MorphableReflectanceModel.from_samples(BALL.people(4, 0), components=10)
    return model.reconstruct(np.full(model.components, coefficient))


# Photographs.

(STRANGER,) = BALL.people(1, 3)
LIGHT = project_environment(generated_environment(8))


@cache
def model():
    """Return a model of twenty people."""
    return MorphableReflectanceModel.from_samples(BALL.people(20, 0), components=8)


def shot(light=LIGHT, scale=1.0, seen=BALL.seen):
    """Return a photograph of one whom the model does not know, its colours multiplied."""
    color = shade_environment(STRANGER, BALL.normals, BALL.view, light).radiance_linear
    return ImageObservation(scale * color, BALL.normals, BALL.view, seen)


def fitted(*shown, **options):
    """Fit the model to a photograph; return the albedo's and the colours' errors in per cent, and the fit."""
    fit = quiet(fit_image, shot(*shown), model(), **options)
    return (
        100 * BALL.albedo_error(fit.face.reflectance.diffuse_linear, STRANGER),
        100 * fit.relative_rmse,
        fit,
    )


def one_direction():
    """Fit the model under one direction of light."""
    return fitted(harmonics(np.array([[0.3, 0.3, 1.0]]) / np.sqrt(1.18)).T @ np.full((1, 3), 3.0))


def one_seen():
    """Return the largest coefficient of a face of which one vertex is seen."""
    seen = with_one(BALL.seen & False, True, np.flatnonzero(BALL.seen)[10])
    return gap(fitted(LIGHT, 1.0, seen)[2].face.coefficients, 0)


# Geometry from landmarks.

CAMERA = look_at([40.0, 20.0, 900.0], [0.0, 0.0, 0.0], focal_px=1000.0, shape=(260, 220))


@cache
def shapes():
    """Return a shape model of ten people, and where the landmarks of one of them are in the picture."""
    afm = AnnotatedFaceModel.default()
    to_surface, (rest, faces) = afm.subdivision(0).matrix, afm.surface(0)
    rng = np.random.default_rng(0)
    neutral = [to_surface @ face_shape.person(afm, rng) for _ in range(10)]
    smile = to_surface @ face_shape.person(afm, rng, strength=0.0, expression="smile") - rest
    nearest = np.linalg.norm(rest - afm.landmarks[:, None], axis=2).argmin(1)
    marks = project(CAMERA, neutral[3][nearest])[0]
    return MorphableShapeModel.from_samples(neutral, [smile], faces, nearest), marks


def placed(marks=None, camera=CAMERA, **options):
    """Fit the shape model to landmarks."""
    marks = shapes()[1] if marks is None else marks
    return quiet(refine_geometry, np.full((260, 220, 3), 0.5), camera, marks, shapes()[0], **options)


def only(count):
    """Return the landmarks with all but some NaN."""
    chosen = np.linspace(0, 67, count).astype(int)
    return with_one(np.full((68, 2), NAN), shapes()[1][chosen], chosen)


def far_off(bound):
    """Return a figure: how many pixels landmarks are off that no face can have."""

    def figure(fit):
        assert fit.landmark_rmse_px > bound
        return Measured(f"landmarks off by {fit.landmark_rmse_px:.3g} px")

    return figure


ALBEDO_OFF = below(3, "albedo off by {:.1f} %")

CASES = table(
    "reflectance",
    refuses(
        "pair 0: 100 % .* exchanged",
        {
            "olat: flash and room exchanged": lambda: flashes(0.2, 0.6),
            "olat: values negative": lambda: flashes(-0.5, 0.1),
        },
    ),
    refuses(
        r"flash picture 0 reaches 1e\+06.* white = 1",
        "olat: values beyond white (HDR 1e6)",
        lambda: flashes(1e6, 0.1),
    ),
    refuses("no number", "olat: NaN everywhere", lambda: flashes(NAN, 0.2)),
    warns(complaint, "olat: saturated everywhere", lambda: flashes(1.0, 0.2)),
    warns(
        measured("light {:.0e} standard deviations: sigma {:.3f} says so"),
        "olat: flash as dark as the room",
        no_light,
    ),
    right(
        below(1e-6, "right within {:.0e}"),
        "olat: images of 1 pixel",
        lambda: gap(flashes(0.5, 0.1, 1).linear, 0.5**1.2 - 0.1**1.2),
    ),
    warns(
        measured("{:.0f} % of the lobes identified, albedo off by {:.0f} %"),
        "99 pairs, all of one pose",
        one_pose,
    ),
    refuses(
        "none of 400 vertices is seen",
        {
            "flash behind the head": lambda: fit_reflectance(lobes_of([0.0, 0.0, -1000.0])),
            "normals zero: lobes zero": lambda: fit_reflectance(lobes_of(normals=0.0)),
            "normals flipped": lambda: fit_reflectance(lobes_of(normals=-1.0)),
            "everything saturated": lambda: fit_reflectance(
                replace(samples(), valid=np.zeros_like(samples().valid))
            ),
        },
    ),
    refuses(
        "vertex 1 is said to be valid in picture 0",
        {
            "sigma 0": lambda: replace(samples(), sigma=0 * samples().sigma),
            "sigma 1e-300": lambda: replace(samples(), sigma=0 * samples().sigma + 1e-300),
            "observations NaN where valid": lambda: replace(
                samples(), observed_linear=NAN * samples().observed_linear
            ),
        },
    ),
    warns(
        measured("albedo off by {:.0f} %, {:.0f} % within the intervals, {:.0f} % identified"),
        "noise 100 %",
        lambda: judged(fit_reflectance(samples(1.0)), 80),
        slow=True,
    ),
    right(ALBEDO_OFF, "pictures times {}", exposed, ("1e-9", "1e9")),
    right(below(10, "albedo off by {:.1f} %"), "one vertex", one_vertex),
    right(
        below(5, "albedo off by {:.1f} %, {:.0f} % within the intervals"),
        "normals off by {} degrees",
        lambda angle: judged(fit_reflectance(samples(normals_off_deg=angle)), 90),
        ("1", "3", "10"),
    ),
    warns(
        measured("converged=False, albedo off by {:.1f} %"),
        "vertex fit with a budget of {}",
        lambda budget: judged(unfinished(fit_reflectance(samples(), budget=budget))),
        BUDGETS,
    ),
    refuses(
        "vertices are NaN or infinite|of length nan|none of 1024 vertices is seen",
        {
            "sampling: vertices NaN": lambda: looked_up(vertices=NAN),
            "sampling: normals NaN": lambda: looked_up(normals=NAN),
            "sampling: normals zero": lambda: looked_up(normals=0.0),
            "sampling: head scaled by 1e3, out of all pictures": lambda: looked_up(vertices=1e3),
        },
    ),
    warns(
        measured("{} directions; `support` says that each vertex was seen of {} subject"),
        "subjects of which none shares a vertex",
        strangers,
    ),
    right(
        below(4, "all there are: {} of 4 subjects"),
        "more directions asked than subjects tell",
        lambda: len(at(0.0).coefficients),
    ),
    refuses("NaN or infinite", "model coefficients NaN", lambda: at(NAN)),
    refuses("light.* NaN or infinite", "light with NaN", lambda: shot(np.full((81, 3), NAN))),
    warns(
        measured("albedo off by {:.0f} %, colours off by {:.0f} %: the fit says so"),
        "photograph under one direction of light",
        one_direction,
        slow=True,
    ),
    warns(
        measured("the mean face: coefficients up to {:.2f} deviations"),
        "photograph that shows one vertex",
        one_seen,
        slow=True,
    ),
    refuses(
        "black where the face is",
        {
            "photograph black": lambda: shot(scale=0.0),
            "photograph half negative": lambda: shot(
                scale=(1 - 2 * (np.arange(len(BALL.points)) % 2 == 0))[:, None]
            ),
        },
    ),
    refuses("vertex 10 holds NaN", "photograph with NaN where seen", lambda: shot(scale=NAN)),
    refuses("no vertex of the face", "photograph that shows nothing", lambda: shot(seen=BALL.seen & False)),
    warns(
        measured("converged=False, colours off by {:.0f} %"),
        "image fit with a budget of {}",
        lambda budget: 100 * unfinished(fitted(budget=budget)[2]).relative_rmse,
        BUDGETS,
        slow=True,
    ),
    refuses("0 inside the picture", "observing a photograph of 1 pixel", lambda: observed(side=1)),
    refuses("0 not saturated", "observing a photograph saturated", lambda: observed(1.0)),
    refuses("black where the face is", "observing a photograph black", lambda: observed(0.0)),
    refuses("0 with finite colours", "observing a photograph NaN", lambda: observed(NAN)),
    refuses("white = 1", "observing a photograph HDR 1e6", lambda: observed(1e6)),
    refuses(
        "singular",
        "observing a photograph whose camera is singular",
        lambda: observed(camera=np.zeros((3, 4))),
    ),
    refuses(
        "0 are seen by the camera",
        "observing a photograph of a head scaled by 1e3",
        lambda: observed(scale=1e3),
    ),
    refuses(
        "vertices are NaN or infinite",
        "observing a photograph of a head with NaN",
        lambda: observed(scale=NAN),
    ),
    refuses("give initial_scene_from_model", "geometry: no landmark", lambda: placed(only(0))),
    refuses("", "geometry: 3 landmarks", lambda: placed(only(3))),
    refuses("one point", "geometry: landmarks coincident", lambda: placed(np.full((68, 2), 120.0))),
    refuses("", "geometry: landmarks infinite", lambda: placed(np.full((68, 2), math.inf))),
    refuses(
        "behind the camera",
        "geometry: start behind the camera",
        lambda: placed(initial_scene_from_model=compose(np.eye(3), [0, 0, 5000])),
    ),
    refuses("", "geometry: camera NaN", lambda: placed(camera=NAN * CAMERA)),
    warns(far_off(2), "geometry: landmarks on a line", lambda: placed(shapes()[1] * [0, 1] + [110.0, 0])),
    warns(far_off(1e5), "geometry: landmarks 1e9 px off", lambda: placed(shapes()[1] + 1e9)),
    warns(
        measured("converged=False, landmarks off by {:.1f} px"),
        "geometry with a budget of {}",
        lambda budget: unfinished(placed(budget=budget)).landmark_rmse_px,
        BUDGETS,
    ),
)
