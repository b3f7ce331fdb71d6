"""How often, how exactly and how fast the pose of a face is found, beside other libraries.

    OMP_NUM_THREADS=1 python tools/bench_registration.py [--poses 300] [--real-poses 50]
        [--shapes person1 james ...] [--peers fpfh ...] [--quick] [--curves curves.png]

Every shape of the light-stage set is made raw-like (noise of 0.2 to 0.5 mm, holes, spikes, hair, shoulders)
and registered where it lies, then in a random pose and unit (mm, cm, m, decided from the size as `load_scan`
does). "repeat" compares the two, "truth" compares the first with landmarks (another person's template has
a basin, no exact pose) or, with a template of the same person, with the exact pose. "noise" registers the
first scan of a shape once more with other 0.2 mm noise: what no choice of frame can make equal. Needs
../shared/data.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from benchmarks.registration_peers import Surface, available_peers, fpfh_ransac_icp, open3d_icp
from worlds.files import face_data
from worlds.raw_like import raw_like

import scan2albedo as s2a
from scan2albedo.core import Budget
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import RegistrationError
from scan2albedo.geometry.mesh import vertex_components, vertex_normals
from scan2albedo.geometry.rigid import (
    Similarity,
    compose,
    invert_rigid,
    procrustes,
    random_rotation,
    rotation_angle_rad,
    transform_points,
)
from scan2albedo.io.units import millimetres_per_unit
from scan2albedo.registration import RegistrationOptions
from scan2albedo.registration.depth_annealing import DepthDerivativeObjective
from scan2albedo.registration.inputs import Template

REAL_SCANS = {"james": "james.obj", "humface": "humface.ply"}
FACE_PART = 6706
REPEAT_DEG, REPEAT_MM = 2.0, 2.0
BASIN_DEG, BASIN_MM = 10.0, 15.0
SAME_PERSON = {
    "generic_neutral": (0.1, 0.1),
    "generic_mouthSmile_L_mouthSmile_R": (0.6, 0.7),
    "generic_jawOpen0.7": (0.6, 0.7),
}
UNSURE = 0.5
UNITS = (1.0, 0.1, 0.001)
UNPOSED = {"rotation_max_deg": 0.0, "translation_max_mm": 0.0}


@dataclass(frozen=True)
class Found:
    """A pose (None: refused), its confidence and its cost."""

    model_from_scan: FloatArray | None
    confidence: float
    cpu_s: float
    note: str = ""


@dataclass
class Row:
    """Results of one shape: (degrees, mm) a scan and comparison, nan where refused."""

    repeat: list[tuple[float, float]] = field(default_factory=list)
    noise: list[tuple[float, float]] = field(default_factory=list)
    truth: list[tuple[float, float]] = field(default_factory=list)
    sure_misses: int = 0
    annealed: list[tuple[tuple[float, float], tuple[float, float]]] = field(default_factory=list)
    """From the truth by ICP and by forced annealing, where its pose was taken."""
    cpu_s: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Shapes:
    """The published shapes in the default model's frame."""

    vertices: dict[str, FloatArray]
    faces: IntArray
    model_from_generic: FloatArray

    @classmethod
    def load(cls, model: s2a.AnnotatedFaceModel) -> Shapes:
        with np.load(face_data("ict_faces.npz")) as data:
            shapes = {k[6:]: data[k].astype(float) for k in data if k.startswith("shape_")}
            faces, inner = data["faces"].astype(np.int64), data["landmarks68"][17:]
        return cls(shapes, faces, procrustes(shapes["generic_neutral"][inner], model.landmarks[17:]))

    def truth(self, name: str) -> FloatArray:
        """Return (4, 4) default model from shape."""
        generic = self.vertices["generic_neutral"][:FACE_PART]
        return self.model_from_generic @ procrustes(self.vertices[name][:FACE_PART], generic)

    def own_template(self) -> tuple[s2a.AnnotatedFaceModel, FloatArray]:
        """Return the generic face as a model and its pose from the generic shapes."""
        used = self.faces[(self.faces < FACE_PART).all(1)]
        index = np.unique(used)
        vertices = self.vertices["generic_neutral"][index]
        model = s2a.AnnotatedFaceModel.from_mesh(vertices, np.searchsorted(index, used))
        assert model.template_points is not None
        return model, compose(np.eye(3), -vertices.mean(0))


def found_by_us(
    scan: s2a.RawScan,
    model: s2a.AnnotatedFaceModel,
    options: RegistrationOptions = RegistrationOptions(),
    budget: Budget | None = None,
) -> Found:
    begin = time.process_time()
    try:
        result = s2a.register(scan, model, budget, options=options)
    except RegistrationError as error:
        return Found(None, 0.0, time.process_time() - begin, str(error))
    note = "; ".join(f"{step.stage} {step.reason}: {step.evidence}" for step in result.plan)
    return Found(result.model_from_scan, result.confidence, time.process_time() - begin, note)


def difference(found: FloatArray | None, truth: FloatArray) -> tuple[float, float]:
    """Return (degrees, mm at the model's origin) between two `model_from_scan`; inf where refused."""
    if found is None:
        return np.inf, np.inf
    change = found @ invert_rigid(truth)
    return float(np.degrees(rotation_angle_rad(change[:3, :3]))), float(np.linalg.norm(change[:3, 3]))


def posed(scan: s2a.RawScan, pose: FloatArray, unit: float) -> s2a.RawScan:
    """Move the scan, store it in another unit, and read that unit back from its size."""
    vertices = unit * transform_points(pose, scan.vertices)
    components = vertex_components(len(vertices), scan.faces)
    factor, _ = millimetres_per_unit(vertices, components, "auto", scan.name)
    return s2a.RawScan(vertices * factor, scan.faces, name=scan.name)


def random_pose(rng: np.random.Generator) -> FloatArray:
    return compose(random_rotation(rng), rng.uniform(-500, 500, 3))


def noisier(scan: s2a.RawScan, rng: np.random.Generator) -> s2a.RawScan:
    offset = rng.normal(scale=0.2, size=len(scan.vertices))[:, None]
    return s2a.RawScan(scan.vertices + offset * vertex_normals(scan.vertices, scan.faces), scan.faces)


def scan_of(shapes: Shapes, shape: str, seed: int) -> tuple[s2a.RawScan, FloatArray | None]:
    """Return an unposed scan and its (4, 4) pose in the default model, None where unknown."""
    if shape == "humface":
        return s2a.load_scan(face_data(REAL_SCANS[shape])), None
    if shape == "james":
        picked = np.loadtxt(face_data("james_ibug68.csv"), delimiter=",")[17:]
        model = s2a.AnnotatedFaceModel.default()
        return s2a.load_scan(face_data(REAL_SCANS[shape])), procrustes(picked, model.landmarks[17:])
    noise = np.random.default_rng(seed).uniform(0.2, 0.5)
    scan, _ = raw_like(shapes.vertices[shape], shapes.faces, seed, noise_mm=noise, **UNPOSED)
    return scan, shapes.truth(shape)


def measure(
    row: Row,
    scan: s2a.RawScan,
    truth: FloatArray | None,
    model: s2a.AnnotatedFaceModel,
    rng: np.random.Generator,
    straight: Found,
) -> s2a.RawScan:
    """Register the scan in a random pose; return that scan."""
    pose = random_pose(rng)
    turned = posed(scan, pose, UNITS[int(rng.integers(3))])
    found = found_by_us(turned, model)
    row.cpu_s.append(found.cpu_s)
    if straight.model_from_scan is None:
        row.repeat.append((np.inf, np.inf))
    else:
        answer = straight.model_from_scan @ invert_rigid(pose)
        row.repeat.append(difference(found.model_from_scan, answer))
    in_scan = None if truth is None else truth @ invert_rigid(pose)
    off = row.repeat[-1] if in_scan is None else difference(found.model_from_scan, in_scan)
    row.truth.append(off)
    missed = not _within(off, BASIN_DEG, BASIN_MM) or not _within(row.repeat[-1], REPEAT_DEG, REPEAT_MM)
    row.sure_misses += int(missed and found.confidence >= UNSURE)
    return turned


def _within(off: tuple[float, float], degrees: float, millimetres: float) -> bool:
    return off[0] <= degrees and off[1] <= millimetres


def schedule(names: list[str], poses: int, real_poses: int) -> list[str]:
    """Return the shape of every registration: the published ones in turn, then each real scan."""
    published = [name for name in names if name not in REAL_SCANS]
    turns = [published[i % len(published)] for i in range(poses)] if published else []
    return turns + [name for name in names if name in REAL_SCANS for _ in range(real_poses)]


def run(turns: list[str], shapes: Shapes, peer_names: list[str] | None) -> None:
    model = s2a.AnnotatedFaceModel.default()
    surface = Surface(*model.surface(1))
    peers, absent = available_peers()
    if peer_names is not None:
        peers = {name: peer for name, peer in peers.items() if any(n in name for n in peer_names)}
    for name in absent:
        print(f"skipped, cannot be imported: {name}")
    rows = {name: Row() for name in dict.fromkeys(turns)}
    others: dict[str, Row] = {name: Row() for name in peers}
    straight: dict[str, Found] = {}
    for number, name in enumerate(turns):
        rng = np.random.default_rng([7, number])
        scan, truth = scan_of(shapes, name, number)
        if name not in straight or name not in REAL_SCANS:
            straight[name] = found_by_us(scan, model)
            known = straight[name].model_from_scan
            if known is not None and truth is not None:
                forced = found_by_us(scan, model, RegistrationOptions(force_annealing=True))
                if "its pose is taken" in forced.note:
                    pair = difference(known, truth), difference(forced.model_from_scan, truth)
                    rows[name].annealed.append(pair)
            if known is not None and not rows[name].noise:
                again = found_by_us(noisier(scan, rng), model)
                rows[name].noise.append(difference(again.model_from_scan, known))
        turned = measure(rows[name], scan, truth, model, rng, straight[name])
        for peer, method in peers.items() if truth is not None else ():
            begin = time.process_time()
            pose = method(surface, turned)
            others[peer].cpu_s.append(time.process_time() - begin)
            move = procrustes(scan.vertices, turned.vertices)
            others[peer].truth.append(difference(invert_rigid(pose), truth @ invert_rigid(move)))
    _print_table(rows, others)
    pairs = np.array([pair for row in rows.values() for pair in row.annealed]).reshape(-1, 2, 2)
    worse = (pairs[:, 1] > pairs[:, 0] + 0.05).any(1)
    print(f"\nforced annealing's pose taken on {len(pairs)} scans, farther from the truth on {worse.sum()}")
    for before, after in pairs:
        print("  {:.2f} deg / {:.2f} mm".format(*before), "-> {:.2f} deg / {:.2f} mm".format(*after))


def _print_table(rows: dict[str, Row], others: dict[str, Row]) -> None:
    print(
        f"{'':48}{'repeat <= 2/2':>14}{'worst deg/mm':>19}{'noise deg/mm':>18}"
        f"{'basin':>9}{'worst deg/mm':>16}{'sure misses':>13}{'CPU s':>8}"
    )
    everything = Row()
    for name, row in rows.items():
        _print_row(name, row)
        for part in ("repeat", "noise", "truth", "cpu_s"):
            getattr(everything, part).extend(getattr(row, part))
        everything.sure_misses += row.sure_misses
    _print_row("all", everything)
    known = Row()
    for name, row in rows.items():
        if name != "humface":
            known.truth.extend(row.truth)
            known.cpu_s.extend(row.cpu_s)
    _print_row("ours, where the truth is known", known)
    for name, row in others.items():
        _print_row(name, row)
        ratio = np.mean(known.cpu_s) / np.mean(row.cpu_s) if row.cpu_s else np.nan
        print(f"{'':8}our CPU is {ratio:.2f} times as much")


def _print_row(name: str, row: Row) -> None:
    if not row.cpu_s:
        return
    repeat, noise, truth = (np.array(v).reshape(-1, 2) for v in (row.repeat, row.noise, row.truth))

    def part(values: FloatArray, degrees: float, millimetres: float) -> str:
        inside = (values[:, 0] <= degrees) & (values[:, 1] <= millimetres)
        return f"{inside.sum()}/{len(values)}" if len(values) else "-"

    def worst(values: FloatArray) -> str:
        return "{:.3g} / {:.3g}".format(*values.max(0)) if len(values) else "-"

    print(
        f"{name:48}{part(repeat, REPEAT_DEG, REPEAT_MM):>14}{worst(repeat):>19}{worst(noise):>18}"
        f"{part(truth, BASIN_DEG, BASIN_MM):>9}{worst(truth):>16}{row.sure_misses:13}"
        f"{np.mean(row.cpu_s):8.2f}"
    )


def same_person(shapes: Shapes, repeats: int) -> None:
    """Compare with the exact pose, by ICP, and with annealing forced."""
    model, truth = shapes.own_template()
    ways = {
        "ICP": RegistrationOptions(),
        "forced": RegistrationOptions(force_annealing=True),
    }
    print(f"\n{'template of the same person: deg / mm (mean)':48}" + "".join(f"{w:>18}" for w in ways))
    for name, bar in SAME_PERSON.items():
        text = ""
        for options in ways.values():
            off = []
            for seed in range(repeats):
                scan, _ = scan_of(shapes, name, seed)
                off.append(difference(found_by_us(scan, model, options).model_from_scan, truth))
            text += "{:9.3f} / {:6.3f}".format(*np.mean(off, 0))
        print(f"{name:34} bar {bar[0]} / {bar[1]:<4}{text}")


def annealing_rate(model: s2a.AnnotatedFaceModel) -> None:
    template = Template.of(model, 0)
    rest = Similarity(np.eye(3), np.zeros(3))
    for size in (32, 64, 128):
        objective = DepthDerivativeObjective(*model.surface(2), template, rest, size)
        trials = np.random.default_rng(0).normal(scale=0.03, size=(1000, 5))
        objective(trials[0])
        begin = time.process_time()
        for trial in trials:
            objective(trial)
        rate = len(trials) / (time.process_time() - begin)
        print(f"depth image and cost at {size:3} x {size:3}: {rate:7.0f} a CPU second")


def curves(shapes: Shapes, names: list[str], scans: int, path: Path) -> None:
    """Draw the part of scans in the basin, and the median error, against CPU seconds."""
    from matplotlib.figure import Figure

    model = s2a.AnnotatedFaceModel.default()
    surface = Surface(*model.surface(1))

    def ours(evaluations: int) -> Callable[[s2a.RawScan], FloatArray | None]:
        return lambda scan: found_by_us(scan, model, budget=Budget(evaluations=evaluations)).model_from_scan

    def theirs(iterations: int) -> Callable[[s2a.RawScan], FloatArray | None]:
        return lambda scan: invert_rigid(fpfh_ransac_icp(iterations)(surface, scan))

    methods = {
        "scan2albedo": [ours(n) for n in (200, 500, 1000, 2000, 10_000)],
        "Open3D FPFH+RANSAC+ICP": [theirs(n) for n in (1000, 10_000, 100_000, 400_000)],
        "Open3D ICP from centroids": [lambda scan: invert_rigid(open3d_icp(surface, scan))],
    }
    figure = Figure(figsize=(10, 4))
    success, error = figure.subplots(1, 2)
    for label, settings in methods.items():
        points = [_point(setting, shapes, names, scans) for setting in settings]
        cpu, inside, degrees = np.array(points).T
        success.plot(cpu, 100 * inside, "o-", label=label)
        error.plot(cpu, degrees, "o-", label=label)
    success.set(xlabel="CPU seconds a scan", ylabel="within 10 deg / 15 mm, %", xscale="log", ylim=(0, 103))
    error.set(xlabel="CPU seconds a scan", ylabel="median error, degrees", xscale="log", yscale="log")
    success.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    print(f"\ncurves drawn: {path}")


def _point(
    method: Callable[[s2a.RawScan], FloatArray | None], shapes: Shapes, names: list[str], scans: int
) -> tuple[float, float, float]:
    off, cpu = [], 0.0
    for number in range(scans):
        rng = np.random.default_rng([11, number])
        scan, truth = scan_of(shapes, names[number % len(names)], number)
        pose = random_pose(rng)
        turned = posed(scan, pose, 1.0)
        begin = time.process_time()
        found = method(turned)
        cpu += time.process_time() - begin
        assert truth is not None
        off.append(difference(found, truth @ invert_rigid(pose)))
    inside = np.mean([_within(o, BASIN_DEG, BASIN_MM) for o in off])
    return cpu / scans, float(inside), min(float(np.median([o[0] for o in off])), 180.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=300, help="random poses over the published shapes")
    parser.add_argument("--real-poses", type=int, default=50, help="random poses of each real scan")
    parser.add_argument("--shapes", nargs="*", help="default: all of the set, james and humface")
    parser.add_argument("--quick", action="store_true", help="one pose a shape")
    parser.add_argument("--peers", nargs="*", help="parts of the peers' names; default: all")
    parser.add_argument("--curves", type=Path, help="PNG to draw error against CPU into")
    arguments = parser.parse_args()
    model = s2a.AnnotatedFaceModel.default()
    shapes = Shapes.load(model)
    names = arguments.shapes or [*shapes.vertices, *REAL_SCANS]
    found_by_us(scan_of(shapes, names[0], 0)[0], model)  # compiles and imports
    counts = (len(shapes.vertices), 1) if arguments.quick else (arguments.poses, arguments.real_poses)
    run(schedule(names, *counts), shapes, arguments.peers)
    same_person(shapes, 1 if arguments.quick else 4)
    annealing_rate(model)
    if arguments.curves:
        known = [name for name in names if name not in REAL_SCANS]
        curves(shapes, known, 10 if arguments.quick else 40, arguments.curves)


if __name__ == "__main__":
    main()
