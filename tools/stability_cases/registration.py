"""The extremes of `register`."""

from __future__ import annotations

import numpy as np
import trimesh

from scan2albedo import AnnotatedFaceModel, Budget, RawScan, Registration, register
from scan2albedo.face_model import Region
from scan2albedo.geometry.loop_subdivision import refine
from scan2albedo.geometry.operators import linear_refinement
from scan2albedo.geometry.rigid import compose, rotation_from_vector, transform_points
from scan2albedo.registration import RegistrationOptions
from stability_cases.case import Cases, assert_finite, naming, said
from stability_cases.scanned_person import (
    Scanned,
    model,
    noisy,
    person,
    shredded,
    spoilt,
    stray,
    with_outlier_triangles,
)

CASES = Cases()
STAGE = "register"

MOST_DEG, MOST_MM = 3.0, 3.0
"""Between two people a pose is known to a few degrees; whole scans of this one end below half of it."""


def found(scene: Scanned, **settings: object) -> tuple[Registration, str]:
    """Register a scene, assert that the pose is right, and return its figure too."""
    registration = register(scene.scan, model(), **settings)  # type: ignore[arg-type]
    assert_finite(registration.model_from_scan, registration.rmse_mm, registration.confidence)
    degrees, millimetres = scene.pose_error(registration.model_from_scan)
    assert degrees < MOST_DEG, f"{degrees:.2f} degrees off"
    assert millimetres < MOST_MM, f"{millimetres:.2f} mm off"
    return registration, said(f"{degrees:.1f} degrees, {millimetres:.1f} mm off", registration.plan)


@CASES.extreme(STAGE, "offset 1e6, 1e7 and 1e9 mm")
def _() -> str:
    return ", ".join(found(person().shifted(distance))[1] for distance in (1e6, 1e7, 1e9))


@CASES.extreme(STAGE, "upside down, and turned by 180 degrees")
def _() -> str:
    upright = person().moved(person().model_from_scan)
    turns = ([0.0, 0.0, np.pi], [0.0, np.pi, 0.0])
    return ", ".join(found(upright.moved(compose(rotation_from_vector(t), np.zeros(3))))[1] for t in turns)


@CASES.extreme(STAGE, "slivers, coincident vertices, zero-area, double and non-manifold faces")
def _() -> str:
    return found(spoilt(person()))[1]


@CASES.extreme(STAGE, "one vertex at 1e9 mm and one at 1e20 mm")
def _() -> str:
    return ", ".join(found(stray(person(), 1, distance))[1] for distance in (1e9, 1e20))


@CASES.extreme(STAGE, "300 vertices thrown some 2 m away")
def _() -> str:
    registration, figure = found(stray(person(), 300, 2e3))
    assert "triangles that reach far away left out" in registration.plan[0].evidence
    return figure


@CASES.extreme(STAGE, "half of all vertices are outliers")
def _() -> str:
    return found(with_outlier_triangles(person()))[1]


@CASES.extreme(STAGE, "noise of 1 and of 3 mm")
def _() -> str:
    return ", ".join(found(noisy(person(), sigma))[1] for sigma in (1.0, 3.0))


@CASES.extreme(STAGE, "60 % of the triangles lost")
def _() -> str:
    return found(shredded(person(), 0.4))[1]


@CASES.extreme(STAGE, "all but the upper 40 % of the head lost")
def _() -> str:
    height = person().centres[:, 1]
    return found(person().kept(height > np.quantile(height, 0.6)))[1]


@CASES.extreme(STAGE, "half a face")
def _() -> str:
    return found(person().kept(person().centres[:, 0] > 0))[1]


@CASES.extreme(STAGE, "a fifth of the triangles wound the wrong way")
def _() -> str:
    faces = person().scan.faces
    turned = np.random.default_rng(0).random(len(faces)) < 0.2
    return found(person().with_faces(np.where(turned[:, None], faces[:, ::-1], faces)))[1]


@CASES.extreme(STAGE, "one side of the face inside out", "named error")
def _() -> str:
    scene = person()
    turned = scene.centres[:, 0] > 0
    with naming(r"\d+ of \d+ triangles are wound against their neighbours", "load_scan does it"):
        return found(
            scene.with_faces(np.where(turned[:, None], scene.scan.faces[:, ::-1], scene.scan.faces))
        )[1]


@CASES.extreme(STAGE, "inside out", "named error", slow=True)
def _() -> str:
    with naming("inside out", "Reverse the order"):
        return found(person().with_faces(person().scan.faces[:, ::-1]))[1]


@CASES.extreme(STAGE, "mirrored, so that triangles face inward", "named error", slow=True)
def _() -> str:
    with naming("inside out", "Reverse the order"):
        return found(person().with_vertices(person().scan.vertices * [-1, 1, 1]))[1]


@CASES.extreme(STAGE, "two heads", "measured warning", slow=True)
def _() -> str:
    one, other = person(), person(3)
    beside = other.in_model_frame + [350.0, 0, 0]
    both = RawScan(
        np.concatenate([one.in_model_frame, beside]),
        np.concatenate([one.scan.faces, other.scan.faces + len(one.in_model_frame)]),
        name="two heads",
    )
    registration = register(both, model())
    errors = [
        scene.pose_error(registration.model_from_scan @ placed)[1]
        for scene, placed in (
            (one, one.model_from_scan),
            (other, compose(np.eye(3), [350.0, 0, 0]) @ other.model_from_scan),
        )
    ]
    assert min(errors) < MOST_MM
    figure = f"{min(errors):.1f} mm off one of them, confidence {registration.confidence:.2f}"
    return said(figure, registration.plan)


@CASES.extreme(STAGE, "1.5 times too large", "measured warning", slow=True)
def _() -> str:
    return _of_size(1.5)


@CASES.extreme(STAGE, "1.5 times too small", "measured warning", slow=True)
def _() -> str:
    return _of_size(1 / 1.5)


def _of_size(scale: float) -> str:
    registration = register(person().scaled(scale).scan, model())
    assert abs(registration.face_scale - scale) < 0.05
    return said(f"face found at {100 * registration.face_scale:.0f} % of its size", registration.plan)


def _in_unit(factor: float, name: str, mends: str) -> str:
    with naming(name, "box .* mm", "unit", f"multiplied by {mends} "):
        return found(person().with_vertices(factor * person().scan.vertices))[1]


CASES.extreme(STAGE, "micrometres taken for mm", "named error")(lambda: _in_unit(1e3, "synthetic", "0.001"))
CASES.extreme(STAGE, "metres taken for mm", "named error")(lambda: _in_unit(1e-3, "synthetic", "1000"))
CASES.extreme(STAGE, "kilometres taken for mm", "named error")(lambda: _in_unit(1e-6, "synthetic", r"1e\+06"))


@CASES.extreme(STAGE, "a single triangle", "named error")
def _() -> str:
    with naming("triangle: 3 vertices cannot show a face", "scan the whole face"):
        register(RawScan([[0.0, 0, 0], [90, 0, 0], [0, 120, 0]], [[0, 1, 2]], name="triangle"), model())
    return "found"


@CASES.extreme(STAGE, "a line of points", "named error")
def _() -> str:
    points = np.column_stack([np.linspace(0, 200, 200), np.zeros((200, 2))])
    faces = np.arange(198)[:, None] + np.arange(3)
    with naming("line: its surface of 0 mm2", "Scan the whole face"):
        register(RawScan(points, faces, name="line"), model())
    return "found"


@CASES.extreme(STAGE, "100 vertices")
def _() -> str:
    """A face of the model itself, 100 vertices of it: 12 mm between neighbours."""
    import igl

    vertices, faces = model().surface(0)
    fewer, index, _, _ = igl.qslim(vertices, faces, 170, False)
    scene = Scanned(RawScan(fewer, index), np.eye(4), model().landmarks, vertices)
    assert len(fewer) < 125
    return f"{len(fewer)} vertices: {found(scene)[1]}"


@CASES.extreme(STAGE, "2 million vertices", slow=True)
def _() -> str:
    vertices, faces = person().scan.vertices, person().scan.faces
    while len(vertices) < 2_000_000:
        finer = linear_refinement(len(vertices), faces, 1)
        vertices, faces = finer @ vertices, refine(len(vertices), faces)[1]
    scene = Scanned(RawScan(vertices, faces), person().model_from_scan, person().landmarks, person().surface)
    return f"{len(vertices)} vertices: {found(scene)[1]}"


def _refused(vertices: np.ndarray, faces: np.ndarray, name: str) -> str:
    with naming(f"{name}: no face found", "probability", "of the face", "box"):
        register(RawScan(vertices, faces, name=name), model())
    return "found"


@CASES.extreme(STAGE, "a plane", "named error", slow=True)
def _() -> str:
    import igl

    grid, faces = igl.triangulated_grid(40, 40)
    return _refused(np.column_stack([250 * grid, np.zeros(len(grid))]), faces, "plane")


@CASES.extreme(STAGE, "a sphere", "named error", slow=True)
def _() -> str:
    ball = trimesh.creation.icosphere(4, 100)
    return _refused(ball.vertices, ball.faces, "sphere")


@CASES.extreme(STAGE, "hair only", "named error", slow=True)
def _() -> str:
    scene = person().kept(person().centres[:, 2] < -60)
    return _refused(scene.scan.vertices, scene.scan.faces, "hair")


@CASES.extreme(STAGE, "a budget of 0.001 s, and of 1 evaluation")
def _() -> str:
    figures = []
    for budget in (1e-3, Budget(evaluations=1)):
        registration, figure = found(person(), budget=budget)
        assert not registration.converged
        figures.append(figure)
    return ", ".join(figures) + ", converged False"


@CASES.extreme(STAGE, "seeds 0 and 2**32 - 1")
def _() -> str:
    poses = [found(person(), seed=seed) for seed in (0, 2**32 - 1)]
    apart = np.abs(
        transform_points(poses[0][0].model_from_scan, person().scan.vertices)
        - transform_points(poses[1][0].model_from_scan, person().scan.vertices)
    ).max()
    assert apart < 1.0
    return f"{poses[0][1]}; {apart:.3f} mm apart"


@CASES.extreme(STAGE, "a seed of -1", "named error")
def _() -> str:
    with naming("seed is -1, expected a whole number"):
        return found(person(), seed=-1)[1]


@CASES.extreme(STAGE, "options without a spacing", "named error")
def _() -> str:
    with naming("anchor_spacing_mm must be finite and above 0"):
        return found(person(), options=RegistrationOptions(anchor_spacing_mm=0.0))[1]


@CASES.extreme(STAGE, "a model of 4 control vertices", "named error")
def _() -> str:
    corners = np.array([[-60.0, -80, -30], [60, -80, -30], [0, 90, -20], [0, -10, 40]])
    chart = np.array([[0.0, 0], [1, 0], [0.5, 1], [0.5, 0.4]])
    faces, region = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]), np.zeros(3, np.uint8)
    tiny = AnnotatedFaceModel(corners, faces, chart, region, {"face": Region("face", 0)}, name="tetrahedron")
    with naming("tetrahedron: .* 4 control vertices", "at least"):
        register(person().scan, tiny)
    return "found"
