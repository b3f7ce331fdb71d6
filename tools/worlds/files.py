"""Scans as files: those that are not part of the repository, and synthetic ones written as OBJ."""

from pathlib import Path

import numpy as np

from scan2albedo.core import RawScan
from scan2albedo.io.images import write_png

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def face_data(name: str) -> Path:
    """Return the path of a file of `DATA`.

    Raises
    ------
    SystemExit
        When it is not there.
    """
    path = DATA / name
    if not path.is_file():
        raise SystemExit(
            f"{path}: no such file; this command measures on faces that are not part of the repository"
        )
    return path


def write_obj(scan: RawScan, path: Path, *, decimals: int = 4) -> None:
    """Write a textured scan as OBJ, MTL and PNG of one stem, in the scan's unit to so many decimals."""
    if scan.uv is None or scan.texture_linear is None:
        raise ValueError(f"{scan.name} has no texture")
    write_png(path.with_suffix(".png"), scan.texture_linear)
    path.with_suffix(".mtl").write_text(f"newmtl skin\nmap_Kd {path.stem}.png\n", encoding="utf-8")
    corners, index = np.unique(scan.uv.reshape(-1, 2), axis=0, return_inverse=True)
    triangles = np.stack([scan.faces, index.reshape(-1, 3)], axis=2).reshape(-1, 6) + 1
    with path.open("w", encoding="utf-8") as file:
        file.write(f"mtllib {path.stem}.mtl\nusemtl skin\n")
        np.savetxt(file, scan.vertices, " ".join(["v", *[f"%.{decimals}f"] * 3]))
        np.savetxt(file, corners, "vt %.6f %.6f")
        np.savetxt(file, triangles, "f %d/%d %d/%d %d/%d")
