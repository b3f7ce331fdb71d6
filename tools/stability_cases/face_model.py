"""The extremes of `AnnotatedFaceModel.from_mesh`."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scan2albedo import AnnotatedFaceModel
from scan2albedo.errors import ModelError
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rigid import transform_points
from stability_cases.case import Cases, Measured, assert_finite, naming
from stability_cases.scanned_person import model

CASES = Cases()
STAGE = "from_mesh"


@cache
def face() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a face template of 950 vertices, mm."""
    return model().surface(0)


def modelled(
    vertices: ArrayLike, faces: ArrayLike, most_mm: float = 1.0, **settings: Any
) -> tuple[AnnotatedFaceModel, str]:
    """Make a model; assert that its template comes back and that its surface passes near by (mean)."""
    xyz, index = np.asarray(vertices, float), np.asarray(faces)
    made = AnnotatedFaceModel.from_mesh(xyz, index, **{"annotate": False, "control_size": 300, **settings})
    assert_finite(made.control_vertices, made.uv)
    assert made.uv.min() >= 0
    assert made.uv.max() <= 1
    carried = made.template_of(made.control_vertices)
    assert carried is not None
    assert made.template_from_model is not None
    used = np.unique(index)
    back = transform_points(made.template_from_model, carried)[used]
    size = np.ptp(xyz[used], axis=0).max()
    assert np.abs(back - xyz[used]).max() < 1e-6 * size + 1e-15 * np.abs(xyz[used]).max()
    surface, surface_faces = made.surface(2)
    inner = transform_points(np.linalg.inv(made.template_from_model), xyz[used])
    apart = ClosestPointQuery(surface, surface_faces).query(inner).distance
    assert apart.mean() < most_mm, f"{apart.mean():.2f} mm from the template"
    return made, f"{len(made.control_vertices)} control vertices, {apart.mean():.2f} mm from the template"


@CASES.extreme(STAGE, "micrometres to metres; 1e6, 1e7 and 1e9 mm away", slow=True)
def _() -> str:
    vertices, faces = face()
    for factor in (1e3, 1.0, 0.1, 1e-3):
        made, _figure = modelled(factor * vertices, faces)
        assert abs(np.ptp(made.control_vertices[:, 1]) / np.ptp(vertices[:, 1]) - 1) < 0.05
    for distance in (1e6, 1e7, 1e9):
        figure = modelled(vertices + distance, faces)[1]
    return figure


@CASES.extreme(STAGE, "kilometres", "named error")
def _() -> str:
    with naming("which is not a head in mm, cm, m or um", "scale it to millimetres"):
        return modelled(1e-6 * face()[0], face()[1])[1]


@CASES.extreme(STAGE, "a plane")
def _() -> str:
    import igl

    grid, faces = igl.triangulated_grid(20, 20)
    return modelled(np.column_stack([200 * grid, np.zeros(len(grid))]), faces)[1]


def _told(made: AnnotatedFaceModel, words: str) -> Measured:
    """Return the note of a model that says this."""
    return Measured(next(note for note in made.notes if words in note))


@CASES.extreme(STAGE, "a sphere, a torus: cut open", "measured warning")
def _() -> str:
    ball, ring = trimesh.creation.icosphere(3, 100.0), trimesh.creation.torus(80.0, 30.0)
    for shape in (ring, ball):
        made, _figure = modelled(shape.vertices, shape.faces, 20.0)
        figure = _told(made, "faces cut off the back of a closed surface")
    return figure


@CASES.extreme(STAGE, "self-intersecting")
def _() -> str:
    vertices, faces = face()
    folded = vertices.copy()
    chin = folded[:, 1] < -40
    folded[chin, 1] = -80 - folded[chin, 1]
    folded[chin, 2] -= 15
    return modelled(folded, faces)[1]


@CASES.extreme(STAGE, "two components", "measured warning")
def _() -> str:
    vertices, faces = face()
    eye = trimesh.creation.icosphere(1, 12.0)
    made, _figure = modelled(
        np.concatenate([vertices, eye.vertices + [30, 30, 0]]),
        np.concatenate([faces, eye.faces + len(vertices)]),
        2.0,
    )
    return _told(made, "faces of loose parts")


@CASES.extreme(STAGE, "a doubled, a reversed and a mixed orientation; a soup of triangles")
def _() -> str:
    vertices, faces = face()
    even = (np.arange(len(faces)) % 2 == 0)[:, None]
    for index in (
        np.concatenate([faces, faces[:, ::-1]]),
        faces[:, ::-1],
        np.where(even, faces, faces[:, ::-1]),
    ):
        modelled(vertices, index)
    return modelled(vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))[1]


@CASES.extreme(STAGE, "non-manifold edges, slivers, zero-area faces", "measured warning")
def _() -> str:
    vertices, faces = face()
    fins = np.column_stack([faces[:2, :2], faces[500:502, 0]])
    beside = vertices[faces[900:903, 0]] + 1e-6 * (vertices[faces[900:903, 1]] - vertices[faces[900:903, 0]])
    slivers = np.column_stack([faces[900:903, :2], len(vertices) + np.arange(3)])
    flat = faces[:40, [0, 0, 1]]
    made, _figure = modelled(np.concatenate([vertices, beside]), np.concatenate([faces, fins, slivers, flat]))
    return _told(made, "faces dropped at edges with three faces")


@CASES.extreme(STAGE, "one vertex at 1e5 mm", "measured warning")
def _() -> str:
    vertices, faces = face()
    thrown = vertices.copy()
    thrown[faces[400, 0]] += 1e5
    made = AnnotatedFaceModel.from_mesh(thrown, faces, annotate=False)
    assert_finite(made.control_vertices, made.uv)
    assert made.notes[0] == "unit mm"
    return _told(made, "vertices far from the rest")


@CASES.extreme(STAGE, "4 vertices; 3 vertices", "named error")
def _() -> str:
    corners, faces = (
        np.array([[0.0, 0, 0], [100, 0, 0], [0, 120, 0], [50, 50, 50]]),
        [[0, 1, 3], [1, 2, 3], [2, 0, 3]],
    )
    with naming("template: only 4 vertices in faces, at least 100 needed"):
        return modelled(corners, faces)[1]


@CASES.extreme(STAGE, "a control mesh of 4 vertices", "named error")
def _() -> str:
    with naming("control_size is 4, but fewer than 20 control vertices hold no face"):
        return modelled(*face(), control_size=4)[1]


@CASES.extreme(STAGE, "a control mesh of 25 vertices", "measured warning")
def _() -> str:
    made, _figure = modelled(*face(), 4.0, control_size=25)
    return _told(made, "a greater control_size follows it better")


@CASES.extreme(STAGE, "a line of points", "named error")
def _() -> str:
    points = np.column_stack([np.linspace(0, 200, 200), np.zeros((200, 2))])
    with naming("template: every face has zero area"):
        return modelled(points, np.arange(198)[:, None] + np.arange(3))[1]


@CASES.extreme(STAGE, "one vertex NaN, all vertices NaN", "named error")
def _() -> str:
    vertices, faces = face()
    broken = vertices.copy()
    broken[3] = np.nan
    with (
        suppress(ModelError),
        naming(f"{len(vertices)} of .* vertices are NaN or infinite; repair"),
    ):
        return modelled(np.full_like(vertices, np.nan), faces)[1]
    with naming("1 of .* vertices are NaN or infinite; repair"):
        return modelled(broken, faces)[1]


@CASES.extreme(STAGE, "a Moebius strip", "named error")
def _() -> str:
    angle, across = np.meshgrid(np.linspace(0, 2 * np.pi, 80, endpoint=False), np.linspace(-30, 30, 5))
    angle, across = angle.T.ravel(), across.T.ravel()
    radius = 100 + across * np.cos(angle / 2)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), across * np.sin(angle / 2)])
    start = (5 * np.arange(80)[:, None] + np.arange(4)).ravel()
    step, column = np.divmod(start, 5)
    near = np.where(step < 79, start + 5, 4 - column)
    far = np.where(step < 79, start + 6, 3 - column)
    faces = np.concatenate(
        [np.column_stack([start, near, start + 1]), np.column_stack([start + 1, near, far])]
    )
    with naming("cannot be oriented", "use an orientable mesh"):
        return modelled(points, faces)[1]


def _charted(uv: NDArray[np.float64]) -> Measured:
    return _told(modelled(*face(), control_size=1000, uv=uv)[0], "a new chart was drawn")


CASES.extreme(STAGE, "uv with a flipped triangle", "measured warning")(lambda: _charted(_flipped(model().uv)))
CASES.extreme(STAGE, "uv NaN", "measured warning")(lambda: _charted(np.nan * model().uv))
CASES.extreme(STAGE, "uv outside [0, 1]", "measured warning")(lambda: _charted(5 * model().uv - 2))
CASES.extreme(STAGE, "uv all in one place", "measured warning")(lambda: _charted(0 * model().uv))


def _flipped(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the chart with one inner triangle turned over."""
    turned = uv.copy()
    corner = face()[1][np.argmin(np.linalg.norm(uv[face()[1]].mean(1) - 0.5, axis=1))]
    turned[corner] = uv[corner][[0, 2, 1]]
    return turned


@CASES.extreme(STAGE, "a plane, annotated: no face in it", "measured warning", slow=True)
def _() -> str:
    import igl

    grid, faces = igl.triangulated_grid(20, 20)
    flat = np.column_stack([200 * grid, np.zeros(len(grid))])
    made, _figure = modelled(flat, faces, annotate=True)
    return _told(made, "axes taken as they are, nothing annotated")


@CASES.extreme(STAGE, "100,000 vertices", slow=True)
def _() -> str:
    vertices, faces = face()
    finer = linear_refinement(len(vertices), faces, 3)
    subdivided = model().subdivision(3)
    assert finer.shape[0] == subdivided.matrix.shape[0]
    return modelled(subdivided.matrix @ vertices, subdivided.faces, control_size=1000)[1]
