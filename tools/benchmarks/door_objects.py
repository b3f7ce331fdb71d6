"""Forty-three objects of a head's size that are not faces."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import trimesh

from benchmarks.door_scans import light_stage_head, random_body
from benchmarks.scan_files import face_data
from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray
from scan2albedo.io import load_scan
from scan2albedo.synthetic.sitter import BodyPart, Mesh, compact, grid_faces, join, shoulder_sheet, sit_down

Maker = Callable[[], Mesh]


def wrong_object(number: int) -> tuple[str, RawScan]:
    """Return the name of one of the objects, and its scan."""
    name = sorted(wrong_objects())[number]
    return name, RawScan(*wrong_objects()[name](), name=name.replace(" ", "-"))


@cache
def wrong_objects() -> dict[str, Maker]:
    """Return what makes each object, by its name."""
    objects: dict[str, Maker] = {
        "plane": lambda: _grid(lambda x, y: 0 * x),
        "waves": lambda: _grid(lambda x, y: 8 * np.sin(x / 14) + 6 * np.cos(y / 17)),
        "saddle": lambda: _grid(lambda x, y: (x**2 - y**2) / 300),
        "dome": lambda: _grid(lambda x, y: 70 * np.exp(-(x**2 + y**2) / 9000)),
        "ridge": lambda: _grid(lambda x, y: 25 * np.exp(-((x / 12) ** 2)) - x**2 / 200),
        "three bumps": lambda: _grid(_three_bumps),
        "stairs": lambda: _grid(lambda x, y: 12 * np.floor(y / 30)),
        "clothes": lambda: shoulder_sheet(np.zeros((1, 3)), np.random.default_rng(3)),
        "hair": _hair,
        "hand": _hand,
        "machined part": machined_part,
        "sunglasses": lambda: _file("sunglasses_khronos.glb", "m"),
        "frame": lambda: _file("frame_giraut.stl", "mm"),
    }
    for radius in (60.0, 90.0, 120.0):
        objects[f"ball {radius:.0f}"] = partial(_ball, radius)
        objects[f"cylinder {radius:.0f}"] = partial(_cylinder, radius)
        objects[f"torus {radius:.0f}"] = partial(_torus, radius)
    for width in (120.0, 180.0):
        objects[f"cube {width:.0f}"] = partial(_box, width, width, width)
        objects[f"box {width:.0f}"] = partial(_box, width, 1.4 * width, width / 2)
        objects[f"cone {width:.0f}"] = partial(_cone, width)
        objects[f"capsule {width:.0f}"] = partial(_capsule, width)
    for number in range(3):
        objects[f"vase {number}"] = partial(_vase, number)
    for number in range(5):
        objects[f"body {number}"] = partial(_body, number)
        objects[f"back of head {number}"] = partial(_back, number)
    return objects


def _mesh(mesh: trimesh.Trimesh, divisions: int = 0) -> Mesh:
    """Return its vertices and faces, so often divided that edges are below 12 mm."""
    for _ in range(divisions):
        if mesh.edges_unique_length.max() > 12:
            mesh = mesh.subdivide()
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def _ball(radius: float) -> Mesh:
    return _mesh(trimesh.creation.icosphere(5, radius))


def _cylinder(radius: float) -> Mesh:
    return _mesh(trimesh.creation.cylinder(radius, 3 * radius, sections=90), 6)


def _torus(radius: float) -> Mesh:
    return _mesh(trimesh.creation.torus(radius, radius / 2.5))


def _box(*extents: float) -> Mesh:
    return _mesh(trimesh.creation.box(extents), 6)


def _cone(width: float) -> Mesh:
    return _mesh(trimesh.creation.cone(width / 2, 1.2 * width, sections=90), 6)


def _capsule(height: float) -> Mesh:
    return _mesh(trimesh.creation.capsule(height, height / 2.4))


def _body(number: int) -> Mesh:
    return random_body(np.random.default_rng([53, number]))


def _grid(height: Callable[[FloatArray, FloatArray], FloatArray]) -> Mesh:
    """Return a height field over 200 x 250 mm."""
    x, y = np.meshgrid(np.linspace(-100, 100, 60), np.linspace(-125, 125, 75))
    return np.stack([x, y, height(x, y)], -1).reshape(-1, 3), grid_faces(75, 60)[:, ::-1]


def _three_bumps(x: FloatArray, y: FloatArray) -> FloatArray:
    z = -(x**2) / 180 - y**2 / 300
    for at_x, at_y, high in ((-32, 30, 14), (32, 30, 14), (0, -35, 20)):
        z = z + high * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / 400)
    return z


def _hair() -> Mesh:
    sitter = sit_down(17, expression="neutral", model=AnnotatedFaceModel.default())
    return compact(sitter.vertices, sitter.faces[sitter.part == BodyPart.HAIR])


def _hand() -> Mesh:
    """Return a palm and five fingers."""
    palm = trimesh.creation.icosphere(4)
    palm.apply_scale([45, 55, 16])
    parts = [_mesh(palm)]
    for x, length, lean in (
        (-34, 65, 0.25),
        (-12, 78, 0.05),
        (12, 74, -0.05),
        (34, 58, -0.2),
        (-48, 50, 0.9),
    ):
        finger = trimesh.creation.capsule(length, 10)
        finger.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        finger.apply_transform(trimesh.transformations.rotation_matrix(lean, [0, 0, 1]))
        finger.apply_translation([x, 40 if lean < 0.5 else 0, 0])
        parts.append(_mesh(finger))
    return join(parts)


def machined_part() -> Mesh:
    """Return a bearing block of 94 mm: plate, boss, two ribs, four screws."""
    make = trimesh.creation
    boss = make.cylinder(21, 38, sections=60)
    boss.apply_translation([0, 0, 25])
    ribs = [make.box((6, 70, 24)), make.box((6, 70, 24))]
    for rib, x in zip(ribs, (-26, 26), strict=True):
        rib.apply_translation([x, 0, 16])
    screws = [make.cylinder(5, 10, sections=30) for _ in range(4)]
    for screw, (x, y) in zip(screws, ((-38, -30), (38, -30), (-38, 30), (38, 30)), strict=True):
        screw.apply_translation([x, y, 10])
    return join([_mesh(part, 6) for part in (make.box((94, 76, 12)), boss, *ribs, *screws)])


def _vase(number: int) -> Mesh:
    """Return a solid of revolution with a random profile."""
    rng = np.random.default_rng([59, number])
    up, turn = np.linspace(-130, 130, 80), np.linspace(0, 2 * np.pi, 120, endpoint=False)
    radius = np.full((80, 1), 70.0)
    for _ in range(3):
        radius[:, 0] += rng.uniform(4, 14) * np.sin(up / rng.uniform(15, 50) + rng.uniform(0, 6))
    points = np.stack(
        [radius * np.sin(turn), np.broadcast_to(up[:, None], (80, 120)), radius * np.cos(turn)], -1
    )
    return points.reshape(-1, 3), grid_faces(80, 120, wrap=True)[:, ::-1]


def _back(number: int) -> Mesh:
    head = light_stage_head(np.random.default_rng([61, number]), {}, hair=number % 2 == 1)
    behind = head.vertices[:, 2] < head.rest[[0, 16], 2].mean() - 10
    return compact(head.vertices, head.faces[behind[head.faces].all(1)])


def _file(name: str, unit: str) -> Mesh:
    scan = load_scan(face_data(name), unit=unit)
    return scan.vertices, scan.faces
