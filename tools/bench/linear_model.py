"""Coefficients of a linear face model from scans: ours beside a fit to 51 landmarks.

The model is made of the ICT faces: identities' principal directions and twelve expressions. Scans are `own`,
shapes of the model itself as a two-pod scanner sees them (noise 0.2 mm, holes, spikes, hair, shoulders, any
pose), whose coefficients are known; `people`, each ICT person with a model made without that person, where
the least error is that of the basis itself, fitted to the true correspondences; `blendshapes`, mixtures of
three expressions as weights of twelve blendshapes, of people in the model and not; and `real`, two scans. The
peer is what flame-fitting does (`fit_lmk3d.py`): pose, then pose and coefficients, by least squares to 51
landmarks with its weights, here by SciPy; its landmarks are the true ones with 1 mm of noise (real scans:
those placed by hand). "shape sd", "expr. sd": RMS error of coefficients in standard deviations, "z" over the
stated ones; "mm" RMS of vertices, "surface mm" mean distance of the true face to the surface. Nothing was
tuned on the people; james and flame_scan were seen before.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from scipy.optimize import least_squares
from worlds.files import face_data
from worlds.fits import fitted_face
from worlds.light_stage import FACE_VERTICES, NEUTRAL, LightStage
from worlds.raw_like import raw_like

import scan2albedo as s2a
from bench.judging import rms
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting.linear_model import fit_linear_model
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, procrustes, rotation_from_vector, transform_points
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.statistics.linear_model import LinearModel, principal_directions
from scan2albedo.templates.annotated_face_model import linear_model_places

EXPRESSION_SD = 0.4
"""Of the weights of ICT's expressions, which go from 0 to 1."""
LANDMARK_MM = 1.0
METRES_WEIGHT = 1e-3
"""flame-fitting's weight of a coefficient beside landmarks in metres."""
FACE = slice(0, FACE_VERTICES)
REAL = {"james": "james_ibug68.csv", "flame_scan": "flame_scan_ibug51.csv"}
"""Scans with points placed by hand."""


def moves() -> tuple[str, ...]:
    """Return the names of the expressions, in the file's order."""
    with np.load(face_data("ict_expressions.npz")) as data:
        return tuple(data.files)


@cache
def ict_model(without: str = "") -> tuple[LinearFaceModel, IntArray]:
    """Return a model of the ICT faces but one, and the vertices of its 51 inner landmarks."""
    stage = LightStage.load()
    people = np.array([shape for name, shape in stage.shapes.items() if name != without])
    mean = people.mean(0)
    directions, _ = principal_directions(people - mean, size=float(np.sum(mean**2)))
    expressions = [EXPRESSION_SD * stage.expressions[name] for name in moves()]
    basis = np.concatenate([directions, expressions])
    model = LinearFaceModel(mean, basis, "ict", "0" * 64, len(directions), stage.face_area)
    return model, stage.landmarks[17:]


@dataclass(frozen=True)
class Scene:
    """A scan, a model with its places on the default one, and what is known in the scan's frame, mm.

    `points` (51, 3) are the landmarks that the peer gets, `surface` (N, 3) lies on the face.
    """

    scan: s2a.RawScan
    model: LinearFaceModel
    places: tuple[FloatArray, ...]
    landmarks: IntArray
    points: FloatArray
    surface: FloatArray
    truth: FloatArray | None = None
    coefficients: FloatArray | None = None


@dataclass(frozen=True)
class Answer:
    """Vertices (V, 3) in the scan's frame, coefficients (K,) and their stated deviations."""

    vertices: FloatArray
    coefficients: FloatArray | None = None
    deviation: FloatArray | None = None


def ours(scene: Scene) -> Answer:
    fitted = fitted_face(scene.scan)
    found = fit_linear_model(scene.scan, fitted, *scene.places, np.ones(len(fitted.vertices)))
    vertices = transform_points(invert_rigid(fitted.model_from_scan), found.vertices)
    return Answer(vertices, found.coefficients, found.deviation[7:])


def by_landmarks(scene: Scene) -> Answer:
    model = scene.model
    marks = model.of(scene.landmarks)
    pose = procrustes(marks.mean, scene.points)

    def placed(x: FloatArray, part: LinearModel) -> FloatArray:
        turn = rotation_from_vector(x[:3]) @ pose[:3, :3]
        return part.at(x[6:]) @ turn.T + pose[:3, 3] + x[3:6]

    def residuals(x: FloatArray) -> FloatArray:
        off_m = (placed(x, marks) - scene.points) / 1000
        return np.concatenate([off_m.ravel(), METRES_WEIGHT * x[6:]])

    x = least_squares(residuals, np.zeros(6 + model.components), method="lm").x
    return Answer(placed(x, model), x[6:])


def best_of_basis(scene: Scene) -> Answer:
    """Return the model's vertices whose face is nearest to the truth, all correspondences given."""
    model = scene.model
    coefficients = np.zeros(model.components)
    for _ in range(30):
        pose = procrustes(model.at(coefficients)[FACE], scene.truth[FACE], scale=True)
        own = transform_points(np.linalg.inv(pose), scene.truth)[FACE]
        coefficients = model.of(FACE).fit(own, prior=0).mean
    return Answer(transform_points(pose, model.at(coefficients)))


def errors(scene: Scene, answer: Answer) -> dict[str, float]:
    distance = ClosestPointQuery(answer.vertices, scene.model.faces).query(scene.surface).distance
    row = {"surface mm": float(distance.mean())}
    if scene.truth is None:
        off = answer.vertices[scene.landmarks] - scene.points
        row["landmarks mm"] = float(np.linalg.norm(off, axis=1).mean())
    else:
        row["mm"] = rms(np.linalg.norm((answer.vertices - scene.truth)[FACE], axis=1))
    if scene.coefficients is not None and answer.coefficients is not None:
        count = scene.model.shapes
        error = answer.coefficients - scene.coefficients
        if not scene.model.names:
            row |= {"shape sd": rms(error[:count]), "expr. sd": rms(error[count:])}
            row["z"] = np.nan if answer.deviation is None else rms(error / answer.deviation)
        else:
            off = np.abs(error[count:])
            row |= {"weights": float(off.mean()), "worst weight": float(off.max())}
    return row


def scene_of(
    model: LinearFaceModel,
    landmarks: IntArray,
    shape: FloatArray,
    seed: int,
    rng: np.random.Generator,
    coefficients: FloatArray | None = None,
) -> Scene:
    """Return a raw scan of a shape (V, 3)."""
    scan, scan_from_shape = raw_like(shape, model.faces, seed)
    truth = transform_points(scan_from_shape, shape)
    points = truth[landmarks] + rng.normal(0, LANDMARK_MM, (len(landmarks), 3))
    places = linear_model_places(model, s2a.AnnotatedFaceModel.default())
    return Scene(scan, model, places, landmarks, points, truth[FACE], truth, coefficients)


def own_shape(seed: int) -> Scene:
    model, landmarks = ict_model()
    rng = np.random.default_rng([0, seed])
    truth = rng.normal(size=model.components)
    # Expressions have no opposite.
    truth[model.shapes :] = np.abs(truth[model.shapes :])
    return scene_of(model, landmarks, model.at(truth), seed, rng, truth)


def person(name: str) -> Scene:
    shape = LightStage.load().shapes[name]
    return scene_of(*ict_model(name), shape, 0, np.random.default_rng(0))


def mixture(name: str, without: str, seed: int) -> Scene:
    """Return a scan of three expressions at once, for a model with ICT's blendshapes."""
    model, landmarks = ict_model(without)
    names = moves()
    basis = np.array(model.basis, float)
    basis[model.shapes :] /= EXPRESSION_SD
    rng = np.random.default_rng([0, seed])
    weights = np.zeros(len(names))
    weights[rng.choice(len(names), 3, replace=False)] = rng.uniform(0.3, 0.9, 3)
    truth = np.concatenate([np.zeros(model.shapes), weights])
    shape = LightStage.load().shapes[name] + np.tensordot(weights, basis[model.shapes :], 1)
    return scene_of(replace(model, basis=basis, names=names), landmarks, shape, seed, rng, truth)


def real_scan(name: str) -> Scene:
    model, landmarks = ict_model()
    scan = s2a.load_scan(face_data(f"{name}.obj"))
    placed = np.loadtxt(face_data(REAL[name]), delimiter=",")[-51:] * scan.mm_per_unit
    fitted = fitted_face(scan)
    known = fitted.vertices[~np.isnan(fitted.residual_mm)]
    face = transform_points(invert_rigid(fitted.model_from_scan), known)
    places = linear_model_places(model, s2a.AnnotatedFaceModel.default())
    return Scene(scan, model, places, landmarks, placed, face)


def mixtures(quick: bool) -> Iterator[Case]:
    for name in NEUTRAL[1:]:
        for without in ("", name):
            group = "person left out" if without else "person in the model"
            for seed in range(1 if quick else 3):
                yield Case(f"{name} {group} {seed}", partial(mixture, name, without, seed), group)


def cases(names: tuple[str, ...], make: Callable[[str], Scene], quick: bool) -> Iterator[Case]:
    for name in names[: 1 if quick else None]:
        yield Case(name, partial(make, name))


OURS = {"scan2albedo": ours}
LANDMARKS = {"51 landmarks": by_landmarks}
BENCHES = {
    "own": Bench(
        lambda quick: (Case(f"shape {n}", partial(own_shape, n)) for n in range(1 if quick else 8)),
        methods=OURS,
        peers=LANDMARKS,
        score=errors,
    ),
    "people": Bench(
        partial(cases, NEUTRAL[1:], person),
        methods=OURS,
        peers=LANDMARKS | {"basis, all known": best_of_basis},
        score=errors,
    ),
    "blendshapes": Bench(mixtures, methods=OURS, score=errors),
    "real": Bench(partial(cases, tuple(REAL), real_scan), methods=OURS, peers=LANDMARKS, score=errors),
}
