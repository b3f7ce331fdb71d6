"""Find the reflectance of a face from flash photographs, and light it with lamps of one's own (PLY meshes).

    python examples/reflectance_from_flashes.py [CAPTURE] [-o OUT]

CAPTURE is a capture file: poses, flashes, pictures, mesh (data_schemas/flash_capture.schema.json). Without it
a synthetic person is photographed.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

import scan2albedo as s2a
from scan2albedo.reflectance import MeshReflectance, VertexSamples
from scan2albedo.synthetic import Portrait

LAMPS_MM = np.array([[-700.0, 300, 700], [0, 900, 400], [800, -100, 500]])
EYE_MM = np.array([0.0, 0, 1000])


def synthetic_samples() -> tuple[VertexSamples, trimesh.Trimesh]:
    """Photograph a synthetic person from three sides with four flashes, and look the vertices up."""
    capture = s2a.synthetic.flash_capture(
        0, views=3, flashes=4, levels=1, portrait=Portrait(picture_size=160)
    )
    reflectance = s2a.reflectance
    olat = reflectance.extract_olat(capture.flash, capture.room)
    poses = (capture.head_rotations, capture.head_translations, capture.intrinsics)
    rig = reflectance.rig_of_head_poses(*poses, view=capture.view, flash=capture.light)
    samples = reflectance.sample_vertices(
        olat, rig, capture.vertices, capture.faces, reference_distance_mm=capture.portrait.distance_mm
    )
    return samples, trimesh.Trimesh(capture.vertices, capture.faces, process=False)


def samples_of(path: Path) -> tuple[VertexSamples, trimesh.Trimesh]:
    """Read a capture file, and look the vertices of its mesh up in its pictures."""
    capture = s2a.reflectance.read_capture(path)
    samples = s2a.reflectance.sample_vertices(
        capture.extract_olat(),
        capture.rig,
        capture.vertices,
        capture.faces,
        reference_distance_mm=capture.reference_distance_mm,
    )
    return samples, trimesh.Trimesh(capture.vertices, capture.faces, process=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write reflectance.npz, lamp_0.ply, lamp_1.ply and lamp_2.ply."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("capture", nargs="?", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("example_out"))
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)

    samples, mesh = synthetic_samples() if given.capture is None else samples_of(given.capture)
    reflectance = s2a.reflectance
    fit = reflectance.fit_reflectance(samples)
    skin = MeshReflectance(mesh.vertices, mesh.faces, fit.reflectance)
    reflectance.write_reflectance(given.out / "reflectance.npz", skin, fit=fit)

    eyes = np.repeat(EYE_MM[None], len(LAMPS_MM), axis=0)
    lobes = reflectance.point_light_lobes(mesh.vertices, mesh.vertex_normals, eyes, LAMPS_MM)
    radiance = reflectance.point_light_radiance(fit.reflectance, lobes)
    values = np.clip(np.nan_to_num(radiance / np.nanpercentile(radiance, 99)), 0, 1) ** (1 / 2.2)
    for number, colors in enumerate(np.round(255 * values).astype(np.uint8)):
        lit = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
        lit.export(given.out / f"lamp_{number}.ply")
    known = f"{fit.reflectance.known.sum()} of {len(mesh.vertices)} vertices known"
    print(f"{known}; reflectance.npz and {len(LAMPS_MM)} lit meshes in {given.out}")


if __name__ == "__main__":
    main()
