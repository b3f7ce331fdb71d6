"""The extremes of what all stages stand on: subdivision, closest points, diffusion, rigid transforms."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from scan2albedo.geometry.closest_points import ClosestPointQuery, NearestSurface
from scan2albedo.geometry.loop_subdivision import LoopSubdivision
from scan2albedo.geometry.mesh import turned_against_neighbours
from scan2albedo.geometry.operators import surface_diffusion
from scan2albedo.geometry.rigid import compose, procrustes, random_rotation, transform_points
from stability_cases.case import Cases, assert_finite, naming

CASES = Cases()

BALL = trimesh.creation.icosphere(3, 100.0)
VERTICES, FACES = np.array(BALL.vertices), np.array(BALL.faces, np.int64)
POINTS = np.random.default_rng(0).normal(scale=120, size=(500, 3))
VALUES = np.random.default_rng(1).random(len(VERTICES))
FLAT_FACES = np.concatenate([FACES, FACES[:50, [0, 0, 1]]])
QUERIES = (ClosestPointQuery, NearestSurface)


def _distance_gap(
    kind: type, factor: float = 1.0, offset: float = 0.0, faces: NDArray[np.int64] = FACES
) -> float:
    """Return how far distances of a scaled and shifted ball are from those of the plain one, in mm."""
    plain = kind(VERTICES, FACES).query(POINTS).distance
    placed = kind(factor * VERTICES + offset, faces).query(factor * POINTS + offset)
    assert_finite(placed.points, placed.barycentric)
    return float(np.abs(placed.distance / factor - plain).max())


@CASES.extreme("geometry", "closest points: offset 1e6, 1e7 and 1e9 mm")
def _() -> str:
    gap = max(_distance_gap(kind, offset=distance) for kind in QUERIES for distance in (1e6, 1e7, 1e9))
    assert gap < 1e-6
    return f"{gap:.0e} mm off"


@CASES.extreme("geometry", "closest points: sizes of 1e-7 and 1e11 mm")
def _() -> str:
    gap = max(_distance_gap(kind, factor) for kind in QUERIES for factor in (1e-9, 1e9))
    assert gap < 1e-9
    return f"{gap:.0e} of 100 off"


@CASES.extreme("geometry", "closest points: zero-area faces; a sliver of aspect 1e6")
def _() -> str:
    gap = max(_distance_gap(kind, faces=FLAT_FACES) for kind in QUERIES)
    assert gap < 1e-9
    sliver = np.array([[0.0, 0, 0], [100, 0, 0], [50, 1e-4, 0]])
    for kind in QUERIES:
        hits = kind(sliver, np.array([[0, 1, 2]])).query(np.array([[30.0, 7, 0]]))
        assert_finite(hits.points, hits.barycentric)
        assert abs(hits.distance[0] - 7) < 1e-3
    return f"{gap:.0e} mm off"


@CASES.extreme("geometry", "closest points: a NaN point, or one at 1e200", "named error")
def _() -> str:
    refusals = []
    for kind in QUERIES:
        for value in (np.nan, 1e200):
            points = POINTS.copy()
            points[3] = value
            try:
                with naming("^1 of 500 points are NaN, infinite"):
                    kind(VERTICES, FACES).query(points)
            except ValueError as error:
                refusals.append(error)
    assert len(refusals) == 2 * len(QUERIES)
    raise refusals[-1]


@CASES.extreme("geometry", "closest points: no faces", "named error")
def _() -> str:
    with naming("a surface without faces has no closest points"):
        ClosestPointQuery(VERTICES, FACES[:0])
    return "built"


def _subdivided(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the limit vertices, their rows of weights seen to sum to 1 and to be no extrapolation."""
    limit = LoopSubdivision.of(len(vertices), faces, 2)
    sums = np.asarray(limit.matrix.sum(1)).ravel()
    assert np.abs(sums - 1).max() < 1e-9, f"rows sum to {sums.min():.3f} ... {sums.max():.3f}"
    points = limit.matrix @ vertices
    assert_finite(points)
    assert np.abs(points).max() <= np.abs(vertices).max() * 1.0001
    return points


@CASES.extreme("geometry", "subdivision: double, zero-area and non-manifold faces")
def _() -> str:
    fins = np.column_stack([FACES[:9, :2], FACES[100:109, 0]])
    for faces in (np.concatenate([FACES, FACES[:3]]), FLAT_FACES, np.concatenate([FACES, fins])):
        points = _subdivided(VERTICES, faces)
    return f"rows sum to 1, {len(points)} points within the ball"


@CASES.extreme("geometry", "subdivision: a single triangle; mixed orientation")
def _() -> str:
    _subdivided(VERTICES, FACES[:1])
    even = (np.arange(len(FACES)) % 2 == 0)[:, None]
    gap = np.abs(_subdivided(VERTICES, np.where(even, FACES, FACES[:, ::-1]))[: len(VERTICES)]).max()
    return f"rows sum to 1, largest coordinate {gap:.1f} mm"


@CASES.extreme("geometry", "subdivision: a vertex of valence 1000; coordinates of 1e9 mm")
def _() -> str:
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    fan = np.concatenate([[[0.0, 0, 1]], np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])])
    index = np.arange(1000)
    faces = np.column_stack([0 * index, index + 1, (index + 1) % 1000 + 1])
    tip = _subdivided(fan, faces)[0]
    assert np.abs(tip[:2]).max() < 1e-12
    far = _subdivided(VERTICES + 1e9, FACES) - 1e9
    gap = np.abs(far - _subdivided(VERTICES, FACES)).max()
    assert gap < 1e-5
    return f"tip {np.abs(tip[:2]).max():.0e} off its axis; {gap:.0e} mm off at 1e9"


@CASES.extreme("geometry", "diffusion: distances of 1e-6 to 1e12 mm")
def _() -> str:
    areas = np.full(len(VERTICES), 1.0)
    for distance in (1e-6, 1.0, 1e3, 1e6, 1e12):
        spread = surface_diffusion(VERTICES, FACES, distance)(VALUES)
        assert spread.min() >= VALUES.min() - 1e-9
        assert spread.max() <= VALUES.max() + 1e-9
        assert abs(spread @ areas / areas.sum() - VALUES.mean()) < 0.01
    assert np.ptp(spread) < 1e-5
    return f"everything at its mean {spread.mean():.4f} (of the values {VALUES.mean():.4f}) at 1e12"


@CASES.extreme("geometry", "diffusion: zero-area faces; micrometres to kilometres; 1e9 mm away")
def _() -> str:
    plain = surface_diffusion(VERTICES, FACES, 5.0)(VALUES)
    gaps = [
        np.abs(surface_diffusion(k * VERTICES, FACES, 5.0 * k)(VALUES) - plain).max()
        for k in (1e-6, 1e3, 1e6)
    ]
    gaps.append(np.abs(surface_diffusion(VERTICES + 1e9, FACES, 5.0)(VALUES) - plain).max())
    assert max(gaps) < 1e-8
    flat = surface_diffusion(VERTICES, FLAT_FACES, 5.0)(VALUES)
    assert_finite(flat)
    assert VALUES.min() <= flat.min() <= flat.max() <= VALUES.max()
    return f"{max(gaps):.0e} apart"


@CASES.extreme("geometry", "diffusion: a NaN value", "named error")
def _() -> str:
    values = VALUES.copy()
    values[3] = np.nan
    with naming("1 values are not finite, and would spread"):
        surface_diffusion(VERTICES, FACES, 5.0)(values)
    return "spread"


@CASES.extreme("geometry", "diffusion: a NaN vertex, a distance of NaN", "named error")
def _() -> str:
    vertices = VERTICES.copy()
    vertices[3] = np.nan
    with naming("1 vertices are NaN or infinite"):
        surface_diffusion(vertices, FACES, 5.0)
    return "built"


@CASES.extreme("geometry", "rigid transforms: points on a plane, on a line, all in one place, one alone")
def _() -> str:
    rng = np.random.default_rng(2)
    pose, points = compose(random_rotation(rng), [1.0, 2, 3]), rng.normal(scale=50, size=(20, 3))
    gaps = []
    for source in (points * [1, 1, 0], points * [1, 0, 0], 0 * points + 5, points[:1]):
        target = transform_points(pose, source)
        found = procrustes(source, target)
        assert abs(np.linalg.det(found[:3, :3]) - 1) < 1e-9
        gaps.append(np.abs(transform_points(found, source) - target).max())
    assert max(gaps) < 1e-9
    return f"{max(gaps):.0e} mm off, no mirror"


@CASES.extreme("geometry", "rigid transforms: offset 1e9 mm; mirrored points")
def _() -> str:
    points = np.random.default_rng(3).normal(scale=50, size=(20, 3))
    far = procrustes(points + 1e9, points - 1e9)
    gap = np.abs(transform_points(far, points + 1e9) - (points - 1e9)).max()
    assert gap < 1e-5
    assert np.linalg.det(procrustes(points, points * [-1, 1, 1])[:3, :3]) > 0
    return f"{gap:.0e} mm off"


@CASES.extreme(
    "geometry",
    "rigid transforms: no points, NaN, weights of zero; a size of coincident points",
    "named error",
)
def _() -> str:
    points = np.ones((5, 3))
    for source, settings in (
        (points[:0], {}),
        (np.nan * points, {}),
        (points, {"weights": np.zeros(5)}),
    ):
        try:
            procrustes(source, source, **settings)
        except ValueError as error:
            assert "place nothing" in str(error)  # noqa: PT017 - every one of them is seen
        else:
            raise AssertionError(f"{len(source)} points, {settings} passed")
    with naming("coincide have no size"):
        procrustes(points, points, scale=True)
    return "placed"


@CASES.extreme("geometry", "orientation: half of the faces reversed; a Moebius strip")
def _() -> str:
    turned = np.random.default_rng(4).random(len(FACES)) < 0.4
    found = turned_against_neighbours(np.where(turned[:, None], FACES[:, ::-1], FACES))
    assert (found == turned).all()
    around = np.arange(40)
    near, far = 2 * around, np.where(around < 39, 2 * around + 2, 1)
    other = np.where(around < 39, 2 * around + 3, 0)
    strip = np.concatenate([np.column_stack([near, far, near + 1]), np.column_stack([near + 1, far, other])])
    assert not turned_against_neighbours(strip).any()
    return f"{int(turned.sum())} of {len(FACES)} faces found; the strip is left alone"
