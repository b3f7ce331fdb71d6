"""Errors of applications against ground truth.

python tools/bench_applications.py relight       relit textures, albedo true and estimated, ten new lights
python tools/bench_applications.py expression    a smile and an open jaw of measured faces, given to another
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import scan2albedo as s2a
from scan2albedo.applications import FaceMesh, ProcessedFace, TransferOptions, personal_model, relight
from scan2albedo.applications.expression_transfer import expression_displacement
from scan2albedo.fitting import FittedFace
from scan2albedo.geometry.nearest_surface import surface_query
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.lighting.asrm import Reflectance
from scan2albedo.synthetic import Material, SyntheticScene, face, light_at
from scan2albedo.synthetic.ray_scene import RayScene
from scan2albedo.synthetic.renderer import render

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
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
GENERIC, OTHER = "generic_neutral", "person2"
MOVES = ("generic_mouthSmile_L_mouthSmile_R", "generic_jawOpen0.7")
NEAR_MM = 2.0
"""Vertices farther than this from the fitted face at rest do not belong to it."""

FloatArray = NDArray[np.float64]


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
            material=scene.parameters.material,
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


def mesh_of(fitted: FittedFace) -> FaceMesh:
    return FaceMesh(fitted.vertices, fitted.faces, fitted.uv)


def carried_error(
    fits: dict[str, FittedFace], move: str, truth: FloatArray, rest: FloatArray, method: str
) -> str:
    """Return the errors of measured points carried with the fitted face, and of the surface."""
    other = fits[OTHER]
    rest, truth = (transform_points(other.model_from_scan, points) for points in (rest, truth))
    moved = expression_displacement(
        mesh_of(fits[GENERIC]),
        mesh_of(fits[move]),
        mesh_of(other),
        options=TransferOptions(method=method),  # type: ignore[arg-type]
    )
    hits = surface_query(other.vertices, other.faces).query(rest)
    near = hits.distance < NEAR_MM
    carried = hits.points + np.einsum("nk,nkc->nc", hits.barycentric, moved[other.faces[hits.face]])
    error = np.linalg.norm(carried - truth, axis=1)[near]
    surface = surface_query(other.vertices + moved, other.faces).query(truth[near]).distance
    motion = np.linalg.norm(truth - rest, axis=1)[near].mean()
    return (
        f"points {error.mean():.2f} mean {np.median(error):.2f} median, surface {surface.mean():.2f} mean; "
        f"they move {motion:.2f}; {near.mean():.0%} of the points"
    )


def bench_expression() -> None:
    with np.load(DATA / "ict_faces.npz") as data:
        shapes = {k.removeprefix("shape_"): data[k].astype(float) for k in data if k.startswith("shape_")}
        faces, inner = data["faces"].astype(np.int64), int(data["narrow_face_vertices"])
        area = faces[: int(data["face_area_faces"])]
        own = s2a.AnnotatedFaceModel.from_mesh(
            shapes[GENERIC], area, landmarks=data["landmarks68"].astype(np.int64), name="generic face"
        )
    truths = {move: shapes[OTHER] + shapes[move] - shapes[GENERIC] for move in MOVES}
    count = int(area.max()) + 1
    print("mm; measured vertices, no fit")
    for move, truth in truths.items():
        for method in ("addition", "local-frames"):
            meshes = [FaceMesh(shapes[n][:count], area, np.zeros((count, 2))) for n in (GENERIC, move, OTHER)]
            options = TransferOptions(method=method)  # type: ignore[arg-type]
            made = meshes[2].vertices + expression_displacement(*meshes, options=options)
            print(f"  {move} {method}: {np.linalg.norm(made - truth[:count], axis=1).mean():.3f} mean")
    default = s2a.AnnotatedFaceModel.default()
    for model, personal in ((default, False), (default, True), (own, False), (own, True)):
        fits = {}
        for name in (GENERIC, OTHER, *MOVES):
            scan = s2a.RawScan(shapes[name], faces)
            start = personal_model(fits[GENERIC]) if personal and name in MOVES else model
            fits[name] = s2a.fit(scan, start, s2a.register(scan, start))
        how = "expressions with the personal model" if personal else "each head by itself"
        print(f"mm; registered and fitted, {how}: {model.name}")
        for move, truth in truths.items():
            for method in ("addition", "local-frames"):
                row = carried_error(fits, move, truth[:inner], shapes[OTHER][:inner], method)
                print(f"  {move} {method}: {row}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["relight", "expression", "all"], nargs="?", default="all")
    what = parser.parse_args().what
    if what in ("relight", "all"):
        bench_relight()
    if what in ("expression", "all"):
        bench_expression()


if __name__ == "__main__":
    main()
