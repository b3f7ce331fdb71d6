"""Eyeglasses: weights beside libigl's, canonical frames, rims and registration against the truth.

    python tools/bench_eyeglasses.py weights [--nodes 7600] [--handles 20] [--frames FILE ...]
    python tools/bench_eyeglasses.py canonical [--seeds 5]
    python tools/bench_eyeglasses.py modes [--pictures FOLDER]
    python tools/bench_eyeglasses.py rims [--seeds 40] [--pictures FOLDER]
    python tools/bench_eyeglasses.py refined [--tuned]
    python tools/bench_eyeglasses.py registration [--seeds 8] [--pictures FOLDER]
    python tools/bench_eyeglasses.py deviations [--seeds 3] [--tuned]
    python tools/bench_eyeglasses.py glass [--seeds 2]
    python tools/bench_eyeglasses.py lenses [--pixels 160] [--pictures FOLDER]
    python tools/bench_eyeglasses.py pictures [--tuned]
    python tools/bench_eyeglasses.py proposed [--tuned] [--pictures FOLDER]

weights: real frames. Both get the same lattice and the same fixed nodes (eight a key point); key points are
farthest points from the leftmost vertex on. libigl solves on the lattice's cells, cut into six tetrahedra
each (Kuhn), in 100 iterations at most. The energies are compared on libigl's own operator, on which our
solver runs too, and on ours. CPU is that of all threads.

canonical: synthetic frames with known bends, brought to their key points at rest (mode "mean"), with key
points that turn and that only shift.

modes: rectangular, round and usual synthetic frames and the real ones, in one set, bent by curves that the
package does not contain; both modes, wire frames, and a frame of no true size.

rims: synthetic frames, four rims a seed, and the real ones.

refined: edges of the lenses in meshes that lack two pieces of each rim (40 to 100 degrees), half of it, every
other face or all of it, or are rough (.3 mm): errors mm without masks and with those of three views, beside
stated deviations. The frame is .3 mm and .3 degrees, key points .4 mm off. Frames and seeds that nothing was
chosen on; with `--tuned` those that were looked at.

registration: synthetic wearers seen by three cameras, 1,024 pixels wide, at 600 mm; rms mm of the vertices
that the head leaves visible, from the pose alone, from labels, with masks; what the result calls observed and
predicts. Then the error after so many evaluations, and Adam on the same loss, with gradients alone, the best
of four steps.

deviations: stated deviations beside true errors, on real frames and others, bent by deformations that no key
points know, with labels and masks whose errors are not those assumed; shares within one and two deviations
(wanted: about .68 and .95), root mean square of the errors over that of the deviations. Frames and seeds that
set no constant; with `--tuned` those that did.

glass: frames with lenses and without, on masks with lenses and without.

lenses: pictures of a frame on a real-shaped head, under lights spread evenly and by importance, beside 8,192
directions drawn by brightness.

pictures: frames on painted faces in three pictures: errors of the front with the head alone, with pictures,
with labels of one view and of all (1 px off), with and without pictures or true masks; proposed key points
beside their stated deviations, proposed masks beside true ones. Frames, people and colours that nothing was
chosen on; with `--tuned` those that were looked at.

proposed: key points of synthetic frames in any pose and unit, whole, with lenses, bent, folded, damaged,
proposed from their shape: errors in mm beside stated deviations, whether the unit was found, points that were
missed, or proposed where the mesh has none (extra). Seeds that nothing was chosen on; with `--tuned` those
that were looked at. Then the real frames, which were looked at, beside placed points.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import igl
import numpy as np
from benchmarks.eyeglasses_canonical import bench_canonical
from benchmarks.eyeglasses_deviations import bench_deviations
from benchmarks.eyeglasses_glass import bench_glass
from benchmarks.eyeglasses_lenses import bench_lenses
from benchmarks.eyeglasses_modes import bench_modes
from benchmarks.eyeglasses_pictures import bench_pictures
from benchmarks.eyeglasses_proposed import bench_proposed
from benchmarks.eyeglasses_registration import bench_registration
from benchmarks.eyeglasses_rims import bench_real, bench_refined, bench_synthetic
from benchmarks.weights import fixed_nodes, igl_bbw, kuhn_tetrahedra
from scipy import sparse

from scan2albedo.core import Meter
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses.embedding import Embedding, embed
from scan2albedo.eyeglasses.lattice import biharmonic_energy
from scan2albedo.eyeglasses.weights import (
    TOLERANCE,
    minimize_bounded,
    optimality_residual,
    solve_lattice,
    solve_weights,
)
from scan2albedo.io import load_scan

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SECTIONS = (
    "weights",
    "canonical",
    "modes",
    "rims",
    "refined",
    "registration",
    "deviations",
    "glass",
    "lenses",
    "pictures",
    "proposed",
)
FRAMES = ("frame_giraut.stl", "sunglasses_khronos.glb")


def farthest_points(vertices: FloatArray, count: int) -> FloatArray:
    chosen, distance = [int(np.argmin(vertices[:, 0]))], np.full(len(vertices), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return vertices[chosen]


def energies(energy: sparse.csr_matrix, weights: FloatArray) -> FloatArray:
    return 0.5 * np.einsum("nk,nk->k", weights, energy @ weights)


def residual(energy: sparse.csr_matrix, weights: FloatArray, free: IntArray) -> float:
    gradient = (energy @ weights)[free]
    return float(optimality_residual(weights[free], gradient, energy.diagonal()[free]).max())


def compare(embedding: Embedding) -> None:
    lattice = embedding.lattice
    nodes, tetrahedra = lattice.nodes.astype(float), kuhn_tetrahedra(lattice)
    fixed, values = fixed_nodes(embedding)
    free = np.setdiff1d(np.arange(len(nodes)), fixed)

    cpu = time.process_time()
    ours = solve_lattice(lattice, embedding.handle_cells, meter=Meter("bench", "1"))
    cpu_ours = time.process_time() - cpu
    cpu = time.process_time()
    theirs = igl_bbw(embedding)
    cpu_theirs = time.process_time() - cpu
    laplacian, mass = igl.cotmatrix(nodes, tetrahedra), igl.massmatrix(nodes, tetrahedra)
    their_energy = (laplacian @ sparse.diags(1 / mass.diagonal()) @ laplacian).tocsr()
    cpu = time.process_time()
    found = minimize_bounded(
        their_energy[free][:, free],
        -(their_energy[free][:, fixed] @ values),
        tolerance=TOLERANCE,
        max_steps=100,
        meter=Meter("bench", "1"),
    )
    cpu_same = time.process_time() - cpu
    same = np.zeros_like(theirs)
    same[fixed], same[free] = values, found.x

    our_energy = biharmonic_energy(lattice)
    print(f"  CPU s: ours {cpu_ours:.2f}, igl.bbw {cpu_theirs:.2f}, ratio {cpu_ours / cpu_theirs:.3f}")
    print(f"  CPU s on igl's operator: {cpu_same:.2f}, ratio {cpu_same / cpu_theirs:.3f}")
    print(f"  Newton steps a handle {ours.steps.min()}-{ours.steps.max()}, median {np.median(ours.steps):g}")
    print(f"  scaled KKT: ours {ours.residual.max():.1e}, igl.bbw {residual(their_energy, theirs, free):.1e}")
    for name, energy, mine in (("igl's", their_energy, same), ("our", our_energy, ours.x)):
        a, b = energies(energy, mine), energies(energy, theirs)
        print(
            f"  energy on {name} operator: ours {a.sum():.9g}, igl.bbw {b.sum():.9g}; "
            f"largest ratio of a handle - 1: {(a / b - 1).max():.1e}"
        )
    raw = ours.x.sum(1)
    print(f"  raw sums {raw.min():.4f} to {raw.max():.4f}")


def bench_weights(frames: list[str], nodes: int, handles: int) -> None:
    for name in frames:
        scan = load_scan(DATA / name)
        points = farthest_points(scan.vertices, handles)
        solve_weights(scan.vertices, scan.faces, points, max_nodes=3000)
        cpu = time.process_time()
        embedding = embed(scan.vertices, scan.faces, points, "auto", max_nodes=nodes, finest=1 / 250)
        cpu = time.process_time() - cpu
        step = embedding.plan[0]
        print(
            f"{name}: {len(embedding.lattice.nodes)} nodes, {handles} handles, spacing "
            f"{embedding.spacing:.3f} mm ({step.reason}); embedding {cpu:.2f} s CPU"
        )
        compare(embedding)


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("section", choices=SECTIONS)
    parser.add_argument("--nodes", type=int, default=7600)
    parser.add_argument("--handles", type=int, default=20)
    parser.add_argument("--frames", nargs="+", default=list(FRAMES))
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--pictures", type=Path, default=None)
    parser.add_argument("--pixels", type=int, default=160)
    parser.add_argument("--tuned", action="store_true")
    arguments = parser.parse_args()
    if arguments.section == "weights":
        bench_weights(arguments.frames, arguments.nodes, arguments.handles)
    elif arguments.section == "canonical":
        bench_canonical(arguments.seeds or 5)
    elif arguments.section == "modes":
        bench_modes(DATA, arguments.pictures)
    elif arguments.section == "registration":
        bench_registration(arguments.seeds or 8, arguments.pictures)
    elif arguments.section == "deviations":
        bench_deviations(DATA, arguments.seeds or 3, held_out=not arguments.tuned)
    elif arguments.section == "refined":
        bench_refined(DATA, tuned=arguments.tuned)
    elif arguments.section == "glass":
        bench_glass(DATA, arguments.seeds or 2)
    elif arguments.section == "proposed":
        bench_proposed(DATA, arguments.pictures, tuned=arguments.tuned)
    elif arguments.section == "pictures":
        bench_pictures(DATA, tuned=arguments.tuned)
    elif arguments.section == "lenses":
        bench_lenses(DATA, arguments.pixels, arguments.pictures)
    else:
        bench_synthetic(arguments.seeds or 40)
        bench_real(DATA, arguments.pictures)


if __name__ == "__main__":
    main()
