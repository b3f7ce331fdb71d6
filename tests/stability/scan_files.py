"""Extremes of `load_scan`: far away, damaged, odd textures."""

import tempfile
from pathlib import Path

import numpy as np
import trimesh
from helpers.meshes import obj_text
from helpers.square import write_square_obj

from scan2albedo import RawScan, load_scan, register
from stability.case import Measured, below, gap, noted, refuses, right, table, warns
from stability.scenes import TEXTURE_SHAPES, at_random, line, model, person, with_one


def loaded(vertices=None, faces=None, kind="obj"):
    """Write a mesh, the person's by default, as OBJ or as PLY of single precision, and load it."""
    vertices = person().scan.vertices if vertices is None else vertices
    faces = person().scan.faces if faces is None else faces
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"scan.{kind}")
        mesh.export(path, **({"digits": 12} if kind == "obj" else {}))
        return load_scan(path)


def far_away(distance):
    """Return how far vertices are off that were written far away."""
    vertices = person().scan.vertices
    return gap(loaded(vertices + distance).vertices - distance, vertices)


def turned(mask):
    """Load the person's scan with some of its faces wound the wrong way."""
    return loaded(faces=person().wound(mask).scan.faces)


def registered():
    """Return how far the pose of a scan is off, one of whose sides was inside out."""
    degrees, millimetres = person().pose_error(
        register(turned(person().centres[:, 0] > 0), model()).model_from_scan
    )
    return max(degrees, millimetres), degrees, millimetres


def wrongly_wound(scan):
    """Return the note on turned faces; loose pieces alone may stay reversed."""
    assert (scan.faces != person().scan.faces).any(1).mean() < 0.01
    return noted("wound against")(scan)


def with_fins():
    """Return how many of 50 faces on non-manifold edges are lost."""
    faces = person().scan.faces
    fins = np.column_stack([faces[:50, :2], np.roll(faces[:50, 0], 25)])
    return len(faces) + 50 - len(loaded(faces=np.concatenate([faces, fins])).faces)


BALL = trimesh.creation.icosphere(3, 100.0)
x, y, z = BALL.vertices.T
CHART = np.column_stack([np.arctan2(x, z) / 2 / np.pi + 0.5, y / 200 + 0.5])
PICTURE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)


def textured(uv=CHART, picture=True):
    """Write a ball as OBJ with texture coordinates and a picture, and load it."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_square_obj(Path(folder), image=PICTURE)
        path.write_text("mtllib face.mtl\nusemtl skin\n" + obj_text(BALL.vertices, BALL.faces, uv))
        if not picture:
            Path(folder, "face.png").unlink()
        scan = load_scan(path)
    assert scan.texture_linear is None or (
        scan.texture_linear.size < 1e7 and 0 <= scan.uv.min() <= scan.uv.max() <= 1
    )
    return scan


def without_colour(scan):
    """Return the notes of a scan that has lost its texture."""
    assert not scan.has_color
    assert "no texture or vertex colours: geometry only" in scan.notes
    return Measured("; ".join(scan.notes[1:]))


def even(shape):
    """Return how far an even texture of a shape is from its colour."""
    with tempfile.TemporaryDirectory() as folder:
        scan = load_scan(write_square_obj(Path(folder), image=np.full((*shape, 3), 128, np.uint8)))
    assert scan.texture_linear.shape == (*shape, 3)
    return gap(scan.texture_linear, 0.2159)


CASES = table(
    "load_scan",
    right(below(2e-7, "{:.1e} mm off"), "{} mm away, double precision", far_away, ("1e6", "1e7", "1e9")),
    warns(
        noted("positions are rounded to 1 mm"),
        "1e7 mm away, single precision",
        lambda: loaded(person().scan.vertices + 1e7, kind="ply"),
    ),
    refuses(
        "scan.ply: positions are rounded to 64 mm.*move the scan to the origin",
        "1e9 mm away, single precision",
        lambda: loaded(person().scan.vertices + 1e9, kind="ply"),
    ),
    right(
        lambda scan: f"{len(scan.vertices)} vertices, {scan.notes[0]}",
        "a single triangle, 3 vertices",
        lambda: loaded([[0, 0, 0], [100, 0, 0], [0, 120, 0]], [[0, 1, 2]]),
    ),
    refuses(
        "every face has zero area",
        "a line of points",
        lambda: loaded(*line()),
    ),
    warns(
        wrongly_wound,
        "half of the faces wound the wrong way",
        lambda: turned(at_random(person(), 0.4)),
    ),
    right(
        below(3, "{1:.1f} degrees, {2:.1f} mm off"),
        "one side of the face inside out, then registered",
        registered,
    ),
    right(below(10, "kept, all but {} of 50 faces"), "non-manifold edges", with_fins),
    right(
        below(1e-3, "0.216 linear within {:.0e}"),
        "a texture of {}",
        even,
        TEXTURE_SHAPES,
    ),
    warns(
        noted("clamped to one"),
        "texture coordinates of {}",
        lambda factor: textured(factor * CHART),
        ("1e9", "1e300"),
    ),
    warns(
        noted("faces without texture"),
        "texture coordinates NaN at one vertex",
        lambda: textured(with_one(CHART, np.nan)),
    ),
    warns(
        without_colour,
        {
            "texture coordinates all NaN": lambda: textured(np.nan * CHART),
            "no texture coordinates": lambda: textured(None),
            "no picture": lambda: textured(picture=False),
        },
    ),
    refuses(
        "texture_linear has shape .* no pixel.*leave it out",
        "RawScan with a texture of no pixels",
        lambda: RawScan(np.eye(3), [[0, 1, 2]], uv=np.zeros((1, 3, 2)), texture_linear=np.zeros((0, 0, 3))),
    ),
    refuses(
        r"a coordinate is 1e\+200, beyond 1e\+30.*re-export",
        "RawScan with coordinates of 1e200",
        lambda: RawScan(1e200 * np.eye(3), [[0, 1, 2]]),
    ),
)
