"""Landmark and surface errors on the measured faces beside the repository.

    python tools/evaluate_real_faces.py [--poses 3]

The real scan and its hand-placed landmarks; and every shape of the light-stage set, made raw-like
(noise, holes, hair, shoulders) and put into random poses. Needs ../shared/data.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from worlds.files import face_data
from worlds.raw_like import raw_like

import scan2albedo as s2a
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, procrustes, rotation_angle_rad, transform_points

INNER = slice(17, 68)
WRONG_POSE_DEG, WRONG_POSE_MM = 10.0, 15.0


def landmark_errors(fitted: s2a.FittedFace, truth_in_scan: NDArray[np.float64]) -> NDArray[np.float64]:
    """(68,) distances in mm between found and given landmarks."""
    assert fitted.landmarks is not None
    return np.linalg.norm(fitted.landmarks - transform_points(fitted.model_from_scan, truth_in_scan), axis=1)


def real_scan(model: s2a.AnnotatedFaceModel) -> None:
    scan = s2a.load_scan(face_data("james.obj"))
    fitted = s2a.fit(scan, model, s2a.register(scan, model))
    errors = landmark_errors(fitted, np.loadtxt(face_data("james_ibug68.csv"), delimiter=","))
    print(f"james: 51 inner landmarks {errors[INNER].mean():.2f} mm mean, all 68 {errors.mean():.2f} mm")
    print(
        f"james: fitted surface to scan {np.nanmean(fitted.residual_mm):.3f} mm mean, "
        f"{np.nanmedian(fitted.residual_mm):.3f} median"
    )


def measured_shapes(model: s2a.AnnotatedFaceModel, poses: int) -> None:
    data = np.load(face_data("ict_faces.npz"))
    faces = data["faces"].astype(np.int64)
    print(f"{'shape':48}{'pose off: deg':>14}{'mm':>7}{'51 landmarks mm':>17}{'surface mm':>12}")
    wrong = 0
    for shape in (name for name in data.files if name.startswith("shape_")):
        vertices = data[shape].astype(float)
        given = vertices[data["landmarks68"]]
        truth = procrustes(given[INNER], model.landmarks[INNER])
        face_area = faces[: int(data["face_area_faces"])]
        for seed in range(poses):
            scan, scan_from_shape = raw_like(vertices, faces, seed)
            registration = s2a.register(scan, model)
            off = registration.model_from_scan @ scan_from_shape @ invert_rigid(truth)
            center = model.landmarks[INNER].mean(0)
            angle = np.degrees(rotation_angle_rad(off[:3, :3]))
            shift = np.linalg.norm(transform_points(off, center[None])[0] - center)
            fitted = s2a.fit(scan, model, registration)
            errors = landmark_errors(fitted, transform_points(scan_from_shape, given))
            clean = transform_points(fitted.model_from_scan @ scan_from_shape, vertices)
            distance = ClosestPointQuery(clean, face_area).query(fitted.vertices).distance
            bad = angle > WRONG_POSE_DEG or shift > WRONG_POSE_MM
            wrong += bad
            print(
                f"{shape:48}{angle:14.2f}{shift:7.2f}{errors[INNER].mean():17.2f}{distance.mean():12.3f}"
                + ("  WRONG POSE" if bad else "")
            )
    print(f"wrong poses (more than {WRONG_POSE_DEG:g} deg or {WRONG_POSE_MM:g} mm off): {wrong}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=3)
    arguments = parser.parse_args()
    model = s2a.AnnotatedFaceModel.default()
    real_scan(model)
    measured_shapes(model, arguments.poses)


if __name__ == "__main__":
    main()
