"""Mouths, lamps and glasses that mislead a fit, for `bench_landmarks.py`."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np
from worlds.glasses_on_head import worn_glasses
from worlds.raw_like import raw_like

import scan2albedo as s2a
from benchmarks.landmark_cases import INNER, LightStage, cases, expressions_of_light_stage, fitted_row
from scan2albedo.errors import NoFaceError
from scan2albedo.fitting import FitOptions
from scan2albedo.fitting.landmark_pull import EYES
from scan2albedo.geometry.closest_points import NearestSurface
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.synthetic import raw_scan
from scan2albedo.synthetic.face_shape import Expression
from scan2albedo.synthetic.sitter import join

SHUT = ("cheek_puff", "mouth_frown", "mouth_pucker", "mouth_roll_lower", "mouth_roll_upper", "mouth_upper_up")
"""Expressions that leave the jaw shut; lips may part by some mm."""
OWN_SHUT: tuple[Expression, ...] = ("neutral", "smile", "frown", "pout", "puff")
LAMPS_DEG = ((0, 0), (0, 50), (0, 70), (0, 90), (0, -50), (50, 30), (-60, 0), (30, -40))
"""Directions of lamps: to the left of the face's front, and above it."""
LENS_MM = 13.0
"""Between lids and lenses, as tight sunglasses stand. Farther ones draw a fit less."""
SKIN, AMBIENT = (0.8, 0.55, 0.45), 0.08


def mouths() -> Iterator[tuple[str, s2a.RawScan, bool]]:
    """Yield names, scans, and whether the jaw is open."""
    people, every = LightStage.load(), expressions_of_light_stage()
    faces, moves = people.faces, {name: every[name] for name in (*SHUT, "jaw_open")}
    seeds = count(2000)
    for person, shape in people.shapes.items():
        for _ in range(2):
            yield f"neutral {person}", raw_like(shape, faces, next(seeds))[0], False
        for name, weight in ((name, weight) for name in moves for weight in (0.5, 0.75, 1.0)):
            scan, _ = raw_like(shape + weight * moves[name], faces, next(seeds))
            yield f"{name} {person} {weight}", scan, name == "jaw_open"
        for weight in (0.4, 0.6, 0.8, 0.9, 1.1):
            scan, _ = raw_like(shape + weight * moves["jaw_open"], faces, next(seeds))
            yield f"jaw_open {person} {weight}", scan, True
    for name, seed in ((name, seed) for name in OWN_SHUT for seed in range(12)):
        yield f"own {name} {seed}", raw_scan(100 + seed, expression=name)[0], False


def print_mouths(model: s2a.AnnotatedFaceModel) -> None:
    """Print the jaws that were judged wrongly, and how many rightly."""
    right: dict[bool, list[bool]] = {True: [], False: []}
    for name, scan, is_open in mouths():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            angle = s2a.fit(scan, model, s2a.register(scan, model)).metrics["jaw_deg"]
        right[is_open].append((angle > 0) == is_open)
        if not right[is_open][-1]:
            print(f"{name}: jaw turned by {angle:.0f} degrees")
    for is_open, each in right.items():
        print(f"{'open' if is_open else 'shut'} jaws: {sum(each)} of {len(each)} judged rightly")


def print_lamps(model: s2a.AnnotatedFaceModel) -> None:
    """Print by how much the landmarks of shapes of one colour get worse under lamps."""
    worse = []
    for case in (c for c in cases(expressions=False) if c.group in ("flame_scan", "neutral")):
        pose = s2a.register(case.scan, model).model_from_scan
        normals = vertex_normals(case.scan.vertices, case.scan.faces) @ pose[:3, :3].T
        plain = fitted_row(case, model, pose).error_mm[INNER]
        parts = []
        for beside, above in np.deg2rad(LAMPS_DEG):
            toward = [np.sin(beside) * np.cos(above), np.sin(above), np.cos(beside) * np.cos(above)]
            light = AMBIENT + np.maximum(normals @ toward, 0)
            lit = replace(case.scan, vertex_color_linear=light[:, None] * SKIN)
            row = fitted_row(replace(case, scan=lit), model, pose)
            worse.append(float(np.nanmean(row.error_mm[INNER] - plain)))
            parts.append(f"{worse[-1]:+8.2f}")
        print(f"{case.name:28}" + "".join(parts))
    print(f"mean {np.mean(worse):+.2f}, worst {np.max(worse):+.2f} mm")


def print_glasses(model: s2a.AnnotatedFaceModel) -> None:
    """Print the errors around the eyes, mm, of shapes without and with glasses, covers kept and left out."""
    people = LightStage.load()
    faces, at = people.faces, people.landmarks
    print(f"{'':28}{'surface by the eyes':>20}{'elsewhere':>12}{'eyes':>8}{'all 51':>8}")
    found: dict[str, list[list[float]]] = {}
    for seed, (name, shape) in enumerate(people.shapes.items()):
        eyes = shape[at[36:48]].mean(0)
        dressed = join([(shape, faces), worn_glasses((shape, faces), eyes, seed, LENS_MM)])
        for label, mesh, covers in (
            ("bare", (shape, faces), True),
            ("glasses, followed", dressed, False),
            ("glasses", dressed, True),
        ):
            scan, scan_from_shape = raw_like(*mesh, seed)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    pose = s2a.register(scan, model)
                except NoFaceError as error:
                    print(f"{label} {name}: refused with {error.confidence:.2f}")
                    continue
                fitted = s2a.fit(scan, model, pose, options=FitOptions(covers=covers))
            shape_from_model = np.linalg.inv(fitted.model_from_scan @ scan_from_shape)
            points = transform_points(shape_from_model, fitted.vertices)
            distance = NearestSurface(shape, faces).query(points).distance
            middles = [shape[at[list(eye)]].mean(0) for eye in EYES]
            by_eyes = np.min([np.linalg.norm((points - eye)[:, :2], axis=1) for eye in middles], axis=0) < 28
            assert fitted.landmarks is not None
            landmarks = transform_points(shape_from_model, fitted.landmarks)
            off = np.linalg.norm(landmarks - shape[at], axis=1)
            row = [distance[by_eyes].mean(), distance[~by_eyes].mean(), off[36:48].mean(), off[INNER].mean()]
            found.setdefault(label, []).append(row)
            print(_glasses_line(f"{label} {name}", row))
    print()
    for label, rows in found.items():
        print(_glasses_line(label, np.mean(rows, axis=0).tolist()))


def _glasses_line(label: str, row: list[float]) -> str:
    return f"{label:28}{row[0]:20.2f}{row[1]:12.2f}{row[2]:8.2f}{row[3]:8.2f}"
