"""Both modes of canonical frames on frames of many makers, with bends that the package does not contain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.bent_frames import (
    OWN_BENDS,
    OwnBend,
    WholeFrame,
    bend_frame,
    frames_of_many_makers,
    synthetic_frame,
)
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import CanonicalEyeglasses, CanonicalizationOptions, canonicalize
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.report.overview import Panel, overview_figure
from scan2albedo.synthetic import GlassesShape

MODES = {mode: CanonicalizationOptions(mode=mode) for mode in ("unbend", "mean")}
ONE_BEND = {
    "one temple 8 mm out": OwnBend(left_spread_mm=8),
    "8 mm out and in": OwnBend(left_spread_mm=8, right_spread_mm=-8),
    "9 out, 3 in, twisted": OwnBend(left_spread_mm=9, right_spread_mm=-3, twist_deg=4),
    "one half folded back": OwnBend(fold_deg=4),
}
ALIKE = {
    "tips 8 mm in": OwnBend(left_spread_mm=-8, right_spread_mm=-8),
    "whole": OwnBend(),
    "tips 8 mm out": OwnBend(left_spread_mm=8, right_spread_mm=8),
    "folded by 4 degrees": OwnBend(fold_deg=4),
}
WIRE_BEND = OwnBend(twist_deg=4, drop_mm=2, left_curl_mm=5, left_spread_mm=6)


def laid_on(points: FloatArray, target: FloatArray) -> FloatArray:
    """Return points (N, 3) brought rigidly to a target (N, 3)."""
    return transform_points(procrustes(points, target), points)


def rms_and_max(points: FloatArray, target: FloatArray) -> str:
    off = np.linalg.norm(laid_on(points, target) - target, axis=1)
    return f"{np.sqrt((off**2).mean()):.2f} / {off.max():.2f}"


def rim_size(vertices: FloatArray, frame: WholeFrame) -> FloatArray:
    """Return the mean width and height of a frame's lens edges, each measured upright."""
    return np.mean(
        [np.ptp(laid_on(vertices[r], frame.vertices[r])[:, :2], axis=0) for r in frame.rims], axis=0
    )


def roundness(vertices: FloatArray, rim: IntArray) -> float:
    """Return the standard deviation of the distances of a lens's edge from its middle."""
    return float(np.linalg.norm(vertices[rim] - vertices[rim].mean(0), axis=1).std())


def edge_change(vertices: FloatArray, bent: FloatArray, faces: IntArray) -> float:
    """Return by how many percent 99 of 100 edges changed at most: those across tubes are their thickness."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    after, before = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (vertices, bent))
    long = before > 1e-3 * np.ptp(bent)
    return float(100 * np.percentile(np.abs(after[long] / before[long] - 1), 99))


def bench_modes(data: Path, pictures: Path | None) -> None:
    frames = frames_of_many_makers(data)
    bent = [bend_frame(f, b) for f, b in zip(frames, OWN_BENDS, strict=False)]
    meshes = [(v, f.faces) for f, v in zip(frames, bent, strict=True)]
    marks = [f.key_points(v) for f, v in zip(frames, bent, strict=True)]
    found = {"unbend": canonicalize(meshes, marks, options=MODES["unbend"])}
    weights = [frame.weights for frame in found["unbend"].frames]
    found["mean"] = canonicalize(meshes, marks, weights=weights, options=MODES["mean"])
    rng = np.random.default_rng(0)
    rough = [m + rng.normal(0, 1, m.shape) for m in marks]
    found["unbend, key points 1 mm off"] = canonicalize(meshes, rough, weights=weights)
    print(
        "rms / max in mm from the unbent frame, laid on it, whole and front; lens edges: largest distance "
        "from the bent one's, width x height, deviation from round of round rims; edges: change of 99 %"
    )
    heads = f"{'whole':>14}{'front':>14}{'lens edge':>11}{'size':>16}{'round':>7}{'edges %':>9}"
    print(f"{'frame':<13}{'':<29}{heads}")
    for i, frame in enumerate(frames):
        _print_row(frame, "bent", bent[i], bent[i])
        for mode, made in found.items():
            _print_row(frame, mode, made.frames[i].vertices, bent[i])
    back = [
        np.abs(frame.uncanonicalize(frame.vertices) - v).max()
        for made in found.values()
        for frame, v in zip(made.frames, bent, strict=True)
    ]
    print(f"way back to the bent frames, all modes: {max(back):.0e} mm")
    bench_wires()
    bench_parts(frames, weights)
    bench_alike(frames)
    bench_sizes(meshes, marks, weights)
    if pictures is not None:
        _draw(frames, bent, [found[mode].frames for mode in MODES], pictures)


def _print_row(frame: WholeFrame, mode: str, vertices: FloatArray, bent: FloatArray) -> None:
    front = frame.vertices[:, 2] > frame.vertices[:, 2].max() - 25
    edge = max(np.linalg.norm(laid_on(vertices[r], bent[r]) - bent[r], axis=1).max() for r in frame.rims)
    width, height = rim_size(vertices, frame)
    circle = f"{max(roundness(vertices, r) for r in frame.rims):.2f}" if frame.round else ""
    print(
        f"{frame.name:<13}{mode:<29}{rms_and_max(vertices, frame.vertices):>14}"
        f"{rms_and_max(vertices[front], frame.vertices[front]):>14}{edge:>11.2f}{width:>8.2f} x {height:.2f}"
        f"{circle:>7}{edge_change(vertices, bent, frame.faces):>9.2f}"
    )


def bench_wires() -> None:
    """Print what becomes of wire frames, with one bridge and with two."""
    for thick in (0.5, 0.9):
        shape = GlassesShape(
            rim_width=thick, rim_depth=thick, bridge_height=thick, temple_height=thick, temple_width=thick
        )
        for double in (False, True):
            frame = synthetic_frame("wire", shape, double_bridge=double)
            bent = bend_frame(frame, WIRE_BEND)
            own = [(bent, frame.faces)], [frame.key_points(bent)]
            try:
                one = canonicalize(*own)
            except EyeglassesError as error:
                print(f"wire of {thick} mm: {error}")
                continue
            options = MODES["mean"]
            rest = frame.key_points(frame.vertices)
            known = canonicalize(
                *own, weights=[one.frames[0].weights], mean_keypoints=rest, options=options
            ).frames[0]
            handles = next(s for s in one.plan if s.stage == "eyeglasses.weights.shared_handles")
            unbent = one.frames[0].vertices
            print(
                f"wire of {thick} mm, {'two bridges' if double else 'one bridge'}: bent "
                f"{rms_and_max(bent, frame.vertices)}, unbent {rms_and_max(unbent, frame.vertices)}, "
                f"to its key points at rest {rms_and_max(known.vertices, frame.vertices)}; "
                f"{handles.evidence or 'no shared handles'}"
            )


def bench_parts(frames: list[WholeFrame], weights: list[FloatArray]) -> None:
    """Print what is left of bends, laid on the true front: what mirrors itself, and what does not."""
    print("rms in mm, front laid on the true one, bent -> unbent: what both sides share; what they do not")
    print(f"{'frame, bend':<32}{'front':>30}{'temples':>34}")
    for frame, shares in zip(frames, weights, strict=True):
        back = frame.vertices[:, 2].max() - frame.vertices[:, 2]
        front, temples = back < 25, back > 50
        _, mirror = cKDTree(frame.vertices * [-1, 1, 1]).query(frame.vertices)
        for name, bend in ONE_BEND.items():
            bent = bend_frame(frame, bend)
            mesh = (bent, frame.faces)
            unbent = canonicalize([mesh], [frame.key_points(bent)], weights=[shares]).frames[0].vertices
            parts = []
            for vertices in (bent, unbent):
                pose = procrustes(vertices[front], frame.vertices[front])
                off = transform_points(pose, vertices) - frame.vertices
                image = off[mirror] * [-1, 1, 1]
                parts.append(((off + image) / 2, (off - image) / 2))
            row = f"{f'{frame.name}, {name}':<32}"
            for part in (front, temples) if temples.any() else (front,):
                for before, after in zip(*parts, strict=True):
                    rms = [np.sqrt((off[part] ** 2).sum(1).mean()) for off in (before, after)]
                    row += f"{rms[0]:>8.2f} -> {rms[1]:.2f}"
            print(row)


def bench_alike(frames: list[WholeFrame]) -> None:
    """Print what is said of bends that both sides share, of frames without a unit (cm)."""
    for frame in frames:
        for name, bend in ALIKE.items():
            bent = bend_frame(frame, bend) / 10
            found = canonicalize([(bent, frame.faces)], [frame.key_points(bent)], spacing=0.3)
            (said,) = found.plan.of_stage("eyeglasses.common_bend")
            print(f"{frame.name}, {name}: {said.evidence}")


def bench_sizes(
    meshes: list[tuple[FloatArray, IntArray]], marks: list[FloatArray], weights: list[FloatArray]
) -> None:
    """Print what a frame of no true size does to the others of its set."""
    scaled = [(meshes[0][0] / 250, meshes[0][1]), *meshes[1:]], [marks[0] / 250, *marks[1:]]
    options = CanonicalizationOptions(skip_failed=True)
    try:
        found = canonicalize(*scaled, weights=weights, options=options)
    except EyeglassesError as error:
        print(f"one frame divided by 250: {error}")
        return
    widths = [np.ptp(frame.vertices[:, 0]) for frame in found.frames]
    print(f"one frame divided by 250: left out {dict(found.failures)}")
    print(f"  scales of the others {[frame.scale for frame in found.frames]}, widths {np.round(widths, 1)}")


def _draw(
    frames: list[WholeFrame],
    bent: list[FloatArray],
    found: list[tuple[CanonicalEyeglasses, ...]],
    folder: Path,
) -> None:
    panels = []
    for i, frame in enumerate(frames):
        shown = {"whole": frame.vertices, "bent": bent[i]} | {
            mode: made[i].vertices for mode, made in zip(MODES, found, strict=True)
        }
        for pitch in (0.0, -90.0):
            for name, vertices in shown.items():
                upright = laid_on(vertices, frame.vertices)
                view = View.around(frame.vertices, pitch_deg=pitch)
                picture = render_mesh(upright, frame.faces, view=view, size=420)
                panels.append(Panel(f"{frame.name}, {name}", picture))
    folder.mkdir(parents=True, exist_ok=True)
    overview_figure("canonical frames, both modes", panels, 4).savefig(folder / "modes.png")
