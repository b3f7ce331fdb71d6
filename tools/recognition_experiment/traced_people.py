"""Raw scans of synthetic people, several sessions each, path-traced on light-stage shapes of ICT-FaceKit.

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
from benchmarks.scan_files import face_data, write_obj
from benchmarks.traced_bake import LightTable, Studio, exposure_of, stored
from benchmarks.traced_lights import COOL, WARM, Environment, Lamp, Rig
from benchmarks.traced_lights import Part as Source
from benchmarks.traced_people import Part
from benchmarks.traced_scans import CENTER_FROM_NOSE_MM, filled, pods_around, row_of, used_pixels
from scipy.ndimage import map_coordinates

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.geometry.mesh import vertex_normals
from scan2albedo.geometry.pinhole import camera_centers, pixel_directions
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.synthetic.raw_scan import RangeMesh, Scanner, assembled, capture, random_pose
from scan2albedo.synthetic.scenes import texel_coordinates
from scan2albedo.synthetic.sitter import HEAD_AXIS_FROM_NOSE_MM, nose_tip
from scan2albedo.synthetic.textures import HEMOGLOBIN, PaintedFeatures, paint_face, smooth_noise

SESSIONS = (
    ("studio", "neutral"),
    ("flash", "neutral"),
    ("lamp", "mixed"),
    ("studio", "mixed"),
)
"""Light and expression of each session; the first is the gallery's, whose lamps the last one has too."""
SCANNER = Scanner(spacing_mm=2.0, noise_mm=0.15, spikes=8, holes=3, crumbs=3)
_PICTURE, _PATHS, _CAMERAS = 448, 64, 2
_BACKDROP = 0.02
_CHART_MM, _TEXTURE = 200.0, (640, 1024)
"""Millimetres of a unit of the paint's chart; rows and columns of the albedo around the head."""
_RADIUS_MM, _AXIS_Z_MM = 90.0, 20.0
"""Of the cylinder on which the head is unrolled."""
_IDENTITY_SPREAD, _RELIEF_MM, _RELIEF_LENGTHS_MM = 0.55, 0.7, (14.0, 30.0)
_COMMON = 0.35
"""Share of the logarithmic albedo that is common to all."""
_BEFORE_MM = 0.3


@dataclass(frozen=True)
class Heads:
    """The shapes that people are blended from; mm, +y up, the face looks along +z.

    `generic` (V, 3), `identities` (K, V, 3) and `expressions` (E, V, 3) are the mean head and displacements
    from it; `faces` (F, 3); `landmarks` (68,) are vertices.
    """

    generic: FloatArray
    identities: FloatArray
    expressions: FloatArray
    faces: IntArray
    landmarks: IntArray

    @classmethod
    def read(cls) -> Heads:
        """Return those of ../shared/data; SystemExit when it is absent."""
        with np.load(face_data("ict_faces.npz")) as stored_shapes:
            shapes = dict(stored_shapes)
        with np.load(face_data("ict_expressions.npz")) as stored_moves:
            moves = np.stack([stored_moves[name] for name in sorted(stored_moves.files)]).astype(np.float64)
        generic = shapes["shape_generic_neutral"].astype(np.float64)
        people = np.stack([shapes[f"shape_person{k}"] for k in range(1, 5)]).astype(np.float64)
        faces, landmarks = shapes["faces"].astype(np.int64), shapes["landmarks68"].astype(np.int64)
        return cls(generic, people - generic, moves, faces, landmarks)

    def unrolled_mm(self) -> FloatArray:
        """Return (V, 2) of the generic head on a cylinder around it, millimetres to the left and up."""
        x, y, z = self.generic.T
        return np.stack([np.arctan2(x, z + _AXIS_Z_MM) * _RADIUS_MM, y], 1)


@dataclass(frozen=True)
class TracedPerson:
    """Shape (V, 3) in mm with a neutral face, and linear albedo (R, C, 3) around the head."""

    shape: FloatArray
    albedo: FloatArray

    @classmethod
    def random(cls, heads: Heads, person: int, seed: int) -> TracedPerson:
        """Return one person of a population."""
        own = np.random.default_rng([seed, person, 41])
        blend = own.normal(0, _IDENTITY_SPREAD, len(heads.identities))
        shape = heads.generic + np.einsum("k,kvc->vc", blend, heads.identities)
        shape = shape + _relief(heads, own)[:, None] * vertex_normals(shape, heads.faces)
        common = _painted(heads, np.random.default_rng([seed, 42]), own_marks=False)
        return cls(shape, np.exp((1 - _COMMON) * np.log(_painted(heads, own)) + _COMMON * np.log(common)))


def _relief(heads: Heads, rng: np.random.Generator) -> FloatArray:
    """Return (V,) millimetres along the normals: smooth noise of two lengths, alike on the left and right."""
    mirrored = np.abs(heads.generic) * [1, 0, 0] + heads.generic * [0, 1, 1]
    relief = np.zeros(len(mirrored))
    for length in _RELIEF_LENGTHS_MM:
        cells = 400.0 / length
        plane = (mirrored[:, :2] + 200.0) / 400.0
        relief += _RELIEF_MM / len(_RELIEF_LENGTHS_MM) * smooth_noise(plane, (cells, cells), rng)
    return relief


def _painted(heads: Heads, rng: np.random.Generator, *, own_marks: bool = True) -> FloatArray:
    """Return (R, C, 3) linear albedo around the head, brows and lips where the generic head has them."""
    unrolled = heads.unrolled_mm()
    grid = _grid(*_TEXTURE)
    low, span = _chart_range(heads)
    millimetres = low + grid * span
    features = PaintedFeatures(
        brow_thickness=float(rng.uniform(0.6, 1.4)),
        brow_lift=float(rng.uniform(-0.008, 0.008)),
        brow_arch=float(rng.uniform(-0.003, 0.01)),
        brow_reach=float(rng.uniform(0.75, 1.1)),
        lip_fullness=float(rng.uniform(-0.005, 0.005)),
    )
    albedo = paint_face(
        millimetres / _CHART_MM + 0.5,
        unrolled[heads.landmarks] / _CHART_MM + 0.5,
        rng,
        tone=float(rng.uniform(0.15, 0.5)),
        marks=own_marks,
        features=features,
    )
    return albedo.reshape(*_TEXTURE, 3)


def _grid(rows: int, columns: int) -> FloatArray:
    """Return (rows columns, 2) centres of texels in [0, 1], the first row the top."""
    v, u = np.mgrid[:rows, :columns]
    return np.stack([(u.ravel() + 0.5) / columns, 1 - (v.ravel() + 0.5) / rows], 1)


def _chart_range(heads: Heads) -> tuple[FloatArray, FloatArray]:
    """Return the lowest corner and the extent of the chart around the head, mm."""
    around = np.pi * _RADIUS_MM
    low, high = heads.generic[:, 1].min(), heads.generic[:, 1].max()
    return np.array([-around, low]), np.array([2 * around, high - low])


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
    return Rig(light, light, parts)


def session_shape(
    heads: Heads, person: TracedPerson, expression: str, rng: np.random.Generator
) -> FloatArray:
    """Return (V, 3) of a person now: three expressions at once, none of them strong."""
    shape = person.shape
    if expression != "neutral":
        weights = np.zeros(len(heads.expressions))
        chosen = rng.choice(len(weights), 3, replace=False)
        weights[chosen] = rng.uniform(0.1, 0.4, 3)
        shape = shape + np.einsum("e,evc->vc", weights, heads.expressions)
    return shape


def _now_albedo(person: TracedPerson, rng: np.random.Generator) -> FloatArray:
    """Return the albedo with today's blood: a little more or less of it here and there."""
    blood = 0.03 * rng.standard_normal() + 0.03 * smooth_noise(_grid(*_TEXTURE), (12, 8), rng)
    return np.clip(person.albedo * np.exp(-blood.reshape(*_TEXTURE, 1) * HEMOGLOBIN), 0.01, 0.95)


def _part(heads: Heads, vertices: FloatArray, albedo: FloatArray) -> Part:
    normals = vertex_normals(vertices, heads.faces)
    return Part(
        "face", vertices, normals, heads.faces, _chart(heads), albedo.astype(np.float32), None, "skin"
    )


def _chart(heads: Heads) -> FloatArray:
    """Return (V, 2) texture coordinates, rows counted downward."""
    low, span = _chart_range(heads)
    return (heads.unrolled_mm() - low) / span * [1, -1] + [0, 1]


def _texture(
    heads: Heads,
    vertices: FloatArray,
    albedo: FloatArray,
    pods: FloatArray,
    measured: RangeMesh,
    rig: Rig,
    seed: int,
) -> FloatArray:
    """Return the photographs side by side (S, K S, 3), linear, of 8 bits and with noise.

    Light is traced at every second pixel, relative to the albedo there, and multiplied by that of all pixels.
    """
    coarse = _PICTURE // 2
    points, direction, hit, under = _seen(heads, vertices, albedo, pods, coarse)
    used = used_pixels(measured, pods, coarse) & hit
    studio = Studio([_part(heads, vertices, albedo)], nearest=False)
    start = (points - _BEFORE_MM * direction)[used]
    radiance = LightTable(studio, start, direction[used], _PATHS, seed).under(rig)
    light = np.zeros((len(hit), 3))
    light[used] = radiance / under[used]
    smooth = filled(light, used, len(pods), coarse).reshape(-1, coarse, coarse, 3)
    fine = [cv2.resize(picture, (_PICTURE, _PICTURE)).reshape(-1, 3) for picture in smooth]
    _, _, shown, paint = _seen(heads, vertices, albedo, pods, _PICTURE)
    rng = np.random.default_rng([seed, 43])
    balance = np.exp(0.03 * rng.standard_normal(3) * [1, 0, 1])
    picture = np.where(shown[:, None], paint, _BACKDROP) * np.concatenate(fine)
    return row_of(stored(exposure_of(radiance) * balance * picture, rng), len(pods), _PICTURE)


def _seen(
    heads: Heads, vertices: FloatArray, albedo: FloatArray, pods: FloatArray, size: int
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """Return points, ray directions, which pixels show the head, and its albedo, of K pictures row by row."""
    direction = np.concatenate([pixel_directions(camera, texel_coordinates(size)) for camera in pods])
    origin = np.repeat(camera_centers(pods), size**2, axis=0)
    hits = RayCaster(vertices, heads.faces).first_hit(origin, direction)
    hit = hits.face >= 0
    corners = heads.faces[hits.face[hit]]
    points, paint = np.zeros((len(hit), 3)), np.ones((len(hit), 3))
    points[hit] = np.einsum("nk,nkc->nc", hits.barycentric[hit], vertices[corners])
    uv = np.einsum("nk,nkc->nc", hits.barycentric[hit], _chart(heads)[corners])
    place = (uv[:, ::-1] * _TEXTURE - 0.5).T
    paint[hit] = np.stack(
        [map_coordinates(c, place, order=1, mode="nearest") for c in np.moveaxis(albedo, 2, 0)], 1
    )
    return points, direction, hit, paint


def build_session(
    heads: Heads, someone: TracedPerson, person: int, session: int, path: Path, seed: int = 0
) -> None:
    """Write one scan as OBJ, MTL and PNG."""
    light, expression = SESSIONS[session]
    rng = np.random.default_rng([seed, person, session, 44])
    vertices = session_shape(heads, someone, expression, rng)
    albedo, rig = _now_albedo(someone, rng), rig_of(light, rng)
    tip = nose_tip(vertices)
    pods = pods_around(tip + CENTER_FROM_NOSE_MM, _CAMERAS)
    axis = tip + HEAD_AXIS_FROM_NOSE_MM
    measured = capture(vertices, heads.faces, pods, spacing_mm=SCANNER.spacing_mm, rng=rng, axis_mm=axis)
    number = 1000 * (seed + 1) + 10 * person + session
    texture = _texture(heads, vertices, albedo, pods, measured, rig, number)
    pose = random_pose(rng, 30.0)
    scan = assembled(measured, pods, texture.astype(np.float32), pose, SCANNER, rng, path.stem)
    write_obj(scan, path)


def scan_path(folder: Path, person: int, session: int) -> Path:
    """Return where a scan lies."""
    return folder / f"p{person:03d}_{session}_{SESSIONS[session][0]}.obj"


def build_people(manifest: Path, persons: int, seed: int = 0) -> Iterator[Path]:
    """Write the scans that are missing, and a manifest of all beside them; yield each scan's path."""
    heads, folder = Heads.read(), manifest.parent
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for person in range(persons):
        someone: TracedPerson | None = None
        for session, (light, expression) in enumerate(SESSIONS):
            path = scan_path(folder, person, session)
            if not path.is_file():
                someone = someone or TracedPerson.random(heads, person, seed)
                build_session(heads, someone, person, session, path, seed)
            rows.append([f"p{person:03d}", str(session), path.name, light, expression])
            yield path
    with manifest.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [["person", "session", "scan", "light", "expression"], *rows]
        )
