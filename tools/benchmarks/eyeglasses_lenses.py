"""Light through lenses: pictures under some lights beside a reference of thousands of directions."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench.judging import picture_errors as errors
from worlds.environments import ENVIRONMENTS, reference_lights

from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import (
    DistantLights,
    LensMaterial,
    LensPictureOptions,
    Surface,
    insert_lenses,
)
from scan2albedo.eyeglasses.lenses.lens_picture import LensPicture
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import write_png
from scan2albedo.lighting.environment import LightSpread
from scan2albedo.synthetic import GlassesShape, eyeglasses
from scan2albedo.synthetic.renderer import RayScene
from scan2albedo.synthetic.wearer import fit_temples, seat

HEAD = "shape_person2"
_FEW_LIGHTS: tuple[tuple[LightSpread, int], ...] = (
    ("even", 64),
    ("even", 256),
    ("important", 64),
    ("important", 128),
    ("important", 256),
    ("important", 512),
)
_AT_ONCE = 1024
"""Of the reference's lights."""
SHAPE = GlassesShape(52, 40, 2.4, 18, 5, 3.2, 3.4, 260, 142, 3, 5, 3, 42)


@dataclass(frozen=True)
class LitGlasses:
    """A frame on a head before a camera."""

    frame: Surface
    keypoints: FloatArray
    head: Surface
    eyes: FloatArray
    """(3,) mm, middle between the eyes."""


def on_real_shaped_head(data: Path) -> LitGlasses:
    """Return a frame on a head of a light stage's face model, in one matte colour."""
    with np.load(data / "ict_faces.npz") as faces:
        vertices, triangles = np.asarray(faces[HEAD], np.float64), np.asarray(faces["faces"], np.int64)
        eyes = vertices[faces["landmarks68"][36:48]].mean(0)
    scene = RayScene(vertices, triangles)
    glasses = eyeglasses(shape=SHAPE, bend=fit_temples(SHAPE, 0, scene, eyes))
    world = seat(glasses, scene, eyes)
    return LitGlasses(
        Surface(transform_points(world, glasses.vertices), glasses.faces, (0.05, 0.05, 0.06)),
        transform_points(world, glasses.keypoints),
        Surface(vertices, triangles, (0.5, 0.38, 0.32), roughness_rad=0.3),
        eyes,
    )


def _picture(scene: LitGlasses, environment: FloatArray, lights: DistantLights, pixels: int) -> LensPicture:
    target = scene.eyes + [0.0, -18.0, -10.0]
    camera = look_at(target + [60.0, 20.0, 560.0], target, focal_px=4.0 * pixels, shape=(pixels, pixels))
    return insert_lenses(
        scene.frame,
        scene.keypoints,
        LensMaterial(dioptres=-3.0, beta=0.04, fresnel=True),
        surfaces=[scene.head],
        camera=camera,
        shape=(pixels, pixels),
        environment_linear=environment,
        lights=lights,
        options=LensPictureOptions(supersampling=1),
    )


def reference(scene: LitGlasses, environment: FloatArray, pixels: int) -> FloatArray:
    """Return the picture (H, W, 3) under the reference's lights, some at a time."""
    lights = reference_lights(environment)
    toward, strength = np.asarray(lights.directions), np.asarray(lights.irradiance_linear)
    total, nothing = np.zeros((pixels, pixels, 3)), np.zeros((1, 1, 3))
    for start in range(0, len(toward), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        # The environment is seen once.
        around = environment if start == 0 else nothing
        some = DistantLights(toward[part], strength[part])
        total += _picture(scene, around, some, pixels).image_linear
    return total


def bench_lenses(data: Path, pixels: int, pictures: Path | None) -> None:
    """Print errors and CPU seconds of evenly spread and of importance-placed lights."""
    if not data.is_dir():
        print(f"nothing is drawn: the head is in {data}, which is not there")
        return
    scene = on_real_shaped_head(data)
    _picture(scene, np.ones((2, 4, 3)), DistantLights([[0, 0, 1.0]], [1.0]), 32)
    print(f"{'light':8}{'lights':>20}{'rms error %':>13}{'worst of 100 %':>15}{'CPU s':>8}")
    for name, make in ENVIRONMENTS.items():
        environment = make()
        truth = reference(scene, environment, pixels)
        shown = {"reference": truth}
        for kind, count in _FEW_LIGHTS:
            cpu = time.process_time()
            lights = DistantLights.from_environment(environment, count, kind)
            made = _picture(scene, environment, lights, pixels).image_linear
            cpu = time.process_time() - cpu
            rms, worst = errors(made, truth)
            shown[f"{kind}_{count}"] = made
            print(f"{name:8}{f'{count} {kind}':>20}{100 * rms:13.2f}{100 * worst:15.2f}{cpu:8.2f}")
        if pictures is not None:
            _write(shown, pictures / f"lenses_{name}.png")


def _write(shown: dict[str, FloatArray], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    exposure = 0.6 / np.percentile(shown["reference"], 95)
    row = [shown["even_64"], shown["important_256"], shown["reference"]]
    write_png(path, encode_srgb_bytes(exposure * np.hstack(row)))
