"""Lens rims: synthetic ones against their known inner edges, real ones against the mesh, with a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.eyeglasses import LensRim, find_lens_rim
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import vertex_components
from scan2albedo.io import load_scan
from scan2albedo.io.images import write_png
from scan2albedo.rendering.views import View, render_mesh
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
