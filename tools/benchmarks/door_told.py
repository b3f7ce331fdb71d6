"""Faces that are not as people's are, and what `process` says of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from worlds.files import write_obj
from worlds.light_stage import light_stage_head
from worlds.objects import machined_part, random_relief
from worlds.raw_like import raw_like
from worlds.stereo import scrap_of

from scan2albedo import process
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.geometry.rigid import compose, invert_rigid, random_rotation, transform_points
from scan2albedo.synthetic import Scanner, raw_scan
from scan2albedo.synthetic.sitter import join

STRETCHES = (1.5, 0.67)
NOSE_HOLE_MM = 26.0
NOSE_TIP = 30


def print_told(offset: int = 0) -> None:
    """Print what becomes of every false face: of an own person, a light-stage one, and of no person."""
    for who, (scan, landmarks) in {"own": _own(offset), "light stage": _light_stage(offset)}.items():
        other = (_own if who == "own" else _light_stage)(offset + 1)
        print(f"\ntold: {who} person")
        for name, false in false_faces(scan, landmarks, *other, np.random.default_rng([71, offset])):
            _print_answer(name, false)
    rng = np.random.default_rng([73, offset])
    print("\ntold: no person")
    for number in range(3):
        _print_answer(f"random relief {number}", RawScan(*random_relief(rng), name="relief"))
    _print_answer("machined part of 94 mm", RawScan(*machined_part(), name="machined"))


def false_faces(
    scan: RawScan,
    landmarks: FloatArray,
    other: RawScan,
    other_landmarks: FloatArray,
    rng: np.random.Generator,
) -> Iterator[tuple[str, RawScan]]:
    """Yield a scan as it is, and what it becomes, each in a random pose.

    The scan and that of another person look along +z with +y up, landmarks (68, 3) in their frames.
    """
    tip = landmarks[NOSE_TIP]
    yield "as it is", _turned(scan, rng)
    for axis, name in enumerate(("width", "height", "depth")):
        for factor in STRETCHES:
            stretched = np.where(np.arange(3) == axis, factor, 1.0) * (scan.vertices - tip)
            yield f"{name} x {factor}", _turned(replace(scan, vertices=stretched), rng)
    mirrored = replace(scan, vertices=scan.vertices * [-1.0, 1.0, 1.0])
    yield "mirrored, thus inside out", _turned(mirrored, rng)
    yield "mirrored, wound rightly", _turned(mirrored.inside_out(), rng)
    right, left = _half(scan, tip, -1), _half(other, other_landmarks[NOSE_TIP], 1)
    yield "halves of two people", _turned(RawScan(*join([right, left]), name="halves"), rng)
    hole = np.linalg.norm(scan.vertices - tip, axis=1) < NOSE_HOLE_MM
    yield "no nose", _turned(_kept(scan, ~hole), rng)
    for place in ("cheek", "forehead"):
        piece = scrap_of((scan.vertices, scan.faces), landmarks, place, rng)
        yield f"scrap: {place}", _turned(RawScan(*piece, name="scrap"), rng)


def _own(number: int) -> tuple[RawScan, FloatArray]:
    """Return a textured scan of a random person, face to +z, and its landmarks."""
    scanner = Scanner(size=64, picture_size=500)
    scan, truth = raw_scan(200_000 + number, scanner=scanner)
    return replace(scan, vertices=transform_points(truth.model_from_scan, scan.vertices)), truth.landmarks


def _light_stage(number: int) -> tuple[RawScan, FloatArray]:
    """Return an untextured scan of a light-stage person, face to +z, and its landmarks."""
    head = light_stage_head(np.random.default_rng([79, number]), {}, hair=False)
    scan, scan_from_head = raw_like(head.vertices, head.faces, number)
    vertices = transform_points(invert_rigid(scan_from_head), scan.vertices)
    return replace(scan, vertices=vertices, name="light-stage"), head.landmarks


def _half(scan: RawScan, tip: FloatArray, side: int) -> tuple[FloatArray, np.ndarray]:
    """Return what lies on one side of the tip of the nose, which comes to the origin."""
    half = _kept(scan, side * (scan.vertices[:, 0] - tip[0]) > 0)
    return half.vertices - tip, half.faces


def _kept(scan: RawScan, vertex: BoolArray) -> RawScan:
    """Return the scan without the faces that lose a vertex."""
    faces = vertex[scan.faces].all(1)
    uv = None if scan.uv is None else scan.uv[faces]
    return replace(scan, faces=scan.faces[faces], uv=uv)


def _turned(scan: RawScan, rng: np.random.Generator) -> RawScan:
    pose = compose(random_rotation(rng), rng.uniform(-300, 300, 3))
    return replace(scan, vertices=transform_points(pose, scan.vertices))


def _print_answer(name: str, scan: RawScan) -> None:
    """Print what `process` says of a scan's file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{scan.name}.obj"
        if scan.uv is None:
            trimesh.Trimesh(scan.vertices, scan.faces, process=False).export(file.with_suffix(".ply"))
            file = file.with_suffix(".ply")
        else:
            write_obj(scan, file)
        try:
            result = process(file, quality="draft", skip=["albedo"])
        except Scan2AlbedoError as error:
            print(f"  {name}: REFUSED: {error}")
            return
    assert result.registration is not None
    notes = "".join(f"\n      {note}" for note in result.notes)
    print(f"  {name}: accepted, confidence {result.registration.confidence:.2f}{notes}")
