"""Extremes of eyeglasses: weights, skinning, canonical frames, registration on faces, lenses."""

import math
from functools import cache

import numpy as np
from helpers.wearers import rest_frame, small_wearer
from helpers.worn_frames import register

from scan2albedo.eyeglasses import (
    CanonicalizationOptions,
    DistantLights,
    LensMaterial,
    Surface,
    ThinLens,
    bounded_biharmonic_weights,
    canonicalize,
    find_lens_rim,
    insert_lenses,
    refract,
    skin,
    triangulate,
)
from scan2albedo.eyeglasses.lenses.inserted_lenses import lens_mesh
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.synthetic import GlassesBend, GlassesShape, eyeglasses
from stability.case import BUDGETS, below, each, gap, measured, refuses, right, table, unfinished, warns
from stability.scenes import plane

SPACING = 3.0
NAN = math.nan
FRAME = eyeglasses()
COUNT = len(FRAME.vertices)


def weighted(handles=FRAME.keypoints, vertices=FRAME.vertices, faces=FRAME.faces, spacing=SPACING):
    """Return weights, which are shares."""
    weights = bounded_biharmonic_weights(vertices, faces, handles, spacing)
    assert gap(weights.sum(1), 1) <= 1e-12
    assert weights.min() >= 0
    return weights


plain = cache(weighted)


def weights_off(scale=1.0, shift=0.0):
    """Return by how much weights change with the unit and the place."""
    points, vertices = (scale * place + shift for place in (FRAME.keypoints, FRAME.vertices))
    return gap(weighted(points, vertices, spacing=scale * SPACING), plain())


def with_slivers():
    """Return by how much slivers and flat triangles change the weights."""
    a, b, c = FRAME.faces[::7].T
    slivers = [np.stack(corners, 1) for corners in ((a, b, a), (a, b, b), (a, c, COUNT + np.arange(len(c))))]
    vertices = np.vstack([FRAME.vertices, FRAME.vertices[c] + 1e-12])
    weights = weighted(vertices=vertices, faces=np.vstack([FRAME.faces, *slivers]))
    return gap(weights[:COUNT], plain())


def own_share(*mesh, at=slice(None)):
    """Return how much of a key point's vertex others move."""
    return 1 - float(np.diag(weighted(*mesh)[at]).min())


def wire():
    """Return how much of a key point's vertex others move on a wire of 0.5 mm."""
    names = ("rim_width", "rim_depth", "bridge_height", "temple_height", "temple_width")
    thin = eyeglasses(shape=GlassesShape(**dict.fromkeys(names, 0.5)))
    return own_share(thin.keypoints, thin.vertices, thin.faces, at=thin.keypoint_vertices)


TRIANGLE = np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0]])

# Canonical frames.


def straightened(vertices, points, rest=FRAME.keypoints, **options):
    """Return the canonical frame of one mesh of the frame's topology."""
    options = {"weights": [plain()], "options": CanonicalizationOptions(mode="mean"), **options}
    return canonicalize([(vertices, FRAME.faces)], [points], mean_keypoints=rest, **options).frames[0]


def rms(off):
    """Return the root mean square length of differences (N, 3)."""
    return float(np.sqrt((off**2).sum(1).mean()))


def unbent_far_away(shift):
    """Return how far a bent frame, straightened far from the origin, is from the one at rest."""
    bent = eyeglasses(bend=GlassesBend(temple_spread_mm=8.0))
    found = straightened(bent.vertices + shift, bent.keypoints + shift, bent.rest_keypoints)
    return rms(found.vertices - bent.rest_vertices)


def folded(angle_deg):
    """Straighten the frame with its temples folded inward; return what shows how bent it was."""
    points, vertices = FRAME.keypoints.copy(), FRAME.vertices.copy()
    for sign, at in ((1, 7), (-1, 16)):
        hinge = FRAME.keypoints[at]
        turn = rotation_from_vector([0, sign * math.radians(angle_deg), 0])
        for moved in (points, vertices):
            side = (sign * moved[:, 0] > 60) & (moved[:, 2] < hinge[2] - 5)
            moved[side] = (moved[side] - hinge) @ turn.T + hinge
    found = straightened(vertices, points)
    assert found.residual > 10
    back = gap(found.uncanonicalize(found.vertices), vertices)
    assert back < 1e-4
    return found.residual, back, rms(found.vertices - FRAME.vertices)


LINE = np.arange(60.0).reshape(20, 3)

# Key points from several views.

THREE = np.stack(
    [
        look_at(center, [0, 0, 0], focal_px=900, shape=(512, 512))
        for center in ((-300, 0, 500), (0, 50, 600), (300, 0, 500))
    ]
)


def zoomed(cameras, factor):
    """Return cameras with another focal length."""
    return np.diag([factor, factor, 1]) @ cameras


def triangulated(focal_px):
    """Return how far key points are off that cameras of a focal length see."""
    cameras = zoomed(THREE, focal_px / 900)
    labels = np.stack([project(camera, FRAME.keypoints)[0] for camera in cameras])
    found = triangulate(labels, cameras, noise_px=max(focal_px / 900, 1e-3))
    return gap(found.points, FRAME.keypoints)


def outliers():
    """Return in how many views the labels of a key point agree when all are wrong."""
    found = triangulate(np.random.default_rng(0).uniform(-1e5, 1e5, (3, 20, 2)), THREE)
    assert found.inliers.sum(0).max() <= 1
    return found.inliers.sum(0).max()


# Registration on a face.


def wearer():
    """Return a person with glasses in small pictures."""
    return small_wearer(1, noise_px=0.5)


def worn(**changes):
    """Put the person's glasses on the head by labels alone, with some arguments changed."""
    return register(wearer(), **{"masks": None, **changes})


def times(factor):
    """Put the glasses, multiplied, on the head."""
    vertices, faces, points, weights = rest_frame(1)
    return worn(glasses=(factor * vertices, faces, factor * points, weights))


def head(shift):
    """Return the person's head, moved."""
    return wearer().head_vertices + shift, wearer().head_faces


def off_mm(found, shift=0.0):
    """Return how far the vertices seen are off: rms in mm."""
    person = wearer()
    return rms((found.vertices - shift - person.vertices)[person.seen])


def labels(high, low=0.0):
    """Return labels by chance."""
    return np.random.default_rng(0).uniform(low, high, wearer().labels.shape)


def moved_camera(forward_mm):
    """Register with the first camera said to be at the glasses, or so far behind them."""
    cameras = wearer().cameras.copy()
    forward = cameras[0, 2, :3] / np.linalg.norm(cameras[0, 2, :3])
    cameras[0, :, 3] = -cameras[0, :, :3] @ (wearer().keypoints.mean(0) + forward_mm * forward)
    found = worn(cameras=cameras)
    assert not found.inliers[0].all()
    return 100 * found.inliers[0].mean(), off_mm(found)


def far_scene():
    """Return how far the glasses are off when everything is 1e6 mm from the origin."""
    shift = np.array([1e6, 0, 0])
    cameras = wearer().cameras.copy()
    cameras[:, :, 3] -= cameras[:, :, :3] @ shift
    return off_mm(worn(cameras=cameras, head=head(shift)), shift)


def out_of_time():
    """Return what counts as observed when time is over at once, and how far it is off."""
    found = unfinished(worn(budget=BUDGETS["0.001 s"]))
    return 100 * found.observed.mean(), off_mm(found)


# Lenses.


def bend_error(dioptres, normal=(0, 0, 1)):
    """Return by how much the bend of a ray 20 mm off the axis differs from the exact thin lens's."""
    rays = refract(ThinLens([0, 0, 0], normal, dioptres), [0, 0, 600.0], [[20.0, 0, 0]])
    slope = rays.directions[0, 0] / -rays.directions[0, 2]
    return abs(math.degrees(math.atan(slope) - math.atan(20 / 600 - 20 * dioptres / 1000)))


def pictured(dioptres, shape):
    """Return the darkest value of a picture of lenses before a wall, negated, and the pixels of lens."""
    center = FRAME.lens_centers[0]
    wall, faces = plane(2, 160)
    picture = insert_lenses(
        Surface(FRAME.vertices, FRAME.faces, albedo_linear=(0.1, 0.1, 0.1)),
        FRAME.keypoints,
        LensMaterial(dioptres),
        surfaces=[Surface(wall - [0, 0, 40], faces)],
        camera=look_at(center + [0, 0, 600], center, focal_px=300, shape=(48, 64)),
        shape=shape,
        lights=DistantLights([[0, 0, 1]], [np.pi]),
    )
    return -picture.image_linear.min(), int((picture.lens >= 0).sum()), picture.image_linear


HELD = below(0.1, "others move {:.2f} of a key point's vertex")
SHAPELESS = {
    "no vertex": (np.zeros((1, 3)), np.zeros((0, 3)), np.zeros((0, 3), int)),
    "no key point": (np.zeros((0, 3)), np.eye(3), [[0, 1, 2]]),
    "shrunk to a point": ([[0, 0, 0]], np.zeros((9, 3)), [[0, 1, 2]]),
    "coincident key points": (FRAME.keypoints[[*range(20), 2]],),
    "key points far off the mesh": (FRAME.keypoints + [0, 90, 0],),
    "spacing 0.001": (FRAME.keypoints, FRAME.vertices, FRAME.faces, 1e-3),
}

CASES = table(
    "eyeglasses",
    refuses("", "weights: {}", lambda mesh: weighted(*mesh), SHAPELESS),
    right(
        below(1e-12, "takes everything but {:.0f}"),
        "weights: one key point",
        lambda: own_share(FRAME.keypoints[:1]),
    ),
    right(HELD, "weights: one triangle", lambda: own_share(TRIANGLE, TRIANGLE, [[0, 1, 2]])),
    right(HELD, "weights: a wire frame of 0.5 mm", wire),
    right(below(1e-6, "as without, within {:.0e}"), "weights: slivers and flat triangles", with_slivers),
    right(
        below(1e-6, "as in mm, within {:.0e}"),
        "weights: glasses in kilometres",
        lambda: weights_off(1e-6),
        slow=True,
    ),
    right(
        below(1e-3, "as at the origin, within {:.0e}"),
        "weights: glasses {} mm off the origin",
        lambda far: weights_off(shift=far),
        ("1e6", "1e7"),
    ),
    refuses(
        "",
        {
            "skinning: weights NaN": lambda: skin(np.ones((2, 3)), np.full((2, 1), NAN), [np.eye(4)]),
            "skinning: transforms NaN": lambda: skin(np.ones((2, 3)), np.ones((2, 1)), [NAN * np.eye(4)]),
        },
    ),
    right(
        below(1, "{} vertices"),
        "skinning: no vertex",
        lambda: len(skin(np.zeros((0, 3)), np.zeros((0, 1)), [np.eye(4)])),
    ),
    right(
        below(0.15, "off by {:.2f} mm rms"),
        "canonical: glasses {} mm off the origin",
        unbent_far_away,
        ("1e6", "1e7"),
    ),
    warns(
        measured("residual {:.0f} mm says how bent it was; the way back within {:.0e} mm, off by {:.1f} mm"),
        "canonical: temples folded by {} degrees",
        folded,
        ("90", "180"),
    ),
    refuses(
        "frame 0: .* key points",
        "canonical: key points {}",
        lambda points: straightened(FRAME.vertices, points),
        {
            "all at one place": 0 * LINE,
            "on a line": LINE * [1, 0, 0],
            "two known": np.where(np.arange(20)[:, None] < 2, 1.0, NAN) * LINE,
            "none known": NAN * LINE,
            "infinite": math.inf + LINE,
        },
    ),
    refuses(
        "",
        "canonical: weights NaN",
        lambda: straightened(FRAME.vertices, FRAME.keypoints, weights=[NAN * plain()]),
    ),
    warns(measured("inliers in {} view at most"), "triangulation: all labels outliers (1e5 px)", outliers),
    right(
        below(1e-4, "points within {:.0e} mm"),
        "triangulation: focal length {} px",
        triangulated,
        ("1", "1e6"),
    ),
    refuses(
        "",
        {
            "registration: all labels outliers (1e5 px)": lambda: worn(keypoints_2d=labels(1e5, -1e5)),
            "registration: labels by chance within the pictures": lambda: worn(keypoints_2d=labels(256)),
            **each(
                "registration: focal length {} px",
                ("1", "1e6"),
                lambda focal: worn(cameras=zoomed(wearer().cameras, focal / 450)),
            ),
        },
        slow=True,
    ),
    refuses(
        "no key point is labelled.*no head.*give a start",
        "registration: no labels",
        lambda: worn(keypoints_2d=NAN * labels(1), head=None),
    ),
    refuses("", "registration: labels infinite", lambda: worn(keypoints_2d=math.inf + labels(1), head=None)),
    warns(
        measured("{:.0f} % of its labels fit, the other views decide: off by {:.1f} mm"),
        {
            "registration: a camera said to be inside the glasses": lambda: moved_camera(0.0),
            "registration: a camera said to be behind the head": lambda: moved_camera(600.0),
        },
        slow=True,
    ),
    refuses(
        "labels of view 0 lie outside its mask of 128 x 128",
        "registration: masks of another size",
        lambda: worn(masks=wearer().masks[:, ::2, ::2]),
    ),
    refuses("", "registration: masks of 1 x 1", lambda: worn(masks=np.ones((3, 1, 1), bool))),
    refuses(
        r"e\+0[36] times as large.*same unit",
        "registration: glasses times {}, cameras in mm",
        times,
        ("1e-3", "1e-6"),
    ),
    refuses("", "registration: head with NaN", lambda: worn(head=head(NAN))),
    right(
        below(1.0, "visible vertices off by {:.2f} mm rms"),
        "registration: scene 1e6 mm off the origin",
        far_scene,
        slow=True,
    ),
    warns(
        measured("converged=False, {:.0f} % counts as observed; off by {:.0f} mm"),
        "registration with a budget of 0.001 s",
        out_of_time,
        slow=True,
    ),
    right(
        below(1e-9, "within {:.0e} degrees of the exact thin lens"),
        "lens of {} dioptres",
        bend_error,
        ("-20", "0", "20", "1e3", "1.66667"),
    ),
    refuses("not finite", "lens of {} dioptres", bend_error, ("nan", "inf")),
    refuses("normal is zero", "lens without a normal", lambda: bend_error(4.0, (0, 0, 0))),
    right(
        below(1e-12, "finite, {1} pixels of lens"),
        {
            "picture through lenses of 1000 dioptres": lambda: pictured(1e3, (48, 64)),
            "picture of 1 x 1": lambda: pictured(-3.0, (1, 1)),
        },
    ),
    refuses(
        "no closed rim",
        "rim sought far from the frame",
        lambda: find_lens_rim(
            FRAME.vertices, FRAME.faces, FRAME.lens_centers[0] + [0, 0, 500.0], normal=[0, 0, 1]
        ),
    ),
    refuses(
        "",
        "lens mesh in a rim {}",
        lambda rim: lens_mesh([0, 0, 0], rim),
        {
            "of two points": TRIANGLE[:2],
            "collapsed to a point": np.ones((8, 3)),
            "with NaN": np.full((8, 3), NAN),
        },
    ),
)
