"""Lens rims: synthetic ones against their known inner edges, real ones against the mesh, with a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.eyeglasses_scenes import (
    SHAPES,
    BareFrame,
    giraut,
    khronos,
    photographed,
    synthetic,
    without_lenses,
)
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES, LensRim, find_lens_rim, refine_lens_rim
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.geometry.rigid import rotation_from_vector
from scan2albedo.io import load_scan
from scan2albedo.io.images import write_png
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.synthetic import GlassesBend, eyeglasses

BENT = GlassesBend(temple_spread_mm=8, bridge_deg=2, twist_deg=4)


def distances(points: FloatArray, outline: FloatArray) -> FloatArray:
    """Distance (P,) of each point to a closed polygon in space."""
    along = np.roll(outline, -1, 0) - outline
    t = np.einsum("psk,sk->ps", points[:, None] - outline, along) / (along**2).sum(1)
    foot = outline + np.clip(t, 0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - foot, axis=2).min(1)


def bench_synthetic(seeds: int) -> None:
    errors, measured, failures = [], [], 0
    for seed in range(seeds):
        for welded in (True, False):
            glasses = eyeglasses(seed, welded=welded, bend=BENT if seed % 2 else GlassesBend())
            for side, name in enumerate(("left", "right")):
                marks = [i for i, n in enumerate(glasses.names) if n.startswith(f"{name}_rim")]
                rim = find_lens_rim(
                    glasses.vertices,
                    glasses.faces,
                    glasses.lens_centers[side],
                    rim_points=glasses.keypoints[marks],
                )
                truth = glasses.lens_outlines[side]
                errors.append(max(distances(rim.points, truth).max(), distances(truth, rim.points).max()))
                measured.append(rim.measured.mean())
                failures += rim.gaps == "subdivided"
    print(
        f"{len(errors)} synthetic rims (half of them bent): worst error {max(errors):.3f} mm, median "
        f"{np.median(errors):.3f} mm, measured share {min(measured):.3f} at least, median "
        f"{np.median(measured):.3f}, {failures} needed subdivision"
    )


def drawn_rim(rim: LensRim, vertices: FloatArray, faces: IntArray, path: Path) -> None:
    """Write the frame seen along the lens's axis with measured points of the rim green, others red."""
    x = rim.points[0] - rim.center
    x = x - (x @ rim.normal) * rim.normal
    axes = np.stack([x / np.linalg.norm(x), np.zeros(3), rim.normal])
    axes[1] = np.cross(axes[2], axes[0])
    seen, outline = (vertices - rim.center) @ axes.T, (rim.points - rim.center) @ axes.T
    half = 1.2 * float(np.linalg.norm(outline[:, :2], axis=1).max())
    size = 900
    picture = render_mesh(seen, faces, view=View((0.0, 0.0, 0.0), half), size=size)
    scale = (size - 1) / (2 * half)
    column = np.round((outline[:, 0] + half) * scale).astype(int)
    row = np.round((half - outline[:, 1]) * scale).astype(int)
    for dx in range(-2, 3):
        for dy in range(-2, 3):
            picture[row + dy, column + dx] = np.where(rim.measured[:, None], (0, 200, 0), (230, 0, 0))
    write_png(path, picture)


def inner_edge(points: FloatArray, center: FloatArray, axis: int, count: int) -> FloatArray:
    """Return points (count, 3) of a rim's vertices nearest to its centre, one a sector across an axis.

    They stand in for key points that a person would put on a real frame.
    """
    offset = np.delete(points - center, axis, axis=1)
    angle, radius = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(*offset.T)
    sector = ((angle + np.pi) / (2 * np.pi) * count).astype(int) % count
    return np.array([points[sector == k][np.argmin(radius[sector == k])] for k in range(count)])


def bench_real(data: Path, pictures: Path | None) -> None:
    for name, axis in (("sunglasses_khronos.glb", 2), ("frame_giraut.stl", 1)):
        scan = load_scan(data / name)
        for side, (part, center) in rims_of(scan.vertices, scan.faces, axis).items():
            own_vertices = scan.vertices[np.unique(scan.faces[part])]
            marks = inner_edge(own_vertices, center, axis, 5)
            # The second one's rims are flat: its front has no other plane.
            given = {"rim_points": marks} if axis == 2 else {"normal": np.eye(3)[axis]}
            rim = find_lens_rim(scan.vertices, scan.faces, center, **given)
            mesh = ClosestPointQuery(scan.vertices, scan.faces).query(rim.points).distance
            own = ClosestPointQuery(scan.vertices, scan.faces[part]).query(rim.points).distance
            filled = mesh[~rim.measured].max(initial=0)
            print(
                f"{name}, {side}: {rim.gaps}, measured share {rim.measured.mean():.3f}; off the mesh: "
                f"measured {mesh[rim.measured].max():.0e} mm, filled in {filled:.2f} mm; "
                f"{100 * (own <= 0.2).mean():.0f} % within 0.2 mm of the rim's own part, worst "
                f"{own.max():.2f} mm"
            )
            if pictures is not None:
                drawn_rim(rim, scan.vertices, scan.faces, pictures / f"rim_{Path(name).stem}_{side}.png")


def rims_of(vertices: FloatArray, faces: IntArray, axis: int) -> dict[str, tuple[BoolArray, FloatArray]]:
    """Return faces and centre of both rims: parts of lens width, or the halves of a front in one piece."""
    if axis == 1:  # round rims, centred 33 mm off the middle
        across = vertices[faces].mean(1)[:, 0]
        sides = {"left": -33.0, "right": 33.0}
        return {side: (x * across > 0, np.array([x, 0.0, 0.0])) for side, x in sides.items()}
    part = vertex_components(len(vertices), faces)[faces[:, 0]]
    found = {}
    for number in np.unique(part):
        own = part == number
        corners = vertices[faces[own]].reshape(-1, 3)
        if 50 < np.ptp(corners[:, 0]) < 75 and own.sum() > 1000:  # the lenses have fewer faces
            side = "left" if corners[:, 0].mean() < 0 else "right"
            found[side] = (own, (corners.min(0) + corners.max(0)) / 2)
    return found


RIMS = tuple(
    [i for i, name in enumerate(KEY_POINT_NAMES) if name.startswith(f"{side}_rim")]
    for side in ("left", "right")
)
DAMAGE = ("whole", "gaps", "half", "holes", "none", "noise")
TUNED = (("drawn 0", 0), ("slab", 0), ("round", 0), ("giraut", 0))
UNSEEN = (
    *((f"drawn {seed}", seed) for seed in range(20, 26)),
    *(("aviator", 21), ("shield", 22), ("khronos", 23), ("giraut", 24)),
)
"""Frame and seed of bend, cameras, masks and damage."""


def bench_refined(data: Path, *, tuned: bool = False) -> None:
    """Print errors of the lenses' edges on damaged meshes, without masks and with those of three views."""
    rows: dict[str, list[FloatArray]] = {}
    for name, seed in TUNED if tuned else UNSEEN:
        frame = _frame(name, data)
        seen = photographed(frame, seed, glass=False)
        rng = np.random.default_rng([seed, 5])
        # Where a registration puts the frame, and where somebody puts its key points.
        turn, middle = rotation_from_vector(np.deg2rad(rng.normal(0, 0.3, 3))), seen.vertices.mean(0)
        shift = middle + rng.normal(0, 0.3, 3)
        vertices, marks = ((p - middle) @ turn.T + shift for p in (seen.vertices, seen.keypoints))
        truth = [_rim(vertices, frame.faces, marks[own], None) for own in RIMS]
        marks = marks + rng.normal(0, 0.4, marks.shape)
        for kind in DAMAGE:
            mesh = damaged(vertices, frame.faces, truth, kind, rng)
            for own, true in zip(RIMS, truth, strict=True):
                rim = _rim(*mesh, marks[own], true.normal)
                refined = refine_lens_rim(
                    rim, list(zip(seen.cameras, seen.masks, strict=True)), rim_points=marks[own]
                )
                before, after = (distances(r.points, true.points) for r in (rim, refined))
                stated = np.full_like(after, np.nan) if refined.deviation is None else refined.deviation
                within = [np.mean(after <= k * stated) for k in (1, 2)]
                rms = [np.sqrt((error**2).mean()) for error in (before, after, stated)]
                row = np.array([rms[0], before.max(), rms[1], after.max(), rms[2], *within])
                rows.setdefault(kind, []).append(row)
                if name in ("khronos", "giraut"):
                    rows.setdefault(f"{kind}, {name}", []).append(row)
    print(f"{'mesh':16}{'rims':>5}{'without: rms':>13}{'worst':>7}{'masks: rms':>12}{'worst':>7}", end="")
    print(f"{'stated':>8}{'in 1 s':>8}{'in 2 s':>8}{'better':>8}{'worse':>7}   (mm; by .02 or more)")
    for kind in sorted(rows, key=lambda kind: (", " in kind, DAMAGE.index(kind.partition(",")[0]))):
        table = np.array(rows[kind])
        rms, worst, within = np.sqrt((table**2).mean(0)), table.max(0), table.mean(0)
        gain = table[:, 0] - table[:, 2]
        print(f"{kind:16}{len(table):5}{rms[0]:13.2f}{worst[1]:7.2f}{rms[2]:12.2f}{worst[3]:7.2f}", end="")
        print(f"{rms[4]:8.2f}{within[5]:8.2f}{within[6]:8.2f}", end="")
        print(f"{(gain > 0.02).sum():8}{(gain < -0.02).sum():7}", flush=True)


def damaged(
    vertices: FloatArray, faces: IntArray, rims: list[LensRim], kind: str, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Return a mesh whose rims lack two pieces, a half, every other face or all, or that is rough."""
    if kind == "noise":
        return vertices + rng.normal(0, 0.3, vertices.shape), faces
    kept = np.ones(len(faces), bool)
    for rim in rims:
        offset = vertices[faces].mean(1) - rim.points.mean(0)
        size = np.linalg.norm(rim.points - rim.points.mean(0), axis=1).mean()
        near = (np.hypot(offset[:, 0], offset[:, 1]) < 1.6 * size) & (np.abs(offset[:, 2]) < 15)
        lost = np.zeros(len(faces), bool)
        if kind == "gaps":
            for at, half in zip(rng.uniform(-np.pi, np.pi, 2), rng.uniform(20, 50, 2), strict=True):
                angle = np.arctan2(offset[:, 1], offset[:, 0]) - at
                lost |= np.abs(np.angle(np.exp(1j * angle))) < np.deg2rad(half)
        elif kind == "half":
            lost = offset[:, 1] < rng.uniform(-5, 5)
        elif kind == "holes":
            lost = rng.random(len(faces)) < 0.5
        kept &= ~(near & (lost | (kind == "none")))
    return vertices, faces[kept]


def _frame(name: str, data: Path) -> BareFrame:
    if name.startswith("drawn"):
        glasses = eyeglasses(int(name.split()[1]))
        none = np.zeros(len(glasses.faces), bool)
        return BareFrame(name, glasses.vertices, glasses.faces, none, glasses.keypoints)
    if name in SHAPES:
        return without_lenses(synthetic(name))
    return giraut(data) if name == "giraut" else without_lenses(khronos(data))


def _rim(vertices: FloatArray, faces: IntArray, marks: FloatArray, normal: FloatArray | None) -> LensRim:
    top, bridge, inner, bottom, outer = marks
    center = (top + bottom) / 4 + (bridge + inner) / 8 + outer / 4
    return find_lens_rim(vertices, faces, center, rim_points=marks, normal=normal)
