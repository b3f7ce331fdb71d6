"""Extremes of what all stages stand on: closest points, subdivision, diffusion, rigid transforms."""

from functools import partial

import numpy as np
import trimesh

from scan2albedo.geometry.closest_points import ClosestPointQuery, NearestSurface
from scan2albedo.geometry.fields import surface_diffusion
from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.mesh import turned_against_neighbours
from scan2albedo.geometry.rigid import compose, procrustes, random_rotation, transform_points
from stability.case import below, each, gap, refuses, right, table
from stability.scenes import mixed, moebius, with_one

BALL = trimesh.creation.icosphere(3, 100.0)
VERTICES = np.array(BALL.vertices)
FACES = np.array(BALL.faces, np.int64)
FLAT_FACES = np.concatenate([FACES, FACES[:50, [0, 0, 1]]])
POINTS = np.random.default_rng(0).normal(scale=120, size=(500, 3))
VALUES = np.random.default_rng(1).random(len(VERTICES))
CLOUD = np.random.default_rng(3).normal(scale=50, size=(20, 3))
QUERIES = (ClosestPointQuery, NearestSurface)


def distance_gap(factor=1.0, offset=0.0):
    """Return how far distances of a scaled and shifted ball are from those of the plain one, in mm."""
    plain = [kind(VERTICES, FACES).query(POINTS).distance for kind in QUERIES]
    placed = [kind(factor * VERTICES + offset, FACES).query(factor * POINTS + offset) for kind in QUERIES]
    gaps = [gap(there.distance / factor, here) for here, there in zip(plain, placed, strict=True)]
    return max(gaps), placed


def subdivided(faces, vertices=VERTICES):
    """Return how far rows of weights are from a sum of 1, and the limit vertices."""
    limit = LoopSubdivision.of(len(vertices), faces, 2)
    points = limit.matrix @ vertices
    assert gap(points, 0) <= gap(vertices, 0) * 1.0001, "extrapolated"
    return gap(np.asarray(limit.matrix.sum(1)), 1), points


def valence_1000():
    """Return how far the tip of a cone of 1000 triangles leaves its axis."""
    cone = trimesh.creation.cone(1.0, 1.0, sections=1000)
    tip = cone.vertices[:, 2].argmax()
    return gap(subdivided(cone.faces, cone.vertices)[1][tip, :2], 0)


def spread(distance):
    """Return how far the mean of a field moves when it is spread over a distance; its range stays."""
    smooth = surface_diffusion(VERTICES, FACES, distance)(VALUES)
    assert VALUES.min() - 1e-9 <= smooth.min() <= smooth.max() <= VALUES.max() + 1e-9
    return float(abs(smooth.mean() - VALUES.mean())), smooth


def diffusion_gap(factor=1.0, offset=0.0):
    """Return by how much diffusion over 5 mm differs from that of a ball of another unit or place."""
    plain = surface_diffusion(VERTICES, FACES, 5.0)(VALUES)
    placed = surface_diffusion(factor * VERTICES + offset, FACES, 5.0 * factor)(VALUES)
    return gap(placed, plain)


def flat_diffusion():
    """Return by how much diffusion over zero-area faces leaves the range of its values."""
    smooth = surface_diffusion(VERTICES, FLAT_FACES, 5.0)(VALUES)
    return float(max(VALUES.min() - smooth.min(), smooth.max() - VALUES.max())), smooth


def rigid_gap(source):
    """Return how far points are from where a rigid transform, found from them, lays them."""
    rng = np.random.default_rng(2)
    target = transform_points(compose(random_rotation(rng), [1.0, 2, 3]), source)
    found = procrustes(source, target)
    assert abs(np.linalg.det(found[:3, :3]) - 1) < 1e-9
    return gap(transform_points(found, source), target)


def half_reversed():
    """Return how many of a ball's reversed faces are not found, or found without being so."""
    turned = np.random.default_rng(4).random(len(FACES)) < 0.4
    found = turned_against_neighbours(np.where(turned[:, None], FACES[:, ::-1], FACES))
    return int((found != turned).sum()), int(turned.sum())


FINS = np.column_stack([FACES[:9, :2], FACES[100:109, 0]])

CASES = table(
    "geometry",
    right(
        below(1e-6, "{:.0e} mm off"),
        "closest points: offset {} mm",
        lambda far: distance_gap(offset=far),
        ("1e6", "1e7", "1e9"),
    ),
    right(
        below(1e-9, "{:.0e} of 100 off"),
        "closest points: size of {} times 100 mm",
        distance_gap,
        ("1e-9", "1e9"),
    ),
    refuses(
        "^1 of 500 points are NaN, infinite",
        {
            f"{kind.__name__}: a point of {value}": partial(
                kind(VERTICES, FACES).query, with_one(POINTS, value)
            )
            for kind in QUERIES
            for value in (np.nan, 1e200)
        },
    ),
    refuses(
        "a surface without faces has no closest points",
        "closest points: no faces",
        lambda: ClosestPointQuery(VERTICES, FACES[:0]),
    ),
    right(
        below(1e-9, "rows sum to 1 within {:.0e}, no extrapolation"),
        "subdivision: {}",
        subdivided,
        {
            "double faces": np.concatenate([FACES, FACES[:3]]),
            "zero-area faces": FLAT_FACES,
            "non-manifold faces": np.concatenate([FACES, FINS]),
            "a single triangle": FACES[:1],
            "mixed orientation": mixed(FACES),
        },
    ),
    right(
        below(1e-12, "tip {:.0e} off its axis"),
        "subdivision: a vertex of valence 1000",
        valence_1000,
    ),
    right(
        below(1e-5, "{:.0e} mm off at 1e9"),
        "subdivision: coordinates of 1e9 mm",
        lambda: gap(subdivided(FACES, VERTICES + 1e9)[1] - 1e9, subdivided(FACES)[1]),
    ),
    right(
        below(0.01, "mean within {:.4f}, range kept"),
        "diffusion: distance of {} mm",
        spread,
        ("1e-6", "1", "1e3", "1e6", "1e12"),
    ),
    right(
        below(1e-8, "{:.0e} apart"),
        {
            **each("diffusion: {} times as large", ("1e-6", "1e3", "1e6"), diffusion_gap),
            "diffusion: 1e9 mm away": lambda: diffusion_gap(offset=1e9),
            "diffusion: zero-area faces": flat_diffusion,
        },
    ),
    refuses(
        "1 values are not finite, and would spread",
        "diffusion: a NaN value",
        lambda: surface_diffusion(VERTICES, FACES, 5.0)(with_one(VALUES, np.nan)),
    ),
    refuses(
        "1 vertices are NaN or infinite",
        "diffusion: a NaN vertex",
        lambda: surface_diffusion(with_one(VERTICES, np.nan), FACES, 5.0),
    ),
    right(
        below(1e-9, "{:.0e} mm off, no mirror"),
        "rigid transforms: {}",
        rigid_gap,
        {
            "points on a plane": CLOUD * [1, 1, 0],
            "points on a line": CLOUD * [1, 0, 0],
            "points all in one place": 0 * CLOUD + 5,
            "one point alone": CLOUD[:1],
        },
    ),
    refuses(
        "place nothing",
        {
            "rigid transforms: no points": lambda: procrustes(CLOUD[:0], CLOUD[:0]),
            "rigid transforms: NaN": lambda: procrustes(np.nan * CLOUD, CLOUD),
            "rigid transforms: weights of zero": lambda: procrustes(CLOUD, CLOUD, weights=np.zeros(20)),
        },
    ),
    refuses(
        "coincide have no size",
        "rigid transforms: a size of coincident points",
        lambda: procrustes(0 * CLOUD, 0 * CLOUD, scale=True),
    ),
    right(
        below(1, "{} of {} reversed faces mistaken"), "orientation: half of the faces reversed", half_reversed
    ),
    right(
        below(1, "{} faces mistaken"),
        "orientation: a Moebius strip",
        lambda: int(turned_against_neighbours(moebius()[1]).sum()),
    ),
)
