"""Extremes of `register`: the pose is right, or the message says why there is none."""

import igl
import numpy as np

from scan2albedo import AnnotatedFaceModel, RawScan, register
from scan2albedo.face_model import Region
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.rigid import compose
from scan2albedo.registration import RegistrationOptions
from stability.case import BUDGETS, each, refuses, right, said, table, warns
from stability.scenes import (
    Scanned,
    at_random,
    line,
    model,
    noisy,
    person,
    plane,
    spoilt,
    stray,
    with_outlier_triangles,
)

MOST_DEG = 3.0
"""Between two people a pose is known to a few degrees; whole scans of this one end below half of it."""

MOST_MM = 3.0
"""The same for the mean of the landmarks."""


def found(scene, **settings):
    """Register a scene; return it and its registration."""
    return scene, register(scene.scan, model(), **settings)


def pose(found):
    """Assert that a pose is right, and return how far it is off."""
    scene, registration = found
    degrees, millimetres = scene.pose_error(registration.model_from_scan)
    assert degrees < MOST_DEG, f"{degrees:.2f} degrees off"
    assert millimetres < MOST_MM, f"{millimetres:.2f} mm off"
    return said(f"{degrees:.1f} degrees, {millimetres:.1f} mm off", registration.plan)


def pose_out_of_time(found):
    """Assert that a pose is right though the search has not converged."""
    assert not found[1].converged
    return f"{pose(found)}, converged False"


def size(found):
    """Assert that a face of another size is found at that size."""
    scale, registration = found
    assert abs(registration.face_scale - scale) < 0.05
    return said(f"face found at {100 * registration.face_scale:.0f} % of its size", registration.plan)


def two_heads():
    """Return a registration of two people side by side, and how far it is off each of them."""
    shifts = compose(np.eye(3), np.zeros(3)), compose(np.eye(3), [350.0, 0, 0])
    heads = [
        head.moved(shift @ head.model_from_scan)
        for head, shift in zip((person(), person(3)), shifts, strict=True)
    ]
    both = RawScan(*join([(head.scan.vertices, head.scan.faces) for head in heads]), name="two heads")
    registration = register(both, model())
    return registration, [head.pose_error(registration.model_from_scan) for head in heads]


def one_of_them(found):
    """Assert that one of two heads is found."""
    registration, errors = found
    off = min(millimetres for _, millimetres in errors)
    assert off < MOST_MM
    figure = f"{off:.1f} mm off one of them, confidence {registration.confidence:.2f}"
    return said(figure, registration.plan)


def hundred_vertices():
    """Return a face of the model itself, 100 vertices of it: 12 mm between neighbours."""
    vertices, faces = model().surface(0)
    fewer, index, _, _ = igl.qslim(vertices, faces, 170, False)
    assert len(fewer) < 125
    return Scanned(RawScan(fewer, index), np.eye(4), model().landmarks, vertices)


def tetrahedron():
    """Return a model of four control vertices."""
    chart = np.array([[1.0, 0], [0, 1], [0, 0], [0.3, 0.3]])
    faces, region = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]), np.zeros(3, np.uint8)
    regions = {"face": Region("face", 0)}
    return AnnotatedFaceModel(100 * np.eye(4, 3), faces, chart, region, regions, name="tetrahedron")


def alone(vertices, faces):
    """Register a mesh that is no face."""
    return register(RawScan(vertices, faces, name="scan"), model())


def above(quantile):
    """Return the person's scan above a quantile of its height."""
    height = person().centres[:, 1]
    return person().kept(height > np.quantile(height, quantile))


NO_FACE = "no face found.*probability.*of the face.*box"

CASES = table(
    "register",
    right(
        pose,
        {
            **each("offset {} mm", ("1e6", "1e7", "1e9"), lambda far: found(person().shifted(far))),
            "upside down": lambda: found(person().turned([0, 0, np.pi])),
            "turned by 180 degrees": lambda: found(person().turned([0, np.pi, 0])),
            "slivers, coincident vertices, zero-area, double and non-manifold faces": lambda: found(
                spoilt(person())
            ),
            **each("one vertex at {} mm", ("1e9", "1e20"), lambda far: found(stray(person(), 1, far))),
            "300 vertices thrown some 2 m away": lambda: found(stray(person(), 300, 2e3)),
            "half of all vertices are outliers": lambda: found(with_outlier_triangles(person())),
            **each("noise of {} mm", "13", lambda sigma: found(noisy(person(), sigma))),
            "60 % of the triangles lost": lambda: found(person().kept(at_random(person(), 0.4))),
            "all but the upper 40 % of the head lost": lambda: found(above(0.6)),
            "a fifth of the triangles wound the wrong way": lambda: found(
                person().wound(at_random(person(), 0.2))
            ),
            "100 vertices": lambda: found(hundred_vertices()),
            "seed 0": lambda: found(person(), seed=0),
            "seed 2**32 - 1": lambda: found(person(), seed=2**32 - 1),
        },
    ),
    right(pose_out_of_time, "a budget of {}", lambda budget: found(person(), budget=budget), BUDGETS),
    warns(one_of_them, "two heads", two_heads, slow=True),
    warns(
        size,
        "1.5 times too {}",
        lambda scale: (scale, found(person().scaled(scale))[1]),
        {"large": 1.5, "small": 1 / 1.5},
        slow=True,
    ),
    refuses(
        r"\d+ of \d+ triangles are wound against their neighbours.*load_scan does it",
        "one side of the face inside out",
        lambda: found(person().wound(person().centres[:, 0] > 0)),
    ),
    refuses(
        "inside out.*Reverse the order",
        "mirrored, so that triangles face inward",
        lambda: found(person().with_vertices(person().scan.vertices * [-1, 1, 1])),
        slow=True,
    ),
    refuses(
        "scan: 3 vertices cannot show a face.*scan the whole face",
        "a single triangle",
        lambda: alone([[0.0, 0, 0], [90, 0, 0], [0, 120, 0]], [[0, 1, 2]]),
    ),
    refuses(
        "scan: its surface of 0 mm2.*Scan the whole face",
        "a line of points",
        lambda: alone(*line()),
    ),
    refuses(NO_FACE, "a plane", lambda: alone(*plane(40, 250)), slow=True),
    refuses("seed is -1, expected a whole number", "a seed of -1", lambda: found(person(), seed=-1)),
    refuses(
        "anchor_spacing_mm must be finite and above 0",
        "options without a spacing",
        lambda: RegistrationOptions(anchor_spacing_mm=0.0),
    ),
    refuses(
        "tetrahedron: .* 4 control vertices.*at least",
        "a model of 4 control vertices",
        lambda: register(person().scan, tetrahedron()),
    ),
)
