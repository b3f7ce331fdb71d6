"""What is not a face: forty-three objects of a head's size, random reliefs and bodies."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from scan2albedo import AnnotatedFaceModel
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import FloatArray, grid_faces
from scan2albedo.io import load_scan
from scan2albedo.synthetic.sitter import BodyPart, Mesh, compact, join, shoulder_sheet, sit_down
from worlds.files import face_data
from worlds.light_stage import light_stage_head

Maker = Callable[[], Mesh]
_EDGE_MM = 12.0
"""Triangles of large flat sides are divided until their edges are this short."""


def wrong_object(number: int) -> tuple[str, RawScan]:
    """Return the name of one of the objects, and its scan."""
    name = sorted(wrong_objects())[number]
    return name, RawScan(*wrong_objects()[name](), name=name.replace(" ", "-"))


@cache
def wrong_objects() -> dict[str, Maker]:
    """Return what makes each object, by its name."""
    make = trimesh.creation
    objects: dict[str, Maker] = {
        "plane": partial(_grid, lambda x, y: 0 * x),
        "waves": partial(_grid, lambda x, y: 8 * np.sin(x / 14) + 6 * np.cos(y / 17)),
        "saddle": partial(_grid, lambda x, y: (x**2 - y**2) / 300),
        "dome": partial(_grid, lambda x, y: 70 * np.exp(-(x**2 + y**2) / 9000)),
        "ridge": partial(_grid, lambda x, y: 25 * np.exp(-((x / 12) ** 2)) - x**2 / 200),
        "three bumps": partial(_grid, _three_bumps),
        "stairs": partial(_grid, lambda x, y: 12 * np.floor(y / 30)),
        "clothes": lambda: shoulder_sheet(np.zeros((1, 3)), np.random.default_rng(3)),
        "hair": _hair,
        "hand": _hand,
        "machined part": machined_part,
        "sunglasses": partial(_file, "sunglasses_khronos.glb", "m"),
        "frame": partial(_file, "frame_giraut.stl", "mm"),
    }
    for radius in (60.0, 90.0, 120.0):
        objects[f"ball {radius:.0f}"] = partial(_made, make.icosphere, 5, radius)
        objects[f"cylinder {radius:.0f}"] = partial(_divided, make.cylinder, radius, 3 * radius, sections=90)
        objects[f"torus {radius:.0f}"] = partial(_made, make.torus, radius, radius / 2.5)
    for width in (120.0, 180.0):
        objects[f"cube {width:.0f}"] = partial(_divided, make.box, (width, width, width))
        objects[f"box {width:.0f}"] = partial(_divided, make.box, (width, 1.4 * width, width / 2))
        objects[f"cone {width:.0f}"] = partial(_divided, make.cone, width / 2, 1.2 * width, sections=90)
        objects[f"capsule {width:.0f}"] = partial(_made, make.capsule, width, width / 2.4)
    for number in range(3):
        objects[f"vase {number}"] = partial(_vase, number)
    for number in range(5):
        objects[f"body {number}"] = partial(_body, number)
        objects[f"back of head {number}"] = partial(_back, number)
    return objects


def _made(create: Callable[..., trimesh.Trimesh], *sizes: Any, **options: Any) -> Mesh:
    """Return vertices and faces of what a creator of trimesh makes."""
    return _mesh_of(create(*sizes, **options))


def _divided(create: Callable[..., trimesh.Trimesh], *sizes: Any, **options: Any) -> Mesh:
    """Return the same with edges below `_EDGE_MM`."""
    mesh = create(*sizes, **options)
    while mesh.edges_unique_length.max() > _EDGE_MM:
        mesh = mesh.subdivide()
    return _mesh_of(mesh)


def _mesh_of(mesh: trimesh.Trimesh) -> Mesh:
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def _moved(mesh: Mesh, x: float, y: float, z: float) -> Mesh:
    return mesh[0] + [x, y, z], mesh[1]


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
    parts = [_mesh_of(palm)]
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
        parts.append(_moved(_mesh_of(finger), x, 40 if lean < 0.5 else 0, 0))
    return join(parts)


def machined_part() -> Mesh:
    """Return a bearing block of 94 mm: plate, boss, two ribs, four screws."""
    make = trimesh.creation
    plate = _divided(make.box, (94, 76, 12))
    boss = _moved(_divided(make.cylinder, 21, 38, sections=60), 0, 0, 25)
    rib = _divided(make.box, (6, 70, 24))
    screw = _divided(make.cylinder, 5, 10, sections=30)
    ribs = [_moved(rib, x, 0, 16) for x in (-26, 26)]
    screws = [_moved(screw, x, y, 10) for y in (-30, 30) for x in (-38, 38)]
    return join([plate, boss, *ribs, *screws])


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


def random_relief(rng: np.random.Generator) -> Mesh:
    """Return a shield of 220 x 260 mm with waves of three lengths."""
    size = 70
    height = np.zeros((size, size))
    for amplitude_mm, length in ((12, 8), (5, 4), (1.5, 1.5)):
        noise = gaussian_filter(rng.normal(size=(size, size)), length)
        height += amplitude_mm * noise / noise.std()
    x, y = np.meshgrid(np.linspace(-110, 110, size), np.linspace(-130, 130, size))
    z = 60 * np.sqrt(np.maximum(0, 1 - (x / 140) ** 2 - (y / 170) ** 2)) + height
    return np.stack([x, y, z], -1).reshape(-1, 3), grid_faces(size, size)[:, ::-1]


def _body(number: int) -> Mesh:
    return random_body(np.random.default_rng([53, number]))


def random_body(rng: np.random.Generator) -> Mesh:
    """Return an ellipsoid of a head's size with 25 bumps and dents."""
    ball = trimesh.creation.icosphere(4)
    unit = np.asarray(ball.vertices)
    height = np.zeros(len(unit))
    for _ in range(25):
        center, width = rng.normal(size=3) / 1.2, rng.uniform(0.15, 0.5)
        height += rng.normal() * np.exp(-((unit - center) ** 2).sum(1) / (2 * width**2))
    return unit * (1 + 0.1 * height)[:, None] * [75.0, 100.0, 90.0], np.asarray(ball.faces, np.int64)
