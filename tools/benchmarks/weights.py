"""Bounded biharmonic weights: how far they and what they move are from a fine lattice's, against spacing."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from benchmarks.presets import SpacingOptions, preset_settings
from benchmarks.sweep import Cost, ErrorKind, Outcome, Peer, Setting, StageBenchmark, timed, varied, within
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import solve_weights
from scan2albedo.eyeglasses.embedding import Embedding, embed
from scan2albedo.eyeglasses.lattice import CORNERS, Lattice
from scan2albedo.synthetic import GlassesBend, SyntheticEyeglasses, eyeglasses

_REFERENCE_MM, _QUICK_REFERENCE_MM = 1.25, 2.5
_SPACINGS_MM = (1.5, 1.75, 2.0, 2.2, 2.35)
_PEER_SPACINGS_MM = (2.0, 2.35)
_BEND = GlassesBend(temple_spread_mm=8, bridge_deg=2)
_SCENES, _QUICK_SCENES = 2, 1


@dataclass(frozen=True)
class WeightedFrame:
    """A frame and the weights (V, K) that a fine lattice gives."""

    glasses: SyntheticEyeglasses
    reference: FloatArray


@cache
def _frame(seed: int, reference_mm: float) -> WeightedFrame:
    glasses = eyeglasses(seed, bend=_BEND)
    mesh = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints)
    return WeightedFrame(glasses, solve_weights(*mesh, reference_mm).weights)


def _settings(quick: bool) -> list[Setting]:
    plain = SpacingOptions()
    if quick:
        return [Setting("spacing", f"{s:g} mm", SpacingOptions(s)) for s in (2.65, 2.8)]
    spacings = [Setting("spacing", f"{s:g} mm", SpacingOptions(s)) for s in _SPACINGS_MM]
    loose = varied("tolerance", plain, (1e-3, 1e-4, 1e-5), "{:g}".format)
    return [
        Setting("default", "", plain),
        *preset_settings("weights"),
        *spacings,
        *loose,
        *within(plain, (50, 100, 200)),
    ]


def _run(scene: WeightedFrame, setting: Setting) -> Outcome:
    glasses, made = scene.glasses, setting.options
    mesh = (glasses.rest_vertices, glasses.faces, glasses.rest_keypoints)
    found, cost = timed(lambda: solve_weights(*mesh, made.spacing, setting.budget, **made.limits()))
    return weight_errors(scene, found.weights, cost, int(found.iterations.sum()), float(found.node_count))


def weight_errors(
    scene: WeightedFrame, weights: FloatArray, cost: Cost, evaluations: int, nodes: float
) -> Outcome:
    """Return the error of weights (V, K), and in mm that of a bend that they carry to the vertices.

    The bend shifts the key points of the frame at rest to those of the bent one.
    """
    off = weights - scene.reference
    shifts = scene.glasses.keypoints - scene.glasses.rest_keypoints
    moved_mm = np.linalg.norm(off @ shifts, axis=1)
    rms = 100 * float(np.sqrt(np.mean(off**2)))
    details = {"nodes": nodes, "worst mm": float(moved_mm.max())}
    return Outcome(cost, (rms, float(np.sqrt(np.mean(moved_mm**2)))), evaluations, details)


def _igl(spacing: float):  # type: ignore[no-untyped-def]
    def run(scene: WeightedFrame) -> Outcome:
        glasses = scene.glasses

        def work() -> tuple[FloatArray, int]:
            embedding = embed(glasses.rest_vertices, glasses.faces, glasses.rest_keypoints, spacing)
            raw = np.clip(igl_bbw(embedding), 0.0, 1.0)
            weights = embedding.interpolation @ (raw / raw.sum(1, keepdims=True))
            return weights / weights.sum(1, keepdims=True), len(embedding.lattice.nodes)

        (weights, nodes), cost = timed(work)
        return weight_errors(scene, weights, cost, 0, float(nodes))

    return run


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


def igl_bbw(embedding: Embedding, iterations: int = 100) -> FloatArray:
    """Return libigl's weights (N, K) of the lattice's nodes, not normalised.

    References
    ----------
    .. [1] A. Jacobson, I. Baran, J. Popovic, O. Sorkine, "Bounded biharmonic weights for real-time
       deformation", SIGGRAPH 2011.
    """
    import igl

    lattice = embedding.lattice
    nodes = lattice.nodes.astype(float)
    fixed, values = fixed_nodes(embedding)
    return np.asarray(igl.bbw(nodes, kuhn_tetrahedra(lattice), fixed, values, max_iter=iterations))


def _peers(quick: bool) -> list[Peer]:
    spacings = (2.8,) if quick else _PEER_SPACINGS_MM
    return [Peer(f"libigl bbw, {s:g} mm", _igl(s)) for s in spacings]


def _scenes(quick: bool) -> list[WeightedFrame]:
    reference = _QUICK_REFERENCE_MM if quick else _REFERENCE_MM
    return [_frame(seed, reference) for seed in range(_QUICK_SCENES if quick else _SCENES)]


BENCHMARK = StageBenchmark(
    "weights",
    (ErrorKind("weights, rms", "%"), ErrorKind("a bend's vertices, rms", "mm")),
    _scenes,
    _settings,
    _run,
    _peers,
)
