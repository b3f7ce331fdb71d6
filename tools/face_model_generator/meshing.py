"""A graded triangle mesh of half the face's layout, its edges along the feature curves."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial import Delaunay, cKDTree

from face_model_generator.layout import inside_polygon
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import ModelError


@dataclass(frozen=True)
class MeshOptions:
    """Edge lengths in the layout, mm, and how long the free vertices relax.

    Parameters
    ----------
    curve_edge_mm : dict of str to float
        Edge length along each feature curve; curves not named take `coarse_edge_mm`.
    coarse_edge_mm : float
        Largest edge length.
    growth : float
        Growth of the edge length per millimetre away from a curve.
    iterations : int
        Relaxation steps of the free vertices.
    seed : int
        Of the initial placement.
    """

    curve_edge_mm: dict[str, float]
    coarse_edge_mm: float = 12.0
    growth: float = 0.24
    iterations: int = 200
    seed: int = 0


@dataclass(frozen=True)
class HalfMesh:
    """Vertices (N, 2) in the layout, faces (F, 3), and the vertex indices along each curve."""

    flat: FloatArray
    faces: IntArray
    curves: dict[str, IntArray]


def mesh_half(curves: dict[str, FloatArray], outline: tuple[str, str], options: MeshOptions) -> HalfMesh:
    """Triangulate the region between two boundary curves, following all curves.

    Parameters
    ----------
    curves : dict of str to (N, 2) float64
        Key points of each curve in the layout. Curves meet at key points only.
    outline : pair of str
        The two curves that together bound the half.
    options : MeshOptions

    References
    ----------
    .. [1] P.-O. Persson, G. Strang, "A Simple Mesh Generator in MATLAB", SIAM Review 46(2), 2004.
    """
    size = _SizeField.of(curves, options)
    junctions = _junctions(curves)
    sampled = {name: _sample(curve, junctions, size) for name, curve in curves.items()}
    fixed, index = _merged(sampled)
    polygon = np.concatenate([sampled[outline[0]], sampled[outline[1]][::-1][1:-1]])
    free = _initial(polygon, fixed, size, options)
    points = _relaxed(fixed, free, polygon, size, options)
    faces = _with_curves(_triangles(points, polygon), index)
    return HalfMesh(points, faces, index)


def _with_curves(faces: IntArray, curves: dict[str, IntArray]) -> IntArray:
    """Flip the edges that cross a curve's edge (Delaunay's criterion does not know the curves)."""
    result = faces
    for name, index in curves.items():
        for a, b in pairwise(index.tolist()):
            present = np.any(np.sum(np.isin(result, [a, b]), axis=1) == 2)
            if not present:
                result = _flipped(result, a, b, name)
    return result


def _flipped(faces: IntArray, a: int, b: int, name: str) -> IntArray:
    """Return the faces with edge (a, b) in place of the one edge that crosses it."""
    at_a, at_b = (np.flatnonzero(np.any(faces == corner, axis=1)) for corner in (a, b))
    for first in at_a:
        # Turned so that its corners are (a, c, d): b's triangle must be (b, d, c).
        _, c, d = np.roll(faces[first], -int(np.argmax(faces[first] == a)))
        for second in at_b:
            if {int(c), int(d)} <= set(faces[second].tolist()):
                flipped = faces.copy()
                flipped[first], flipped[second] = (a, c, b), (a, b, d)
                return flipped
    raise ModelError(
        f"the mesh cannot follow the curve {name} between vertices {a} and {b}; "
        "give the curve shorter edges, or move its key points away from other curves"
    )


@dataclass(frozen=True)
class _SizeField:
    """Wanted edge lengths: one tree of dense curve points for each edge length."""

    trees: dict[float, cKDTree]
    options: MeshOptions

    @classmethod
    def of(cls, curves: dict[str, FloatArray], options: MeshOptions) -> _SizeField:
        lengths = sorted(set(options.curve_edge_mm.values()))
        trees = {
            length: cKDTree(
                np.concatenate(
                    [
                        _densified(curves[n], 0.5)
                        for n, edge in options.curve_edge_mm.items()
                        if edge == length
                    ]
                )
            )
            for length in lengths
        }
        return cls(trees, options)

    def at(self, points: FloatArray) -> FloatArray:
        """Return (N,) lengths: least over the curves of their edge plus growth times distance."""
        best = np.full(len(points), self.options.coarse_edge_mm)
        for edge, tree in self.trees.items():
            best = np.minimum(best, edge + self.options.growth * tree.query(points)[0])
        return best


def _curve(points: FloatArray) -> tuple[FloatArray, PchipInterpolator]:
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    return arc, PchipInterpolator(arc, points)


def _densified(points: FloatArray, step: float) -> FloatArray:
    arc, curve = _curve(points)
    return curve(np.linspace(0, arc[-1], max(2, int(np.ceil(arc[-1] / step)))))


def _junctions(curves: dict[str, FloatArray]) -> FloatArray:
    """Return points where curves end or meet."""
    return np.concatenate([curve[[0, -1]] for curve in curves.values()])


def _sample(points: FloatArray, junctions: FloatArray, size: _SizeField) -> FloatArray:
    """Sample a curve with the wanted edge lengths, every junction on it kept."""
    arc, curve = _curve(points)
    near = np.min(np.linalg.norm(points[:, None] - junctions[None], axis=2), axis=1) < 1e-9
    knots = arc[near]
    pieces = [_piece(curve, a, b, size) for a, b in pairwise(knots)]
    return np.concatenate([*pieces, points[-1:]])


def _piece(curve: PchipInterpolator, start: float, stop: float, size: _SizeField) -> FloatArray:
    arc = np.linspace(start, stop, 200)
    density = 1 / size.at(curve(arc))
    count = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(arc))])
    edges = max(1, round(count[-1]))
    return curve(np.interp(np.arange(edges) / edges * count[-1], count, arc))


def _merged(sampled: dict[str, FloatArray]) -> tuple[FloatArray, dict[str, IntArray]]:
    stacked = np.concatenate(list(sampled.values()))
    _, first, inverse = np.unique(np.round(stacked, 7), axis=0, return_index=True, return_inverse=True)
    ends = np.cumsum([len(c) for c in sampled.values()])[:-1]
    return stacked[first], dict(zip(sampled, np.split(inverse.ravel(), ends), strict=True))


def _initial(polygon: FloatArray, fixed: FloatArray, size: _SizeField, options: MeshOptions) -> FloatArray:
    """Throw a hexagonal grid of the finest spacing and thin it to the wanted density."""
    random = np.random.default_rng(options.seed)
    finest = min(options.curve_edge_mm.values())
    low, high = polygon.min(0), polygon.max(0)
    x, y = np.meshgrid(
        np.arange(low[0], high[0], finest), np.arange(low[1], high[1], finest * np.sqrt(3) / 2)
    )
    x[1::2] += finest / 2
    grid = np.stack([x.ravel(), y.ravel()], 1)
    grid = grid[inside_polygon(grid, polygon)]
    wanted = size.at(grid)
    grid = grid[random.random(len(grid)) < (finest / wanted) ** 2]
    away, _ = cKDTree(fixed).query(grid)
    return grid[away > 0.6 * size.at(grid)]


def _relaxed(
    fixed: FloatArray, free: FloatArray, polygon: FloatArray, size: _SizeField, options: MeshOptions
) -> FloatArray:
    """Move free vertices by edge forces until edges have the wanted length ratio."""
    points = np.concatenate([fixed, free])
    boundary = cKDTree(_densified_polygon(polygon))
    for _ in range(options.iterations):
        edges = _edges(_triangles(points, polygon))
        vector = points[edges[:, 0]] - points[edges[:, 1]]
        length = np.linalg.norm(vector, axis=1)
        wanted = size.at(points[edges].mean(1))
        wanted = wanted * 1.15 * np.sqrt(np.sum(length**2) / np.sum(wanted**2))
        pull = (np.maximum(wanted - length, 0) / length)[:, None] * vector
        force = np.zeros_like(points)
        np.add.at(force, edges[:, 0], pull)
        np.add.at(force, edges[:, 1], -pull)
        force[: len(fixed)] = 0
        # Rounded, so that the last bits of another processor do not grow into another mesh.
        moved = np.round(points + 0.2 * force, 6)
        # A vertex pushed to the boundary's rim would make a sliver there: it stays where it was.
        rim, _ = boundary.query(moved)
        stay = ~inside_polygon(moved, polygon) | (rim < 0.45 * size.at(moved))
        stay[: len(fixed)] = True
        points = np.where(stay[:, None], points, moved)
    return points


def _densified_polygon(polygon: FloatArray) -> FloatArray:
    closed = np.concatenate([polygon, polygon[:1]])
    t = np.linspace(0, 1, 8, endpoint=False)[None, :, None]
    return (closed[:-1, None] * (1 - t) + closed[1:, None] * t).reshape(-1, 2)


def _triangles(points: FloatArray, polygon: FloatArray) -> IntArray:
    faces = Delaunay(points).simplices.astype(np.int64)
    faces = faces[inside_polygon(points[faces].mean(1), polygon)]
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    faces = np.where((turn < 0)[:, None], faces[:, [0, 2, 1]], faces)
    return faces[np.abs(turn) > 1e-6]


def _edges(faces: IntArray) -> IntArray:
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
