"""Coefficients of a linear face model from scans: ours beside a fit to 51 landmarks, in one run.

    python tools/bench_linear_model.py [--shapes 8] [--mixtures 3] [--seed 0]

The model is made of the ICT faces: identities' principal directions and twelve expressions. Scans are, first,
shapes of the model itself as a two-pod scanner sees them (noise 0.2 mm, holes, spikes, hair, shoulders, any
pose), whose coefficients are known; then each ICT person with a model made without that person, where the
least error is that of the basis itself, fitted to the true correspondences; then mixtures of expressions as
weights of blendshapes; then two real scans. The peer is
what flame-fitting does (`fit_lmk3d.py`): pose, then pose and coefficients, by least squares to 51 landmarks
with its weights, here by SciPy; its landmarks are the true ones with 1 mm of noise (real scans: those placed
by hand). Needs ../shared/data. Nothing was tuned on the people; james and flame_scan were seen before.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from worlds.files import face_data
from worlds.raw_like import raw_like

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.fitting import FittedFace
from scan2albedo.fitting.linear_model import LinearModelFit, fit_linear_model
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, procrustes, rotation_from_vector, transform_points
from scan2albedo.io.linear_model_files import LinearFaceModel
from scan2albedo.reflectance.linear_model import principal_directions
from scan2albedo.templates.annotated_face_model import linear_model_places

IDENTITIES = ("generic_neutral", "person1", "person2", "person3", "person4")
EXPRESSION_SD = 0.4
"""Of the weights of ICT's expressions, which go from 0 to 1."""
LANDMARK_MM = 1.0
METRES_WEIGHT = 1e-3
"""flame-fitting's weight of a coefficient beside landmarks in metres."""
FACE = slice(0, 6706)
"""ICT's vertices of the face without neck, ears and scalp."""


def ict_model(without: str = "") -> tuple[LinearFaceModel, IntArray]:
    """Return a model of the ICT faces but one, and the vertices of its 68 landmarks."""
    with np.load(face_data("ict_faces.npz")) as data, np.load(face_data("ict_expressions.npz")) as moves:
        people = np.array([data[f"shape_{name}"] for name in IDENTITIES if name != without], float)
        mean, off = people.mean(0), people - people.mean(0)
        directions = np.tensordot(principal_directions(off, None, size=float(np.sum(mean**2)))[0], off, 1)
        expressions = [EXPRESSION_SD * moves[name].astype(float) for name in moves.files]
        basis = np.moveaxis(np.concatenate([directions, expressions]), 0, -1)
        faces = data["faces"][: data["face_area_faces"]].astype(np.int64)
        model = LinearFaceModel("ict", "0" * 64, mean, basis, len(directions), faces)
        return model, data["landmarks68"].astype(np.int64)


def ours(scan: s2a.RawScan, model: LinearFaceModel) -> tuple[FittedFace, LinearModelFit, float, float]:
    """Return both fits, the seconds of the whole way, and those of the linear model alone."""
    default = s2a.AnnotatedFaceModel.default()
    places = linear_model_places(model, default)  # once a model
    start = time.process_time()
    fitted = s2a.fit(scan, default, s2a.register(scan, default))
    between = time.process_time()
    found = fit_linear_model(scan, fitted, *places, np.ones(len(fitted.vertices)))
    return fitted, found, time.process_time() - start, time.process_time() - between


def by_landmarks(
    points: FloatArray, model: LinearFaceModel, landmarks: IntArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return vertices in the frame of points (51, 3) in mm, coefficients and seconds of the peer."""
    start = time.process_time()
    mean, basis = model.mean[landmarks], model.basis[landmarks].astype(float)
    pose = procrustes(mean, points)
    size = basis.shape[2]

    def residuals(x: FloatArray) -> FloatArray:
        turn = rotation_from_vector(x[:3]) @ pose[:3, :3]
        placed = (mean + basis @ x[6:]) @ turn.T + pose[:3, 3] + x[3:6]
        return np.concatenate([((placed - points) / 1000).ravel(), METRES_WEIGHT * x[6:]])

    x = least_squares(residuals, np.zeros(6 + size), method="lm").x
    turn = rotation_from_vector(x[:3]) @ pose[:3, :3]
    vertices = (model.mean + model.basis @ x[6:]) @ turn.T + pose[:3, 3] + x[3:6]
    return vertices, x[6:], time.process_time() - start


def best_of_basis(truth: FloatArray, model: LinearFaceModel) -> FloatArray:
    """Return the model's vertices whose face is nearest to the truth (V, 3), all correspondences given."""
    coefficients = np.zeros(model.basis.shape[2])
    for _ in range(30):
        shape = model.mean + model.basis @ coefficients
        pose = procrustes(shape[FACE], truth[FACE], scale=True)
        own = transform_points(np.linalg.inv(pose), truth)[FACE]
        rows = model.basis[FACE].reshape(-1, len(coefficients)).astype(float)
        coefficients = np.linalg.lstsq(rows, (own - model.mean[FACE]).ravel(), rcond=None)[0]
    return transform_points(pose, model.mean + model.basis @ coefficients)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def in_scan(fitted: FittedFace, vertices: FloatArray) -> FloatArray:
    return transform_points(invert_rigid(fitted.model_from_scan), vertices)


def vertex_rms(found: FloatArray, truth: FloatArray) -> float:
    return rms(np.linalg.norm((found - truth)[FACE], axis=1))


def own_shapes(count: int, seed: int) -> None:
    model, landmarks = ict_model()
    print("shapes of the model: RMS error of coefficients in standard deviations, and of vertices in mm")
    print(
        f"{'':10}"
        + "".join(f"{name:>8}" for name in ("shape", "expr.", "z", "mm", "| shape", "expr.", "mm"))
        + "".join(f"{name:>8}" for name in ("s, ours", "all", "peer"))
    )
    table = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        truth = rng.normal(size=model.basis.shape[2])
        truth[model.shapes :] = np.abs(truth[model.shapes :])  # expressions have no opposite
        shape = model.at(truth)
        scan, scan_from_shape = raw_like(shape, model.faces, seed + number)
        right = transform_points(scan_from_shape, shape)
        fitted, found, whole_s, own_s = ours(scan, model)
        points = right[landmarks[17:]] + rng.normal(0, LANDMARK_MM, (51, 3))
        peer, guess, peer_s = by_landmarks(points, model, landmarks[17:])
        error, k = found.coefficients - truth, model.shapes
        table.append([
            rms(error[:k]), rms(error[k:]), rms(error / found.deviation[7:]),
            vertex_rms(in_scan(fitted, found.vertices), right),
            rms((guess - truth)[:k]), rms((guess - truth)[k:]), vertex_rms(peer, right),
            own_s, whole_s, peer_s,
        ])  # fmt: skip
        print(f"{number:<10}" + "".join(f"{value:8.3f}" for value in table[-1]), flush=True)
    print(f"{'mean':10}" + "".join(f"{value:8.3f}" for value in np.mean(table, axis=0)))


def people(seed: int) -> None:
    print(
        "people left out of the model: RMS of vertices in mm; distance of the true face to the surface, mean"
    )
    print(f"{'':10}{'basis':>8}{'ours':>8}{'peer':>8}   |{'basis':>8}{'ours':>8}{'peer':>8}")
    for name in IDENTITIES[1:]:
        model, landmarks = ict_model(name)
        with np.load(face_data("ict_faces.npz")) as data:
            shape = data[f"shape_{name}"].astype(float)
        scan, scan_from_shape = raw_like(shape, model.faces, seed)
        right = transform_points(scan_from_shape, shape)
        fitted, found, _, _ = ours(scan, model)
        rng = np.random.default_rng(seed)
        points = right[landmarks[17:]] + rng.normal(0, LANDMARK_MM, (51, 3))
        ways = (
            best_of_basis(right, model),
            in_scan(fitted, found.vertices),
            by_landmarks(points, model, landmarks[17:])[0],
        )
        row = [vertex_rms(one, right) for one in ways]
        row += [float(ClosestPointQuery(one, model.faces).query(right[FACE]).distance.mean()) for one in ways]
        print(f"{name:10}" + "".join(f"{value:8.3f}" for value in row), flush=True)


def blendshapes(mixtures: int, seed: int) -> None:
    """Print how well the weights of three expressions at once are found, of people in the model and not."""
    print(
        "weights of blendshapes, mixtures of three of twelve: mean and greatest error, person in / left out"
    )
    for name in IDENTITIES[1:]:
        row = list[float]()
        for without in ("", name):
            model, _ = ict_model(without)
            with (
                np.load(face_data("ict_faces.npz")) as data,
                np.load(face_data("ict_expressions.npz")) as moves,
            ):
                shape, names = data[f"shape_{name}"].astype(float), tuple(moves.files)
            basis = np.array(model.basis, float)
            basis[..., model.shapes :] /= EXPRESSION_SD
            model, errors = replace(model, basis=basis, names=names), list[FloatArray]()
            for number in range(mixtures):
                rng, truth = np.random.default_rng([seed, number]), np.zeros(len(names))
                truth[rng.choice(len(names), 3, replace=False)] = rng.uniform(0.3, 0.9, 3)
                face = shape + basis[..., model.shapes :] @ truth
                scan, _ = raw_like(face, model.faces, seed + number)
                _, found, _, _ = ours(scan, model)
                errors.append(np.abs(found.coefficients[model.shapes :] - truth))
            row += [float(np.mean(errors)), float(np.max(errors))]
        print(f"{name:10}" + "".join(f"{value:8.3f}" for value in row), flush=True)


def real_scans() -> None:
    print(
        "real scans: mean distance of the scan's face to the model, mm; 51 landmarks placed by hand, mean mm"
    )
    print(f"{'':14}{'ours':>8}{'peer':>8}   |{'ours':>8}{'peer':>8}")
    model, landmarks = ict_model()
    for name, file in (("james", "james_ibug68.csv"), ("flame_scan", "flame_scan_ibug51.csv")):
        scan = s2a.load_scan(face_data(f"{name}.obj"))
        placed = np.loadtxt(face_data(file), delimiter=",")[-51:] * scan.mm_per_unit
        fitted, found, _, _ = ours(scan, model)
        own, peer = in_scan(fitted, found.vertices), by_landmarks(placed, model, landmarks[17:])[0]
        face = in_scan(fitted, fitted.vertices[~np.isnan(fitted.residual_mm)])
        row = [float(ClosestPointQuery(one, model.faces).query(face).distance.mean()) for one in (own, peer)]
        row += [float(np.linalg.norm(one[landmarks[17:]] - placed, axis=1).mean()) for one in (own, peer)]
        print(f"{name:14}" + "".join(f"{value:8.3f}" for value in row), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=Path(__file__).name)
    parser.add_argument("--shapes", type=int, default=8)
    parser.add_argument("--mixtures", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    own_shapes(chosen.shapes, chosen.seed)
    people(chosen.seed)
    blendshapes(chosen.mixtures, chosen.seed)
    real_scans()


if __name__ == "__main__":
    main()
