"""Raw scans of light-stage people, several sessions each, path-traced, for recognition.

Shapes are random blends of the identities in ../shared/data/ict_faces.npz with relief of their own, the skin
is procedural, light, gloss and bounce are Mitsuba's: nothing here is code that the pipeline runs.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.synthetic.raw_scan import Scanner, assembled, random_pose
from scan2albedo.synthetic.sitter import nose_tip
from scan2albedo.synthetic.textures import HEMOGLOBIN, PaintedFeatures, paint_face, smooth_noise
from worlds.files import write_obj
from worlds.lamps import COOL, WARM, Environment, Lamp, Part as Source, Rig
from worlds.light_stage import LightStage
from worlds.path_tracer import LightTable, Part, Studio, exposure_of, stored
from worlds.pictures import (
    CENTER_FROM_NOSE_MM,
    Pictured,
    bilinear,
    filled,
    measured_by,
    pictured,
    pods_around,
    row_of,
    used_pixels,
)

SESSIONS = (
    ("studio", "neutral"),
    ("flash", "neutral"),
    ("lamp", "mixed"),
    ("studio", "mixed"),
)
"""Light and expression of each session; the first is the gallery's, whose lamps the last one has too."""
SCANNER = Scanner(spacing_mm=2.0, noise_mm=0.15, spikes=8, holes=3, crumbs=3)
_SEED = 0
"""Of the population."""
_PATHS = 64
"""Of a ray."""
_PIXELS = 448
"""Of a side of a picture."""
_BACKDROP = 0.02
"""Albedo behind the head."""
_CHART_MM = 200.0
"""Millimetres of a unit of the paint's chart."""
_RADIUS_MM = 90.0
"""Of the cylinder on which the head is unrolled."""
_AXIS_Z_MM = 20.0
"""Of the cylinder's axis, behind the middle of the head."""
_IDENTITY_SPREAD = 0.55
"""Standard deviation of the weights of identities."""
_RELIEF_MM = 0.7
"""Standard deviation of a person's own relief, in halves of two lengths."""
_RELIEF_LENGTHS_MM = (14.0, 30.0)
_COMMON = 0.35
"""Share of the logarithmic albedo that is common to all."""


@dataclass(frozen=True)
class Unrolled:
    """The light-stage head unrolled on a cylinder around it; `texels` are rows and columns of its albedo."""

    stage: LightStage
    texels: tuple[int, int] = (640, 1024)

    @property
    def generic(self) -> FloatArray:
        """(V, 3) of the mean head."""
        return self.stage.shapes["generic_neutral"]

    def millimetres(self) -> FloatArray:
        """Return (V, 2) of the generic head, to the left and up."""
        x, y, z = self.generic.T
        return np.stack([np.arctan2(x, z + _AXIS_Z_MM) * _RADIUS_MM, y], 1)

    def extent(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest corner and the size of the chart, mm."""
        around = np.pi * _RADIUS_MM
        y = self.generic[:, 1]
        return np.array([-around, y.min()]), np.array([2 * around, np.ptp(y)])

    def uv(self) -> FloatArray:
        """Return (V, 2) texture coordinates, rows counted downward."""
        low, span = self.extent()
        return (self.millimetres() - low) / span * [1, -1] + [0, 1]

    def grid(self) -> FloatArray:
        """Return (rows columns, 2) centres of texels in [0, 1], the first row the top."""
        rows, columns = self.texels
        v, u = np.mgrid[:rows, :columns]
        return np.stack([(u.ravel() + 0.5) / columns, 1 - (v.ravel() + 0.5) / rows], 1)

    def painted(self, rng: np.random.Generator, *, own_marks: bool = True) -> FloatArray:
        """Return (R, C, 3) linear albedo, brows and lips where the generic head has them."""
        low, span = self.extent()
        features = PaintedFeatures(
            brow_thickness=float(rng.uniform(0.6, 1.4)),
            brow_lift=float(rng.uniform(-0.008, 0.008)),
            brow_arch=float(rng.uniform(-0.003, 0.01)),
            brow_reach=float(rng.uniform(0.75, 1.1)),
            lip_fullness=float(rng.uniform(-0.005, 0.005)),
        )
        albedo = paint_face(
            (low + self.grid() * span) / _CHART_MM + 0.5,
            self.millimetres()[self.stage.landmarks] / _CHART_MM + 0.5,
            rng,
            tone=float(rng.uniform(0.15, 0.5)),
            marks=own_marks,
            features=features,
        )
        return albedo.reshape(*self.texels, 3)


@dataclass(frozen=True)
class TracedPerson:
    """Shape (V, 3) in mm with a neutral face, and linear albedo (R, C, 3) around the head."""

    shape: FloatArray
    albedo: FloatArray

    @classmethod
    def random(cls, head: Unrolled, person: int, seed: int) -> TracedPerson:
        """Return one person of a population."""
        own = np.random.default_rng([seed, person, 41])
        identities = np.stack(list(head.stage.shapes.values())[1:]) - head.generic
        blend = own.normal(0, _IDENTITY_SPREAD, len(identities))
        shape = head.generic + np.einsum("k,kvc->vc", blend, identities)
        shape = shape + _relief(head.generic, own)[:, None] * vertex_normals(shape, head.stage.faces)
        common = head.painted(np.random.default_rng([seed, 42]), own_marks=False)
        return cls(shape, np.exp((1 - _COMMON) * np.log(head.painted(own)) + _COMMON * np.log(common)))


def _relief(generic: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (V,) millimetres along the normals: smooth noise of two lengths, alike on the left and right."""
    mirrored = np.abs(generic) * [1, 0, 0] + generic * [0, 1, 1]
    relief = np.zeros(len(mirrored))
    for length in _RELIEF_LENGTHS_MM:
        cells = 400.0 / length
        plane = (mirrored[:, :2] + 200.0) / 400.0
        relief += _RELIEF_MM / len(_RELIEF_LENGTHS_MM) * smooth_noise(plane, (cells, cells), rng)
    return relief


def rig_of(light: str, rng: np.random.Generator) -> Rig:
    """Return the lamps of a session: softboxes of a studio, a flash from a side, or a lamp in a warm room."""
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    parts: tuple[Source, ...]
    if light == "studio":  # the same lamps for everybody
        left, right = (Lamp(azimuth, 15, 1500.0, (350.0, 350.0)) for azimuth in (-42, 48))
        parts = (Source(left, 0.6), Source(right, 0.45, COOL), Source(Environment("dim_room"), 0.12))
    elif light == "flash":
        flash = Lamp(side * rng.uniform(20, 60), rng.uniform(-5, 35), rng.uniform(700, 1100), (20.0,))
        parts = (Source(flash, 1.0), Source(Environment("dim_room"), 0.14))
    else:
        lamp = Lamp(side * rng.uniform(25, 60), rng.uniform(15, 45), 1700.0, (120.0,))
        parts = (Source(lamp, 0.8, WARM), Source(Environment("dim_room"), 0.35))
    return Rig(light, parts)


def session_shape(
    stage: LightStage, shape: FloatArray, expression: str, rng: np.random.Generator
) -> FloatArray:
    """Return (V, 3) of a person now: three expressions at once, none of them strong."""
    if expression == "neutral":
        return shape
    moves = np.stack(list(stage.expressions.values()))
    weights = np.zeros(len(moves))
    chosen = rng.choice(len(weights), 3, replace=False)
    weights[chosen] = rng.uniform(0.1, 0.4, 3)
    return shape + np.einsum("e,evc->vc", weights, moves)


def _photographs(
    head: Unrolled, part: Part, pods: FloatArray, used: BoolArray, rig: Rig, number: int
) -> FloatArray:
    """Return the photographs side by side (S, K S, 3), linear, of 8 bits and with noise.

    Light is traced at every second pixel, relative to the albedo there, and multiplied by that of all pixels.
    """
    seen = pictured(part.vertices, part.faces, pods, _PIXELS // 2)
    used = used & seen.hit
    table = LightTable(Studio([part], nearest=False), *seen.before(used), _PATHS, number)
    radiance = table.under(rig)
    light = np.zeros(seen.position.shape)
    light[used] = radiance / _paint(head, part, seen)[used]
    fine = [
        cv2.resize(picture, (_PIXELS, _PIXELS)) for picture in filled(light, used, len(pods), _PIXELS // 2)
    ]
    seen = pictured(part.vertices, part.faces, pods, _PIXELS)
    rng = np.random.default_rng([number, 43])
    balance = np.exp(0.03 * rng.standard_normal(3) * [1, 0, 1])
    shown = np.where(seen.hit[:, None], _paint(head, part, seen), _BACKDROP)
    picture = shown * np.stack(fine).reshape(-1, 3)
    return row_of(stored(exposure_of(radiance) * balance * picture, rng), len(pods), _PIXELS)


def _paint(head: Unrolled, part: Part, seen: Pictured) -> FloatArray:
    """Return (N, 3) the albedo that pixels show, 1 where they show nothing."""
    hit, paint = seen.hit, np.ones(seen.position.shape)
    corners = part.uv[part.faces[seen.face[hit]]]
    uv = np.einsum("nk,nkc->nc", seen.barycentric[hit], corners)
    place = (uv[:, ::-1] * head.texels - 0.5).T
    paint[hit] = bilinear(part.albedo.astype(float), place)
    return paint


def build_session(
    head: Unrolled,
    someone: TracedPerson,
    person: int,
    session: int,
    path: Path,
) -> None:
    """Write one scan as OBJ, MTL and PNG, of two pictures of `_PIXELS` x `_PIXELS`."""
    stage, (light, expression) = head.stage, SESSIONS[session]
    rng = np.random.default_rng([_SEED, person, session, 44])
    vertices = session_shape(stage, someone.shape, expression, rng)
    # Today's blood: a little more or less of it here and there.
    blood = 0.03 * rng.standard_normal() + 0.03 * smooth_noise(head.grid(), (12, 8), rng)
    albedo = someone.albedo * np.exp(-blood.reshape(*head.texels, 1) * HEMOGLOBIN)
    rig = rig_of(light, rng)
    normals, paint = vertex_normals(vertices, stage.faces), np.clip(albedo, 0.01, 0.95).astype(np.float32)
    part = Part("face", vertices, normals, stage.faces, head.uv(), paint, None, "skin")
    tip = nose_tip(vertices)
    pods = pods_around(tip + CENTER_FROM_NOSE_MM, 2)
    measured = measured_by(pods, vertices, stage.faces, tip, SCANNER, rng)
    number = 1000 * (_SEED + 1) + 10 * person + session
    used = used_pixels(measured, pods, _PIXELS // 2)
    texture = _photographs(head, part, pods, used, rig, number).astype(np.float32)
    pose = random_pose(rng, 30.0)
    write_obj(assembled(measured, pods, texture, pose, SCANNER, rng, path.stem), path)


def build_people(manifest: Path, persons: int) -> Iterator[Path]:
    """Write the scans that are missing, and a manifest of all beside them; yield each scan's path."""
    head, folder = Unrolled(LightStage.load()), manifest.parent
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for person in range(persons):
        someone: TracedPerson | None = None
        for session, (light, expression) in enumerate(SESSIONS):
            path = folder / f"p{person:03d}_{session}_{light}.obj"
            if not path.is_file():
                someone = someone or TracedPerson.random(head, person, _SEED)
                build_session(head, someone, person, session, path)
            rows.append([f"p{person:03d}", str(session), path.name, light, expression])
            yield path
    with manifest.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [["person", "session", "scan", "light", "expression"], *rows]
        )
