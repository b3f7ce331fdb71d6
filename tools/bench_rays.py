"""Shadow rays a second, ours beside Open3D and trimesh; the shading kernel beside its NumPy reference.

    python tools/bench_rays.py [--size 512] [--runs 9] [--trimesh]

Rays start at every texel of a face; the methods take turns in each run, so that a
busy machine slows all of them alike. `RayCaster.occluded` and Open3D get the same rays; `ShadowMap.visible`
answers for the same texels, but shoots only where they face the light. Medians over the runs.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import brdf_reference
import numpy as np
from numpy.typing import NDArray

from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shading import Reflectance, Shading, shade_rows
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.synthetic import face

DIRECTIONS = ((0.0, 0.0, 1.0), (0.7, 0.1, 0.7), (-0.5, -0.4, 0.75), (0.9, 0.0, 0.3))
OFFSET_MM = 0.2


@dataclass(frozen=True)
class Timing:
    """Medians over the runs: `wall_s` and `cpu_s` (all threads)."""

    wall_s: float
    cpu_s: float


def interleaved(methods: dict[str, Callable[[], object]], runs: int) -> dict[str, Timing]:
    """Return the timing of every method; each run calls all of them once, after one call to warm up."""
    for method in methods.values():
        method()
    wall, cpu = ({name: [] for name in methods} for _ in range(2))
    for _ in range(runs):
        for name, method in methods.items():
            start, start_cpu = time.perf_counter(), time.process_time()
            method()
            wall[name].append(time.perf_counter() - start)
            cpu[name].append(time.process_time() - start_cpu)
    return {name: Timing(float(np.median(wall[name])), float(np.median(cpu[name]))) for name in methods}


def bench_rays(size: int, runs: int, with_trimesh: bool) -> None:
    import open3d as o3d

    image = face(0, size=size).image
    vertices, faces = image.occluder_mesh()
    position, normal = image.position[image.mask], image.normal[image.mask]
    origins = position + OFFSET_MM * normal
    caster = RayCaster(vertices, faces)
    shadows = ShadowMap(caster, position, normal, OFFSET_MM)
    peer = o3d.t.geometry.RaycastingScene()
    peer.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    print(f"{len(origins)} rays, {len(faces)} triangles, {runs} runs")
    print(f"{'direction':24}    ours ms (CPU)     Open3D ms (CPU)   throughput   differ")
    for direction in DIRECTIONS:
        toward = np.array(direction) / np.linalg.norm(direction)
        rays = np.concatenate([origins, np.broadcast_to(toward, origins.shape)], 1).astype(np.float32)
        tensor = o3d.core.Tensor(rays)
        methods = {
            "RayCaster": lambda toward=toward: caster.occluded(origins, toward),
            "ShadowMap": lambda toward=toward: shadows.visible(toward),
            "Open3D": lambda tensor=tensor: peer.test_occlusions(tensor),
        }
        timing = interleaved(methods, runs)
        theirs, b = peer.test_occlusions(tensor).numpy(), timing["Open3D"]
        facing = normal @ toward > 0
        differ = {
            "RayCaster": caster.occluded(origins, toward) != theirs,
            "ShadowMap": (shadows.visible(toward) == 0) != (theirs | ~facing),
        }
        for name, wrong in differ.items():
            a = timing[name]
            label = f"{name} {direction[0]:g} {direction[1]:g} {direction[2]:g}"
            print(
                f"{label:24} {1e3 * a.wall_s:8.1f} ({1e3 * a.cpu_s:6.1f}) {1e3 * b.wall_s:8.1f} "
                f"({1e3 * b.cpu_s:6.1f}) {b.wall_s / a.wall_s:9.2f}x {int(wrong.sum()):8d}"
            )
    if with_trimesh:
        import trimesh

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        heading = np.tile(toward, (len(origins), 1))
        timing = interleaved(
            {"trimesh": lambda: mesh.ray.intersects_any(origins, heading)}, max(1, runs // 3)
        )
        print(f"trimesh, last direction  {1e3 * timing['trimesh'].wall_s:8.1f} ms")


def bench_shading(size: int, runs: int) -> None:
    """Compare the compiled kernel with the reference formulas: a near light and a distant one, with gloss."""
    image = face(0, size=size).image
    position, normal = image.position[image.mask], image.normal[image.mask]
    visible = (np.random.default_rng(0).random((2, len(position))) > 0.2).astype(np.uint8)
    lights = np.array([[0.6, 0.0, 0.8, 0.0, 2.0], [-0.48, 0.6, 0.64, 1 / 700, 1.5]])
    view, sigma, specular, exponent = np.array([0.0, 0.0, 1.0]), 0.4, 0.2, 20.0
    reflectance = Reflectance("oren-nayar", sigma, specular, exponent)
    ours: list[Shading] = []
    result: list[FloatArray] = []

    def compiled() -> None:
        ours[:] = [shade_rows(position, normal, visible, lights, view, reflectance, np.ones(len(position)))]

    def reference() -> None:
        result[:] = _reference(position, normal, visible, lights, view, sigma, specular, exponent)

    timing = interleaved({"ours": compiled, "reference": reference}, runs)
    error = max(
        float(np.abs(a - b).max()) for a, b in zip((ours[0].light, ours[0].specular), result, strict=True)
    )
    ratio = timing["reference"].wall_s / timing["ours"].wall_s
    print(
        f"shading, {len(position)} points, 2 lights: kernel {1e3 * timing['ours'].wall_s:.1f} ms, "
        f"NumPy {1e3 * timing['reference'].wall_s:.1f} ms, {ratio:.1f}x; largest difference {error:.1e}"
    )


def _reference(
    position: FloatArray,
    normal: FloatArray,
    visible: NDArray[np.uint8],
    lights: FloatArray,
    view: FloatArray,
    sigma: float,
    specular: float,
    exponent: float,
) -> tuple[FloatArray, FloatArray]:
    light, gloss = np.ones(len(position)), np.zeros(len(position))
    n_v = normal @ view
    for row, seen in zip(lights, visible, strict=True):
        distance = math.inf if row[3] == 0 else 1 / row[3]
        vector = (
            np.tile(row[:3], (len(position), 1)) if math.isinf(distance) else row[:3] - position / distance
        )
        length = np.linalg.norm(vector, axis=1)
        unit = vector / length[:, None]
        n_l, l_v = np.einsum("ij,ij->i", normal, unit), unit @ view
        energy = seen * row[4] / length**2
        light += energy * brdf_reference.oren_nayar(n_l, n_v, l_v, sigma)
        gloss += energy * brdf_reference.phong(n_l, n_v, l_v, exponent)
    return light, specular * gloss


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--trimesh", action="store_true", help="time trimesh too (slow)")
    arguments = parser.parse_args()
    bench_rays(arguments.size, arguments.runs, arguments.trimesh)
    bench_shading(arguments.size, arguments.runs)


if __name__ == "__main__":
    main()
