"""Errors of applications against ground truth.

python tools/bench_applications.py relight       relit textures, albedo true and estimated, ten new lights
python tools/bench_applications.py expression    expressions of measured and synthetic faces, given to another
python tools/bench_applications.py people        how far apart fits of one person, and of two, are where still
python tools/bench_applications.py swap          real faces with each other's skin: figures, and swap.png
python tools/bench_applications.py blend         real faces blended half way: figures, and blend.png
python tools/bench_applications.py seams         the same: edges that neither face has, as a table
python tools/bench_applications.py rims          texels beside the charts of every texture that is exported
python tools/bench_applications.py relit         real faces under a lamp from three sides: relit.png
python tools/bench_applications.py environment   real faces under environment maps: figures, environment.png

The last six take processed scans from `--results FOLDER` (what is not there is processed into it first) and
write pictures, or faces, to `-o FOLDER`. `--pairs A,B ...` swaps, blends or measures other pairs, among them
of one's own results in that folder.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.real_applications import (
    bench_blend,
    bench_environment,
    bench_relit,
    bench_seams,
    bench_swap,
)
from benchmarks.texture_rims import bench_rims
from worlds.files import face_data

import scan2albedo as s2a
from scan2albedo.applications import FaceMesh, ProcessedFace, TransferOptions, personal_model, relight
from scan2albedo.applications.expression_transfer import (
    TWO_PEOPLE_MM,
    apart_where_still,
    expression_displacement,
)
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.closest_points import surface_query
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.synthetic import Material, SyntheticScene, face, light_at
from scan2albedo.synthetic.face_shape import person
from scan2albedo.synthetic.renderer import RayScene, render

LIGHTS = [
    light_at(0, 0),
    light_at(30, 20),
    light_at(-45, 10, intensity=2),
    light_at(60, -20, intensity=4),
    light_at(-75, 30, intensity=5),
    light_at(15, 60),
    light_at(0, -40, intensity=2),
    light_at(40, 30, distance_mm=450),
    light_at(-60, 0, distance_mm=350, intensity=4),
    light_at(85, 45, intensity=6),
]
NOISE_MM = 0.15
GENERIC = "generic_neutral"
SMILE = "generic_mouthSmile_L_mouthSmile_R"
PAIRS = (
    ("generic_neutral", "smile", "person2"),
    ("generic_neutral", "left smile", "person2"),
    ("generic_neutral", "jaw", "person2"),
    ("generic_neutral", "left smile and jaw", "person1"),
    ("generic_neutral", "brows and jaw", "person1"),
    ("person1", "smile", "person2"),
    ("person2", "smile", "person1"),
    ("person4", "jaw", "generic_neutral"),
    ("person3", "brows and jaw", "person4"),
)
"""Who makes which face, and to whom it is given."""
SIDE_MM = 6.0
"""Over this width from the middle a one-sided smile fades out."""
SYNTHETIC = ("smile", "frown", "pout", "surprise")
NEAR_MM = 2.0
"""Vertices farther than this from the fitted face at rest do not belong to it."""


def relit_errors(scene: SyntheticScene, given: ProcessedFace, unit: float) -> tuple[float, float]:
    """Return mean and worst relative RMSE in percent over the lights, the face's colours times `unit`."""
    mask, image, occluder = scene.image.mask, scene.image, RayScene(*scene.image.occluder_mesh())
    errors = []
    for light in LIGHTS:
        truth = render(
            image.position[mask],
            image.normal[mask],
            scene.albedo_linear[mask],
            [light],
            material=scene.material,
            occluder=occluder,
            specular_scale=image.specular_scale[mask],
        ).radiance_linear
        relit = unit * relight(given, [light]).texture_linear[mask]
        errors.append(100 * np.linalg.norm(relit - truth) / np.linalg.norm(truth))
    return float(np.mean(errors)), float(np.max(errors))


def bench_relight() -> None:
    print("seed  gloss  true albedo: mean worst %   estimated: mean worst %")
    for seed in range(3):
        for gloss in (0.0, 0.15):
            material = Material(0.3, gloss, 20.0)
            scene = face(seed, size=128, material=material, lights=[light_at(30, 15)])
            skin = Reflectance("oren-nayar", material.sigma_rad, gloss, material.specular_exponent)
            true = ProcessedFace.of("true", scene.image, scene.albedo_linear, reflectance=skin)
            estimate = s2a.estimate_albedo(scene.image)
            found = ProcessedFace.of(
                "estimated", scene.image, estimate.albedo_linear, reflectance=estimate.reflectance
            )
            a, b = relit_errors(scene, true, 1.0), relit_errors(scene, found, 1 / scene.gain)
            print(f"{seed:4d}  {gloss:5.2f}  {a[0]:16.2f} {a[1]:6.2f}  {b[0]:16.2f} {b[1]:6.2f}", flush=True)


@dataclass(frozen=True)
class Pair:
    """Vertices of A at rest and with the expression, of B, and of B with the same: (V, 3) mm each.

    `inner` of them are measured, the same index being the same point; `faces` (F, 3) are all of theirs.
    """

    name: str
    a: FloatArray
    moving: FloatArray
    b: FloatArray
    truth: FloatArray
    faces: IntArray
    inner: int


def measured_moves(shapes: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Return displacements (V, 3) mm of light-stage expressions, which add to any of the shapes."""
    rest = shapes[GENERIC]
    smile, jaw = shapes[SMILE] - rest, shapes["generic_jawOpen0.7"] - rest
    left = smile / (1 + np.exp(-rest[:, :1] / SIDE_MM))
    brows = shapes["person3_browInnerUp_L_browInnerUp_R_jawOpen0.5"] - shapes["person3"]
    return {
        "smile": smile,
        "jaw": jaw,
        "left smile": left,
        "left smile and jaw": left + 0.4 * jaw,
        "brows and jaw": brows,
    }


def measured_pairs() -> tuple[list[Pair], s2a.AnnotatedFaceModel]:
    """Return pairs of light-stage shapes, and the model that the generic one makes."""
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {k.removeprefix("shape_"): data[k].astype(float) for k in data if k.startswith("shape_")}
        faces, inner = data["faces"].astype(np.int64), int(data["narrow_face_vertices"])
        own = s2a.AnnotatedFaceModel.from_mesh(
            shapes[GENERIC],
            faces[: int(data["face_area_faces"])],
            landmarks=data["landmarks68"].astype(np.int64),
            name="generic face",
        )
    moves, pairs = measured_moves(shapes), []
    for a, move, b in PAIRS:
        moved = [shapes[name] + moves[move] for name in (a, b)]
        name = f"{a.removesuffix('_neutral')} {move} to {b.removesuffix('_neutral')}"
        pairs.append(Pair(name, shapes[a], moved[0], shapes[b], moved[1], faces, inner))
    return pairs, own


def synthetic_pairs() -> list[Pair]:
    """Return pairs of synthetic people, whose skin has no features but those of the default model."""
    model = s2a.AnnotatedFaceModel.default()
    surface = model.subdivision(2)

    def shape(seed: int, expression: str) -> FloatArray:
        made = person(model, np.random.default_rng(seed), expression=expression)  # type: ignore[arg-type]
        return np.asarray(surface.matrix @ made)

    rest, count = [shape(seed, "neutral") for seed in (1, 2)], surface.matrix.shape[0]
    return [
        Pair(f"synthetic {e}", rest[0], shape(1, e), rest[1], shape(2, e), surface.faces, count)
        for e in SYNTHETIC
    ]


def fitted(vertices: FloatArray, faces: IntArray, model: s2a.AnnotatedFaceModel) -> FittedFace:
    scan = s2a.RawScan(vertices, faces)
    return s2a.fit(scan, model, s2a.register(scan, model))


def mesh_of(face: FittedFace) -> FaceMesh:
    return FaceMesh(face.vertices, face.faces, face.uv)


def carried_errors(pair: Pair, b: FittedFace, moved: FloatArray) -> FloatArray:
    """Return (N,) mm by which measured points carried with B's fitted face miss their true places."""
    rest, truth = (
        transform_points(b.model_from_scan, points[: pair.inner]) for points in (pair.b, pair.truth)
    )
    hits = surface_query(b.vertices, b.faces).query(rest)
    near = hits.distance < NEAR_MM
    carried = hits.points + np.einsum("nk,nkc->nc", hits.barycentric, moved[b.faces[hits.face]])
    return np.asarray(np.linalg.norm(carried - truth, axis=1)[near])


def true_displacement(pair: Pair, a: FittedFace) -> FloatArray:
    """Return (V, 3) by which the points of A that the fit at rest found truly move."""
    rest, moving = (transform_points(a.model_from_scan, points) for points in (pair.a, pair.moving))
    hits = surface_query(rest, pair.faces).query(a.vertices)
    return np.asarray(np.einsum("nk,nkc->nc", hits.barycentric, (moving - rest)[pair.faces[hits.face]]))


def expression_row(pair: Pair, model: s2a.AnnotatedFaceModel) -> list[float]:
    """Return mean errors in mm: nothing carried, as fitted with the model and from A at rest, refined (the
    median too), and the truth of A carried."""
    a, moving, b = (fitted(v, pair.faces, model) for v in (pair.a, pair.moving, pair.b))
    own = fitted(pair.moving, pair.faces, personal_model(a))

    def errors(expression: FittedFace, options: TransferOptions) -> FloatArray:
        meshes = (mesh_of(face) for face in (a, expression))
        return carried_errors(pair, b, expression_displacement(*meshes, options=options, model=model))

    unrefined, refined = (TransferOptions(correspondence=how) for how in ("as-fitted", "refined"))  # type: ignore[arg-type]
    best = errors(moving, refined)
    return [
        float(carried_errors(pair, b, np.zeros_like(b.vertices)).mean()),
        *(float(errors(face, unrefined).mean()) for face in (moving, own)),
        float(best.mean()),
        float(np.median(best)),
        float(carried_errors(pair, b, true_displacement(pair, a)).mean()),
    ]


def bench_expression() -> None:
    measured, own = measured_pairs()
    default = s2a.AnnotatedFaceModel.default()
    for model, pairs in ((default, [*measured, *synthetic_pairs()]), (own, measured)):
        print(
            f"mm, registered and fitted with {model.name}: none carried, as fitted, as fitted from A at rest,"
        )
        print("refined mean and median, A's true displacement carried")
        rows = []
        for pair in pairs:
            rows.append(expression_row(pair, model))
            print(f"  {pair.name:40s}" + "".join(f"{value:6.2f}" for value in rows[-1]), flush=True)
        print(f"  {'mean':40s}" + "".join(f"{value:6.2f}" for value in np.mean(rows, axis=0)))


def bench_people() -> None:
    """Print how far light-stage people are apart where still: one at rest and with expressions, and two."""
    with np.load(face_data("ict_faces.npz")) as data:
        shapes = {k.removeprefix("shape_"): data[k].astype(float) for k in data if k.startswith("shape_")}
        faces = data["faces"].astype(np.int64)
    moves = {k: v for k, v in measured_moves(shapes).items() if k in ("smile", "jaw", "brows and jaw")}
    with np.load(face_data("ict_expressions.npz")) as data:
        moves |= {k: data[k].astype(float) for k in ("cheek_puff", "nose_sneer")}
    model, rng = s2a.AnnotatedFaceModel.default(), np.random.default_rng(0)

    def mesh(vertices: FloatArray) -> FaceMesh:
        return mesh_of(fitted(vertices + rng.normal(0, NOISE_MM, vertices.shape), faces, model))

    rest = {name: mesh(shapes[name]) for name in (GENERIC, "person1", "person2", "person3", "person4")}
    one: list[float] = []
    two: list[float] = []
    for name in ("person1", "person2", "person4"):
        for move in ({"nothing": np.zeros_like(shapes[name])} | moves).values():
            moved = mesh(shapes[name] + move)
            for other, still in rest.items():
                (one if other == name else two).append(apart_where_still(still, moved))
    for title, found in (("one person", one), ("two people", two)):
        least, middle, most = np.percentile(found, [0, 50, 100])
        told = int((np.array(found) > TWO_PEOPLE_MM).sum())
        print(
            f"{title}: {least:.2f} to {most:.2f} mm apart, median {middle:.2f}; taken for two people: "
            f"{told} of {len(found)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    real = {
        "swap": lambda: bench_swap(given.results, given.out, given.pairs),
        "blend": lambda: bench_blend(given.results, given.out, given.pairs),
        "seams": lambda: bench_seams(given.results, given.pairs),
        "rims": lambda: bench_rims(given.results, given.out, given.pairs),
        "relit": lambda: bench_relit(given.results, given.out),
        "environment": lambda: bench_environment(given.results, given.out),
    }
    parser.add_argument(
        "what", choices=["relight", "expression", "people", *real, "all"], nargs="?", default="all"
    )
    parser.add_argument("--results", type=Path, default=Path("real_results"))
    parser.add_argument("-o", "--out", type=Path, default=Path("real_pictures"))
    parser.add_argument("--pairs", type=lambda text: tuple(text.split(",")), nargs="+")
    given = parser.parse_args()
    what = given.what
    if what in ("relight", "all"):
        bench_relight()
    if what in ("expression", "all"):
        bench_expression()
    if what in ("people", "all"):
        bench_people()
    for name, bench in real.items():
        if what in (name, "all"):
            given.out.mkdir(parents=True, exist_ok=True)
            bench()


if __name__ == "__main__":
    main()
