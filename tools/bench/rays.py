"""Shadow rays beside Open3D's, and the shading kernel beside its NumPy reference.

Rays start at every texel of a face. `RayCaster` and Open3D get the same rays; `ShadowMap` answers for the
same texels, but shoots only where they face the light. "differ" counts texels that Open3D answers otherwise;
of the shading it is the largest difference from the reference.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import brdf_reference
import numpy as np
from numpy.typing import NDArray

from bench.runner import Bench, Case
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.lighting.shading import Reflectance, shade_rows
from scan2albedo.lighting.shadow_map import ShadowMap
from scan2albedo.synthetic import face

SIZE = 512
QUICK_SIZE = 128
DIRECTIONS = ((0.0, 0.0, 1.0), (0.7, 0.1, 0.7), (-0.5, -0.4, 0.75), (0.9, 0.0, 0.3))
OFFSET_MM = 0.2
LIGHTS = np.array([[0.6, 0.0, 0.8, 0.0, 2.0], [-0.48, 0.6, 0.64, 1 / 700, 1.5]])
"""Direction, 1 / distance in mm and strength of a distant light and a near one."""
SKIN = Reflectance("oren-nayar", 0.4, 0.2, 20.0)
TOWARD_CAMERA = np.array([0.0, 0.0, 1.0])


class Texels:
    """The texels of a face, what casts shadows on them, and the direction of a light."""

    def __init__(self, size: int, direction: tuple[float, float, float] = DIRECTIONS[0]) -> None:
        import open3d

        image = face(0, size=size).image
        vertices, faces = image.occluder_mesh()
        self.position = image.position[image.mask]
        self.normal = image.normal[image.mask]
        self.origins = self.position + OFFSET_MM * self.normal
        self.toward = np.array(direction) / np.linalg.norm(direction)
        self.caster = RayCaster(vertices, faces)
        self.shadows = ShadowMap(self.caster, self.position, self.normal, OFFSET_MM)
        self.peer = open3d.t.geometry.RaycastingScene()
        self.peer.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
        ahead = np.broadcast_to(self.toward, self.origins.shape)
        self.rays = open3d.core.Tensor(np.concatenate([self.origins, ahead], 1).astype(np.float32))


def differing(texels: Texels, answer: BoolArray | NDArray[np.uint8]) -> dict[str, float]:
    hidden = texels.peer.test_occlusions(texels.rays).numpy()
    if answer.dtype == np.uint8:
        facing = texels.normal @ texels.toward > 0
        return {"differ": float(np.sum((answer == 0) != (hidden | ~facing)))}
    return {"differ": float(np.sum(answer != hidden))}


def ray_cases(quick: bool) -> Iterator[Case]:
    for direction in DIRECTIONS:
        size = QUICK_SIZE if quick else SIZE
        name = "light from {:g} {:g} {:g}".format(*direction)
        yield Case(name, lambda size=size, direction=direction: Texels(size, direction))


@dataclass(frozen=True)
class LitPoints:
    """Points (N, 3), their normals, and which of `LIGHTS` reach them (2, N)."""

    position: FloatArray
    normal: FloatArray
    visible: NDArray[np.uint8]


def lit_points(size: int) -> LitPoints:
    image = face(0, size=size).image
    count = int(image.mask.sum())
    visible = (np.random.default_rng(0).random((len(LIGHTS), count)) > 0.2).astype(np.uint8)
    return LitPoints(image.position[image.mask], image.normal[image.mask], visible)


def kernel(points: LitPoints) -> tuple[FloatArray, FloatArray]:
    scale = np.ones(len(points.position))
    shading = shade_rows(points.position, points.normal, points.visible, LIGHTS, TOWARD_CAMERA, SKIN, scale)
    return shading.light, shading.specular


def reference(points: LitPoints) -> tuple[FloatArray, FloatArray]:
    light = np.ones(len(points.position))
    gloss = np.zeros(len(points.position))
    n_v = points.normal @ TOWARD_CAMERA
    for (*direction, nearness, strength), seen in zip(LIGHTS, points.visible, strict=True):
        # With q = 1 / distance, the light lies along d - q x and falls off as 1 / |d - q x|^2.
        vector = direction - nearness * points.position
        length = np.linalg.norm(vector, axis=1)
        unit = vector / length[:, None]
        n_l = np.einsum("ij,ij->i", points.normal, unit)
        l_v = unit @ TOWARD_CAMERA
        energy = seen * strength / length**2
        light += energy * brdf_reference.oren_nayar(n_l, n_v, l_v, SKIN.roughness)
        gloss += energy * brdf_reference.phong(n_l, n_v, l_v, SKIN.exponent)
    return light, SKIN.specular_strength * gloss


def off_reference(points: LitPoints, answer: tuple[FloatArray, FloatArray]) -> dict[str, float]:
    return {"differ": max(float(np.abs(a - b).max()) for a, b in zip(answer, reference(points), strict=True))}


BENCHES = {
    "shadows": Bench(
        ray_cases,
        methods={
            "RayCaster": lambda texels: texels.caster.occluded(texels.origins, texels.toward),
            "ShadowMap": lambda texels: texels.shadows.visible(texels.toward),
        },
        peers={"Open3D": lambda texels: texels.peer.test_occlusions(texels.rays).numpy()},
        score=differing,
        warm=True,
        repeats=9,
    ),
    "shading": Bench(
        lambda quick: [Case("two lights", lambda: lit_points(QUICK_SIZE if quick else SIZE))],
        methods={"kernel": kernel},
        peers={"NumPy": reference},
        score=off_reference,
        warm=True,
        repeats=9,
    ),
}
