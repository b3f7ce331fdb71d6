"""Heads of the light-stage set ICT-FaceKit (../shared/data/ict_*.npz): five people, expressions, mixtures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.geometry.mesh import boundary_loops
from scan2albedo.synthetic.sitter import Mesh, hair_shell, join
from worlds.files import face_data

NEUTRAL = ("generic_neutral", "person1", "person2", "person3", "person4")
"""The people without expression; the first one is their mean."""
FACE_VERTICES = 6706
"""Vertices of the face without neck, ears and scalp; they come first."""
_SMILE = "shape_generic_mouthSmile_L_mouthSmile_R"
_SPREAD = 0.35
"""Standard deviation of the weights of people about the mean of a mixture."""
_EYE_MM = 4.0
"""Height of the fans that close the eyes."""
_HAIR_SHARE = 0.7
"""Part of the mixtures that have hair."""


@dataclass(frozen=True)
class LightStage:
    """Heads in mm that look along +z, +y up.

    `shapes` (V, 3) by names of `NEUTRAL`, their `faces` (F, 3), vertices of 68 `landmarks` (iBUG order),
    `face_area` (A, 3) the first of the faces, without head and neck, `corner_uv` (F, 3, 2) of two tiles side
    by side, and displacements (V, 3) by `expressions` and for a `smile`.
    """

    shapes: dict[str, FloatArray]
    faces: IntArray
    landmarks: IntArray
    face_area: IntArray
    corner_uv: FloatArray
    expressions: dict[str, FloatArray]
    smile: FloatArray

    @classmethod
    @cache
    def load(cls) -> LightStage:
        """Return the set; SystemExit where it is absent."""
        with np.load(face_data("ict_expressions.npz")) as data:
            expressions = {name: data[name].astype(float) for name in sorted(data)}
        with np.load(face_data("ict_faces.npz")) as data:
            shapes = {name: data[f"shape_{name}"].astype(float) for name in NEUTRAL}
            faces = data["faces"].astype(np.int64)
            return cls(
                shapes,
                faces,
                data["landmarks68"].astype(np.int64),
                faces[: int(data["face_area_faces"])],
                data["uv"].astype(float)[data["uv_faces"]],
                expressions,
                data[_SMILE] - shapes["generic_neutral"],
            )


@dataclass(frozen=True)
class LightStageHead:
    """A head: `vertices` (V, 3) mm, `faces` (F, 3), `landmarks` and those at `rest` (68, 3)."""

    vertices: FloatArray
    faces: IntArray
    landmarks: FloatArray
    rest: FloatArray
    expressions: tuple[str, ...]


def light_stage_head(
    rng: np.random.Generator, expressions: dict[str, float] | None = None, *, hair: bool = True
) -> LightStageHead:
    """Return a random person's head; up to three expressions are drawn, with any weight, when None.

    Eyes and the mouth, which are holes in the set, are closed: by balls, and by a pit as deep as the mouth
    is open.
    """
    stage = LightStage.load()
    moves = stage.expressions | {"smile": stage.smile}
    if expressions is None:
        drawn = rng.choice(sorted(moves), rng.integers(4), replace=False)
        expressions = {str(name): float(rng.uniform(0.2, 1.0)) for name in drawn}
    weights = rng.normal(scale=_SPREAD, size=len(stage.shapes))
    weights += 1 / len(weights) - weights.mean()
    rest = np.einsum("p,pvc->vc", weights, np.stack(list(stage.shapes.values())))
    moved = rest.copy()
    for name, amount in expressions.items():
        moved += amount * moves[name]
    mesh = _closed(moved, stage.faces, stage.landmarks)
    if hair and rng.uniform() < _HAIR_SHARE:
        thick = rng.uniform(5, 18)
        drop = rng.uniform(0, 30)
        mesh = join([mesh, hair_shell(*mesh, rng, thickness_mm=thick, side_drop_deg=drop)])
    at = stage.landmarks
    return LightStageHead(mesh[0], mesh[1], moved[at], rest[at], tuple(expressions))


def _closed(vertices: FloatArray, faces: IntArray, landmarks: IntArray) -> Mesh:
    """Return the head with fans over its eyes and its mouth."""
    points, fans = [vertices], [faces]
    mouth = vertices[landmarks[48:]].mean(0)
    for loop in boundary_loops(faces):
        rim = vertices[loop]
        if np.ptp(rim[:, 0]) > 100:  # below the neck
            continue
        in_mouth = np.linalg.norm(rim.mean(0) - mouth) < 25
        depth = -0.5 * np.ptp(rim[:, 1]) if in_mouth else _EYE_MM
        middle = np.full(len(loop), sum(map(len, points)))
        points.append((rim.mean(0) + [0, 0, depth])[None])
        fans.append(np.stack([np.roll(loop, -1), loop, middle], 1))
    return np.concatenate(points), np.concatenate(fans)
