"""Landmarks of fits beside those placed by hand: error by feature, and what the stated deviation is worth.

"james" and "flame_scan" are real scans with points placed by hand, "traced" path-traced whole heads,
"neutral" light-stage shapes made raw, "expressions" each of twelve at weights 0.6 and 1. Every scan is
registered and fitted with the default model, without any help, by shape alone, with five landmarks given,
with one of these 25 mm off, and with those that MediaPipe finds (where the extra [landmarks] is installed).
"MediaPipe" are these landmarks themselves; "nricp_amberg" (the extra [peers]) deforms the default model from
the pose that ours has found. Errors are mean distances in mm over the 51 inner points of iBUG-68; "within 1"
and "2" are shares of coordinates within one and two stated deviations: 68 % and 95 % where these are right;
"above" is by how much placed landmarks lie above the model's, mm. `mouths` asks of 200 scans of shut mouths
with many expressions and of open jaws whether the jaw was judged rightly; `lamps` paints shapes in one colour
under a lamp, and shows by how much landmarks get worse when colours are looked at; `glasses` puts glasses
with lenses on shapes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count

import numpy as np
from worlds.door import PLACED, WRONG_BY_MM
from worlds.files import DATA, face_data
from worlds.fits import fitted_face
from worlds.glasses_on_head import worn_glasses
from worlds.light_stage import LightStage
from worlds.raw_like import raw_like

import scan2albedo as s2a
from bench.peers.fit import deformed
from bench.runner import Bench, Case, Timed
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.landmarks import PLACED_SIGMA_MM, PlacedLandmarks
from scan2albedo.fitting import FitOptions, FittedFace
from scan2albedo.fitting.landmark_pull import EYES
from scan2albedo.geometry.closest_points import ClosestPointQuery, NearestSurface
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.pipeline.detected_landmarks import detected_landmarks
from scan2albedo.synthetic import raw_scan
from scan2albedo.synthetic.sitter import join

INNER = slice(17, 68)
"""iBUG-68 numbers of brows, nose, eyes and lips."""
FEATURES = {
    "brows": slice(17, 27),
    "bridge": slice(27, 31),
    "nostrils": slice(31, 36),
    "eyes": slice(36, 48),
    "lips": slice(48, 68),
}
NOSE_TOP = [27]
BROW_ENDS = [21, 22]
"""Points that those who place landmarks put at different heights."""
KEY_POINTS = (51, 39, 42, 48, 54)
"""Five that other libraries have, too: the nose, corners of the eyes and of the mouth."""
WEIGHTS = (0.6, 1.0)
"""Of expressions."""
SHUT = ("cheek_puff", "mouth_frown", "mouth_pucker", "mouth_roll_lower", "mouth_roll_upper", "mouth_upper_up")
"""Expressions that leave the jaw shut; lips may part by some mm."""
OWN_SHUT = ("neutral", "smile", "frown", "pout", "puff")
LAMPS_DEG = ((0, 0), (0, 50), (0, 70), (0, 90), (0, -50), (50, 30), (-60, 0), (30, -40))
"""Directions of lamps: to the left of the face's front, and above it."""
SKIN = (0.8, 0.55, 0.45)
AMBIENT = 0.08
LENS_MM = 13.0
"""Between lids and lenses, as tight sunglasses stand. Farther ones draw a fit less."""
BY_EYES_MM = 28.0


@dataclass(frozen=True)
class Scene:
    """A scan and its landmarks (68, 3) in mm in its frame, NaN where nobody placed one."""

    scan: s2a.RawScan
    landmarks: FloatArray


@dataclass(frozen=True)
class Found:
    """Offsets of landmarks (68, 3) in mm, along the model's axes, and their stated deviations (68,)."""

    offset_mm: FloatArray
    deviation_mm: FloatArray


def james() -> Scene:
    placed = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")
    return Scene(s2a.load_scan(face_data("james.obj")), placed)


def flame_scan() -> Scene:
    inner = 1000 * np.loadtxt(face_data("flame_scan_ibug51.csv"), delimiter=",")
    placed = np.concatenate([np.full((17, 3), np.nan), inner])
    return Scene(s2a.load_scan(face_data("flame_scan.obj")), placed)


def traced(name: str) -> Scene:
    file = DATA / "traced" / f"{name}.obj"
    with np.load(file.with_name(f"{name}_truth.npz")) as truth:
        placed = truth["vertices_mm"][truth["landmarks68"]]
        placed = transform_points(truth["scan_from_truth"], placed) * float(truth["unit_mm"])
    return Scene(s2a.load_scan(file), placed)


def light_stage(person: str, move: str, weight: float, seed: int) -> Scene:
    people = LightStage.load()
    shape = people.shapes[person]
    if move:
        shape = shape + weight * people.expressions[move]
    scan, scan_from_shape = raw_like(shape, people.faces, seed)
    return Scene(scan, transform_points(scan_from_shape, shape[people.landmarks]))


def cases(quick: bool) -> Iterator[Case]:
    yield Case("james", james, "james")
    if quick:
        return
    yield Case("flame_scan", flame_scan, "flame_scan")
    for file in sorted((DATA / "traced").glob("p*_truth.npz")):
        name = file.stem.removesuffix("_truth")
        yield Case(name, partial(traced, name), "traced")
    people = list(LightStage.load().shapes)
    for seed, name in enumerate(people):
        yield Case(name, partial(light_stage, name, "", 0.0, seed), "neutral")
    for seed, move in enumerate(LightStage.load().expressions):
        person = people[seed % len(people)]
        for weight in WEIGHTS:
            name = f"{move} {person} {weight}"
            yield Case(name, partial(light_stage, person, move, weight, 100 + seed), "expressions")


def fitted(scene: Scene, landmarks: PlacedLandmarks | None = None, colors: bool = True) -> Found:
    scan = replace(scene.scan, landmarks=landmarks)
    face = fitted_face(scan, options=FitOptions(colors=colors))
    return of_fit(face, scene.landmarks)


def of_fit(face: FittedFace, placed: FloatArray) -> Found:
    return Found(face.landmarks - transform_points(face.model_from_scan, placed), face.landmark_deviation_mm)


def with_five(scene: Scene, one_wrong: bool) -> Found:
    """Fit with five landmarks given, placed to 1.5 mm along each axis; the last may be wrong."""
    points = np.full((68, 3), np.nan)
    five = list(PLACED)
    noise = np.random.default_rng(5).normal(scale=PLACED_SIGMA_MM, size=(len(five), 3))
    points[five] = scene.landmarks[five] + noise
    if one_wrong:
        points[five[-1]] += WRONG_BY_MM
    return fitted(scene, PlacedLandmarks.of(points))


def pose_of(scene: Scene) -> FloatArray:
    return s2a.register(scene.scan, s2a.AnnotatedFaceModel.default()).model_from_scan


def detected(scene: Scene) -> PlacedLandmarks:
    import mediapipe  # noqa: F401 (its absence is to be reported)

    found = detected_landmarks(scene.scan, pose_of(scene))
    return found or PlacedLandmarks(np.full((68, 3), np.nan), np.full(68, np.nan))


def mediapipe_alone(scene: Scene) -> Found:
    found = detected(scene)
    return Found(found.points - scene.landmarks, found.sigma_mm)


def nricp(scene: Scene) -> Timed:
    model = s2a.AnnotatedFaceModel.default()
    pose = pose_of(scene)
    moved = deformed("nricp_amberg", scene.scan, model, pose)
    rest, faces = model.surface(1)
    landmarks = ClosestPointQuery(rest, faces).query(model.landmarks).interpolated(moved.answer, faces)
    offset = landmarks - transform_points(pose, scene.landmarks)
    return Timed(Found(offset, np.full(68, np.nan)), moved.cpu_s)


def mean_of(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def errors(scene: Scene, found: Found) -> dict[str, float]:
    error = np.linalg.norm(found.offset_mm, axis=1)
    row = {"51 mm": mean_of(error[INNER])}
    row |= {name: mean_of(error[part]) for name, part in FEATURES.items()}
    row["five points"] = mean_of(error[list(KEY_POINTS)])
    row["nose above"] = mean_of(-found.offset_mm[NOSE_TOP, 1])
    row["brows above"] = mean_of(-found.offset_mm[BROW_ENDS, 1])
    ratio = np.abs(found.offset_mm[INNER]) / found.deviation_mm[INNER, None]
    known = np.isfinite(ratio)
    row["stated mm"] = mean_of(found.deviation_mm[INNER])
    for limit in (1, 2):
        row[f"within {limit} %"] = float(100 * np.mean(ratio[known] < limit)) if known.any() else np.nan
    return row


def jaws(quick: bool) -> Iterator[Case]:
    """Yield scans of open and of shut jaws; a scene is a scan and whether the jaw is open."""
    seeds = count(2000)
    for person in list(LightStage.load().shapes)[: 1 if quick else None]:
        parts = [("", 0.0)] * 2
        parts += [(move, weight) for move in (*SHUT, "jaw_open") for weight in (0.5, 0.75, 1.0)]
        parts += [("jaw_open", weight) for weight in (0.4, 0.6, 0.8, 0.9, 1.1)]
        for (move, weight), seed in zip(parts, seeds, strict=False):
            is_open = move == "jaw_open"
            group = "open jaws" if is_open else "shut jaws"
            made = partial(light_stage, person, move, weight, seed)
            yield Case(f"{person} {move} {weight}", lambda made=made, o=is_open: (made().scan, o), group)
    for name in () if quick else OWN_SHUT:
        for seed in range(100, 112):
            scan = partial(raw_scan, seed, expression=name)
            yield Case(f"own {name} {seed}", lambda scan=scan: (scan()[0], False), "shut jaws")


def jaw_deg(scene: tuple[s2a.RawScan, bool]) -> float:
    return float(fitted_face(scene[0]).metrics["jaw_deg"])


@cache
def without_colors(name: str) -> tuple[Scene, FloatArray, FloatArray]:
    """Return a scene, its pose and the landmarks' errors (51,) of a fit without colours."""
    names = list(LightStage.load().shapes)
    scene = flame_scan() if name == "flame_scan" else light_stage(name, "", 0.0, names.index(name))
    pose = pose_of(scene)
    face = s2a.fit(scene.scan, s2a.AnnotatedFaceModel.default(), pose)
    return scene, pose, np.linalg.norm(of_fit(face, scene.landmarks).offset_mm[INNER], axis=1)


def under_lamp(scene: tuple[str, tuple[float, float]]) -> FloatArray:
    """Return the errors (51,) of landmarks on a shape of one colour under a lamp."""
    name, (beside, above) = scene[0], np.deg2rad(scene[1])
    plain, pose, _ = without_colors(name)
    normals = vertex_normals(plain.scan.vertices, plain.scan.faces) @ pose[:3, :3].T
    toward = [np.sin(beside) * np.cos(above), np.sin(above), np.cos(beside) * np.cos(above)]
    light = AMBIENT + np.maximum(normals @ toward, 0)
    scan = replace(plain.scan, vertex_color_linear=light[:, None] * SKIN)
    face = s2a.fit(scan, s2a.AnnotatedFaceModel.default(), pose)
    return np.linalg.norm(of_fit(face, plain.landmarks).offset_mm[INNER], axis=1)


def lamps(quick: bool) -> Iterator[Case]:
    names = ["flame_scan", *LightStage.load().shapes]
    for name in names[:1] if quick else names:
        for lamp in LAMPS_DEG:
            yield Case(f"{name} {lamp[0]}/{lamp[1]}", lambda name=name, lamp=lamp: (name, lamp), name)


@dataclass(frozen=True)
class Wearer:
    """A shape, its landmarks (68, 3), and scans of it with and without glasses."""

    shape: FloatArray
    faces: FloatArray
    landmarks: FloatArray
    bare: s2a.RawScan
    dressed: s2a.RawScan
    scans_from_shape: tuple[FloatArray, FloatArray]


def wearer(name: str, seed: int) -> Wearer:
    people = LightStage.load()
    shape = people.shapes[name]
    faces = people.faces
    landmarks = shape[people.landmarks]
    glasses = worn_glasses((shape, faces), landmarks[36:48].mean(0), seed, LENS_MM)
    bare, of_bare = raw_like(shape, faces, seed)
    dressed, of_dressed = raw_like(*join([(shape, faces), glasses]), seed)
    return Wearer(shape, faces, landmarks, bare, dressed, (of_bare, of_dressed))


def by_the_eyes(scene: Wearer, dressed: bool, covers: bool) -> dict[str, float]:
    """Fit, and return the errors of surface and landmarks in mm."""
    scan = scene.dressed if dressed else scene.bare
    face = fitted_face(scan, options=FitOptions(covers=covers))
    shape_from_model = invert_rigid(face.model_from_scan @ scene.scans_from_shape[dressed])
    points = transform_points(shape_from_model, face.vertices)
    distance = NearestSurface(scene.shape, scene.faces).query(points).distance
    middles = [scene.landmarks[list(eye)].mean(0) for eye in EYES]
    near = np.min([np.linalg.norm((points - eye)[:, :2], axis=1) for eye in middles], axis=0) < BY_EYES_MM
    off = np.linalg.norm(transform_points(shape_from_model, face.landmarks) - scene.landmarks, axis=1)
    return {
        "surface by the eyes": float(distance[near].mean()),
        "elsewhere": float(distance[~near].mean()),
        "eyes": float(off[36:48].mean()),
        "51 mm": float(off[INNER].mean()),
    }


def wearers(quick: bool) -> Iterator[Case]:
    for seed, name in enumerate(LightStage.load().shapes):
        yield Case(name, partial(wearer, name, seed))
        if quick:
            return


BENCHES = {
    "placed": Bench(
        cases,
        methods={
            "scan2albedo": fitted,
            "shape alone": partial(fitted, colors=False),
            "five given": partial(with_five, one_wrong=False),
            "one of five wrong": partial(with_five, one_wrong=True),
            "with MediaPipe": lambda scene: fitted(scene, detected(scene)),
        },
        peers={"MediaPipe": mediapipe_alone, "nricp_amberg": nricp},
        score=errors,
        slow=("five given", "one of five wrong", "nricp_amberg"),
        quick=("scan2albedo", "shape alone"),
    ),
    "mouths": Bench(
        jaws,
        methods={"scan2albedo": jaw_deg},
        score=lambda scene, degrees: {"right %": 100.0 * ((degrees > 0) == scene[1]), "jaw deg": degrees},
        summaries=("mean",),
    ),
    "lamps": Bench(
        lamps,
        methods={"scan2albedo": under_lamp},
        score=lambda scene, error: {"worse by mm": mean_of(error - without_colors(scene[0])[2])},
    ),
    "glasses": Bench(
        wearers,
        methods={
            "bare": partial(by_the_eyes, dressed=False, covers=True),
            "glasses, followed": partial(by_the_eyes, dressed=True, covers=False),
            "glasses": partial(by_the_eyes, dressed=True, covers=True),
        },
        score=lambda scene, row: row,
    ),
}
