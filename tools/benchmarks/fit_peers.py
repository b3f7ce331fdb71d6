"""Run one peer of the fit in an environment that may be its own; the benchmarks call this file.

    PYTHON fit_peers.py nricp_amberg|nricp_sumner|meshmonk IN.npz OUT.npz
    PYTHON fit_peers.py autofacemonker SCAN.obj OUT.npz

Needs trimesh and rtree, `meshmonk`, or `autofacemonker` (PyPI); nothing of this repository.
"""

from __future__ import annotations

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


def meshmonk(source: str, target: str) -> None:
    """Deform the template by meshmonk's `pyramid_register` with its defaults."""
    import meshmonk as peer

    template, scan = meshes(source)
    start = time.process_time()
    result = peer.pyramid_register(floating=template, target=scan)
    spent = time.process_time() - start
    np.savez(target, vertices=np.asarray(result.aligned_vertices)[:, :3], cpu_s=spent)


def autofacemonker(source: str, target: str) -> None:
    """Register the peer's own template on a textured scan, from any pose."""
    import trimesh
    from autofacemonker import AutoFaceMonker
    from autofacemonker._register import DEFAULT_CORRESPONDENCES

    warped = target.replace(".npz", ".ply")
    start = time.process_time()
    AutoFaceMonker().register(source, save_path=warped)
    spent = time.process_time() - start
    mesh = trimesh.load_mesh(warped, process=False)
    key_points = np.array([(int(k), int(v)) for k, v in DEFAULT_CORRESPONDENCES])
    np.savez(target, vertices=mesh.vertices, faces=mesh.faces, key_points=key_points, cpu_s=spent)


if __name__ == "__main__":
    if sys.argv[1].startswith("nricp"):
        nricp(*sys.argv[1:])
    else:
        {"meshmonk": meshmonk, "autofacemonker": autofacemonker}[sys.argv[1]](*sys.argv[2:])
