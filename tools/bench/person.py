"""A person from several scans: the neutral shape, scans of strangers, and one albedo.

`shape`: light-stage people scanned raw-like, of one or two of thirteen expressions at random weights 0 to
1, in any pose, a third of them without a side of the face, their unit wrong by 2 % (one deviation). Errors
after the best similarity: mean distance from the fitted to the true neutral face, mm, and of 51 landmarks.
Peers are the first scan alone, and the mean and the median of the fits laid on each other. `strangers` are
sets with one scan of another person: in how many it is the farthest, the odds are right, and the odds of
the others are. `albedo` are synthetic scans, each with an expression, a lamp near by and a pose of its own,
through `scan2albedo person` as a user runs it, at draft; errors are relative RMSE on the texels of skin
that two scans or more show, in % of the true albedo, beside each scan alone and the stated one. `traced`
are the pairs of scans that `python tools/worlds FOLDER --heads` makes, in the folder that S2A_TRACED names:
both alone, and the common albedo on the texels of skin of either. `FIT_MM` and `PEOPLE_MM` were chosen on
person1, person2 and the generic face.
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from worlds.files import write_obj
from worlds.fits import fitted_face
from worlds.light_stage import LightStage
from worlds.raw_like import raw_like

import scan2albedo as s2a
from bench.judging import VARIABLE, ScanTruth, judged_scan, score
from bench.landmarks import INNER
from bench.pipeline import run_command
from bench.runner import Bench, Case, Timed
from scan2albedo.albedo import albedo_error
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.fitting import FittedFace, PersonShape, common_shape
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_vertex_mask
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.io.images import read_exr_channels, read_image_linear
from scan2albedo.synthetic import Scanner, light_at, raw_scan

PEOPLE = ("person3", "person4")
SCANS = 12
DRAWS = 6
COUNTS = (1, 2, 3, 5)
ALBEDO_COUNTS = (1, 2, 3, 5, 8, 32)
ALBEDO_SIZE = 256
SCALE_SD = 0.02
"""Of the logarithm of a scanner's unit."""
EXPRESSIONS = ("neutral", "smile", "frown", "surprise")
RIM = 0.8
"""Part of the chart's half width beyond which nothing counts: a head's photographs do not reach its rim."""

Fits = Sequence[FittedFace]


def laid_on_each_other(fits: Fits) -> FloatArray:
    """Return control points (K, C, 3) at the least squared distances from their mean."""
    mean = fits[0].control_points
    for _ in range(6):
        poses = [procrustes(fit.control_points, mean, scale=True) for fit in fits]
        laid = np.stack(
            [transform_points(pose, fit.control_points) for pose, fit in zip(poses, fits, strict=True)]
        )
        mean = laid.mean(0)
    return laid


PEERS: dict[str, Callable[[Fits], FloatArray]] = {
    "first scan": lambda fits: fits[0].control_points,
    "mean": lambda fits: laid_on_each_other(fits).mean(0),
    "median": lambda fits: np.median(laid_on_each_other(fits), axis=0),
}


def person_scan(people: LightStage, person: str, seed: int) -> s2a.RawScan:
    """Return a scan of one or two random expressions of weights 0 to 1, one in three without a side."""
    rng = np.random.default_rng([seed, *person.encode()])
    moves = people.expressions | {"smile": people.smile}
    names = rng.choice(sorted(moves), int(rng.integers(1, 3)), replace=False)
    shape = people.shapes[person] + sum(float(rng.uniform()) * moves[str(name)] for name in names)
    scale = float(np.exp(rng.normal(0, SCALE_SD)))
    scan, scan_from_shape = raw_like(shape, people.faces, int(rng.integers(2**31)), scale=scale)
    if rng.uniform() < 1 / 3:
        x = transform_points(np.linalg.inv(scan_from_shape), scan.vertices)[:, 0] * rng.choice([-1, 1])
        scan = scan.without_faces((x > rng.uniform(5, 40))[scan.faces].any(1))
    return scan


class Truth:
    """A person's neutral face, and how far an estimate is from it."""

    def __init__(self, people: LightStage, person: str, model: s2a.AnnotatedFaceModel) -> None:
        points = people.shapes[person]
        self.model = model
        self.landmarks = points[people.landmarks]
        self.query = ClosestPointQuery(points, people.faces)
        self.at_rim = boundary_vertex_mask(len(points), people.faces)[people.faces].any(1)

    def of(self, control: FloatArray) -> tuple[FloatArray, BoolArray, float]:
        """Return each vertex's distance (V,), which count (V,), and the mean error of 51 landmarks, mm."""
        subdivision = self.model.subdivision(2)
        vertices = subdivision.matrix @ control
        found = self.model.landmarks_of(control)
        points = transform_points(procrustes(found[INNER], self.landmarks[INNER], scale=True), vertices)
        for _ in range(8):
            hits = self.query.query(points)
            trust = 1 / (1 + hits.distance**2)
            points = transform_points(procrustes(points, hits.points, weights=trust, scale=True), points)
        hits = self.query.query(points)
        counted = ~boundary_vertex_mask(len(vertices), subdivision.faces) & ~self.at_rim[hits.face]
        moved = transform_points(procrustes(vertices, points, scale=True), found[INNER])
        apart = np.linalg.norm(moved - self.landmarks[INNER], axis=1)
        return hits.distance, counted, float(apart.mean())


def fits_of(
    people: LightStage, person: str, model: s2a.AnnotatedFaceModel, count: int
) -> Iterator[FittedFace]:
    """Fit `count` scans of a person; those that registration or fit refuse are left out."""
    for seed in range(count):
        scan = person_scan(people, person, seed)
        try:
            yield fitted_face(scan, model)
        except s2a.Scan2AlbedoError as error:
            print(f"  {person}, scan {seed} left out: {error}", flush=True)


@cache
def person_fits(person: str, count: int) -> tuple[list[FittedFace], Truth]:
    people, model = LightStage.load(), s2a.AnnotatedFaceModel.default()
    return list(fits_of(people, person, model, count)), Truth(people, person, model)


def drawn(person: str, scans: int, count: int, draw: int) -> tuple[list[FittedFace], Truth]:
    fits, truth = person_fits(person, scans)
    rng = np.random.default_rng(count)
    for _ in range(draw + 1):
        chosen = rng.choice(len(fits), count, replace=False)
    return [fits[k] for k in chosen], truth


def shapes(quick: bool) -> Iterator[Case]:
    scans = 3 if quick else SCANS
    for person in PEOPLE[: 1 if quick else None]:
        for count in COUNTS[:3] if quick else COUNTS:
            for draw in range(1 if quick else DRAWS):
                make = partial(drawn, person, scans, count, draw)
                yield Case(f"{person}, {count} scans, draw {draw}", make, f"{count} scans")


def shape_errors(scene: tuple[list[FittedFace], Truth], control: FloatArray) -> dict[str, float]:
    fits, truth = scene
    distance, counted, far = truth.of(control)
    row = {"surface mm": float(distance[counted].mean()), "corr. mm": far}
    found = common_shape(fits)
    if np.array_equal(found.control_points, control):
        stated = found.deviation_mm[counted]
        row["stated mm"] = float(np.sqrt(np.mean(stated**2)))
        row["true mm"] = float(np.sqrt(np.mean(distance[counted] ** 2)))
    return row


def with_stranger(person: str, stranger: str, count: int, draw: int) -> list[FittedFace]:
    """Return fits of a person's scans, and one of a scan of another person."""
    own, _ = drawn(person, SCANS, count, draw)
    rng = np.random.default_rng([count, draw])
    others, _ = person_fits(stranger, SCANS)
    return [*own, others[rng.integers(len(others))]]


def strangers(quick: bool) -> Iterator[Case]:
    for person, stranger in zip(PEOPLE, PEOPLE[::-1], strict=True):
        for count in (2,) if quick else COUNTS:
            for draw in range(1 if quick else 3 * DRAWS):
                name = f"{stranger} beside {count} of {person}, draw {draw}"
                make = partial(with_stranger, person, stranger, count, draw)
                yield Case(name, make, f"beside {count}")


def odds(fits: list[FittedFace], shape: PersonShape) -> dict[str, float]:
    return {
        "farthest %": 100.0 * (shape.other_person.argmax() == len(fits) - 1),
        "told %": 100.0 * (shape.other_person[-1] > 0),
        "others kept %": float(100 * np.mean(shape.other_person[:-1] < 0)),
    }


@dataclass(frozen=True)
class Files:
    """Files of a person's scans, and the true albedo (H, W, 3)."""

    folder: Path
    scans: list[Path]
    truth: FloatArray


@cache
def written_scans(seed: int, count: int, size: int) -> Files:
    folder = Path(tempfile.mkdtemp(prefix="person"))
    files: list[Path] = []
    rng = np.random.default_rng(seed)
    for k in range(count):
        lamp = light_at(*rng.uniform((-50, -10), (50, 50)), distance_mm=900.0, intensity=rng.uniform(2, 3))
        expression = EXPRESSIONS[k % len(EXPRESSIONS)]
        scan, truth = raw_scan(seed, expression=expression, lights=(lamp,), scanner=Scanner(size=size))
        files.append(folder / f"scan{k}.obj")
        write_obj(scan, files[-1])
    return Files(folder, files, truth.albedo_linear)


def albedo_cases(quick: bool) -> Iterator[Case]:
    counts = ALBEDO_COUNTS[:2] if quick else ALBEDO_COUNTS
    size = 64 if quick else ALBEDO_SIZE
    for seed in (3,) if quick else (3, 4):
        for count in counts:
            made = partial(written_scans, seed, max(counts), size)
            yield Case(
                f"person {seed}, {count} scans",
                lambda made=made, count=count, size=size: (made(), count, size),
                f"{count} scans",
            )


def by_command(scene: tuple[Files, int, int]) -> Timed:
    """Run the command; its answer is the result's folder and the most memory, in MB."""
    files, count, size = scene
    words = ["person", f"of{count}", *files.scans[:count], "-o", files.folder]
    words += ["--quality", "draft", "--size", size, "--no-pictures"]
    done = run_command(list(map(str, words)))
    return Timed((files.folder / f"of{count}", done.answer.peak_mb), done.cpu_s)


def albedo_errors(scene: tuple[Files, int, int], answer: tuple[Path, float]) -> dict[str, float]:
    result, peak_mb = answer
    files, count, _ = scene
    seen = read_image_linear(result / "coverage.png")[..., 0] > 0
    image = s2a.read_geometry_image(result / "geometry_image.npz")
    counted = seen & (image.skin > 0.5) & (files.truth.max(-1) > 0)

    def error(folder: Path) -> float:
        found = read_image_linear(folder / "albedo.exr")[counted]
        return 100 * albedo_error(found, files.truth[counted], np.ones(len(found), bool)).relative_rmse

    alone = [error(result / f"scan{k}") for k in range(count)]
    stated = next(iter(read_exr_channels(result / "expected_error.exr").values()))[counted]
    return {
        "best alone %": min(alone),
        "mean alone %": float(np.mean(alone)),
        "of all %": error(result),
        "stated %": float(100 * np.median(stated)),
        "peak MB": peak_mb,
    }


def pairs(quick: bool) -> Iterator[Case]:
    folder = Path(os.environ.get(VARIABLE, "."))
    files = sorted(folder.glob("*_*.obj"))
    if not files:
        raise FileNotFoundError(f"{VARIABLE} names no folder with pairs of scans")
    for first in files[: 2 if quick else None : 2]:
        both = [file for file in files if file.stem.startswith(first.stem[:3])]
        yield Case(first.stem.split("_")[0], lambda both=both: both)


def common_of(files: list[Path]) -> FloatArray:
    common = s2a.process_person(files, quality="draft", size=ALBEDO_SIZE).common
    return common.albedo_linear.astype(float)


def pair_errors(files: list[Path], common: FloatArray) -> dict[str, float]:
    across = np.abs(np.linspace(-1, 1, ALBEDO_SIZE))
    away = np.hypot(across, across[:, None]) < RIM
    row: dict[str, float] = {}
    for name, file in zip(("first", "second"), files, strict=True):
        result = s2a.process(file, quality="draft", size=ALBEDO_SIZE)
        judged = judged_scan(result, ScanTruth.read(file.parent, file.stem))
        on = judged.albedo_linear, judged.judged & (result.geometry_image.skin > 0.5) & away
        row[f"{name} alone %"] = score(result.albedo.albedo_linear.astype(float), *on).rmse
        row[f"common on {name} %"] = score(common, *on).rmse
    best = min(row["first alone %"], row["second alone %"])
    row["to the better"] = (row["common on first %"] + row["common on second %"]) / 2 / best
    return row


METHODS = {"common_shape": lambda scene: common_shape(scene[0]).control_points}
OTHERS = {name: lambda scene, peer=peer: peer(scene[0]) for name, peer in PEERS.items()}
BENCHES = {
    "shape": Bench(shapes, METHODS, shape_errors, OTHERS, summaries=("mean",)),
    "strangers": Bench(strangers, {"common_shape": common_shape}, odds),
    "albedo": Bench(albedo_cases, {"scan2albedo person": by_command}, albedo_errors),
    "traced": Bench(pairs, {"scan2albedo": common_of}, pair_errors),
}
