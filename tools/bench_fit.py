"""The deformable fit beside its peers, in one run: error against CPU time.

    python tools/bench_fit.py [--out DIR] [--peers-python PYTHON] [--shapes 4] [--scaling]

Scans are whole heads made raw (re-meshed to about 20,000 vertices, noise 0.3 mm, holes, spikes, hair,
shoulders) with dense ground truth; the rigid pose is given. Ours, trimesh's `nricp_amberg` and
`nricp_sumner` and meshmonk deform the same template; trimesh's and meshmonk's at the resolution of
our samples. trimesh's need the extra [peers]. `--peers-python` names a Python that has all peers (`pip
install trimesh rtree meshmonk autofacemonker` in an environment of their own); what it lacks is left out
and said. Needs ../shared/data.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks import fit_peers
from worlds.files import face_data
from worlds.raw_like import with_holes

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.fit import CROP_MARGIN
from scan2albedo.fitting.scan_surface import ScanSurface, scan_near_model
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import compose, invert_rigid, procrustes, random_rotation, transform_points
from scan2albedo.synthetic.sitter import grid_faces, join

PEERS = Path(fit_peers.__file__)
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
KEY_POINTS = {0: 51, 133: 39, 362: 42, 61: 48, 291: 54}
"""autofacemonker's key points (MediaPipe's numbers) as iBUG-68 numbers."""
MESH_PEERS = ("nricp_amberg", "nricp_sumner", "meshmonk")
BUDGETS = (5, 15, 30, 45, 60, 90)


@dataclass(frozen=True)
class Case:
    """A raw scan, the template, the pose given, and the truth in the template's order (model's frame)."""

    name: str
    scan: s2a.RawScan
    model: s2a.AnnotatedFaceModel
    pose: FloatArray
    truth: FloatArray


@dataclass(frozen=True)
class Score:
    """One method on one case."""

    method: str
    case: str
    surface_mm: FloatArray
    correspondence_mm: FloatArray
    flips: int
    cpu_s: float

    def numbers(self) -> list[float]:
        """Return mean, median and 95 % of the surface, mean and 95 % of the correspondence, flips, CPU s."""
        d, c = self.surface_mm, self.correspondence_mm
        distances = [d.mean(), np.median(d), np.percentile(d, 95), c.mean(), np.percentile(c, 95)]
        return [*(float(distance) for distance in distances), self.flips, self.cpu_s]


def numbers_line(case: str, method: str, numbers: Sequence[float]) -> str:
    """Return a row of the table."""
    mean, median, most, far, farthest, flips, cpu_s = numbers
    return (
        f"{case[:34]:36}{method:22}{mean:7.3f}{median:7.3f}{most:7.3f}{far:8.2f}{farthest:7.2f}"
        f"{flips:6.0f}{cpu_s:8.2f}"
    )


def whole_head_scan(
    vertices: FloatArray, faces: IntArray, seed: int, target: int
) -> tuple[s2a.RawScan, FloatArray]:
    """Return a raw scan of about `target` vertices of a whole head, and scan_from_shape (4, 4)."""
    import open3d as o3d

    rng = np.random.default_rng(seed)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    while len(mesh.triangles) < 2 * target:
        mesh = mesh.subdivide_midpoint(1)
    mesh = mesh.simplify_quadric_decimation(2 * target)
    points, index = np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int64)
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


def cases(names: tuple[str, ...], target: int) -> list[Case]:
    data = np.load(face_data("ict_faces.npz"))
    faces, inner = data["faces"].astype(np.int64), int(data["narrow_face_vertices"])
    template = data["shape_generic_neutral"].astype(float)[:inner]
    model = s2a.AnnotatedFaceModel.from_mesh(
        template,
        faces[(faces < inner).all(1)],
        landmarks=data["landmarks68"].astype(np.int64),
        name="generic face",
    )
    rest = template - template[np.unique(faces[(faces < inner).all(1)])].mean(0)
    made = []
    for name in names:
        shape = data[f"shape_{name}"].astype(float)
        scan, scan_from_shape = whole_head_scan(shape, faces, 0, target)
        model_from_shape = procrustes(shape[:inner], rest)
        pose = model_from_shape @ invert_rigid(scan_from_shape)
        made.append(Case(name, scan, model, pose, transform_points(model_from_shape, shape[:inner])))
    return made


def score_ours(case: Case, options: FitOptions | None = None, steps: int | None = None) -> Score:
    budget = None if steps is None else s2a.Budget(evaluations=steps)
    start = time.process_time()
    fitted = s2a.fit(case.scan, case.model, case.pose, budget, options=options)
    spent = time.process_time() - start
    truth = transform_points(fitted.model_from_scan @ invert_rigid(case.pose), case.truth)
    assert fitted.template_vertices is not None
    return Score(
        "scan2albedo" if steps is None else f"scan2albedo, {steps} steps",
        case.name,
        ClosestPointQuery(fitted.vertices, fitted.faces).query(truth).distance,
        np.linalg.norm(fitted.template_vertices - truth, axis=1),
        int(fitted.metrics["flipped_faces"]),
        spent,
    )


def score_mesh(method: str, case: Case, vertices: FloatArray, cpu_s: float) -> Score:
    """Score the template's surface at level 1 deformed to `vertices`; the dense template goes along."""
    from scan2albedo.fitting.stages import FoldFinder

    rest, faces = case.model.surface(1)
    template = _template_at_rest(case.model)
    hits = ClosestPointQuery(rest, faces).query(template)
    carried = np.einsum("nk,nkj->nj", hits.barycentric, vertices[faces[hits.face]]) + template - hits.points
    return Score(
        method,
        case.name,
        ClosestPointQuery(vertices, faces).query(case.truth).distance,
        np.linalg.norm(carried - case.truth, axis=1),
        len(FoldFinder(rest, faces).find(vertices)),
        cpu_s,
    )


def _template_at_rest(model: s2a.AnnotatedFaceModel) -> FloatArray:

    template = model.template_of(model.control_vertices)
    assert template is not None
    return template


def cropped(case: Case) -> ScanSurface:
    """The scan as posed, near the model: what every peer is given."""
    low, high = case.model.control_vertices.min(0), case.model.control_vertices.max(0)
    margin = CROP_MARGIN * float(np.max(high - low))
    surface = scan_near_model(case.scan.vertices, case.scan.faces, case.pose, low - margin, high + margin)
    assert surface is not None
    return surface


def score_peer(peer: str, case: Case, python: str, folder: Path) -> Score | None:
    """Run one mesh peer of fit_peers.py on a case; None where it is not installed."""
    found = deformed_by(peer, case, python, folder)
    return None if found is None else score_mesh(peer, case, *found)


def deformed_by(peer: str, case: Case, python: str, folder: Path) -> tuple[FloatArray, float] | None:
    """Return the template's surface at level 1 as a mesh peer deforms it, and its CPU seconds."""
    rest, faces = case.model.surface(1)
    scan, source, target = cropped(case), folder / "in.npz", folder / "out.npz"
    np.savez(source, vertices=rest, faces=faces, scan_vertices=scan.vertices, scan_faces=scan.faces)
    if not run_peer(python, peer, source, target):
        return None
    found = np.load(target)
    return found["vertices"].astype(float), float(found["cpu_s"])


def run_peer(python: str, peer: str, source: Path, target: Path) -> bool:
    done = subprocess.run(
        [python, str(PEERS), peer, str(source), str(target)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        print(f"{peer} left out: {(done.stderr.strip() or 'failed').splitlines()[-1]}")
    return done.returncode == 0


def james(python: str, folder: Path) -> None:
    """The textured scan with hand-placed landmarks: ours from any pose, and autofacemonker."""
    scan = s2a.load_scan(face_data("james.obj"))
    given = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")
    model = s2a.AnnotatedFaceModel.default()
    start = time.process_time()
    fitted = s2a.fit(scan, model, s2a.register(scan, model))
    spent = time.process_time() - start
    scan_from_model = invert_rigid(fitted.model_from_scan)
    assert fitted.landmarks is not None
    found = transform_points(scan_from_model, fitted.landmarks)
    error = np.linalg.norm(found - given, axis=1)
    query = ClosestPointQuery(scan.vertices, scan.faces)
    keys = list(KEY_POINTS.values())
    print("\njames: template to scan mean / median / p95 mm, landmarks mm, CPU s with registration")
    residual = query.query(transform_points(scan_from_model, fitted.vertices)).distance
    _print_james("scan2albedo", residual, error[keys], spent)
    print(f"{'':22}51 inner landmarks {error[17:].mean():.2f} mm")
    if not run_peer(python, "autofacemonker", face_data("james.obj"), folder / "james.npz"):
        return
    peer = np.load(folder / "james.npz")
    number = {int(k): int(v) for k, v in peer["key_points"]}
    placed = np.array([peer["vertices"][number[k]] for k in KEY_POINTS])
    _print_james(
        "autofacemonker",
        query.query(peer["vertices"]).distance,
        np.linalg.norm(placed - given[keys], axis=1),
        float(peer["cpu_s"]),
    )


def _print_james(name: str, residual: FloatArray, error: FloatArray, cpu_s: float) -> None:
    print(
        f"{name:22}{residual.mean():7.3f}{np.median(residual):7.3f}{np.percentile(residual, 95):7.3f}"
        f"   {len(error)} key points {error.mean():.2f}{cpu_s:8.2f}"
    )


def scaling() -> None:
    print("\nscan vertices, fit CPU s, surface mean / median mm")
    for target in (10_000, 20_000, 50_000, 100_000, 200_000, 300_000, 1_000_000):
        (case,) = cases(("person1",), target)
        score = score_ours(case)
        print(
            f"{len(case.scan.vertices):9d}{score.cpu_s:8.2f}"
            f"{score.surface_mm.mean():8.3f}{np.median(score.surface_mm):8.3f}",
            flush=True,
        )


def draw(scores: list[Score], curves: list[Score], path: Path) -> None:
    """Error against CPU time, means over the cases: ours as a curve over budgets, peers as points."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5))
    for axis, title, pick in (
        (axes[0], "surface distance, mean [mm]", lambda s: s.surface_mm.mean()),
        (axes[1], "dense correspondence, mean [mm]", lambda s: s.correspondence_mm.mean()),
    ):
        means = _means(curves, pick)
        axis.plot(
            [x for x, _ in means.values()], [y for _, y in means.values()], ".-", label="scan2albedo, budgets"
        )
        for method, (x, y) in _means(scores, pick).items():
            axis.plot(x, y, "o", label=method)
        axis.set(xlabel="CPU time [s]", ylabel=title, xscale="symlog", yscale="log")
        axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    print(f"drawn: {path}")


def _means(scores: list[Score], pick) -> dict[str, tuple[float, float]]:  # type: ignore[no-untyped-def]
    methods = dict.fromkeys(s.method for s in scores)
    return {
        m: (
            float(np.mean([s.cpu_s for s in scores if s.method == m])),
            float(np.mean([pick(s) for s in scores if s.method == m])),
        )
        for m in methods
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="a folder for bench_fit.png, ours with budgets too")
    parser.add_argument("--peers-python", default=sys.executable, help="a Python that has the peers")
    parser.add_argument("--shapes", type=int, default=4, help=f"how many of the {len(SHAPES)} shapes")
    parser.add_argument("--vertices", type=int, default=20_000)
    parser.add_argument("--scaling", action="store_true", help="also fit scans of 10k to 1M vertices")
    arguments = parser.parse_args()
    made = cases(SHAPES[: arguments.shapes], arguments.vertices)
    score_ours(made[0])  # compiles
    scores: list[Score] = []
    curves: list[Score] = []
    print(
        f"{'scan':36}{'method':22}{'surface':>7}{'median':>7}{'p95':>7}{'corr.':>8}{'p95':>7}"
        f"{'flips':>6}{'CPU s':>8}"
    )
    with tempfile.TemporaryDirectory() as name:
        for case in made:
            rows = [score_mesh("rigid only", case, case.model.surface(1)[0], 0.0), score_ours(case)]
            peers = (score_peer(peer, case, arguments.peers_python, Path(name)) for peer in MESH_PEERS)
            rows += [row for row in peers if row is not None]
            print(*(numbers_line(row.case, row.method, row.numbers()) for row in rows), sep="\n", flush=True)
            scores += rows
            curves += [score_ours(case, steps=steps) for steps in BUDGETS if arguments.out]
        for method in dict.fromkeys(row.method for row in scores):
            numbers = np.array([row.numbers() for row in scores if row.method == method])
            print(numbers_line("mean", method, numbers.mean(0)), flush=True)
        james(arguments.peers_python, Path(name))
    if arguments.scaling:
        scaling()
    if arguments.out:
        draw(scores, curves, arguments.out / "bench_fit.png")


if __name__ == "__main__":
    main()
