"""Bounded biharmonic weights of real frames beside libigl's, on the same lattice and the same fixed nodes.

Key points are farthest points from the leftmost vertex on. libigl solves on the lattice's cells, cut into
six tetrahedra each (Kuhn), in 100 iterations at most; "on igl's matrix" is our solver on the matrix it
builds of them. Energies are the sums over all key points, by libigl's matrix and by ours, over those of
libigl's weights.
"""

import itertools
from functools import cached_property

import igl
import numpy as np
from scipy import sparse
from worlds.files import DATA

from bench.runner import Bench, Case
from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.embedding import Embedding, embed
from scan2albedo.eyeglasses.lattice import CORNERS, Lattice, biharmonic_energy
from scan2albedo.eyeglasses.weights import TOLERANCE, minimize_bounded, solve_lattice
from scan2albedo.io import load_scan

FRAMES = ("frame_giraut.stl", "sunglasses_khronos.glb")
HANDLES = 20
NODES = 7600
QUICK_NODES = 2000


def kuhn_tetrahedra(lattice: Lattice) -> IntArray:
    """Return (T, 4) nodes of the tetrahedra, six a cell, in which neighbouring cells agree (Kuhn)."""
    number = {tuple(corner): n for n, corner in enumerate(CORNERS.tolist())}
    paths = []
    for axes in itertools.permutations(range(3)):
        place, path = [0, 0, 0], [0]
        for axis in axes:
            place[axis] = 1
            path.append(number[tuple(place)])
        paths.append(path)
    return np.ascontiguousarray(lattice.corners[:, np.array(paths)].reshape(-1, 4), np.int64)


def fixed_nodes(embedding: Embedding) -> tuple[IntArray, FloatArray]:
    """Return the nodes (8 K,) whose weights the handles fix, and these weights (8 K, K)."""
    count = len(embedding.handle_cells)
    fixed = embedding.lattice.corners[embedding.lattice.find(embedding.handle_cells)].ravel()
    return fixed, np.repeat(np.eye(count), 8, 0)


def igl_bbw(embedding: Embedding) -> FloatArray:
    """Return libigl's weights (N, K) of the lattice's nodes, not normalised.

    References
    ----------
    .. [1] A. Jacobson, I. Baran, J. Popovic, O. Sorkine, "Bounded biharmonic weights for real-time
       deformation", SIGGRAPH 2011.
    """
    lattice = embedding.lattice
    nodes = lattice.nodes.astype(float)
    fixed, values = fixed_nodes(embedding)
    return np.asarray(igl.bbw(nodes, kuhn_tetrahedra(lattice), fixed, values, max_iter=100))


class Problem:
    """A frame in a lattice of so many nodes at most, libigl's matrix on it, and libigl's weights."""

    def __init__(self, name: str, nodes: int) -> None:
        scan = load_scan(DATA / name)
        chosen, distance = [int(np.argmin(scan.vertices[:, 0]))], np.full(len(scan.vertices), np.inf)
        while len(chosen) < HANDLES:
            away = np.linalg.norm(scan.vertices - scan.vertices[chosen[-1]], axis=1)
            distance = np.minimum(distance, away)
            chosen.append(int(np.argmax(distance)))
        self.embedding = embed(scan.vertices, scan.faces, scan.vertices[chosen], "auto", max_nodes=nodes)
        self.lattice = self.embedding.lattice
        self.fixed, self.values = fixed_nodes(self.embedding)
        self.free = np.setdiff1d(np.arange(len(self.lattice.nodes)), self.fixed)
        places, tetrahedra = self.lattice.nodes.astype(float), kuhn_tetrahedra(self.lattice)
        laplacian, mass = igl.cotmatrix(places, tetrahedra), igl.massmatrix(places, tetrahedra)
        self.matrix = (laplacian @ sparse.diags(1 / mass.diagonal()) @ laplacian).tocsr()

    @cached_property
    def theirs(self) -> FloatArray:
        return igl_bbw(self.embedding)

    def ours(self) -> FloatArray:
        return solve_lattice(self.lattice, self.embedding.handle_cells, meter=Meter("bench", "1")).x

    def on_their_matrix(self) -> FloatArray:
        rows, free = self.matrix[self.free], self.free
        given = rows[:, free], -(rows[:, self.fixed] @ self.values)
        meter = Meter("bench", "1")
        weights = np.empty((len(self.lattice.nodes), self.values.shape[1]))
        weights[self.fixed] = self.values
        weights[free] = minimize_bounded(*given, tolerance=TOLERANCE, max_steps=100, meter=meter).x
        return weights

    def score(self, weights: FloatArray) -> dict[str, float]:
        row = {}
        for name, matrix in (("igl's", self.matrix), ("our", biharmonic_energy(self.lattice))):
            mine, other = (np.sum(w * (matrix @ w)) for w in (weights, self.theirs))
            row[f"{name} energy - 1"] = float(mine / other - 1)
        return row


BENCH = Bench(
    lambda quick: [
        Case(name, lambda name=name: Problem(name, QUICK_NODES if quick else NODES)) for name in FRAMES
    ],
    methods={"ours": Problem.ours, "on igl's matrix": Problem.on_their_matrix},
    peers={"igl.bbw": lambda problem: igl_bbw(problem.embedding)},
    score=Problem.score,
)
