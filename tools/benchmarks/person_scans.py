"""Light-stage people scanned several times: expression, pose, coverage and size differ from scan to scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from worlds.files import face_data
from worlds.raw_like import raw_like

import scan2albedo as s2a
from benchmarks.landmark_cases import LightStage, expressions_of_light_stage
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.rigid import transform_points

SMILE = "generic_mouthSmile_L_mouthSmile_R"
SCALE_SD = 0.02
"""Of the logarithm of a scanner's unit."""


@dataclass(frozen=True)
class PersonScan:
    """A raw-like scan; `scan_from_shape` (4, 4) maps the person's own frame and millimetres into it."""

    scan: s2a.RawScan
    scan_from_shape: FloatArray
    weights: dict[str, float]


def moves_of_light_stage(people: LightStage) -> dict[str, FloatArray]:
    """Return displacements (V, 3) mm of thirteen expressions by name."""
    with np.load(face_data("ict_faces.npz")) as data:
        smile = data[f"shape_{SMILE}"].astype(float) - people.shapes["generic_neutral"]
    return expressions_of_light_stage() | {"smile": smile}


def person_scan(
    people: LightStage, moves: dict[str, FloatArray], person: str, seed: int, *, expressions: int = 2
) -> PersonScan:
    """Return a scan of up to `expressions` random ones of weights 0 to 1, one in three without a side."""
    rng = np.random.default_rng([seed, *person.encode()])
    names = rng.choice(sorted(moves), int(rng.integers(1, expressions + 1)), replace=False)
    weights = {str(name): float(rng.uniform()) for name in names} if expressions else {}
    shape = people.shapes[person] + sum(weight * moves[name] for name, weight in weights.items())
    scale = float(np.exp(rng.normal(0, SCALE_SD)))
    scan, scan_from_shape = raw_like(shape, people.faces, int(rng.integers(2**31)), scale=scale)
    if rng.uniform() < 1 / 3:
        x = transform_points(np.linalg.inv(scan_from_shape), scan.vertices)[:, 0] * rng.choice([-1, 1])
        scan = scan.without_faces((x > rng.uniform(5, 40))[scan.faces].any(1))
    return PersonScan(scan, scan_from_shape, weights)


def face_area(people: LightStage) -> IntArray:
    """Return the triangles (F, 3) of the face, without head and neck."""
    with np.load(face_data("ict_faces.npz")) as data:
        return people.faces[: int(data["face_area_faces"])]
