"""The deformable fit beside its peers: distance of the true surface, and of corresponding points.

`heads` are whole light-stage heads made raw (re-meshed to about 20,000 vertices, noise 0.3 mm, holes,
spikes, hair, shoulders) with dense ground truth; the rigid pose is given. `settings` are our options on
synthetic scans, where errors are measured where skin was scanned. `james` is a textured scan with
hand-placed landmarks, from any pose. trimesh's `nricp_amberg` and `nricp_sumner` deform the same template
at the resolution of our samples. They run in the Python that S2A_PEERS_PYTHON names, or in this one (the
extra [peers]).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from worlds.files import face_data
from worlds.fits import fitted_face
from worlds.raw_like import with_holes
from worlds.synthetic_scans import ScanScene, scan_scenes

import scan2albedo as s2a
from bench.landmarks import KEY_POINTS
from bench.peers.fit import LEVEL, deformed
from bench.runner import Bench, Case, Timed
from bench.settings import presets, varied, within
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray, IntArray, grid_faces
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import compose, invert_rigid, procrustes, random_rotation, transform_points
from scan2albedo.synthetic.sitter import join

SHAPES = (
    "person1",
    "person2",
    "generic_mouthSmile_L_mouthSmile_R",
    "generic_jawOpen0.7",
    "person3",
    "person4",
    "person2_mouthSmile_L_mouthSmile_R",
    "person3_browInnerUp_L_browInnerUp_R_jawOpen0.5",
)
TARGET = 20_000
MESH_PEERS = ("nricp_amberg", "nricp_sumner")
CORRESPONDENCE_LEVEL = 2
"""Refinement of the model's surface at which corresponding points of synthetic scans are compared."""


@dataclass(frozen=True)
class Head:
    """A raw scan, the template, the pose given, and the truth in the template's order (model's frame)."""

    scan: s2a.RawScan
    model: s2a.AnnotatedFaceModel
    pose: FloatArray
    truth: FloatArray


@dataclass(frozen=True)
class Answer:
    """A surface in the model's frame as it lay on the scan, and how the frame moved meanwhile."""

    vertices: FloatArray
    faces: IntArray
    points: FloatArray
    """The template's vertices, or the model's at some level."""
    model_from_scan: FloatArray


def whole_head_scan(vertices: FloatArray, faces: IntArray) -> tuple[s2a.RawScan, FloatArray]:
    """Return a raw scan of about `TARGET` vertices of a whole head, and scan_from_shape (4, 4)."""
    import open3d as o3d

    rng = np.random.default_rng(0)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    while len(mesh.triangles) < 2 * TARGET:
        mesh = mesh.subdivide_midpoint(1)
    mesh = mesh.simplify_quadric_decimation(2 * TARGET)
    points = np.asarray(mesh.vertices)
    index = np.asarray(mesh.triangles, np.int64)
    normals = vertex_normals(points, index)
    points = points + normals * rng.normal(0, 0.3, (len(points), 1))
    spikes = rng.random(len(points)) < 0.002
    points[spikes] += normals[spikes] * rng.uniform(5, 20, (int(spikes.sum()), 1))
    high = points[:, 1] > np.percentile(vertices[:, 1], 85)
    shell = index[high[index].all(1)]
    hair = points + 8 * normals + rng.normal(0, 1.5, points.shape)
    x, z = np.meshgrid(np.linspace(-220, 220, 45), np.linspace(-120, 60, 19))
    y = vertices[:, 1].min() - 5 - 0.15 * np.abs(x) + rng.normal(0, 0.5, x.shape)
    shoulders = np.stack([x, y, z], -1).reshape(-1, 3), grid_faces(19, 45)
    front = vertices[rng.choice(len(vertices) // 3, 6, replace=False)]
    face = with_holes((points, index), front, np.full(6, 6.0))
    all_points, all_faces = join([face, with_holes((hair, shell), front[:0], np.zeros(0)), shoulders])
    scan_from_shape = compose(random_rotation(rng), rng.normal(0, 300, 3))
    return s2a.RawScan(transform_points(scan_from_shape, all_points), all_faces), scan_from_shape


def head(name: str) -> Head:
    with np.load(face_data("ict_faces.npz")) as stored:
        data = dict(stored)
    faces = data["faces"].astype(np.int64)
    inner = int(data["narrow_face_vertices"])
    inner_faces = faces[(faces < inner).all(1)]
    template = data["shape_generic_neutral"].astype(float)[:inner]
    landmarks = data["landmarks68"].astype(np.int64)
    model = s2a.AnnotatedFaceModel.from_mesh(template, inner_faces, landmarks=landmarks, name="generic face")
    shape = data[f"shape_{name}"].astype(float)
    scan, scan_from_shape = whole_head_scan(shape, faces)
    model_from_shape = procrustes(shape[:inner], template - template[np.unique(inner_faces)].mean(0))
    truth = transform_points(model_from_shape, shape[:inner])
    return Head(scan, model, model_from_shape @ invert_rigid(scan_from_shape), truth)


def ours(scene: Head) -> Answer:
    found = s2a.fit(scene.scan, scene.model, scene.pose)
    return Answer(found.vertices, found.faces, found.template_vertices, found.model_from_scan)


def carried(scene: Head, vertices: FloatArray) -> Answer:
    """Return the template as the model's surface at `LEVEL`, deformed to `vertices`, takes it along."""
    rest, faces = scene.model.surface(LEVEL)
    template = scene.model.template_of(scene.model.control_vertices)
    hits = ClosestPointQuery(rest, faces).query(template)
    points = hits.interpolated(vertices, faces) + template - hits.points
    return Answer(vertices, faces, points, scene.pose)


def mesh_peer(name: str, scene: Head) -> Timed:
    moved = deformed(name, scene.scan, scene.model, scene.pose)
    return Timed(carried(scene, moved.answer), moved.cpu_s)


def of_surface(distance: FloatArray) -> dict[str, float]:
    return {
        "surface mm": float(distance.mean()),
        "median": float(np.median(distance)),
        "95 %": float(np.percentile(distance, 95)),
    }


def errors(scene: Head, answer: Answer) -> dict[str, float]:
    truth = transform_points(answer.model_from_scan @ invert_rigid(scene.pose), scene.truth)
    distance = ClosestPointQuery(answer.vertices, answer.faces).query(truth).distance
    apart = np.linalg.norm(answer.points - truth, axis=1)
    return of_surface(distance) | {
        "corr. mm": float(apart.mean()),
    }


def james_by_us(scan: s2a.RawScan) -> tuple[FloatArray, FloatArray]:
    """Return vertices of the surface and landmarks (68, 3) in the scan's frame."""
    found = fitted_face(scan)
    scan_from_model = invert_rigid(found.model_from_scan)
    vertices, landmarks = (transform_points(scan_from_model, p) for p in (found.vertices, found.landmarks))
    return vertices, landmarks


def james_errors(scan: s2a.RawScan, answer: tuple[FloatArray, FloatArray]) -> dict[str, float]:
    distance = ClosestPointQuery(scan.vertices, scan.faces).query(answer[0]).distance
    placed = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")
    off = np.linalg.norm(answer[1] - placed, axis=1)
    return of_surface(distance) | {
        "five points": float(off[list(KEY_POINTS)].mean()),
        "51 mm": float(off[17:].mean()),
    }


def fitted(scene: ScanScene, options: FitOptions, budget: Budget | None = None) -> Answer:
    return of_fit(scene, s2a.fit(scene.scan, scene.model, scene.found_pose, budget, options=options))


def of_fit(scene: ScanScene, found: s2a.FittedFace) -> Answer:
    points = scene.model.subdivision(CORRESPONDENCE_LEVEL).matrix @ found.control_points
    return Answer(found.vertices, found.faces, points, found.model_from_scan)


def moved_model(name: str, scene: ScanScene) -> Timed:
    """Return the model's surface at `LEVEL` as a mesh peer deforms it, or as it is for no name."""
    vertices, faces = scene.model.surface(LEVEL)
    moved = deformed(name, scene.scan, scene.model, scene.found_pose) if name else Timed(vertices, 0.0)
    return Timed(Answer(moved.answer, faces, moved.answer, scene.found_pose), moved.cpu_s)


def errors_on_skin(scene: ScanScene, answer: Answer) -> dict[str, float]:
    """Return the errors where skin was scanned: under hair there is nothing to be right about."""
    found_from_truth = answer.model_from_scan @ invert_rigid(scene.truth.model_from_scan)
    level = LEVEL if len(answer.points) == len(answer.vertices) else CORRESPONDENCE_LEVEL
    places = scene.limit_points(level)
    skin = scene.surface[scene.scanned(scene.surface)]
    true = transform_points(found_from_truth, skin)
    distance = ClosestPointQuery(answer.vertices, answer.faces).query(true).distance
    apart = np.linalg.norm(answer.points - transform_points(found_from_truth, places), axis=1)
    return {
        "surface mm": float(distance.mean()),
        "corr. mm": float(apart[scene.scanned(places)].mean()),
        "95 %": float(np.percentile(distance, 95)),
    }


def settings() -> dict[str, Callable[[ScanScene], Answer]]:
    """Return our fits by setting, the default first."""
    free = FitOptions()
    levels = ((0,), (0, 0), (0, 0, 0), (0, 0, 1), (0, 0, 1, 1), (0, 0, 0, 1, 1, 1), (0,) * 3 + (1,) * 9)
    options = {
        "default": free,
        **presets("fit"),
        **varied("levels", free, levels),
        **varied("finest_level", free, (0, 3)),
        **varied("steps", free, (1, 2, 3, 4, 6, 20, 40)),
        **varied("rigid_iterations", free, (0, 2, 15)),
        **varied("proportion_iterations", free, (0, 3, 20)),
        **varied("smoothing_mm", free, (0.0, 1.6)),
    }
    made = {name: partial(fitted, options=each) for name, each in options.items()}
    return made | within(fitted, free, (1, 5, 10, 20, 40, 80))


def scenes(quick: bool) -> Iterator[Case]:
    for number, scene in enumerate(scan_scenes(1, 4.0) if quick else scan_scenes(3)):
        yield Case(f"scan {number}", lambda scene=scene: scene)


BENCHES = {
    "heads": Bench(
        lambda quick: (Case(name, partial(head, name)) for name in SHAPES[: 1 if quick else None]),
        methods={"scan2albedo": ours},
        peers={
            "rigid only": lambda scene: carried(scene, scene.model.surface(LEVEL)[0]),
            **{name: partial(mesh_peer, name) for name in MESH_PEERS},
        },
        score=errors,
        quick=("scan2albedo", "rigid only"),
        warm=True,
    ),
    "james": Bench(
        lambda quick: [Case("james", lambda: s2a.load_scan(face_data("james.obj")))],
        methods={"scan2albedo": james_by_us},
        score=james_errors,
    ),
    "settings": Bench(
        scenes,
        methods=settings(),
        peers={
            "rigid only": partial(moved_model, ""),
            **{name: partial(moved_model, name) for name in MESH_PEERS},
        },
        score=errors_on_skin,
        quick=("default", "steps 3", "rigid only"),
        warm=True,
    ),
}
