"""Run one peer of the fit in an environment that may be its own; `bench.peers.fit` calls this file.

    PYTHON programs.py nricp_amberg|nricp_sumner|bake IN.npz OUT.npz

Needs trimesh and rtree; nothing of this repository.
"""

import sys
import time

import numpy as np

REACH_MM = 20.0


def meshes(source: str):  # type: ignore[no-untyped-def]
    """Return the template (vertices, faces) and the scan (scan_vertices, scan_faces) of IN.npz."""
    import trimesh

    data = np.load(source)
    template = trimesh.Trimesh(data["vertices"], data["faces"], process=False)
    return template, trimesh.Trimesh(data["scan_vertices"], data["scan_faces"], process=False)


def nricp(name: str, source: str, target: str) -> None:
    """Deform the template by `trimesh.registration.nricp_*` with its own default steps."""
    from trimesh import registration

    template, scan = meshes(source)
    start = time.process_time()
    moved = getattr(registration, name)(template, scan, distance_threshold=REACH_MM)
    np.savez(target, vertices=np.asarray(moved), cpu_s=time.process_time() - start)


def bake(source: str, target: str) -> None:
    """Lay a scan's colours on the texture coordinates of a template, as one writes it with trimesh.

    IN.npz: `vertices`, `faces`, `uv` (F, 3, 2) of the template on the scan, `scan_vertices`, `scan_faces`,
    `scan_uv` (F, 3, 2), `texture` (H, W, 3) and `size`.
    """
    import trimesh

    data = np.load(source)
    start, size = time.process_time(), int(data["size"])
    corners = data["uv"] * (size, -size) + (-0.5, size - 0.5)
    points, texels = [], []
    for face, corner in zip(data["faces"], corners, strict=True):
        low, high = np.ceil(corner.min(0)).astype(int), np.floor(corner.max(0)).astype(int) + 1
        grid = np.stack(np.meshgrid(*map(np.arange, low.clip(0), high.clip(0, size))), axis=-1).reshape(-1, 2)
        system = np.vstack([corner.T, np.ones(3)])
        if len(grid) == 0 or abs(np.linalg.det(system)) < 1e-9:
            continue
        weight = np.linalg.solve(system, np.vstack([grid.T, np.ones(len(grid))])).T
        inside = (weight >= -1e-9).all(1)
        points.append(weight[inside] @ data["vertices"][face])
        texels.append(grid[inside])
    place, texel = np.concatenate(points), np.concatenate(texels)
    scan = trimesh.Trimesh(data["scan_vertices"], data["scan_faces"], process=False)
    color = np.zeros((size, size, 3), np.float32)
    for part in np.array_split(np.arange(len(place)), len(place) // 20_000 + 1):
        nearest, _, face = trimesh.proximity.closest_point(scan, place[part])
        weight = trimesh.triangles.points_to_barycentric(scan.triangles[face], nearest)
        uv = np.einsum("nk,nkc->nc", weight, data["scan_uv"][face])
        color[texel[part, 1], texel[part, 0]] = trimesh.visual.color.uv_to_interpolated_color(
            uv, _picture(data["texture"])
        )[:, :3]
    np.savez(target, color_srgb=color, cpu_s=time.process_time() - start)


def _picture(texture: np.ndarray):  # type: ignore[no-untyped-def]
    from PIL import Image

    return Image.fromarray(texture)


if __name__ == "__main__":
    if sys.argv[1] == "bake":
        bake(*sys.argv[2:])
    else:
        nricp(*sys.argv[1:])
