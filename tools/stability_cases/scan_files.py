"""The extremes of `load_scan`: units, damage, textures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scan2albedo import RawScan, load_scan, register
from stability_cases.case import Cases, Measured, assert_finite, naming
from stability_cases.scanned_person import model, person

CASES = Cases()
STAGE = "load_scan"


@contextmanager
def folder() -> Iterator[Path]:
    """Give a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as path:
        yield Path(path)


def write_ply(path: Path, vertices: ArrayLike, faces: ArrayLike, kind: str = "double") -> Path:
    """Write a binary PLY of `float` or `double` coordinates."""
    xyz, index = np.asarray(vertices), np.asarray(faces)
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {kind} {axis}" for axis in "xyz"]
    head += [f"element face {len(index)}", "property list uchar int vertex_indices", "end_header", ""]
    rows = np.zeros(len(index), [("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, index
    numbers = np.ascontiguousarray(xyz, "<f8" if kind == "double" else "<f4")
    path.write_bytes("\n".join(head).encode() + numbers.tobytes() + rows.tobytes())
    return path


def loaded(vertices: ArrayLike, faces: ArrayLike, kind: str = "double", unit: str = "auto") -> RawScan:
    """Write a PLY and load it."""
    with folder() as here:
        scan = load_scan(write_ply(here / "scan.ply", vertices, faces, kind), unit)
    assert_finite(scan.vertices)
    return scan


def head() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices in mm and the faces of a scan."""
    return person().scan.vertices, person().scan.faces


@CASES.extreme(STAGE, "millimetres, centimetres, metres")
def _() -> str:
    vertices, faces = head()
    for factor in (1.0, 10.0, 1000.0):
        scan = loaded(vertices / factor, faces)
        np.testing.assert_allclose(scan.vertices, vertices, atol=1e-9)
    return scan.notes[0]


def _no_head(factor: float) -> str:
    vertices, faces = head()
    with naming("scan.ply: the scan is .* units long, which is not a head", "unit='mm', 'cm' or 'm'"):
        return loaded(factor * vertices, faces).notes[0]


CASES.extreme(STAGE, "micrometres", "named error")(lambda: _no_head(1e3))
CASES.extreme(STAGE, "kilometres", "named error")(lambda: _no_head(1e-6))


@CASES.extreme(STAGE, "a unit forced that makes no head", "measured warning")
def _() -> str:
    scan = loaded(*head(), unit="m")
    assert "though a head measures 80 to 800 mm" in scan.notes[0]
    return Measured(scan.notes[0])


@CASES.extreme(STAGE, "1e6, 1e7 and 1e9 mm away, double precision")
def _() -> str:
    vertices, faces = head()
    for distance in (1e6, 1e7, 1e9):
        scan = loaded(vertices + distance, faces)
        assert scan.vertices.shape == vertices.shape
        assert np.abs(scan.vertices - distance - vertices).max() < 2e-7
    return f"{np.abs(scan.vertices - distance - vertices).max():.1e} mm off at 1e9"


@CASES.extreme(STAGE, "1e7 mm away, single precision", "measured warning")
def _() -> str:
    vertices, faces = head()
    scan = loaded(vertices + 1e7, faces, "float")
    (told,) = [note for note in scan.notes if "positions are rounded to 1 mm" in note]
    return Measured(told)


@CASES.extreme(STAGE, "1e9 mm away, single precision", "named error")
def _() -> str:
    vertices, faces = head()
    with naming("scan.ply: positions are rounded to 64 mm", "move the scan to the origin"):
        return loaded(vertices + 1e9, faces, "float").notes[0]


@CASES.extreme(STAGE, "a single triangle, 3 vertices")
def _() -> str:
    scan = loaded([[0, 0, 0], [100, 0, 0], [0, 120, 0]], [[0, 1, 2]])
    assert len(scan.faces) == 1
    return f"{len(scan.vertices)} vertices, {scan.notes[0]}"


@CASES.extreme(STAGE, "a line of points", "named error")
def _() -> str:
    points = np.column_stack([5.0 * np.arange(30), np.zeros((30, 2))])
    with naming("every face has zero area"):
        return loaded(points, np.arange(30).reshape(-1, 3)).notes[0]


def _broken(value: float, where: slice, count: int) -> str:
    vertices, faces = head()
    vertices = vertices.copy()
    vertices[where] = value
    with naming(f"scan.ply: {count} vertices used by faces are NaN or infinite", "repair the scan"):
        return loaded(vertices, faces).notes[0]


CASES.extreme(STAGE, "one vertex NaN", "named error")(lambda: _broken(np.nan, slice(3, 4), 1))
CASES.extreme(STAGE, "one vertex infinite", "named error")(lambda: _broken(np.inf, slice(3, 4), 1))
CASES.extreme(STAGE, "all vertices NaN", "named error")(lambda: _broken(np.nan, slice(None), len(head()[0])))


@CASES.extreme(STAGE, "one vertex at 1e9 mm")
def _() -> str:
    vertices, faces = head()
    vertices = vertices.copy()
    vertices[faces[0, 0]] += 1e9
    scan = loaded(vertices, faces)
    assert scan.notes[0].startswith("unit: mm (largest extent 3")
    return scan.notes[0]


@CASES.extreme(STAGE, "zero-area, double and reversed double faces; unused vertices", "measured warning")
def _() -> str:
    vertices, faces = head()
    more = np.concatenate([faces, faces[:50, [0, 0, 1]], faces[:40], faces[:30, ::-1]])
    scan = loaded(np.concatenate([vertices, vertices[:7] + 5]), more)
    assert len(scan.faces) == len(faces)
    told = [note for note in scan.notes if "dropped" in note]
    assert told == [
        "zero-area faces dropped: 50",
        "duplicate faces dropped: 70",
        "unreferenced vertices dropped: 7",
    ]
    return Measured("; ".join(told))


@CASES.extreme(STAGE, "slivers of aspect 1e6")
def _() -> str:
    corners = [[0, 0, 0], [100, 0, 0], [50, 1e-4, 0], [50, 80, 0]]
    scan = loaded(corners, [[0, 1, 2], [0, 2, 3], [2, 1, 3]])
    assert len(scan.faces) == 3
    return "kept: 3 faces"


@CASES.extreme(STAGE, "half of the faces wound the wrong way", "measured warning")
def _() -> str:
    vertices, faces = head()
    turned = np.random.default_rng(0).random(len(faces)) < 0.4
    scan = loaded(vertices, np.where(turned[:, None], faces[:, ::-1], faces))
    wrong = (scan.faces != faces).any(1)
    assert wrong.mean() < 0.01, "loose pieces alone may stay reversed"
    (told,) = [note for note in scan.notes if "wound against" in note]
    return Measured(told)


@CASES.extreme(STAGE, "one side of the face inside out, then registered")
def _() -> str:
    vertices, faces = head()
    turned = person().centres[:, 0] > 0
    scan = loaded(vertices, np.where(turned[:, None], faces[:, ::-1], faces))
    degrees, millimetres = person().pose_error(register(scan, model()).model_from_scan)
    assert degrees < 3
    assert millimetres < 3
    return f"{degrees:.1f} degrees, {millimetres:.1f} mm off"


@CASES.extreme(STAGE, "non-manifold edges")
def _() -> str:
    vertices, faces = head()
    fins = np.column_stack([faces[:50, :2], np.roll(faces[:50, 0], 25)])
    scan = loaded(vertices, np.concatenate([faces, fins]))
    assert len(scan.faces) > len(faces) + 40
    return f"kept: {len(scan.faces)} faces"


@CASES.extreme(STAGE, "2 million vertices", slow=True)
def _() -> str:
    side = 1415
    row, column = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([column.ravel(), row.ravel(), np.zeros(side * side)], 1) * (200 / side)
    start = (row * side + column)[:-1, :-1].ravel()
    faces = np.concatenate(
        [
            np.stack([start, start + 1, start + side], 1),
            np.stack([start + 1, start + side + 1, start + side], 1),
        ]
    )
    scan = loaded(vertices, faces)
    np.testing.assert_array_equal(scan.vertices, vertices)
    return f"{len(scan.vertices)} vertices, {len(scan.faces)} faces"


BALL = trimesh.creation.icosphere(3, 100.0)
CHART = np.column_stack(
    [np.arctan2(BALL.vertices[:, 0], BALL.vertices[:, 2]) / 2 / np.pi + 0.5, BALL.vertices[:, 1] / 200 + 0.5]
)
PICTURE = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)


def textured(picture: NDArray[np.generic] | None, uv: ArrayLike | None = CHART) -> RawScan:
    """Write a ball as OBJ with a picture (B, G, R as OpenCV stores) and coordinates, and load it."""
    lines = ["mtllib ball.mtl", "usemtl skin"]
    lines += ["v {!r} {!r} {!r}".format(*map(float, point)) for point in BALL.vertices]
    if uv is not None:
        lines += ["vt {} {}".format(*point) for point in np.asarray(uv)]
    corner = "{0}" if uv is None else "{0}/{0}"
    lines += ["f " + " ".join(corner.format(i + 1) for i in face) for face in BALL.faces]
    with folder() as here:
        (here / "ball.obj").write_text("\n".join(lines))
        (here / "ball.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
        if picture is not None:
            cv2.imwrite(str(here / "skin.png"), picture)
        scan = load_scan(here / "ball.obj")
    if scan.texture_linear is not None:
        assert scan.uv is not None
        assert_finite(scan.texture_linear, scan.uv)
        assert scan.uv.min() >= 0
        assert scan.uv.max() <= 1
    return scan


def _same_colour(picture: NDArray[np.generic], expected: NDArray[np.generic]) -> str:
    """Load two pictures that must mean the same colour."""
    one, other = textured(picture).texture_linear, textured(expected).texture_linear
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one, other, atol=1e-5)
    return f"{np.abs(one - other).max():.0e} from 8-bit colour"


CASES.extreme(STAGE, "a 16-bit texture")(lambda: _same_colour(PICTURE.astype(np.uint16) * 257, PICTURE))
CASES.extreme(STAGE, "a grey texture")(
    lambda: _same_colour(PICTURE[..., 0], np.repeat(PICTURE[..., :1], 3, axis=2))
)
CASES.extreme(STAGE, "a texture with alpha 0")(
    lambda: _same_colour(np.dstack([PICTURE, np.zeros((64, 64), np.uint8)]), PICTURE)
)


@CASES.extreme(STAGE, "textures of 1 x 1, 1 x 10000 and 10000 x 1")
def _() -> str:
    for shape in ((1, 1), (1, 10000), (10000, 1)):
        texture = textured(np.full((*shape, 3), 128, np.uint8)).texture_linear
        assert texture is not None
        assert texture.shape == (*shape, 3)
        np.testing.assert_allclose(texture, 0.2159, atol=1e-3)
    return "0.216 linear everywhere"


@CASES.extreme(STAGE, "texture coordinates outside [0, 1]", "measured warning")
def _() -> str:
    scan = textured(PICTURE, 3 * CHART - 1)
    (told,) = [note for note in scan.notes if "outside [0, 1]" in note]
    return Measured(told)


@CASES.extreme(STAGE, "texture coordinates of 1e9 and 1e300", "measured warning")
def _() -> str:
    for factor in (1e9, 1e300):
        scan = textured(PICTURE, factor * CHART)
        assert scan.texture_linear is not None
        assert scan.texture_linear.size < 1e7
        (told,) = [note for note in scan.notes if "clamped to one" in note]
    return Measured(told)


@CASES.extreme(STAGE, "texture coordinates NaN at one vertex", "measured warning")
def _() -> str:
    uv = CHART.copy()
    uv[3] = np.nan
    scan = textured(PICTURE, uv)
    (told,) = [note for note in scan.notes if "faces without texture" in note]
    return Measured(told)


@CASES.extreme(STAGE, "texture coordinates all NaN; none; no picture", "measured warning")
def _() -> str:
    for scan in (textured(PICTURE, np.nan * CHART), textured(PICTURE, None), textured(None)):
        assert not scan.has_color
        assert "no texture or vertex colours: geometry only" in scan.notes
    return Measured("; ".join(scan.notes[1:]))


@CASES.extreme(STAGE, "RawScan with a texture of no pixels", "named error")
def _() -> str:
    with naming("texture_linear has shape .* no pixel", "leave it out"):
        RawScan(np.eye(3), [[0, 1, 2]], uv=np.zeros((1, 3, 2)), texture_linear=np.zeros((0, 0, 3)))
    return "made"


@CASES.extreme(STAGE, "RawScan with NaN, or coordinates of 1e200", "named error")
def _() -> str:
    with naming("a coordinate is 1e\\+200, beyond 1e\\+30", "re-export"):
        RawScan(1e200 * np.eye(3), [[0, 1, 2]])
    return "made"
