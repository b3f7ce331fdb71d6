"""How often, how exactly and how fast the pose of a face is found, beside other libraries.

`raw` are the light-stage shapes made raw-like (noise of 0.2 to 0.5 mm, holes, spikes, hair, shoulders) and
two real scans. Each is registered where it lies, then in a random pose and unit (mm, cm, m, decided from the
size as `load_scan` does): "repeated" compares the two (within 2 degrees and 2 mm), "in basin" compares with
landmarks (another person's template has a basin of 10 degrees and 15 mm, no exact pose). "sure misses" have a
confidence of 0.5 and more. `settings` are our options, and others' budgets, on harder synthetic scans: "mm"
is by how far the face's points are from their place.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from worlds.files import face_data
from worlds.light_stage import FACE_VERTICES
from worlds.raw_like import raw_like
from worlds.synthetic_scans import ScanScene, hard_scan_scenes, scan_scenes

import scan2albedo as s2a
from bench.peers.registration import PEERS, Peer, Surface
from bench.runner import Bench, Case
from bench.settings import presets, varied, within
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import (
    compose,
    invert_rigid,
    procrustes,
    random_rotation,
    rotation_angle_rad,
    transform_points,
)
from scan2albedo.io.units import millimetres_per_unit
from scan2albedo.registration import RegistrationOptions

REAL_SCANS = {"james": "james.obj", "humface": "humface.ply"}
POSES = 300
REAL_POSES = 50
REPEAT_DEG = 2.0
REPEAT_MM = 2.0
BASIN_DEG = 10.0
BASIN_MM = 15.0
"""Within the basin a fit finds the rest."""
SURE = 0.5
UNITS = (1.0, 0.1, 0.001)
UNPOSED = {"rotation_max_deg": 0.0, "translation_max_mm": 0.0}
REFUSED_MM = 300.0
"""What a refusal, and a pose farther off, counts as."""
FORCED = RegistrationOptions(force_annealing=True)


@dataclass(frozen=True)
class Shapes:
    """The published shapes in the default model's frame."""

    vertices: dict[str, FloatArray]
    faces: IntArray
    model_from_generic: FloatArray

    def truth(self, name: str) -> FloatArray:
        """Return (4, 4) default model from shape."""
        generic = self.vertices["generic_neutral"][:FACE_VERTICES]
        return self.model_from_generic @ procrustes(self.vertices[name][:FACE_VERTICES], generic)


@cache
def published() -> Shapes:
    landmarks = s2a.AnnotatedFaceModel.default().landmarks
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {k.removeprefix("shape_"): data[k].astype(float) for k in data if k.startswith("shape_")}
        inner = data["landmarks68"][17:]
        of_model = procrustes(shapes["generic_neutral"][inner], landmarks[17:])
        return Shapes(shapes, data["faces"].astype(np.int64), of_model)


@dataclass(frozen=True)
class Scene:
    """A scan in a random pose and the same where it lay, its own frame; the true pose where it is known."""

    scan: s2a.RawScan
    straight: s2a.RawScan
    pose: FloatArray
    truth: FloatArray | None


def scan_of(shape: str, seed: int) -> tuple[s2a.RawScan, FloatArray | None]:
    """Return an unposed scan and its (4, 4) pose in the default model, None where unknown."""
    if shape in REAL_SCANS:
        scan = s2a.load_scan(face_data(REAL_SCANS[shape]))
        if shape != "james":
            return scan, None
        placed = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")[17:]
        return scan, procrustes(placed, s2a.AnnotatedFaceModel.default().landmarks[17:])
    noise = np.random.default_rng(seed).uniform(0.2, 0.5)
    shapes = published()
    scan, _ = raw_like(shapes.vertices[shape], shapes.faces, seed, noise_mm=noise, **UNPOSED)
    return scan, shapes.truth(shape)


def scene(shape: str, number: int) -> Scene:
    rng = np.random.default_rng([7, number])
    straight, truth = scan_of(shape, number)
    pose = compose(random_rotation(rng), rng.uniform(-500, 500, 3))
    # The unit is read back from the size, as it is for a file.
    vertices = UNITS[int(rng.integers(3))] * transform_points(pose, straight.vertices)
    components = vertex_components(len(vertices), straight.faces)
    factor, _ = millimetres_per_unit(vertices, components, "auto", shape)
    scan = s2a.RawScan(vertices * factor, straight.faces, name=shape)
    return Scene(scan, straight, pose, truth)


def cases(quick: bool) -> Iterator[Case]:
    names = list(published().vertices)
    turns = [names[number % len(names)] for number in range(2 if quick else POSES)]
    turns += ["james"] if quick else [name for name in REAL_SCANS for _ in range(REAL_POSES)]
    for number, shape in enumerate(turns):
        group = "truth unknown" if shape == "humface" else "truth known"
        yield Case(f"{shape} {number}", partial(scene, shape, number), group)


@dataclass(frozen=True)
class Found:
    """`model_from_scan` (4, 4), None where it was refused, its confidence and the search's evaluations."""

    pose: FloatArray | None
    confidence: float = 1.0
    evaluations: int = 0
    plan: str = ""


def registered(
    scan: s2a.RawScan,
    options: RegistrationOptions = RegistrationOptions(),
    budget: Budget | None = None,
    model: s2a.AnnotatedFaceModel | None = None,
) -> Found:
    try:
        found = s2a.register(scan, model or s2a.AnnotatedFaceModel.default(), budget, options=options)
    except RegistrationError as error:
        return Found(None, 0.0, plan=str(error))
    plan = " ".join(f"{step.stage} {step.reason}" for step in found.plan)
    return Found(found.model_from_scan, found.confidence, found.iterations, plan)


def by_peer(peer: Peer, scan: s2a.RawScan) -> Found:
    surface = Surface(*s2a.AnnotatedFaceModel.default().surface(1))
    return Found(invert_rigid(peer(surface, scan)))


def difference(found: FloatArray | None, truth: FloatArray) -> tuple[float, float]:
    """Return (degrees, mm at the model's origin) between two `model_from_scan`; inf where refused."""
    if found is None:
        return np.inf, np.inf
    change = found @ invert_rigid(truth)
    return float(np.degrees(rotation_angle_rad(change[:3, :3]))), float(np.linalg.norm(change[:3, 3]))


def errors(scene: Scene, found: Found) -> dict[str, float]:
    row: dict[str, float] = {}
    missed = False
    if scene.truth is not None:
        degrees, mm = difference(found.pose, scene.truth @ invert_rigid(scene.pose))
        missed = degrees > BASIN_DEG or mm > BASIN_MM
        row |= {"in basin": float(not missed), "deg": degrees, "mm": mm}
    # Peers do not say how sure they are, and give no plan; only ours is repeated.
    if found.plan:
        straight = registered(scene.straight).pose
        apart = (np.inf, np.inf)
        if straight is not None:
            apart = difference(found.pose, straight @ invert_rigid(scene.pose))
        repeated = apart[0] <= REPEAT_DEG and apart[1] <= REPEAT_MM
        row |= {"repeated": float(repeated), "repeat deg": apart[0], "repeat mm": apart[1]}
        row["sure misses"] = float((missed or not repeated) and found.confidence >= SURE)
    return row


def off_their_place(scene: ScanScene, found: Found) -> dict[str, float]:
    """Return the mean distance between the true face's points where the poses found and true put them."""
    if found.pose is None:
        return {"mm": REFUSED_MM, "deg": 180.0, "in basin": 0.0, "evaluations": 0.0}
    points = transform_points(invert_rigid(scene.truth.model_from_scan), scene.surface)
    apart = transform_points(found.pose, points) - transform_points(scene.model_from_scan, points)
    mm = min(float(np.linalg.norm(apart, axis=1).mean()), REFUSED_MM)
    degrees, _ = difference(found.pose, scene.model_from_scan)
    inside = degrees <= BASIN_DEG and mm <= BASIN_MM
    return {"mm": mm, "deg": degrees, "in basin": float(inside), "evaluations": float(found.evaluations)}


def settings() -> dict[str, Callable[[ScanScene], Found]]:
    """Return our registrations by setting, the default first."""
    free = RegistrationOptions()

    def of_scene(scene: ScanScene, options: RegistrationOptions, budget: Budget | None = None) -> Found:
        return registered(scene.scan, options, budget, scene.model)

    options = {
        "default": free,
        **presets("register"),
        **varied("anchor_spacing_mm", free, (60.0, 20.0)),
        **varied("kept_starts", free, (20, 480)),
        **varied("candidates", free, (1, 2, 4, 16)),
        **varied("settling_iterations", free, (2, 10, 100)),
        # Several knobs at once, by the number of starts relative to the default.
        "effort 1/64": replace(free, anchor_spacing_mm=60.0, kept_starts=20, candidates=2),
        "effort 1/16": replace(free, anchor_spacing_mm=45.0, kept_starts=40, candidates=2),
        "effort 1/4": replace(free, kept_starts=60, candidates=4),
        "effort 4": replace(free, anchor_spacing_mm=20.0, kept_starts=480, candidates=16),
        "annealing 100": replace(FORCED, annealing_evaluations=100),
        "annealing 400": replace(FORCED, annealing_evaluations=400),
    }
    made = {name: partial(of_scene, options=each) for name, each in options.items()}
    return made | within(of_scene, free, (20, 50, 100, 200, 500, 1000, 2000))


def scenes(quick: bool) -> Iterator[Case]:
    for number, made in enumerate(scan_scenes(1, 4.0) if quick else hard_scan_scenes(6)):
        yield Case(f"scan {number}", lambda made=made: made)


OTHERS = {name: lambda scene, peer=peer: by_peer(peer, scene.scan) for name, peer in PEERS.items()}
BENCHES = {
    "raw": Bench(
        cases,
        methods={"scan2albedo": lambda scene: registered(scene.scan)},
        peers=OTHERS,
        score=errors,
        quick=("scan2albedo",),
        error="mm",
        warm=True,
    ),
    "settings": Bench(
        scenes,
        methods=settings(),
        peers=OTHERS,
        score=off_their_place,
        quick=("default", "candidates 2"),
        warm=True,
    ),
}
