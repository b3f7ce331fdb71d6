"""Extremes of `AnnotatedFaceModel.from_mesh`: the template comes back, or the message says what is wrong."""

import numpy as np
import trimesh

from scan2albedo import AnnotatedFaceModel
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import transform_points
from stability.case import Measured, below, each, gap, refuses, right, table, warns
from stability.scenes import line, mixed, model, moebius, plane, with_one

VERTICES, FACES = model().surface(0)
"""A face template of 950 vertices, mm."""


def modelled(vertices=VERTICES, faces=FACES, **settings):
    """Make a model whose template comes back; return how far its surface is off (mean), its size, and it."""
    xyz, index = np.asarray(vertices, float), np.asarray(faces)
    made = AnnotatedFaceModel.from_mesh(xyz, index, **{"annotate": False, "control_size": 300, **settings})
    assert 0 <= made.uv.min() <= made.uv.max() <= 1
    used = np.unique(index)
    back = transform_points(made.template_from_model, made.template_of(made.control_vertices))[used]
    size = np.ptp(xyz[used], axis=0).max()
    assert gap(back, xyz[used]) < 1e-6 * size + 1e-15 * gap(xyz[used], 0)
    inner = transform_points(np.linalg.inv(made.template_from_model), xyz[used])
    apart = ClosestPointQuery(*made.surface(2)).query(inner).distance
    return apart.mean(), len(made.control_vertices), made


def noted(words, bound=2.0):
    """Return a figure: the note of a model that says this; its surface passes near the template."""

    def figure(found):
        assert found[0] < bound
        return Measured(next(note for note in found[2].notes if words in note))

    return figure


def folded():
    """Return the face with its chin folded through itself."""
    vertices = VERTICES.copy()
    chin = vertices[:, 1] < -40
    vertices[chin, 1] = -80 - vertices[chin, 1]
    vertices[chin, 2] -= 15
    return vertices


def damaged():
    """Model the face with non-manifold edges, slivers and zero-area faces."""
    fins = np.column_stack([FACES[:2, :2], FACES[500:502, 0]])
    first, second, _ = VERTICES[FACES[900:903]].swapaxes(0, 1)
    slivers = np.column_stack([FACES[900:903, :2], len(VERTICES) + np.arange(3)])
    vertices = np.concatenate([VERTICES, first + 1e-6 * (second - first)])
    return modelled(vertices, np.concatenate([FACES, fins, slivers, FACES[:40, [0, 0, 1]]]))


def flipped():
    """Return the chart with one inner triangle turned over."""
    uv = model().uv
    corner = FACES[np.argmin(np.linalg.norm(uv[FACES].mean(1) - 0.5, axis=1))]
    return with_one(uv, uv[corner[[0, 2, 1]]], corner)


def fine():
    """Model the face with 100,000 vertices."""
    finer = model().subdivision(3)
    return modelled(finer.matrix @ VERTICES, finer.faces, control_size=1000)


def far_vertex():
    """Model the face with one vertex at 1e5 mm."""
    made = AnnotatedFaceModel.from_mesh(with_one(VERTICES, 1e5, FACES[400, 0]), FACES, annotate=False)
    assert made.notes[0] == "unit mm"
    return 0.0, 0, made


TORUS = trimesh.creation.torus(80.0, 30.0)
NEAR = below(1.0, "{:.2f} mm from the template, {} control vertices")
BROKEN = "{} of .* vertices are NaN or infinite; repair"

CASES = table(
    "from_mesh",
    right(
        NEAR,
        {
            **each("face times {}", ("1e3", "0.1", "1e-3"), lambda factor: modelled(factor * VERTICES)),
            **each("{} mm away", ("1e6", "1e7", "1e9"), lambda far: modelled(VERTICES + far)),
            "100,000 vertices": fine,
        },
        slow=True,
    ),
    right(
        NEAR,
        {
            "a plane": lambda: modelled(*plane(20, 200)),
            "self-intersecting": lambda: modelled(folded()),
            "every face twice, once reversed": lambda: modelled(
                faces=np.concatenate([FACES, FACES[:, ::-1]])
            ),
            "a mixed orientation": lambda: modelled(faces=mixed(FACES)),
            "a soup of triangles": lambda: modelled(
                VERTICES[FACES].reshape(-1, 3), np.arange(FACES.size).reshape(-1, 3)
            ),
        },
    ),
    warns(
        noted("faces cut off the back of a closed surface", 20.0),
        "a torus: cut open",
        lambda: modelled(TORUS.vertices, TORUS.faces),
    ),
    warns(
        noted("faces dropped at edges with three faces"),
        "non-manifold edges, slivers, zero-area faces",
        damaged,
    ),
    warns(noted("vertices far from the rest"), "one vertex at 1e5 mm", far_vertex),
    warns(
        noted("a greater control_size follows it better", 4.0),
        "a control mesh of 25 vertices",
        lambda: modelled(control_size=25),
    ),
    warns(
        noted("a new chart was drawn"),
        "uv {}",
        lambda uv: modelled(control_size=1000, uv=uv),
        {
            "with a flipped triangle": flipped(),
            "NaN": np.nan * model().uv,
            "outside [0, 1]": 5 * model().uv - 2,
            "all in one place": 0 * model().uv,
        },
    ),
    refuses(
        "which is not a head in mm, cm, m or um.*scale it to millimetres",
        "kilometres",
        lambda: modelled(1e-6 * VERTICES),
    ),
    refuses(
        "template: only 4 vertices in faces, at least 100 needed",
        "4 vertices",
        lambda: modelled(100 * np.eye(4, 3), [[0, 1, 3], [1, 2, 3], [2, 0, 3]]),
    ),
    refuses(
        "control_size is 4, but fewer than 20 control vertices hold no face",
        "a control mesh of 4 vertices",
        lambda: modelled(control_size=4),
    ),
    refuses(
        "template: every face has zero area",
        "a line of points",
        lambda: modelled(*line()),
    ),
    refuses(BROKEN.format(1), "one vertex NaN", lambda: modelled(with_one(VERTICES, np.nan, FACES[400, 0]))),
    refuses(BROKEN.format(len(VERTICES)), "all vertices NaN", lambda: modelled(np.nan * VERTICES)),
    refuses("cannot be oriented.*use an orientable mesh", "a Moebius strip", lambda: modelled(*moebius())),
)
